"""Talk to devices: links (bytes, CAN frames), protocols, turntables, IMUs. Nothing here knows a twin."""
