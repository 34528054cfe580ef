"""Figures as readers see them, each with its full precision in the file."""

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from drivers.packaged import packaged_toml
from estimator.calibration.error_model import Size
from station.bench.units import Units
from station.views.figures import human, state_figures

COVERAGE = 2.0
"""Coverage factor of expanded uncertainties: about 95 % of a normal distribution."""
UNKNOWN = "not known"
_DEG = 180 / np.pi
_SIGNS: dict[str, str] = packaged_toml("station.views", "units.toml")["typeset"]


def typographic(text: str) -> str:
    """Return a text with units as typeset: "deg/h" becomes "°/h"."""
    for plain, sign in _SIGNS.items():
        text = text.replace(plain, sign)
    return re.sub(r"-(?=\d)", "−", text)


@dataclass(frozen=True, slots=True)
class Unit:
    """The unit in which a figure in SI is shown."""

    name: str
    factor: float


PPM = Unit("ppm", 1e6)
DEG_PER_H = Unit("°/h", _DEG * 3600)
DEG_PER_S = Unit("°/s", _DEG)
DEG = Unit("°", _DEG)
ARCSEC = Unit('"', _DEG * 3600)
MICRORADIANS = Unit("µrad", 1e6)
ONE = Unit("", 1.0)
PER_MILLION = Unit("ppm", 1.0)
PERCENT = Unit("%", 1e2)
CELSIUS = Unit("°C", 1.0)
SECONDS = Unit("s", 1.0)
MILLISECONDS = Unit("ms", 1e3)
MICROSECONDS = Unit("µs", 1e6)
ARW = Unit("°/s/√Hz", _DEG)
WALK = Unit("°/h/√h", _DEG * 3600 * 60)

SYMBOLS = tuple(map(Markup, ("<var>k</var>", "<var>b</var>", "<var>σ</var><sub>j</sub>", "<var>σ</var><sub>k</sub>")))


def states_in(units: Units) -> tuple[tuple[Markup, Unit], ...]:
    """Return symbol and unit of each state, in the order of every vector of states."""
    shown = state_figures(units)
    return tuple((symbol, Unit(typographic(one.unit), one.factor)) for symbol, one in zip(SYMBOLS, shown, strict=True))


def figure(value: float, unit: Unit, text: str, source: str | None = None, times: float | None = None) -> Markup:
    """Return a figure as HTML that shows ``text``, without its unit, and also carries its full ``value`` in SI.

    It carries the factor of ``unit`` as well. ``source`` is its place in the recording: "group/dataset[row,column]" or
    "group@attribute"; ``times`` the factor by which the value there is to be multiplied. What is None is left out.
    """
    beside = {
        "value": repr(float(value)),
        "data-factor": repr(float(unit.factor)),
        "data-h5": source,
        "data-times": times,
    }
    named = (
        Markup(' {}="{}"').format(name, value_text) for name, value_text in beside.items() if value_text is not None
    )
    return Markup("<data{}>{}</data>").format(Markup("").join(named), text)


def plain(value: float, unit: Unit, digits: int = 3, source: str | None = None) -> Markup:
    """Return a figure with ``digits`` significant digits, without an exponent where that is readable."""
    return figure(value, unit, significant(value * unit.factor, digits), source)


def interval(value: float, low: float, high: float, unit: Unit, place: str) -> Markup:
    """Return ``value``, a term of the noise at rest, with its interval; "at most" ``high`` if ``low`` is 0.

    ``place`` is the index in the datasets of the calibration.
    """
    upper = plain(high, unit, 3, f"calibration/rest_noise_high{place}")
    if low == 0:
        return Markup("at most {}").format(upper)
    lower = plain(low, unit, 3, f"calibration/rest_noise_low{place}")
    return Markup("{} ({} to {})").format(plain(value, unit, 3, f"calibration/rest_noise{place}"), lower, upper)


def hash_text(text: str) -> Markup:
    """Return a hash, which may be broken anywhere to fit its column."""
    return Markup('<code class="hash">{}</code>').format(text)


def fixed(value: float, unit: Unit, decimals: int, source: str | None = None) -> Markup:
    """Return a figure with ``decimals`` decimals."""
    text = _minus(f"{value * unit.factor:.{decimals}f}") if math.isfinite(value) else UNKNOWN
    return figure(value, unit, text, source)


def count(number: int, source: str | None = None) -> Markup:
    """Return a number of things."""
    return figure(number, ONE, str(number), source)


def known(value: float | None, unit: Unit) -> Markup:
    """Return a figure from JSON, where null means unknown."""
    return plain(math.nan if value is None else value, unit)


def with_uncertainty(value: float, sd: float, unit: Unit, source: str | None, source_of_sd: str | None) -> list[Markup]:
    """Return a value, its standard and its expanded uncertainty in ``unit``.

    The value is rounded to two digits of the expanded uncertainty (GUM 7.2.6), and each uncertainty to two digits of
    itself, see ``rounded``. ``value`` and ``sd`` are in SI; ``source`` and ``source_of_sd`` say where in the recording
    they stand, None for nowhere.
    """
    expanded = COVERAGE * sd
    shown = [rounded(x * unit.factor, expanded * unit.factor) for x in (value, expanded)]
    standard = rounded(sd * unit.factor, sd * unit.factor)
    return [
        figure(value, unit, shown[0], source),
        figure(sd, unit, standard, source_of_sd),
        figure(expanded, unit, shown[1], source_of_sd, COVERAGE),
    ]


def worded(value: float, expanded: float, unit: str, source: str | None = None) -> Markup:
    """Return a value of an effect and its expanded uncertainty (0: none), ``unit`` in SI, as everyday units have it."""
    return figure(value, Unit(unit, 1.0), typographic(human(value, expanded, unit)), source)


def parameters(sizes: Iterable[Size], values: Iterable[float]) -> Markup:
    """Return the values of the parameters of an effect on one gyro."""
    shown = (worded(float(value), 0.0, size.unit) for value, size in zip(values, sizes, strict=True))
    return Markup("; ").join(shown)


def rounded(value: float, uncertainty: float) -> str:
    """Return a value rounded to the second significant digit of its uncertainty, with at most nine decimals.

    Without an uncertainty that is finite and above 0 it has six significant digits. ``UNKNOWN`` if it is not finite.
    """
    if not math.isfinite(value):
        return UNKNOWN
    if not math.isfinite(uncertainty) or uncertainty <= 0:
        return significant(value, 6)
    place = min(1 - math.floor(math.log10(uncertainty)), 9)
    return _minus(f"{round(value, place):.{max(place, 0)}f}")


def stated(value: float, unit: Unit) -> Markup:
    """Return a figure that a person stated, as it was most likely written."""
    return figure(value, unit, _minus(f"{value * unit.factor:.6g}"))


def significant(value: float, digits: int) -> str:
    """Return a value with ``digits`` significant digits and a typographic minus; ``UNKNOWN`` if it is not finite.

    The form is exponential for sizes below 1e-5 and from 1e7 on. In between all digits before the decimal point are
    shown, even if there are more; zero is "0". Where rounding adds a place there is one digit more (9.996 to three
    digits is "10.00").
    """
    if not math.isfinite(value):
        return UNKNOWN
    if value == 0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    if not -5 <= exponent < 7:
        return _minus(f"{value:.{digits - 1}e}")
    return _minus(f"{value:.{max(digits - 1 - exponent, 0)}f}")


def _minus(text: str) -> str:
    """Return a number with a minus sign, but none before nought."""
    return text.replace("-", "−") if float(text) else text.removeprefix("-")
