"""What the resolution of a table's encoders leaves open: an axis stands off its reading by up to half a count.

A count of 2 pi / 65536 is 1 mm/s2 of gravity, and no averaging reduces it. But a drive that goes to whole counts stands
on them, so how large these errors are is asked of the data: of what the poses leave beside noise. They are estimated
with the states, under the noise that was found without them: together with the noise they would take the wandering of
the biases for theirs.
"""

from dataclasses import replace

import numpy as np

from estimator.estimation.evidence import Evidence
from estimator.estimation.noise_evidence import Joint, Law, columns_of, settled, terms_of
from estimator.types import Floats

SCALES = np.array([1e-3, 0.25, 0.5, 0.75, 1.0])
"""Sizes of the errors to choose among, of that of angles which are anywhere within their count."""


def with_rest_angles(joint: Joint, law: Law) -> tuple[Joint, float]:
    """Return the estimate of one run with the angles of axes that stand as its last law, and the size of their errors.

    The noise is that which was found without the law. The estimate is the mean over the sizes that the errors may have,
    each as probable as the data make it. ``law`` is that of the angles at the size of those that are anywhere within
    their count; the size returned (0 to 1) is the root mean square over that one.
    """
    laws = [*joint.laws, law]
    columns = columns_of(joint.runs[0], [law])
    spectra = [replace(own) for own in joint.evidence.gyros]
    for own in spectra:
        own.add(own.parts(joint.runs, lambda _, number: columns[number]))
    apart, shared = terms_of(laws)
    others = len(shared.columns) - len(law.sd)
    sized = [replace(shared, sizes=(1.0,) * others + (scale,) * len(law.sd)) for scale in SCALES.tolist()]
    beside, _ = settled(joint.runs, spectra, joint.evidence.shapes, laws)
    logs = np.array([beside.of([apart, term]) for term in sized])
    chances = np.exp(logs - logs.max())
    chances /= chances.sum()
    evidence = Evidence(spectra, joint.evidence.shapes, joint.evidence.excess)
    found = [evidence.posterior([apart, term], joint.weight) for term in sized]
    means: list[Floats] = []
    covariances: list[Floats] = []
    for number in range(len(joint.means)):
        each = np.array([one.means[number] for one in found])
        within = np.array([one.covariances[number] for one in found])
        mean = chances @ each
        spread = each - mean
        means.append(mean)
        covariances.append(np.einsum("s,sij->ij", chances, within + spread[:, :, None] * spread[:, None, :]))
    both = [np.concatenate([joint.columns[0], columns], axis=2)]
    whole = replace(joint, laws=laws, columns=both, means=means, covariances=covariances, evidence=evidence)
    return whole, float(np.sqrt(chances @ SCALES**2))
