"""The residual of a model against the noise model: its size, whiteness, spectrum, and dependences.

All is worked out in the cosine domain, where bias instability and random walk are a weight for each frequency
(``spectra``). The mean of each stretch is left out: it holds the bias since power-on, of which nothing is known.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.estimation.runs.run import Run, with_gyro
from estimator.estimation.spectra import Stretch, cosines
from estimator.tracing.augmented import Augmented
from estimator.tracing.residuals.dependence import Dependence, Group, Regressors, dependences
from estimator.tracing.residuals.origin import WHITE_DOUBT, Origin, Split, shape_of, split_of
from estimator.types import Floats

_LAGS = 20
_BANDS_A_DECADE = 5
_FEWEST_IN_BAND = 4
_FEWEST_BLOCKS = 10
_BEYOND = 4.0  # sigmas
BY_CHANCE = 1e-4
"""What white noise shows less often than this is not white."""


@dataclass(frozen=True, slots=True, eq=False)
class Spectrum:
    """One-sided density of a residual and of its noise model in (rad/s)^2/Hz, at the frequencies of bands; (f,)
    each.
    """

    frequency_hz: Floats
    density: Floats
    noise: Floats


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class GyroResidual:
    """The residual of one gyro under a model, whitened by its noise model.

    ``nis`` is the mean square, 1 for noise, ``nis_sd`` its standard deviation by chance. ``lag1`` is the
    autocorrelation from one block to the next, with its standard deviation; ``white_p`` the probability that white
    noise shows as much at twenty lags (Ljung and Box 1978). ``beyond`` is the share of the power beyond the noise, of
    which ``dependences`` hold shares.
    """

    name: str
    nis: float
    nis_sd: float
    lag1: float
    lag1_sd: float
    white_p: float
    spectrum: Spectrum
    beyond: float
    dependences: tuple[Dependence, ...]

    @property
    def white(self) -> bool:
        """Whether it passes for white noise."""
        return self.white_p >= BY_CHANCE

    @property
    def clean(self) -> bool:
        """Whether it passes for the noise of the model: no larger, white, depending on nothing."""
        return self.white and not self.beyond


@dataclass(frozen=True, slots=True, eq=False)
class Residual:
    """The residual of some runs under a model: by gyro, and split by its origin.

    ``split`` is None where that is unknown, with ``no_split`` as the reason.
    """

    gyros: tuple[GyroResidual, ...]
    split: Split | None
    no_split: str = ""

    @property
    def clean(self) -> bool:
        """Whether it counts as noise, in every gyro and in their common part."""
        return all(gyro.clean for gyro in self.gyros) and (self.split is None or self.split.origin == Origin.NOISE)

    def share_of(self, variable: str) -> float:
        """Return the share of the power beyond the noise that depends on a variable, over all gyros.

        1 for a variable that is not among those of the dependences; 0 if no power is beyond the noise.
        """
        power = taken = 0.0
        for gyro in self.gyros:
            own = {dependence.variable: dependence.share for dependence in gyro.dependences}
            power += gyro.nis * gyro.beyond
            taken += gyro.nis * gyro.beyond * own.get(variable, 1.0)
        return taken / power if power else 0.0


@dataclass(kw_only=True, slots=True, eq=False)
class _Gyro:
    """Stretches of one gyro in the cosine domain, divided by the noise; ``rests`` are (b, models).

    ``gram`` holds the products of all columns: those of regressors, of each model, then each model's residual.
    """

    arw: float
    stretches: list[Stretch]
    shapes: list[Floats]
    rests: list[Floats]
    gram: Floats
    blocks: float


def residuals(
    runs: Sequence[Run], models: Sequence[Augmented], first: int = 0, *, held_back: bool = False
) -> list[Residual]:
    """Return the residual of runs under each of some models; ``first`` is the number of the first run among all.

    The models have the same gyros and noise. ``held_back``: the models were not fitted to these runs, so that states
    that do not fit them count as a dependence, and their uncertainty is expected in the residual. Gyros without a
    stretch that is long enough are left out.
    """
    regressors = Regressors(runs)
    left = [[run.z_rps.copy() for run in runs] for _ in models]
    found: list[list[GyroResidual]] = [[] for _ in models]
    for name in models[0].names:
        gyro = _whitened(name, runs, models, first, left, regressors)
        if gyro is not None:
            for m in range(len(models)):
                found[m].append(_gyro_residual(name, gyro, m, models, regressors, held_back))
    splits = [split_of(runs, rest, model) for rest, model in zip(left, models, strict=True)]
    return [Residual(tuple(gyros), *split) for gyros, split in zip(found, splits, strict=True)]


def _whitened(
    name: str,
    runs: Sequence[Run],
    models: Sequence[Augmented],
    first: int,
    left: Sequence[Sequence[Floats]],
    regressors: Regressors,
) -> _Gyro | None:
    """Return the whitened columns and residuals of gyro ``name`` in all runs; None without a long enough stretch.

    What the states and effects of each model give is subtracted in place from ``left``, arrays (b, m) by model and run.
    ``first`` is the number of the first run among all; shorter stretches and runs without the gyro are left out.
    """
    g = models[0].names.index(name)
    arw = float(models[0].arw[g])
    gyro = _Gyro(arw=arw, stretches=[], shapes=[], rests=[], gram=np.zeros(()), blocks=0.0)
    for number, run, i in with_gyro(runs, name):
        columns = [model.columns(run, first + number, i) for model in models]
        for its, own, model in zip(left, columns, models, strict=True):
            its[number][:, i] -= own @ model.mean[g]
        rests = np.column_stack([its[number][:, i] for its in left])
        whole = run.weighed(np.hstack([regressors.columns(number, i), *columns, rests]), i) / arw
        for blocks in run.stretches():
            good = float((run.weight[blocks] > 0).sum())
            if good < _FEWEST_BLOCKS:
                continue
            stretch = Stretch.of(number, blocks, run.length_s, True)
            shape = shape_of(models[0], stretch)
            white = cosines(whole[blocks]) * np.sqrt(run.length_s / shape)[:, None]
            white[0] = 0.0
            gyro.stretches.append(stretch)
            gyro.shapes.append(shape)
            gyro.rests.append(white[:, -len(left) :])
            gyro.gram = gyro.gram + white.T @ white
            gyro.blocks += good - 1
    return gyro if gyro.stretches else None


def _gyro_residual(
    name: str, gyro: _Gyro, m: int, models: Sequence[Augmented], regressors: Regressors, held_back: bool
) -> GyroResidual:
    """Return the residual of gyro ``name`` under ``models[m]``: how large it is, how white, and what it depends on.

    ``gyro`` is as ``_whitened`` returns it for these ``models`` and ``regressors``, the functions of known variables
    that the residual may depend on. The expected squares, at least 1, are the number of blocks less what a fit removes.
    With ``held_back`` the models were not fitted to these data: their uncertainty is added instead, and the four states
    count as a dependence too.
    """
    model, gram = models[m], gyro.gram
    ends = np.cumsum([regressors.count, *(other.mean.shape[1] for other in models)])
    own = np.arange(ends[m], ends[m + 1])
    rest = int(ends[-1]) + m
    # A fit removes so many squares; for runs that were not fitted, its uncertainty adds as many.
    fitted = _doubt(model, name, gram, own)
    expected = max(gyro.blocks + fitted if held_back else gyro.blocks - fitted, 1.0)
    nis_sd = float(np.sqrt(2 / expected + WHITE_DOUBT**2 / (0.5 * gyro.blocks)))
    states, none = own[:4], own[:0]
    groups = {v: Group(columns, states if held_back else own) for v, columns in regressors.where.items()}
    if held_back:
        groups["states"] = Group(states, none, _doubt(model, name, gram, states))
    parts = [part[:, m] for part in gyro.rests]
    lag1, white_p = _whiteness(parts)
    beyond, found = dependences(gram, rest, groups, expected, _BEYOND * nis_sd * expected)
    return GyroResidual(
        name=name,
        nis=float(gram[rest, rest]) / expected,
        nis_sd=nis_sd,
        lag1=lag1,
        lag1_sd=float(1 / np.sqrt(gyro.blocks)),
        white_p=white_p,
        spectrum=_spectrum(gyro, parts),
        beyond=beyond,
        dependences=found,
    )


def _doubt(model: Augmented, name: str, gram: Floats, columns: NDArray[np.intp]) -> float:
    """Return the squares over the noise that the uncertainty of a model's first parameters adds."""
    covariance = model.covariance[model.names.index(name), : len(columns), : len(columns)]
    return float(np.sum(covariance * gram[np.ix_(columns, columns)]))


