"""An investigation in the report: effects that the error model lacks, residuals before and after, the text."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drivers.types import Floats
from estimator.calibration.error_model import ErrorModel
from estimator.effects.constructed import readable as words
from estimator.errors import RecordingError
from estimator.recordings.safe_open import probe
from estimator.recordings.writing import plain
from estimator.tracing.investigation import ResidualView
from estimator.untrusted import read_json
from station.errors import sentence
from station.report.recorded import Recorded, labels_of, laid_out
from station.views.investigation import Spectra, judged_views

if TYPE_CHECKING:
    from h5py import Group


ALL = "all gyros"  # under this name an error model keeps the values of a shared effect


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Traced:
    """Group /investigation: ``what`` is the output of `station investigate --json`.

    ``states`` (n, 4) are those of the gyros ``names`` with the effects of ``model``. ``residuals`` are of one run, the
    verification run if there is one; ``spectra`` by gyro.
    """

    path: Path
    what: Mapping[str, Any]
    names: tuple[str, ...]
    states: Floats
    model: ErrorModel | None
    residuals: tuple[ResidualView, ...]
    spectra: Mapping[str, Spectra]

    @property
    def added(self) -> list[str]:
        """Readable names of the effects that were added."""
        return [words(name) for name in dict.fromkeys(str(effect["effect"]) for effect in self.what["added"])]


def read_traced(path: Path | None, recorded: Recorded) -> Traced | None:
    """Return the investigation in a file, or by default in the recording itself; None if the recording has none.

    RecordingError for a file that cannot be read, holds none, or one of gyros that the recording does not have.
    """
    import h5py

    where = path or recorded.path
    if path is not None:
        probe(path)
    message = "its investigation cannot be read ({}). Investigate again"
    with laid_out(where, message), h5py.File(where, "r") as file:
        if "investigation" not in file:
            if path is None:
                return None
            raise RecordingError(sentence("report.no_investigation", path=path))
        traced = _read(where, file["investigation"])
    ours = set(labels_of(recorded.recording).values())
    if not set(traced.names) <= ours:
        names = ", ".join(traced.names)
        raise RecordingError(sentence("report.other_device", path=where, names=names, ours=", ".join(sorted(ours))))
    return traced


def _read(path: Path, group: "Group") -> Traced:
    """Return the investigation in an open group of the file ``path``; ValueError if its states have a wrong shape.

    Residuals and spectra are those of the verification run where there is one. Older files have no model.
    """
    names = tuple(str(plain(name)) for name in group["name"][()])
    states = np.asarray(group["states_after"][()], dtype=np.float64)
    if states.shape != (len(names), 4):
        raise ValueError(f"states of shape {states.shape} for {len(names)} gyros")
    model = None
    if "error_model" in group:
        model = ErrorModel.parse(str(plain(group["error_model"][()])), str(path))
    runs = group.get("residual", {})
    residuals = [_residual(run, gyro, part) for run, gyros in runs.items() for gyro, part in gyros.items()]
    judged = judged_views(residuals)
    spectra = group.get("spectrum_verification") or group.get("spectrum") or {}
    return Traced(
        path=path,
        what=read_json(str(plain(group.attrs["json"]))),
        names=names,
        states=states,
        model=model,
        residuals=tuple(view for name in names for view in judged if view.gyro == name),
        spectra={name: _spectrum(part) for name, part in spectra.items()},
    )


def _residual(run: str, gyro: str, part: "Group") -> ResidualView:
    columns = {key: values[()].astype(np.float64) for key, values in part.items()}
    judges, noise_rps = bool(part.attrs["verification"]), float(part.attrs["noise_rps"])
    return ResidualView(
        run=run, gyro=gyro, verification=judges, noise_rps=noise_rps, **{"temperature_c": None, **columns}
    )


def _spectrum(part: "Group") -> Spectra:
    return Spectra(*(part[key][()].astype(np.float64) for key in ("frequency_hz", "before", "after", "noise")))


def number(value: float | None) -> float:
    """Return a number from JSON, where null means unknown; NaN for that."""
    return math.nan if value is None else float(value)
