"""What the resolution of a table's encoders leaves open: an axis at rest stands off its reading by up to half a count.

A count of 2 pi / 65536 is 1 mm/s2 of gravity, and no averaging reduces it. But a drive that goes to whole counts stands
on them, so how large these errors are is asked of the data: of what the rests leave beside noise. They are not
subtracted: together they would take the wandering of the biases for theirs.
"""

from dataclasses import replace

import numpy as np

from estimator.estimation.accelerometers.force_runs import ForceRun
from estimator.estimation.noise_evidence import Joint, Law, joint_estimate, terms_of
from estimator.geometry.noise import NoiseModel
from estimator.types import Floats

SCALES = np.array([1e-3, 0.25, 0.5, 0.75, 1.0])
"""Sizes of the errors to choose among, of that of angles which are anywhere within their count."""


def resolution_covariance(joint: Joint, run: ForceRun, law: Law, noise: NoiseModel | None) -> Floats:
    """Return the covariance (4 a, 4 a) of the states x of all accelerometers that comes from rounded angles.

    ``law`` is that of the angles at rest, at the size of angles that are anywhere within their count; ``noise`` is that
    of the data sheet.
    """
    columns = [run.columns(law.effect, number) * law.sd for number in range(len(run.array))]
    moved = np.concatenate([joint.shifts(number, own) for number, own in enumerate(columns)])
    return np.asarray(moved @ moved.T) * _mean_square(joint, run, law, noise)


def _mean_square(joint: Joint, run: ForceRun, law: Law, noise: NoiseModel | None) -> float:
    """Return the mean square of the size of the errors, 1 for angles that are anywhere within their count."""
    rich = joint_estimate([run], [*joint.laws, law], noise)
    own, shared = terms_of(rich.laws)
    others = len(shared.columns) - len(law.sd)
    logs = []
    for scale in SCALES.tolist():
        sizes = (1.0,) * others + (scale,) * len(law.sd)
        logs.append(rich.evidence.of([own, replace(shared, sizes=sizes)]))
    weights = np.exp(np.array(logs) - max(logs))
    return float(weights @ SCALES**2 / weights.sum())