def _whiteness(parts: Sequence[Floats]) -> tuple[float, float]:
    """Return the autocorrelation from one block to the next, and the probability that white noise shows as much.

    The latter is for the first 20 lags together. ``parts`` are the whitened coefficients of each stretch.
    """
    from scipy.fft import idct
    from scipy.special import chdtrc  # of the chi-square distribution; scipy.stats takes a second to import

    series = [np.asarray(idct(part, norm="ortho")) for part in parts]
    n = sum(len(x) for x in series)
    power = max(sum(float(x @ x) for x in series), 1e-300)
    lags = np.arange(1, min(_LAGS, max(len(x) for x in series) - 1) + 1)
    rho = np.array([sum(float(x[lag:] @ x[:-lag]) for x in series) for lag in lags]) / power
    return float(rho[0]), float(chdtrc(len(lags), n * (n + 2) * np.sum(rho**2 / (n - lags))))


def _spectrum(gyro: _Gyro, parts: Sequence[Floats]) -> Spectrum:
    """Return the mean densities of the residual and its noise within bands, over all stretches together.

    ``parts`` are the whitened coefficients of each stretch; the means of stretches do not count.
    """
    hz = np.concatenate([s.frequency_hz[1:] for s in gyro.stretches])
    noise = np.concatenate([2 * gyro.arw**2 * shape[1:] for shape in gyro.shapes])
    density = noise * np.concatenate([part[1:] for part in parts]) ** 2
    lowest = np.sort(hz)[:_FEWEST_IN_BAND][-1]  # single coefficients say nothing about the spectrum
    _, band = np.unique(np.floor(_BANDS_A_DECADE * np.log10(np.maximum(hz, lowest))), return_inverse=True)
    counts = np.bincount(band)
    return Spectrum(*(np.bincount(band, values) / counts for values in (hz, density, noise)))
