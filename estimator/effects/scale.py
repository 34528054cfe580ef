"""Scale factors that depend on the rate itself; u is the rate about the sense axis."""

import numpy as np

from estimator.effects.conditions import Axes, Conditions
from estimator.effects.effect import Odds, Parameter, Record, Regressors, Setting, Settings
from estimator.types import Floats

_LOST = 0.3  # share of the rate within a dead band that may be missing to all of it


def _within(settings: Settings) -> Regressors:
    """Return the columns of a gyro that does not answer rates within a band."""

    def columns(conditions: Conditions, axes: Axes) -> Floats:
        u = conditions.w_rps @ axes.p
        return np.asarray(np.where(np.abs(u) <= float(settings["width_rps"]), -u, 0.0))

    return columns


def _all_of_it(sizes: Floats) -> bool:
    """Return whether shares of the rate (gyros, 1) are lost to a dead band: within one a gyro loses all rates."""
    return bool(np.any(np.abs(sizes - 1) < _LOST)) and bool(np.all(sizes > -_LOST))


RECORDS = (
    # Directions that differ by twice the parameter: some 100 ppm in tactical, some 1000 ppm in automotive MEMS gyros.
    SCALE_ASYMMETRY := Record(
        name="scale_asymmetry",
        parameters=(Parameter("each direction", "1", 5e-3),),
        law="abs(u)",
        shown_by="turns in both directions about each axis",
        confused_with=("scale_quadratic",),
        depends_on="rate",
        suspected_of=("rate",),
    ),
    SCALE_QUADRATIC := Record(  # up to 1 % of full scale at 30 deg/s
        name="scale_quadratic",
        parameters=(Parameter("u^2", "1/(rad/s)", 2e-2),),
        law="u**2",
        shown_by="three rates and more in each direction",
        confused_with=("scale_asymmetry", "scale_cubic"),
        depends_on="rate",
        suspected_of=("rate",),
        power=2,
    ),
    SCALE_CUBIC := Record(  # up to 1 % of full scale at 30 deg/s
        name="scale_cubic",
        parameters=(Parameter("u^3", "1/(rad/s)2", 3e-2),),
        law="u**3",
        shown_by="three rates and more in each direction",
        confused_with=("scale_quadratic",),
        depends_on="rate",
        suspected_of=("rate",),
        power=3,
    ),
    DEAD_BAND := Record(
        name="dead_band",
        parameters=(Parameter("share of the rate that is lost", "1", 1.0),),
        regressors=_within,
        formula="-u within the band",
        shown_by="slow turns and ramps through zero",
        confused_with=("scale_asymmetry",),
        settings=(
            Setting(
                "width_rps",
                "width",
                "rad/s",
                lambda width_rps: f"{np.degrees(width_rps):.3g} deg/s",
                grid=lambda span_s, count: np.radians(np.geomspace(0.01, 3.0, 12)),
                begin=6,
                range_log=5.0,
            ),
        ),
        needs=frozenset({"gimbals"}),  # a rate measured by another gyro or encoder has steps of its own about zero
        odds=Odds(-1.5),
        plausible=_all_of_it,
        planned=False,
        listed=lambda duration_s: ({"width_rps": float(np.radians(0.1))},),
        left_out="what a gyro does not answer cannot be got back",
        of_encoders=True,
    ),
)
