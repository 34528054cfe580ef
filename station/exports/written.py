"""One calibration in one format: the text of the file, and what the file cannot hold."""

import json
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml

from estimator.calibration.compensation import Compensation
from estimator.effects.constructed import readable
from station.errors import UsageError, sentence
from station.exports.accelerations import HeldForces
from station.exports.exported import Exported
from station.render.template import rendered

_LINE_END = re.compile(r"[\r\n\f]")
_NOT_FINITE = "the calibration holds a number that is not finite. Estimate it again"
"""Why a calibration cannot be written in any form."""
_NO_FORCES = HeldForces()


@dataclass(frozen=True, slots=True)
class Written:
    """Text or bytes of a file; ``not_held`` has one line for each part of the calibration that it lacks."""

    text: str | bytes
    not_held: tuple[str, ...] = ()


def number(value: float, digits: int = 17) -> str:
    """Return a number as C and Python read it, always with a point or exponent; UsageError if it is not finite.

    17 significant digits restore a double, 9 a float.
    """
    if not np.isfinite(value):
        raise UsageError(_NOT_FINITE)
    text = format(float(value), f".{digits}g")
    mantissa, e, exponent = text.partition("e")
    # C takes 1 for an int.
    return f"{mantissa}{'' if '.' in mantissa else '.0'}{e}{exponent}"


def json_text(value: Mapping[str, object]) -> str:
    """Return values as JSON; UsageError for a number that is not finite."""
    try:
        return json.dumps(value, indent=1, allow_nan=False) + "\n"
    except ValueError:
        raise UsageError(_NOT_FINITE) from None


def yaml_text(value: Mapping[str, object]) -> str:
    """Return JSON values as YAML 1.1 and 1.2, rows of numbers in one line; UsageError as ``json_text``."""
    held = json.loads(json_text(value))  # no two places of it are one object, which YAML would write as an alias
    return str(yaml.dump(held, Dumper=_Dumper, default_flow_style=None, sort_keys=False, allow_unicode=True, width=1e9))


class _Dumper(yaml.SafeDumper):  # type: ignore[misc]
    """Quotes texts that begin like a number: 1e5 is a text in YAML 1.1, and a number in YAML 1.2."""

    def represent_str(self, text: str) -> Any:
        """Return the node of a text."""
        return self.represent_scalar("tag:yaml.org,2002:str", text, style='"' if text[:1] in "+-.0123456789" else None)


_Dumper.add_representer(str, _Dumper.represent_str)


def lines_of(reasons: Mapping[str, str]) -> list[str]:
    """Return a line for each effect that is not held, with the reason."""
    return [f"{readable(effect)}: {why}" for effect, why in reasons.items()]


def delay_line(exported: Exported, remedy: str = "subtract it from the time stamps of the samples") -> list[str]:
    """Return the line on a delay that a format cannot hold; none if there is no delay."""
    delay_s = exported.compensation.delay_s
    return [f"a delay of {delay_s:.6g} s: {remedy}"] if delay_s else []


def head(exported: Exported, title: str, not_held: Sequence[str], mark: str) -> list[str]:
    """Return the first lines of a text, each behind ``mark``: what it is, the origin, and what it does not hold."""
    lines = [title, "", *exported.origin]
    if not_held:
        lines += ["", "Not in this file, or to be done by hand:", *(f"  - {line}" for line in not_held)]
    return [f"{mark} {_LINE_END.sub(' ', line)}".rstrip() for line in lines]  # a name must not end the comment


def from_template(
    form: str, exported: Exported, dropped: Mapping[str, str], forces: HeldForces = _NO_FORCES, **values: Any
) -> Written:
    """Return a file made from the template of a format; its first lines say what it lacks and leaves to be done.

    ``dropped`` are effects of the gyros that it lacks, with reasons; ``forces`` is what it has of the accelerometers.
    ``values`` are further names in the template. Its first line is the title of the file; with an empty ``head``, as it
    is rendered first, the others are what is to be done by hand.
    """
    values |= {"numbers": lambda row: ", ".join(map(number, row)), "delay_s": exported.compensation.delay_s}
    values["force"] = forces.correction
    purpose, *notes = rendered("station.exports", f"{form}.jinja", {"head": (), **values}).splitlines()
    not_held = [*notes, *lines_of(dropped), *forces.lines]
    values["head"] = head(exported, purpose, not_held, "#")
    return Written(rendered("station.exports", f"{form}.jinja", values), tuple(not_held))


def as_triad(exported: Exported, form: str, keep: Collection[str] = ()) -> tuple[Compensation, dict[str, str]]:
    """Return the compensation for a format of three gyros with only the effects ``keep``, and by effect why others not.

    Other effects of the temperature are included in the constants by their value at the mean of the calibration.
    UsageError, with what to do, if there are not three gyros; ``form`` names the format in it.
    """
    count = len(exported.gyros)
    if count != 3:
        several = f" of {len(exported.devices)} devices: give one with --device" if len(exported.devices) > 1 else ""
        raise UsageError(sentence("export.three_gyros", form=form, count=count, several=several))
    held, dropped = exported.compensation.simplified(keep, exported.seen.temperature_c[1])
    return held, {**exported.compensation.left_out, **dropped}
