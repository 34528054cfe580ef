"""States and further laws, estimated together under noise that is found from the data.

Block means go through the cosine transform (``spectra``), in which coloured noise is a weight for each frequency. Every
noise model is gone through: how much of it is bias instability and how much rate random walk is not known beforehand.
The estimate is the mean over them, so its covariance holds the doubt about the noise too. Gyros of one device are of
one make: what the others say of the noise is the better part of what is expected of each. Where the residual is beyond
all models, up or down, its own spectrum is the noise. Without laws this is the estimate of four states.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.effects.conditions import Conditions
from estimator.effects.effect import Effect
from estimator.errors import RecordingError
from estimator.estimation.evidence import Evidence, Term
from estimator.estimation.runs.measured import weighed
from estimator.estimation.runs.run import Run
from estimator.estimation.runs.samples import samples_of, tone_columns
from estimator.estimation.spectra import GyroSpectra, NoiseShapes, Z, cosines, gyro_spectra
from estimator.geometry.kinematics import EARTH_RATE_RPS
from estimator.geometry.noise import NoiseFound, NoiseModel
from estimator.observations.blocks import Blocks
from estimator.packaged import sentence
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import TableReadings
from estimator.types import Floats

_SURELY = 0.95  # probability from which on a report says that biases differ from file to file
_LEAST_ARW = 1e-9  # rad/s/rtHz, below any gyro
_ACCELERATING = 0.02  # change of rate from block to block, as a share of the largest rate, that counts as a ramp
_FEWEST_STEADY = 40
_ASIDE = 0.1  # weight of ramps while steady rates are fitted
_ROWS_A_COLUMN = 4  # with fewer the residual of the blocks gives no information on ramps


class TooShort(RecordingError):
    """Too few blocks to tell noise by its frequencies."""


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Law:
    """An effect estimated beside the states: expected mean and standard deviation of its parameters (p,).

    ``line`` names the line of the budget that holds what the data do not show of it; empty: it counts as noise. ``hz``
    is the frequency of a tone, ``source`` the only source that the effect acts on, empty for all.
    """

    called: str
    effect: Effect
    mean: Floats
    sd: Floats
    line: str = ""
    hz: float | None = None
    source: str = ""


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Joint:
    """Joint estimate of all gyros of some runs.

    ``means`` (c,) and ``covariances`` (c, c) by gyro are those of [states, laws]: laws in the order of ``laws``, a
    gyro's own before the shared ones, each parameter as its deviation from the expected value in units of its expected
    sigma. ``noise`` is the estimated noise; ``arw`` and ``white`` (gyros,) are the white noise in all of the residual
    and in the upper half of its frequencies. ``runs`` have the expected part of the laws subtracted; ``columns`` are by
    run those of the laws (m, b, p). ``weight`` (G, gyros) is the probability of each noise model for each gyro,
    ``expected_nis`` mean and standard deviation of the mean NIS of blocks.
    """

    runs: list[Run]
    laws: list[Law]
    columns: list[Floats]
    means: list[Floats]
    covariances: list[Floats]
    noise: list[NoiseFound]
    arw: Floats
    white: Floats
    expected_nis: tuple[float, float]
    weight: Floats
    evidence: Evidence

    def gyros_of(self, run: int) -> range:
        """Return which of the gyros are those of a run."""
        first = sum(len(r.array) for r in self.runs[:run])
        return range(first, first + len(self.runs[run].array))

    def run_of(self, gyro: int) -> tuple[Run, int]:
        """Return the run that a gyro is of, and its number there."""
        return next((r, gyro - its.start) for n, r in enumerate(self.runs) if gyro in (its := self.gyros_of(n)))

    def place_of(self, gyro: int) -> tuple[int, int]:
        """Return the number of the run that a gyro is of, and its number there."""
        return next((n, gyro - its.start) for n in range(len(self.runs)) if gyro in (its := self.gyros_of(n)))

    def shifts(self, gyro: int, columns: Floats) -> Floats:
        """Return by how much the states (4, p) of a gyro move if each of the columns (b, p), in rad/s over the blocks
        of its run, is added to its output error.
        """
        number, own = self.place_of(gyro)
        run, spectra = self.runs[number], self.evidence.gyros[gyro]
        weighed = run.weighed(columns, own)
        information: Floats = np.diag(np.concatenate([1 / spectra.prior, np.ones(len(self.means[gyro]) - 4)]))
        across = np.zeros((len(information), columns.shape[1]))
        for stretch, of_stretch in zip(spectra.stretches, spectra.columns, strict=True):
            weight = self.weight[:, gyro] @ (1 / self.evidence.density(spectra, stretch))
            root = np.sqrt(weight[stretch.band])[:, None]
            known = np.delete(of_stretch, Z, axis=1) * root
            new = cosines(weighed[stretch.blocks]) * (np.sqrt(stretch.length_s) / spectra.arw) * root
            information = information + known.T @ known
            across += known.T @ new
        return np.asarray(np.linalg.solve(information, across)[:4])

    def through(self, covariance: Floats, laws: Sequence[int]) -> Floats:
        """Return the part (4, 4) of the covariance of the states that is due to some laws."""
        at = np.concatenate([np.arange(len(covariance))[self.slice_of(n)] for n in laws])
        across = covariance[:4, at]
        return np.asarray(across @ np.linalg.solve(covariance[np.ix_(at, at)], across.T))

    def slice_of(self, law: int) -> slice:
        """Return where the parameters of a law are."""
        first = 4 + sum(len(one.sd) for one in self.laws[:law])
        return slice(first, first + len(self.laws[law].sd))

    def whitened(self, gyro: int) -> tuple[Floats, Floats]:
        """Return instants (b,) and rows (b, c + 1) of [states, z, laws], weighted so that their noise is white with
        variance one.

        Blocks outside the stretches that are long enough for a spectrum are left out.
        """
        from scipy.fft import idct

        spectra = self.evidence.gyros[gyro]
        parts = []
        for stretch, columns in zip(spectra.stretches, spectra.columns, strict=True):
            weight = (self.weight[:, gyro] @ (1 / self.evidence.density(spectra, stretch)))[stretch.band]
            parts.append(idct(columns * np.sqrt(weight)[:, None], axis=0, norm="ortho"))
        t_s = [self.runs[stretch.run].t_s[stretch.blocks] for stretch in spectra.stretches]
        return np.concatenate(t_s), np.vstack(parts)


def bias_notes(recording: Recording, weight: Floats, turn_on: Floats, arw: float) -> list[str]:
    """Return a sentence if noise models (G,) with biases that differ from file to file are by far likelier, else
    nothing.

    ``weight`` (G,) are the probabilities of the models, ``turn_on`` (G,) the standard deviation of the bias over the
    angle random walk ``arw``. Where no site is stated, biases within Earth rate are not reported: Earth rate may cause
    them.
    """
    size_rps = float(np.sqrt(weight @ turn_on**2)) * arw
    least_rps = 0.0 if recording.site is not None else EARTH_RATE_RPS
    if float(weight[turn_on > 0].sum()) < _SURELY or size_rps <= least_rps:
        return []
    return [sentence("estimation.biases_by_file", size_dph=3600 * np.degrees(size_rps))]


def joint_estimate(runs: Sequence[Run], laws: Sequence[Law] = (), stated: NoiseModel | None = None) -> Joint:
    """Return the joint estimate of the gyros of one device, each name once; ``stated`` is its data sheet's noise, which
    makes noise models near it likelier.

    Parameters of laws are deviations from their means, over their expected sigmas; shared laws come last, whatever
    their place in ``laws``. Blocks on ramps of the rate weigh less if they leave more than steady rates. Raises
    TooShort for a run without samples, or a gyro with too few blocks to tell noise by its frequencies.
    """
    ordered = sorted(laws, key=lambda law: law.effect.shared)
    columns = [columns_of(run, ordered) for run in runs]
    expected = expected_of(ordered)
    moved = [
        _steadied(replace(r, z_rps=r.z_rps - np.einsum("mbp,p->bm", c, expected)), c)
        for r, c in zip(runs, columns, strict=True)
    ]
    if not all(len(run.t_s) for run in moved):
        raise TooShort("no block holds samples")
    span_s = max(float(run.t_s[-1] - run.t_s[0]) + run.length_s for run in moved)
    several = any(run.recording.several_files for run in moved)
    shapes = NoiseShapes.over(span_s, stated, several=several, finely=True)
    evidence, terms = settled(moved, _spectra(moved, columns), shapes, ordered)
    white = np.array([gyro.arw for gyro in evidence.gyros])
    arw = np.maximum(white * np.sqrt(evidence.level), _LEAST_ARW)
    weight = evidence.noise_weights(terms)
    posterior = evidence.posterior(terms, weight)
    noise = [_noise(own, evidence.shapes, share) for own, share in zip(arw.tolist(), weight.T, strict=True)]
    white, chance = np.maximum(white, 1e-3 * arw), _expected_nis(evidence, weight)
    return Joint(
        runs=list(moved),
        laws=ordered,
        columns=columns,
        means=posterior.means,
        covariances=posterior.covariances,
        noise=noise,
        arw=arw,
        white=white,
        expected_nis=chance,
        weight=weight,
        evidence=evidence,
    )


def settled(
    runs: Sequence[Run], spectra: Sequence[GyroSpectra], shapes: NoiseShapes, laws: Sequence[Law]
) -> tuple[Evidence, list[Term]]:
    """Return the evidence of runs beside ordered laws, its noise taken from all that they leave, and their terms."""
    evidence, terms = Evidence(spectra, shapes), terms_of(laws)
    evidence.settle(terms, np.concatenate([np.full(len(r.array), r.stated_rps * np.sqrt(r.length_s)) for r in runs]))
    return evidence, terms


def run_of_blocks(source: str, data: ImuData, blocks: Blocks, reference: TableReadings) -> Run:
    """Return blocks as a run of one source, without conditions: only the states can be estimated for it.

    ``data`` may hold no samples. Blocks that are missing or less than half full have weight 0, others less than 1 where
    the noise grows with the rate; without any block the run is empty.
    """
    b, m = (int(blocks.index[-1]) + 1 if len(blocks.index) else 0), len(data.array)
    w, z, weight = np.zeros((b, 3)), np.zeros((b, m)), np.zeros(b)
    w[blocks.index], z[blocks.index] = blocks.w_rps, blocks.z_rps
    weight[blocks.index] = 2 * blocks.held_s >= blocks.length_s
    stretch = np.zeros(b, dtype=np.intp)
    weight, growth_s = weighed(w, z, weight, stretch)
    none = np.empty((0, 0))
    nowhere = Conditions(
        t_s=np.empty(0),
        w_rps=np.empty((0, 3)),
        wdot_rps2=np.empty((0, 3)),
        angle_rad=none,
        rate_rps=none,
        acceleration_rps2=none,
        gimbals=(),
        specific_force_mps2=np.empty((0, 3)),
    )
    return Run(
        name=source,
        source=source,
        data=data,
        length_s=blocks.length_s,
        t_s=np.asarray((np.arange(b) + 0.5) * blocks.length_s),
        w_rps=w,
        z_rps=z,
        weight=weight,
        stretch=stretch,
        grid=nowhere,
        fold=lambda columns: columns,
        recording=Recording({source: data}, reference),
        growth_s=growth_s,
    )


def columns_of(run: Run, laws: Sequence[Law]) -> Floats:
    """Return the block means (m, b, p) of the columns of all laws, times the expected sigma of each parameter.

    The columns of a law of another source are zero.
    """
    waves: dict[str, Floats] = {}
    if any(law.hz is not None for law in laws):
        samples = samples_of(run)
        waves = {law.called: tone_columns(law.hz, run, samples) for law in laws if law.hz is not None}
    found = np.empty((len(run.array), len(run.t_s), sum(len(law.sd) for law in laws)))
    for gyro, own in enumerate(found):
        first = 0
        for law in laws:
            columns = waves[law.called] if law.called in waves else run.columns(law.effect, gyro)
            own[:, first : first + len(law.sd)] = columns * law.sd * (law.source in ("", run.source))
            first += len(law.sd)
    return found


def expected_of(laws: Sequence[Law]) -> Floats:
    """Return the expected values of the parameters of some laws (p,), in their sigmas."""
    return np.concatenate([np.zeros(0), *(law.mean / law.sd for law in laws)])


def _steadied(run: Run, columns: Floats) -> Run:
    """Return a run in which blocks on ramps weigh less, as far as their residual exceeds that at steady rates.

    ``columns`` (gyros, blocks, p) are those of the laws, fitted together with the states. All gyros get one factor,
    from the mean of what their variances exceed chance by. While an axis accelerates, the table's readings are off by
    their timing and by what lies between two readings. The same run is returned for turns with stated noise, without
    ramps, and with too few blocks.
    """
    good = np.flatnonzero(run.weight > 0)
    if run.stated_rps or len(good) < _ROWS_A_COLUMN * (4 + columns.shape[2]):
        return run
    size = float(np.abs(run.w_rps[good]).max(initial=0.0))
    change = np.abs(np.diff(run.w_rps, axis=0, prepend=run.w_rps[:1])).max(axis=1)
    ramp = (np.maximum(change, np.append(change[1:], 0.0)) > _ACCELERATING * size)[good]
    if not ramp.any() or (~ramp).sum() < _FEWEST_STEADY:
        return run
    # Columns that only ramps show are fitted to them, everything else to steady rates.
    states, row, shares = run.state_columns()[:, good], np.where(ramp, _ASIDE, 1.0), []
    for i, own in enumerate(columns[:, good]):
        both, z = np.hstack([states[i], own]) * run.weight[good, None], run.z_rps[good, i] * run.weight[good]
        scale = np.maximum(np.linalg.norm(both, axis=0), 1e-300)
        rest = z - both @ (np.linalg.lstsq(both / scale * row[:, None], z * row, rcond=1e-8)[0] / scale)
        steady = float(np.mean(rest[~ramp] ** 2))
        # Only the excess over chance: the mean square of a few values has this much scatter of its own.
        excess = float(np.mean(rest[ramp] ** 2)) - steady * (1 + 2 * np.sqrt(2 / ramp.sum()))
        shares.append(max(excess, 0.0) / max(steady, 1e-30))
    weight = run.weight.copy()
    weight[good[ramp]] /= np.sqrt(1 + np.mean(shares))
    return replace(run, weight=weight)


def _spectra(runs: Sequence[Run], columns: Sequence[Floats]) -> list[GyroSpectra]:
    spectra = gyro_spectra(runs)
    if [gyro.name for gyro in spectra] != [name for run in runs for name in run.array.names]:
        raise TooShort("too few blocks of a gyro follow on each other")
    for gyro in spectra if columns[0].shape[2] else ():
        gyro.add(gyro.parts(runs, lambda number, own: columns[number][own]))
    return spectra


def terms_of(laws: Sequence[Law]) -> list[Term]:
    """Return ordered laws as terms: one of all laws of single gyros, one of all shared ones; a term without columns is
    left out.

    Their columns, scaled by the expected sigmas, come after that of the output error.
    """
    count = [sum(len(law.sd) for law in laws if law.effect.shared == shared) for shared in (False, True)]
    own, shared = range(Z + 1, Z + 1 + count[0]), range(Z + 1 + count[0], Z + 1 + sum(count))
    both = Term("own", tuple(own), shared=False), Term("shared", tuple(shared), shared=True)
    return [term for term in both if term.columns]


def _expected_nis(evidence: Evidence, weight: Floats) -> tuple[float, float]:
    """Return mean and standard deviation of the mean NIS of blocks that the estimated noise predicts, per unit of white
    noise.

    ``weight`` (G, gyros) are the probabilities of the noise models. The mean of each stretch does not count.
    """
    total = squares = count = 0.0
    for gyro, own in zip(evidence.gyros, weight.T, strict=True):
        for stretch in gyro.stretches:
            density = (own @ evidence.shapes.density(stretch))[1:]  # the mean of a stretch is the bias
            counts = stretch.counts[1:]
            total += float(counts @ density)
            squares += float(2 * counts @ density**2)
            count += float(counts.sum())
    return total / count, float(np.sqrt(squares)) / count


def _noise(arw: float, shapes: NoiseShapes, weight: Floats) -> NoiseFound:
    instability, walk = shapes.instability * arw, shapes.walk * arw
    mean = NoiseModel(arw, float(weight @ instability), float(weight @ walk))
    below = (np.quantile(one, 0.95, weights=weight, method="inverted_cdf") for one in (instability, walk))
    return NoiseFound(mean, *(float(one) for one in below))
