"""The kinds of sensor that the station calibrates, one module each."""
