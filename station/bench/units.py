"""The units in which the states of gyros are shown, as a bench file chooses them."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Units:
    """The unit of each state, for its value, sigma and limits alike; ``misalignment`` is that of both angles."""

    scale_factor_error: str = "ppm"
    bias: str = "deg/h"
    misalignment: str = "urad"


USUAL = Units()
"""What is usual in the field, where no bench file says otherwise."""
