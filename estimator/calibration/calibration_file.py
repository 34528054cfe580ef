"""Results in the recording they come from, in the group /calibration: written and read back."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from estimator.calibration.budget import Contribution
from estimator.calibration.error_model import ErrorModel
from estimator.calibration.force_text import forces_of, forces_text
from estimator.calibration.gyro import EffectValue, GyroCalibration
from estimator.calibration.values import Calibration
from estimator.errors import MISSHAPEN, RecordingError
from estimator.geometry.model import STATES
from estimator.geometry.noise import NoiseFound, NoiseModel
from estimator.observations.allan.sensor import SensorNoise
from estimator.observations.allan.spectrum import TERMS
from estimator.observations.coverage import coverage_object, coverage_of
from estimator.observations.health import Excluded
from estimator.packaged import sentence
from estimator.recordings.reading import read_array
from estimator.recordings.recovery import recover
from estimator.recordings.safe_open import probe
from estimator.recordings.writing import plain, write_results
from estimator.types import Floats


def write_calibration(path: Path, calibration: Calibration, attributes: dict[str, object] | None = None) -> None:
    """Write the group /calibration of a file anew: datasets by gyro, attributes, and ``attributes`` added to these.

    Always there are ``name``, ``source``, ``states`` and ``sd`` (n, 4), ``covariance`` (n, 4, 4) and ``noise_rps``
    (n,). If known for all gyros: ``noise`` (n, 3) with upper 95 % limits ``noise_below`` (n, 2); noise at rest and
    Allan deviations (``_rest_datasets``); ``budget`` (n, contributions, 4), standard uncertainties that add in squares
    to ``sd``, if all have the same lines. With an error model ``effects`` and ``effects_sd`` (n, e) in SI units, named
    by attributes. ``accelerometers`` is the JSON of their calibration (``force_text``), if there is any.

    Attributes are the names of states, noise, budget and effects, ``model``, ``excluded``, ``nis_mean``, ``samples``,
    ``lost``, ``notes``, ``doubts``, ``holds_for`` and ``constancy``. Parity, time offsets, ``spoilt`` and undeclared
    effects are not written.
    """
    gyros = calibration.gyros
    found = [g.noise for g in gyros if g.noise is not None]
    more: dict[str, NDArray[np.float64]] = {}
    if len(found) == len(gyros):
        more["noise"] = np.array([[n.mean.arw, n.mean.instability, n.mean.walk] for n in found])
        more["noise_below"] = np.array([[n.instability_below, n.walk_below] for n in found])
    rests = [g.rest for g in gyros if g.rest is not None]
    if len(rests) == len(gyros):
        more |= _rest_datasets(rests)
    names = [c.name for c in gyros[0].budget] if gyros else []
    if names and all([c.name for c in g.budget] == names for g in gyros):
        more["budget"] = np.array([[c.u for c in g.budget] for g in gyros])
    texts: dict[str, NDArray[Any]] = {}
    if calibration.forces:
        texts["accelerometers"] = np.array([forces_text(calibration.forces).encode()])
    effects = gyros[0].effects if gyros else ()
    named: dict[str, object] = {}
    if effects:
        more["effects"] = np.array([[e.value for e in g.effects] for g in gyros])
        more["effects_sd"] = np.array([[e.sd for e in g.effects] for g in gyros])
        named["effect_names"] = [f"{e.effect}: {e.parameter}" for e in effects]
        named["effect_units"] = [e.unit for e in effects]
        named["model"] = calibration.model
    write_results(
        path,
        "calibration",
        {
            "name": np.array([g.name.encode() for g in gyros]),
            "source": np.array([g.source.encode() for g in gyros]),
            **{key: np.array([getattr(g, key) for g in gyros]) for key in ("states", "sd", "covariance", "noise_rps")},
            **more,
            **texts,
        },
        {
            "budget_names": names,
            "noise_names": ["arw_rps_rthz", "instability_rps", "walk_rps_rts"],
            "excluded": [f"{e.name}: {e.reason}" for e in calibration.excluded],
            "state_names": list(STATES),
            **{key: getattr(calibration, key) for key in ("nis_mean", "samples", "lost")},
            **{key: list(getattr(calibration, key)) for key in ("notes", "doubts")},
            "holds_for": calibration.holds_for,
            "constancy": json.dumps([coverage_object(axis) for axis in calibration.constancy]),
            **named,
            **(attributes or {}),
        },
    )


def _rest_datasets(rests: Sequence[SensorNoise]) -> dict[str, NDArray[np.float64]]:
    """Return the datasets of the noise at rest by name: N, B, K with their 95 % intervals, (n, 3), and curves (n, t).

    The former are ``rest_noise`` and, with "_low" (0 if not seen) and "_high", its ends. Curves are ``allan_tau_s``,
    ``allan_deviation_rps``, ``allan_low_rps`` and ``allan_high_rps``, NaN beyond their last averaging time.
    """
    longest = max(len(rest.curve.tau_s) for rest in rests)
    columns = {"tau_s": "tau_s", "deviation_rps": "deviation", "low_rps": "low", "high_rps": "high"}
    found = {
        "rest_noise": np.array([rest.terms.values for rest in rests]),
        "rest_noise_low": np.array([[rest.terms[name].low for name in TERMS] for rest in rests]),
        "rest_noise_high": np.array([[rest.terms[name].high for name in TERMS] for rest in rests]),
    }
    for key, attribute in columns.items():
        own = [getattr(rest.curve, attribute) for rest in rests]
        found[f"allan_{key}"] = np.array([np.pad(c, (0, longest - len(c)), constant_values=np.nan) for c in own])
    return found


def read_calibration(path: Path | str, *, trusted: bool = False) -> Calibration:
    """Return the calibration stored in the group /calibration of a recording.

    Missing from it are correlations within a line of the budget (its covariance is diagonal), the noise at rest
    (``rest`` is None), the parity of redundant gyros, time offsets, ``spoilt`` and undeclared effects. A recording
    whose run died is recovered first, and probed. ``trusted`` skips both, for a file that this process has read
    already.

    RecordingError if the file cannot be read, or holds no calibration or a damaged one; ModelError if its error model
    is of another version.
    """
    path = Path(path)
    if not trusted:
        recover(path)
        probe(path)
    try:
        with h5py.File(path, "r") as file:
            group = file.get("calibration")
            if not isinstance(group, h5py.Group):
                raise RecordingError(sentence("calibration.none_held", path=path))
            return _read(path, file, group)
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error}") from None
    except MISSHAPEN as error:
        raise RecordingError(sentence("calibration.broken", path=path, kind=type(error).__name__, why=error)) from None


def _read(path: Path, file: Any, group: Any) -> Calibration:
    """Return the calibration in ``group`` of the open ``file``, whose sources hold the arrays.

    Attributes that earlier versions did not write have empty values. ValueError if it holds no gyro or no valid states,
    KeyError if it lacks others.
    """
    names, sources = _texts(group["name"][()]), _texts(group["source"][()])
    n = len(names)
    model = str(plain(group.attrs.get("model", "")))
    effects = _effects(group, model, n, str(path))
    arrays = {source: read_array(f"{path}: /imu/{source}", source, file[f"imu/{source}"]) for source in set(sources)}
    gyros = tuple(
        GyroCalibration(
            name=name,
            source=source,
            states=_floats(group, "states", (n, 4))[i],
            covariance=_floats(group, "covariance", (n, 4, 4))[i],
            noise_rps=float(_floats(group, "noise_rps", (n,))[i]),
            p=arrays[source].p[arrays[source].names.index(name)],
            device=str(plain(file[f"imu/{source}"].attrs.get("device", ""))),
            budget=_budget(group, i),
            noise=_noise(group, i),
            effects=effects[i],
        )
        for i, (name, source) in enumerate(zip(names, sources, strict=True))
    )
    if not gyros or not all(np.isfinite(gyro.states).all() for gyro in gyros):
        raise ValueError("states that are no numbers")
    excluded = [text.partition(": ") for text in _texts(group.attrs.get("excluded", ()))]
    return Calibration(
        gyros=gyros,
        nis_mean=float(group.attrs["nis_mean"]),
        samples=int(group.attrs["samples"]),
        lost=int(group.attrs["lost"]),
        notes=tuple(_texts(group.attrs.get("notes", ()))),
        excluded=tuple(Excluded(name, reason) for name, _, reason in excluded),
        model=model,
        doubts=tuple(_texts(group.attrs.get("doubts", ()))),
        holds_for=str(plain(group.attrs.get("holds_for", ""))),
        arrays=arrays,
        forces=forces_of(_texts(group["accelerometers"][()])[0]) if "accelerometers" in group else (),
        constancy=tuple(map(coverage_of, json.loads(str(plain(group.attrs.get("constancy", "[]")))))),
    )


def _floats(group: Any, key: str, shape: tuple[int, ...]) -> Floats:
    values = np.asarray(group[key][()], dtype=np.float64)
    if values.shape != shape:
        raise ValueError(f"{key} has shape {values.shape}")
    return values


def _budget(group: Any, gyro: int) -> tuple[Contribution, ...]:
    names = _texts(group.attrs.get("budget_names", ()))
    if "budget" not in group:
        return ()
    lines = np.asarray(group["budget"][()], dtype=np.float64)[gyro]
    return tuple(Contribution(name, np.diag(u**2)) for name, u in zip(names, lines, strict=True))


def _noise(group: Any, gyro: int) -> NoiseFound | None:
    if "noise" not in group:
        return None
    arw, instability, walk = np.asarray(group["noise"][()], dtype=np.float64)[gyro].tolist()
    below = np.asarray(group["noise_below"][()], dtype=np.float64)[gyro].tolist()
    return NoiseFound(NoiseModel(arw, instability, walk), below[0], below[1])


def _effects(group: Any, model: str, n: int, where: str) -> list[tuple[EffectValue, ...]]:
    """Return the effects of each of ``n`` gyros, without any if ``group`` names none.

    Their expected sizes are taken from the text of the ``model``; ``where`` names it in errors. ModelError if that is
    no model of this version, KeyError for an effect or parameter that it lacks, ValueError for arrays of another shape.
    """
    labels = [label.partition(": ") for label in _texts(group.attrs.get("effect_names", ()))]
    if not labels:
        return [()] * n
    units = _texts(group.attrs["effect_units"])
    values, sds = _floats(group, "effects", (n, len(labels))), _floats(group, "effects_sd", (n, len(labels)))
    known = {effect.called: effect for effect in ErrorModel.parse(model, where).effects}
    found: list[tuple[EffectValue, ...]] = []
    for i in range(n):
        own = []
        for column, ((called, _, parameter), unit) in enumerate(zip(labels, units, strict=True)):
            size = {size.name: size for size in known[called].sizes}[parameter]
            value, sd = float(values[i, column]), float(sds[i, column])
            own.append(
                EffectValue(
                    effect=called,
                    parameter=parameter,
                    value=value,
                    sd=sd,
                    unit=unit,
                    expected_sd=size.sd,
                    shared=known[called].shared,
                )
            )
        found.append(tuple(own))
    return found


def _texts(values: Any) -> list[str]:
    return [str(plain(value)) for value in np.atleast_1d(np.asarray(values, dtype=object)).tolist()]
