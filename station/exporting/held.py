"""What each form of an export holds, for people: read by the command line, so nothing is imported here."""

HELD: dict[str, tuple[str, str]] = {
    "json": ("everything that the calibration has", "nothing left out"),
    "yaml": ("the same", "nothing left out"),
    "csv": ("a line a gyro: axes, states, sigmas, effects", "no covariances, no uncertainty budget"),
    "c": ("C99 header with the correction function, effects included", "what no sample by itself can undo"),
    "python": ("Python module with the same, standard library only", "what no sample by itself can undo"),
    "ros": ("imu_calib YAML of three gyros: matrix and bias", "no effects"),
    "kalibr": ("imu.yaml of three gyros: noise, scale and misalignment, g-sensitivity", "no bias, no other effects"),
    "px4": ("CAL_GYROn offsets and TC_Gn temperature of three gyros", "no scale, no misalignment, no other effects"),
    "ardupilot": ("INS_GYROFFS offsets and INS_TCALn temperature", "no scale, no misalignment, no other effects"),
}
"""By the format's name: what it holds, what it does not."""
