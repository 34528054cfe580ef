"""The application: bench file, scripts, sequencer, session, reports, command line."""
