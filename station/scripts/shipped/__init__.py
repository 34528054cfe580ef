"""Scripts that come with the station, one file each."""
