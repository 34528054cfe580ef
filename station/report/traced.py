"""An investigation read back: what the error model lacks, and the residual before and after."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drivers.types import Floats
from estimator.calibration.error_model import ErrorModel
from estimator.errors import RecordingError
from estimator.recordings.safe_open import probe
from station.render.investigation_printed import words
from station.report.recorded import Recorded, labels_of, plain

if TYPE_CHECKING:
    from h5py import Group


_ALL = "all gyros"  # under this name an error model keeps what was found of a shared effect


@dataclass(frozen=True, slots=True, eq=False)
class Residual:
    """Residual of one gyro over a run, means over blocks (b,), rad/s; ``noise_rps`` is the white noise of one."""

    run: str
    gyro: str
    verification: bool
    t_s: Floats
    rate_rps: Floats
    before_rps: Floats
    after_rps: Floats
    noise_rps: float


@dataclass(frozen=True, slots=True, eq=False)
class Spectrum:
    """One-sided densities (f,) of the residual of a gyro, (rad/s)^2/Hz."""

    frequency_hz: Floats
    before: Floats
    after: Floats
    noise: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Traced:
    """Group /investigation: ``what`` is what `station investigate --json` printed.

    ``states`` (n, 4) are those of the gyros ``names`` with the effects of ``model`` in place. ``residuals`` are of one
    run, that which verifies if there is one; ``spectra`` by gyro.
    """

    path: Path
    what: Mapping[str, Any]
    names: tuple[str, ...]
    states: Floats
    model: ErrorModel | None
    residuals: tuple[Residual, ...]
    spectra: Mapping[str, Spectrum]

    @property
    def added(self) -> bool:
        """Whether effects were added."""
        return bool(self.what.get("added"))

    @property
    def added_words(self) -> list[str]:
        """What people call these."""
        return [words(name) for name in dict.fromkeys(str(effect["effect"]) for effect in self.what["added"])]


def read_traced(path: Path | None, recorded: Recorded) -> Traced | None:
    """Return the investigation in a file, or by default the one in the recording itself, None if it has none.

    Raises RecordingError for a file without one, and for one of other gyros than the recording's.
    """
    import h5py

    where = path or recorded.path
    if path is not None:
        probe(path)
    try:
        with h5py.File(where, "r") as file:
            if "investigation" not in file:
                if path is None:
                    return None
                raise RecordingError(
                    f"{path} holds no investigation: give the file that `station investigate ... -o FILE` wrote"
                )
            traced = _read(where, file["investigation"])
    except (OSError, AttributeError, TypeError, ValueError, KeyError, IndexError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise RecordingError(f"{where}: its investigation cannot be read ({reason}): investigate again") from None
    ours = set(labels_of(recorded.recording).values())
    if not set(traced.names) <= ours:
        raise RecordingError(
            f"{where} is an investigation of {', '.join(traced.names)}, the recording is of {', '.join(sorted(ours))}: "
            "give the investigation of this device"
        )
    return traced


def found_of(traced: Traced, gyro: str) -> dict[str, list[float]]:
    """Return the values of each effect's parameters on one gyro, by the name that the model calls the effect."""
    if traced.model is None:
        return {}
    found = {}
    for known in traced.model.effects:
        pairs = known.found.get(_ALL if known.shared else gyro)
        if pairs is not None:
            found[known.called] = [value for value, _ in pairs]
    return found


def _read(path: Path, group: Group) -> Traced:
    names = tuple(str(plain(name)) for name in group["name"][()])
    states = np.asarray(group["states_after"][()], dtype=np.float64)
    if states.shape != (len(names), 4):
        raise ValueError(f"states of shape {states.shape} for {len(names)} gyros")
    model = None
    if "error_model" in group:
        model = ErrorModel.parse(str(plain(group["error_model"][()])), str(path))
    runs = group.get("residual", {})
    residuals = [_residual(run, gyro, part) for run, gyros in runs.items() for gyro, part in gyros.items()]
    judging = [residual for residual in residuals if residual.verification] or residuals
    ordered = [r for name in names for r in judging if r.gyro == name and r.run == judging[0].run]
    spectra = group.get("spectrum_verification") or group.get("spectrum") or {}
    return Traced(
        path,
        json.loads(str(plain(group.attrs["json"]))),
        names,
        states,
        model,
        tuple(ordered),
        {name: _spectrum(part) for name, part in spectra.items()},
    )


def _residual(run: str, gyro: str, part: Group) -> Residual:
    columns = (part[key][()].astype(np.float64) for key in ("t_s", "rate_rps", "before_rps", "after_rps"))
    t_s, rate, before, after = columns
    return Residual(
        run, gyro, bool(part.attrs["verification"]), t_s, rate, before, after, float(part.attrs["noise_rps"])
    )


def _spectrum(part: Group) -> Spectrum:
    return Spectrum(*(part[key][()].astype(np.float64) for key in ("frequency_hz", "before", "after", "noise")))
