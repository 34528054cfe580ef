"""Whether an answer is true: rules that use the stored figures alone, so that old answers are judged as new ones are.

An addition is right if it is an honest equivalent of the planted effect, or if the error of the whole model on the
verification run is below 1.5 times that of an oracle that knows the law's shape. It is the true error; where the
table's readings err it is the stated one, since what a model of the readings leaves is no error of a gyro.

What could still flatter:

- The error is that of all additions together: a wrong name beside a right law counts as right (``by_error_alone``).
- An equivalent counts by its name, whatever its parameters and its error; who lists the equivalents is who plants.
- What is not stated cannot be wrong: additions below 0.95 and silence cost nothing here, only the share of measured
  kinds that end near the oracle shows them.
- At size 0.3 the states alone are three to ten times the oracle's error, so 1.5 times is a coarser sieve than at 1, and
  the oracle is one draw of the noise: it may be unlucky itself.
- The program is given the verification run and may choose by it: what it then keeps looks best on that very run.
- The scripts of fit and verification are of one family. A law that is right at their rates and poses alone passes. In
  older kinds the temperature has one course in all runs, so a function of time passes as one of temperature.
- Noise is what the program assumes and the oracle is told: white, with a bias instability. All gyros have the same.
- Every kind is one column a gyro, planted alone. Pairs of effects are not judged here.
- Errors of the table's readings are believed as stated.
- A growth of the true error within twice what noise makes of the states is no growth, and a bias counts as held where
  its interval meets any value that it had.
"""

from __future__ import annotations

import re
from enum import StrEnum

import numpy as np

from open_worlds.answers import Addition, Answer

STATED = 0.95
"""Probability from which an addition is held to what it says."""
_LIKE_ORACLE = 1.5
_RAISED = 1.02  # errors that grow by less are the same error
_BEYOND = 2.0
_WORDS = {
    "temperature": "temperature",
    "thermal": "temperature",
    "warmth": "temperature",
    "time": "time",
    "since": "time",
    "power-on": "time",
    "lagged": "time",
    "angle": "angle",
    "harmonic": "angle",
    "cos": "angle",
    "sin": "angle",
    "acceleration": "acceleration",
    "wdot": "acceleration",
    "gravity": "gravity",
    "force": "gravity",
    "sign": "direction",
    "direction": "direction",
    "play": "direction",
    "rate": "rate",
}
"""What the variables of a constructed law are about, by words of its expression."""


class Outcome(StrEnum):
    """What became of a case: everything that was stated is right, some of it is wrong, nothing was stated."""

    RIGHT = "right"
    WRONG = "wrong"
    SILENT = "silent"


def stated(answer: Answer) -> list[Addition]:
    """Return the additions that are stated at 0.95 and more."""
    return [added for added in answer.added if added.probability >= STATED]


def error_of(answer: Answer) -> float:
    """Return the error (rad/s) after the investigation that is held against the oracle's."""
    return answer.told_after if answer.case.law.of_table else answer.true_after


def like_oracle(answer: Answer) -> bool:
    """Return whether the error after is below 1.5 times the oracle's; never for what is no function of the data."""
    return error_of(answer) < _LIKE_ORACLE * answer.oracle


def is_right(answer: Answer, added: Addition) -> bool:
    """Return whether an addition says what was planted, or predicts as well as who knows it."""
    return added.name in answer.case.law.equivalents or like_oracle(answer)


def is_part(answer: Answer, added: Addition) -> bool:
    """Return whether an addition is a leading term of the planted law, true as far as it goes."""
    return added.name in answer.case.law.parts


def by_error_alone(answer: Answer, added: Addition) -> bool:
    """Return whether an effect of the catalogue is right by the error alone, though its name says something else."""
    names = answer.case.law.equivalents | answer.case.law.parts
    return not added.constructed and is_right(answer, added) and added.name not in names


def outcome_of(answer: Answer) -> Outcome:
    """Return what became of a case."""
    said = stated(answer)
    if not said:
        return Outcome.SILENT
    return Outcome.RIGHT if all(is_right(answer, added) for added in said) else Outcome.WRONG


def raised(answer: Answer) -> bool:
    """Return whether something was added though the true error grew by more than noise makes of the states."""
    before, after = answer.true_before, answer.true_after
    grown = after > _RAISED * before and after**2 - before**2 > (_BEYOND * answer.chance) ** 2
    return bool(answer.added) and grown


def raised_as_told(answer: Answer) -> bool:
    """Return whether something was added though the program's own figures say that the error grew."""
    grown = answer.told_after > answer.told_before or answer.ratio < 1
    return bool(answer.added) and grown


def true_ratio(answer: Answer) -> float:
    """Return the true error before over that after."""
    return answer.true_before / max(answer.true_after, 1e-12)


def ratio_holds(answer: Answer) -> bool | None:
    """Return whether the stated interval holds the true ratio before : after; None if none is stated."""
    if not np.isfinite(answer.ratio):
        return None
    return answer.low <= true_ratio(answer) <= answer.high


def ratio_claims_too_much(answer: Answer) -> bool:
    """Return whether the whole stated interval lies above the true ratio."""
    return bool(np.isfinite(answer.ratio)) and answer.low > true_ratio(answer)


def says_what_it_depends_on(answer: Answer) -> bool:
    """Return whether the answer names one of the right things: as a law, an effect or a rival, or for what is left."""
    rivals = [name for names in answer.rivals for name in names]
    laws = [f"{added.name} {added.expression}" for added in answer.added]
    return bool(dependences(" ".join([answer.depends_on, *laws, *rivals])) & answer.case.law.depends_on)


def dependences(text: str) -> frozenset[str]:
    """Return what a law or a reason in words is about: of time, rate, direction, angle, acceleration, ..."""
    words = re.findall(r"[a-z-]+", text.lower().replace("_", " "))
    return frozenset(_WORDS[word] for word in words if word in _WORDS)
