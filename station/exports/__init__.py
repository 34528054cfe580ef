"""Calibrations written for what is to use them: data, robotics tools, autopilots, source code."""

from drivers.packaged import packaged_toml

HELD: dict[str, tuple[str, str]] = {
    form: (holds, lacks) for form, (holds, lacks) in packaged_toml("station.exports", "held.toml").items()
}
"""What each form of an export holds, by its name, and what it does not: for --help, which imports no numpy."""
