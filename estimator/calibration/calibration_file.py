"""Results kept in the recording they were drawn from: the group /calibration."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimator.calibration.values import Calibration
from estimator.geometry.model import STATES
from estimator.recordings.writing import write_results


def write_calibration(path: Path, calibration: Calibration, attributes: dict[str, object] | None = None) -> None:
    """Write /calibration: names, sources, states (n, 4), sd (n, 4), covariance (n, 4, 4), noise of a sample (n,).

    Of runs on a table also ``noise`` (n, 3) and what 95 % of the expectation lies below (n, 2), and ``budget`` (n,
    contributions, 4): standard uncertainties that add in squares to ``sd``. If the table rested, also the Allan
    deviation then, ``allan_deviation_rps`` (n, t) at ``allan_tau_s`` (n, t), NaN beyond the last, and the noise it
    tells of, ``rest_noise`` (n, 3). With an error model its effects, ``effects`` (n, e) and ``effects_sd`` (n, e) in SI
    units, named by the attributes ``effect_names`` and ``effect_units``; ``model`` is the text of that model.
    """
    gyros = calibration.gyros
    found = [g.noise for g in gyros if g.noise is not None]
    more: dict[str, NDArray[np.float64]] = {}
    if len(found) == len(gyros):
        more["noise"] = np.array([[n.mean.arw, n.mean.instability, n.mean.walk] for n in found])
        more["noise_below"] = np.array([[n.instability_below, n.walk_below] for n in found])
    rests = [g.rest for g in gyros if g.rest is not None]
    if len(rests) == len(gyros):
        longest = max(len(rest.tau_s) for rest in rests)
        more["rest_noise"] = np.array([[r.noise.arw, r.noise.instability, r.noise.walk] for r in rests])
        for key in ("tau_s", "deviation_rps"):
            curves = [getattr(rest, key) for rest in rests]
            more[f"allan_{key}"] = np.array([np.pad(c, (0, longest - len(c)), constant_values=np.nan) for c in curves])
    names = [c.name for c in gyros[0].budget] if gyros else []
    if names and all([c.name for c in g.budget] == names for g in gyros):
        more["budget"] = np.array([[c.u for c in g.budget] for g in gyros])
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
        },
        {
            "budget_names": names,
            "noise_names": ["arw_rps_rthz", "instability_rps", "walk_rps_rts"],
            "excluded": [f"{e.name}: {e.reason}" for e in calibration.excluded],
            "state_names": list(STATES),
            **{key: getattr(calibration, key) for key in ("nis_mean", "samples", "lost")},
            **{key: list(getattr(calibration, key)) for key in ("notes", "doubts")},
            "holds_for": calibration.holds_for,
            **named,
            **(attributes or {}),
        },
    )
