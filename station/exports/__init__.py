"""Calibrations written for what is to use them: data, robotics tools, autopilots, source code."""
