"""The live filter: how its estimates converged, and whether its innovations were as they should be."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from estimator.calibration.values import Calibration
from station.report.chapters.results import States
from station.report.figures import ONE, plain
from station.report.pictures import Picture, convergence_pictures, nis_picture
from station.report.recorded import Recorded


@dataclass(kw_only=True, frozen=True, slots=True)
class LiveView:
    """The chapters on the live filter.

    ``ran``: there was one, whose estimates are ``convergence``. ``nis_mean`` of the calibration is empty if not known.
    """

    ran: bool
    convergence: Sequence[Picture]
    nis_mean: Markup
    nis: Picture | None


def live_view(recorded: Recorded, calibration: Calibration, states: States) -> LiveView:
    """Return what a recording holds of its live filter: pictures if it ran, and the mean NIS if it is known.

    Without it ``convergence`` is empty; ``nis`` is None if no innovations are stored, ``nis_mean`` empty if unknown.
    """
    ran = bool(recorded.courses)
    known = math.isfinite(calibration.nis_mean)
    return LiveView(
        ran=ran,
        convergence=convergence_pictures(recorded, states) if ran else (),
        nis_mean=plain(calibration.nis_mean, ONE, 4, "calibration@nis_mean") if known else Markup(),
        nis=nis_picture(recorded),
    )
