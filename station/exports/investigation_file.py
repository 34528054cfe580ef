"""The file of an investigation: HDF5 with the verdict as JSON and the residuals before and after."""

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from estimator.calibration.error_model import WHERE, ErrorModel
from estimator.tracing.accelerometers.trace_forces import ForceFinding
from estimator.tracing.investigation import Investigation
from estimator.tracing.type_model import error_model_of, force_effects_of
from station.errors import UsageError
from station.views.investigation import spectra_of

FORMAT = "turntable-investigation"
FORMAT_VERSION = 1


def write_investigation(
    path: Path, investigation: Investigation, answer: Mapping[str, Any], forces: Sequence[ForceFinding] = ()
) -> None:
    """Write group /investigation: ``answer`` as its attribute ``json``, states, and residuals by run and gyro.

    Group ``spectrum`` holds by gyro the densities (rad/s)^2/Hz at ``frequency_hz`` of the residual of the fitted
    recordings, before and after, and of the noise model; ``spectrum_verification`` those of the verification run. The
    text of the error model, for the next device of the type, is stored as ``estimator.calibration.error_model`` has it,
    with the effects that were added to accelerometers (``forces``).
    UsageError if the file exists or cannot be written; an incomplete file is removed.
    """
    import h5py

    try:
        created = h5py.File(path, "x")
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot create {path}: {' '.join(str(error).split())}") from None
    try:
        with created as file:
            file.attrs.update({"format": FORMAT, "format_version": FORMAT_VERSION})
            group = file.create_group("investigation")
            group.attrs.update(
                {"verdict": str(investigation.finding), "reason": investigation.reason, "json": json.dumps(answer)}
            )
            model = error_model_of(investigation.model) if investigation.model is not None else ErrorModel(())
            model = replace(model, forces=force_effects_of(forces))
            if investigation.model is not None or not model.is_empty:
                file[WHERE] = model.text()
            group["name"] = np.array([gyro.name.encode() for gyro in investigation.gyros])
            for key in ("states_before", "states_after", "moved"):
                group[key] = np.array([getattr(gyro, key) for gyro in investigation.gyros])
            for view in investigation.views:
                part = group.create_group(f"residual/{_name(view.run)}/{_name(view.gyro)}")
                part.attrs.update({"verification": view.verification, "noise_rps": view.noise_rps})
                for key in ("t_s", "rate_rps", "temperature_c", "before_rps", "after_rps"):
                    values = getattr(view, key)
                    if values is not None:
                        part[key] = values
            fitted = spectra_of(investigation.residual_before, investigation.residual_after)
            verified = spectra_of(investigation.verified_before, investigation.verified_after)
            for kind, by_gyro in (("spectrum", fitted), ("spectrum_verification", verified)):
                for gyro, spectra in by_gyro.items():
                    for key in ("frequency_hz", "before", "after", "noise"):
                        group[f"{kind}/{_name(gyro)}/{key}"] = getattr(spectra, key)
    except (OSError, ValueError) as error:
        with suppress(OSError):
            path.unlink()
        raise UsageError(f"cannot write {path}: {' '.join(str(error).split())}") from None


def _name(text: str) -> str:
    """Return a name with underscores for slashes, which would make a group each."""
    return text.replace("/", "_")
