"""The words of pictures: what a picture shows to those who cannot see it, and its caption."""

from collections.abc import Sequence
from dataclasses import dataclass

_STATE_NAMES = ("k", "b", "sigma j", "sigma k")


@dataclass(kw_only=True, frozen=True, slots=True)
class PictureWords:
    """The alternative text of a picture, and its caption."""

    alternative: str
    caption: str


@dataclass(kw_only=True, frozen=True, slots=True)
class LastEstimate:
    """The last estimate of a state and its sigma, in ``unit``."""

    value: float
    sd: float
    unit: str


def rates_words(quantity: str, span_s: float, largest: Sequence[str]) -> PictureWords:
    """Return the words for rates over ``span_s``; ``quantity`` says which, such as "rates of the body".

    ``largest`` has a text for each panel: its name and the range of its rate in deg/s.
    """
    return PictureWords(
        alternative=(
            f"Line plots of the {quantity} over {span_s:.0f} s, one panel each, in degrees per second: "
            f"{'; '.join(largest)}."
        ),
        caption=f"{quantity[0].upper()}{quantity[1:]} over time, as measured.",
    )


def convergence_words(gyro: str, last: Sequence[LastEstimate]) -> PictureWords:
    """Return the words for the live estimates of a gyro, whose four states end with ``last``."""
    figures = [
        f"{name} {state.value:.4g} ± {state.sd:.2g} {state.unit}"
        for name, state in zip(_STATE_NAMES, last, strict=True)
    ]
    return PictureWords(
        alternative=(
            f"Four line plots of the live estimates of {gyro} over time with bands of one sigma that narrow; "
            f"at the end: {', '.join(figures)}."
        ),
        caption=gyro,
    )


def nis_words(means: Sequence[str]) -> PictureWords:
    """Return the words for the innovations; ``means`` has a text for each source: its name and its mean NIS per dof."""
    return PictureWords(
        alternative=(
            "Line plot of the normalised innovations squared per degree of freedom over time, one line a source; "
            f"means of the run: {', '.join(means)}."
        ),
        caption=(
            "Innovations of the live filter: normalised squares per degree of freedom, 1 if the sigmas are correct."
        ),
    )


def allan_words(lowest: Sequence[str]) -> PictureWords:
    """Return the words for Allan deviations; ``lowest`` has a text for each gyro: its name and its lowest, in deg/h."""
    return PictureWords(
        alternative=(
            "Allan deviation at rest against averaging time, both logarithmic, one line a gyro; "
            f"lowest values in degrees per hour: {', '.join(lowest)}."
        ),
        caption="Overlapping Allan deviation while the table rested, with intervals of 95 %.",
    )


def residual_words(gyro: str, run: str, *, with_spectrum: bool, before_dph: float, after_dph: float) -> PictureWords:
    """Return the words for the picture of a gyro's residual in the run named ``run``.

    ``before_dph`` and ``after_dph`` are the rms of its block means in deg/h, before and after the traced effects were
    added. ``with_spectrum`` says whether the picture has the spectra.
    """
    drawn = "over time, against the rate and as a spectrum" if with_spectrum else "over time, against the rate"
    spectra = ", and its spectra" if with_spectrum else ""
    return PictureWords(
        alternative=(
            f"Residual of {gyro} before and after the traced effects were added, {drawn}; rms of its block means "
            f"{before_dph:.3g} and {after_dph:.3g} degrees per hour."
        ),
        caption=f"{gyro}: residual of {run} before and after{spectra}.",
    )
