"""Disturbances: tones, a random walk of the bias, faults of the data.

A random walk is no law but noise: it has a strength that is estimated with the noise, and nothing to take off. Faults
are seen in the samples, which are left out.
"""

from dataclasses import replace

import numpy as np

from estimator.effects.conditions import Axes, Conditions
from estimator.effects.dynamics import LATENCY
from estimator.effects.effect import Kind, Odds, Parameter, Record, Regressors, Setting, Settings
from estimator.types import Floats

TONE_HZ = 2.3
"""Nominal frequency of a tone: below half the rate of every source, and no multiple of a script's steps."""
_IN_THE_DATA = "it is a fault of the data, not of the gyros"


def _waves(settings: Settings) -> Regressors:
    """Return cosine and sine of a frequency."""
    turning_rps = 2 * np.pi * float(settings["frequency_hz"])

    def columns(conditions: Conditions, axes: Axes) -> Floats:
        phase = turning_rps * conditions.t_s
        return np.column_stack([np.cos(phase), np.sin(phase)])

    return columns


RECORDS = (
    TONE := Record(  # a vibration or an alias of the mains, up to 0.5 deg/s
        name="tone",
        parameters=tuple(
            Parameter(f"{part} at {{frequency_hz:g}} Hz", "rad/s", float(np.radians(0.5)))
            for part in ("cosine", "sine")
        ),
        regressors=_waves,
        formula="cosine and sine of the frequency",
        shown_by="samples faster than twice its frequency",
        settings=(Setting("frequency_hz", "frequency", "Hz", "{:g} Hz".format),),
        searched=False,
        listed=lambda duration_s: ({"frequency_hz": TONE_HZ},),
        left_out="its phase is another each time: a notch filter takes it away",
        any_phase=True,
    ),
    Record(
        name="bias_walk",
        kind=Kind.NOISE,
        parameters=(Parameter("rate random walk", "rad/s/rts", float(np.radians(100 / 3600 / 60))),),
        shown_by="long rests",
        confused_with=("bias_drift", "warm_up"),
        not_kept="it is noise",
    ),
    SAMPLE_HOLD := replace(
        LATENCY,
        name="sample_hold",
        kind=Kind.SAMPLES,
        shown_by="samples that repeat in a rhythm, and ramps",
        confused_with=("latency",),
        settings=(Setting("", "samples held", "1"),),
        depends_on="",
        suspected_of=(),
        odds=Odds(6.0),  # that they are held is seen in them
        within_turns=False,
    ),
    SATURATION := Record(
        name="saturation",
        kind=Kind.SAMPLES,
        parameters=(),
        settings=(Setting("", "limit", "rad/s"),),
        shown_by="rates beyond the range",
        confused_with=("scale_cubic",),
        not_kept=_IN_THE_DATA,
    ),
    STUCK := Record(
        name="stuck",
        kind=Kind.SAMPLES,
        parameters=(),
        settings=(Setting("", "from", "s"), Setting("", "until", "s")),
        shown_by="any motion",
        confused_with=("dead_band",),
        not_kept=_IN_THE_DATA,
    ),
)
