"""What each form of an export holds, for people: read by the command line, so nothing is imported here."""

from drivers.packaged import packaged_toml

HELD: dict[str, tuple[str, str]] = {
    form: (holds, lacks) for form, (holds, lacks) in packaged_toml("station.exports", "held.toml").items()
}
"""By the format's name: what it holds, what it does not."""

GROUP = "turntable_station.exports"
"""Entry points of packages that bring forms of their own."""
