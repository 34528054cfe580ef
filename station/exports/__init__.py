"""Calibrations written for their users: data, robotics tools, autopilots, source code."""

GROUP = "turntable_station.exports"
"""Entry points of packages that bring forms of their own: each names a ``station.exports.formats.Format``."""
