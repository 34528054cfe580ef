"""What the chapter on the correction shows of effects: formulas, letters, numbers."""

import re
from collections.abc import Callable, Mapping, Sequence

from markupsafe import Markup, escape

from estimator.calibration.compensation import HeldEffect
from estimator.effects.conditions import SLOPE_S
from estimator.effects.constructed import CONSTRUCTED
from estimator.effects.law import VARIABLES, variables_of
from station.report.chapters.correction import Correction
from station.report.figures import ONE, figure
from station.report.recorded import Recorded


def origin(recorded: Recorded, data_sha256: str, title: str) -> str:
    """Return the comment that Python for a device begins with."""
    return f"Recording {recorded.path.name}, SHA-256 of its samples\n{data_sha256}\n{title}"


def gains(one: Correction, gyro: int) -> list[Markup]:
    """Return the row of the sensitivity of a gyro, or what it has of the rate about its own axis."""
    compensation = one.compensation
    values = [1 - compensation.states[gyro, 0]] if one.axes_only else compensation.sensitivity[gyro].tolist()
    return [figure(float(value), ONE, f"{value:.7f}".replace("-", "−")) for value in values]


def formula_of(effect: HeldEffect) -> Markup:
    """Return what an effect adds to the outputs, with a factor a for each of its terms."""
    known = effect.known
    shown = "<code>{}</code>" if known.record is CONSTRUCTED else "{}"
    terms = [term.strip() for term in (known.law or str(escape(known.record.formula))).split(";")]
    if known.law and known.record is not CONSTRUCTED:
        terms = list(map(_typeset, terms))
    subs = [f"<sub>{n}</sub>" if len(terms) > 1 else "" for n in range(1, len(terms) + 1)]
    return Markup(" + ".join(f"<var>a</var>{sub} {shown.format(term)}" for sub, term in zip(subs, terms, strict=True)))


_SIGNS: Mapping[str, str | Callable[[re.Match[str]], str]] = {
    r"-expm1\((.*)\)": r"(1 - exp(\1))",
    r"abs\(([^()]*)\)": r"|\1|",
    r" ?\*\* ?(\w+)": r"<sup>\1</sup>",
    r" ?\* ?": " ",
    "-": "−",
    r"\bTdot\b": "dT/dt",
    rf"\b({'|'.join(map(re.escape, VARIABLES))})\b": lambda found: _letter(found[1]),
}


def _typeset(law: str) -> str:
    """Return a law, which holds no sign that HTML knows, as mathematics."""
    for pattern, sign in _SIGNS.items():
        law = re.sub(pattern, sign, law)
    return law


def _letter(name: str) -> str:
    return f"<var>{name[0]}</var>" + (f"<sub>{name[1:].lstrip('_')}</sub>" if name[1:] else "")


_MORE = {
    "u": ", found by iteration",
    "Tdot": f", taken over {SLOPE_S:g} s",
    "t": ", from switching on",
    **dict.fromkeys(("a", "aj", "ak", "jolt"), ", a difference of two samples"),
}


def variables_of_laws(effects: Sequence[HeldEffect]) -> list[str]:
    """Return what the variables mean in the laws of effects."""
    names = {name for effect in effects if effect.known.law for name in variables_of(effect.known.law)}
    return [f"{name}: {VARIABLES[name][2]} in {VARIABLES[name][1]}{_MORE.get(name, '')}" for name in sorted(names)]
