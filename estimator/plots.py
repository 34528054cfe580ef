"""Pictures for a notebook: each function draws into matplotlib axes, new ones unless given, and returns them."""

from typing import TYPE_CHECKING

import numpy as np

from estimator.calibration.values import Calibration
from estimator.recordings.recording import Recording
from estimator.tracing.investigation import Investigation

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_STATES = ("k, ppm", "b, deg/h", "sigma_j, arcsec", "sigma_k, arcsec")
_SHOWN = np.array([1e6, np.degrees(3600), np.degrees(3600), np.degrees(3600)])


def plot_rates(recording: Recording, axes: "Axes | None" = None) -> "Axes":
    """Draw the outputs of all gyros over time, in deg/s; return the axes, new ones by default.

    Time is in seconds since the first sample of all sources. The title is the recording's name; a legend names gyros.
    """
    axes = _axes(axes)
    start_ns = min(data.t_ns[0] for data in recording.sources.values())
    for data in recording.sources.values():
        axes.plot((data.t_ns - start_ns) * 1e-9, np.degrees(data.rate_rps), label=data.array.names, linewidth=0.8)
    axes.set(xlabel="time, s", ylabel="output, deg/s", title=recording.name)
    axes.legend()
    return axes


def plot_states(calibration: Calibration, state: int = 0, axes: "Axes | None" = None) -> "Axes":
    """Draw one state of every gyro with its 95 % interval; return the axes, new ones by default.

    ``state`` is 0 to 3 for k in ppm, b in deg/h, sigma_j and sigma_k in arcsec. Gyros stand side by side by name; there
    is no title.
    """
    axes = _axes(axes)
    values = [gyro.states[state] * _SHOWN[state] for gyro in calibration.gyros]
    halves = [1.96 * gyro.sd[state] * _SHOWN[state] for gyro in calibration.gyros]
    axes.errorbar([gyro.name for gyro in calibration.gyros], values, halves, fmt="o", capsize=4)
    axes.set(ylabel=_STATES[state])
    return axes


def plot_errors(investigation: Investigation, axes: "Axes | None" = None) -> "Axes":
    """Draw the rms error of every gyro's compensated rate before and after an investigation, in deg/h, as bars.

    The title is the reason of the verdict; a legend names the bars. Return the axes, new ones by default.
    """
    axes = _axes(axes)
    at = np.arange(len(investigation.gyros))
    for shift, name, errors in (
        (-0.2, "before", [gyro.before for gyro in investigation.gyros]),
        (0.2, "after", [gyro.after for gyro in investigation.gyros]),
    ):
        axes.bar(at + shift, [np.degrees(error.rms_rps) * 3600 for error in errors], 0.4, label=name)
    axes.set(
        xticks=at,
        xticklabels=[gyro.name for gyro in investigation.gyros],
        ylabel="rms error, deg/h",
        title=investigation.reason,
    )
    axes.legend()
    return axes


def _axes(axes: "Axes | None") -> "Axes":
    from matplotlib import pyplot

    return pyplot.subplots(layout="constrained")[1] if axes is None else axes
