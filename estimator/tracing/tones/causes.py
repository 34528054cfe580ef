"""Which tones have a cause of their own: neither images of others by sampling nor too weak to matter."""

from collections.abc import Sequence

import numpy as np

from estimator.estimation.evidence import Evidence
from estimator.estimation.runs.run import Run, with_gyro
from estimator.tracing.augmented import Augmented, Part
from estimator.tracing.residuals.residual import Residual
from estimator.types import Floats

_FAINT = 0.1  # share of the power beyond the noise, 5 % of its size
_MOST_HELD = 6  # samples for which a logger may keep a value, or between which it may interpolate
_RESOLVED = 2.0  # of one over the length of a run: nearer than this frequencies are one
_ALIKE = 0.98  # cosine of the angle between the sizes that two lines have in the gyros


def images(parts: Sequence[Part], runs: Sequence[Run]) -> dict[str, list[Part]]:
    """Return by candidate name of a tone the other, weaker tones that sampling makes of it; tones without any are left
    out.

    If values are held or interpolated over some samples, a line appears again beside each multiple of their rate, with
    the same ratio of sizes between gyros. Only tones later in ``parts`` count, each for one cause.
    """
    found: dict[str, list[Part]] = {}
    taken: set[str] = set()
    lines = [part for part in parts if part.tone is not None]
    for number, part in enumerate(lines):
        for other in lines[number + 1 :]:
            if other.candidate.name not in taken and _is_image(part, other, runs):
                found.setdefault(part.candidate.name, []).append(other)
                taken.add(other.candidate.name)
    return found


def _is_image(part: Part, other: Part, runs: Sequence[Run]) -> bool:
    """Return whether tone ``other`` may be an image of tone ``part``.

    It must be no stronger, have the same ratio of sizes between gyros, and the sum or difference of frequencies must be
    a multiple of the sample rate, that of the first of ``runs``, over 1 to 6.
    """
    assert part.tone is not None
    assert other.tone is not None
    sizes, others = _sizes(part), _sizes(other)
    if float(np.linalg.norm(others)) > float(np.linalg.norm(sizes)):
        return False
    if float(sizes @ others) < _ALIKE * float(np.linalg.norm(sizes) * np.linalg.norm(others)):
        return False
    own_hz, other_hz = part.tone.found.frequency_hz, other.tone.found.frequency_hz
    rate_hz = 1e9 / float(np.median(np.diff(runs[0].data.t_ns)))
    near_hz = _RESOLVED / max(float(run.t_s[-1] - run.t_s[0]) for run in runs)
    apart = [own_hz + other_hz, abs(own_hz - other_hz)]
    for held in range(1, _MOST_HELD + 1):
        each_hz = rate_hz / held
        if any(abs(hz / each_hz - round(hz / each_hz)) * each_hz < near_hz and hz > near_hz for hz in apart):
            return True
    return False


def _sizes(part: Part) -> Floats:
    """Return the amplitude of a tone in each gyro (n,)."""
    assert part.tone is not None
    return np.array([float(np.linalg.norm(amplitude)) for amplitude in part.tone.amplitude.values()])


def faint(
    parts: Sequence[Part], evidence: Evidence, runs: Sequence[Run], model: Augmented, left: Residual
) -> list[Part]:
    """Return the tones that explain less than a tenth of the power beyond the noise, over all gyros of ``evidence``.

    That power is what the tone explains and what ``left``, the residual of ``model``, still has. Parts other than tones
    are left out.
    """
    beyond = {gyro.name: gyro.nis * gyro.beyond for gyro in left.gyros}
    found = []
    for part in (part for part in parts if part.tone is not None):
        where = model.slice_of(part.candidate.name)
        taken = rest = 0.0
        for gyro in evidence.gyros:
            g = model.names.index(gyro.name)
            for number, run, i in with_gyro(runs, gyro.name):
                wave = model.columns(run, number, i)[run.weight > 0][:, where] @ model.mean[g, where]
                taken += float(wave @ wave) * run.length_s / gyro.arw**2
                rest += len(wave) * beyond.get(gyro.name, 0.0)
        if taken < _FAINT * (taken + rest):
            found.append(part)
    return found
