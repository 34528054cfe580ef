"""One device in several mountings on a table: what each run shows of it, joined to one calibration."""
