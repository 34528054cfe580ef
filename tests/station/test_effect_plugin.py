"""A record of an effect that is none is refused with what it lacks."""

from __future__ import annotations

import pytest

from estimator.effects import catalogue
from estimator.effects.effect import EffectError, Parameter, Record


@pytest.mark.parametrize(
    ("record", "said"),
    [
        (Record(name="Mine!", parameters=()), "no name of small letters"),
        (Record(name="mine", parameters=(Parameter("a", "rad/s", 1.0),), law="u; T"), "2 terms for 1 parameters"),
        (Record(name="mine", parameters=(Parameter("a", "rad/s", 1.0),), law="phlogiston"), "no law.*phlogiston"),
        (Record(name="mine", parameters=(Parameter("a", "rad/s", 1.0),)), "neither a law nor regressors"),
        (Record(name="mine", parameters=(Parameter("a", "rad/s", 1.0),), law=3), "no law: 3: a law is a text"),  # type: ignore[arg-type]
        (
            Record(name="mine", parameters=Parameter("a", "rad/s", 1.0), law="u"),
            "parameters: write a tuple",
        ),  # type: ignore[arg-type]
        (Record(name="mine", parameters=(Parameter("a", "deg/s", 1.0),), law="u"), "'deg/s' of a is no SI unit"),
        (Record(name="mine", parameters=(Parameter("a", "rad/s", -1.0),), law="u"), "size of a is -1.0"),
        (
            Record(name="mine", parameters=(Parameter("a", "rad/s", "1"),), law="u"),
            "size of a is '1'. Give a number above 0",
        ),  # type: ignore[arg-type]
        (
            Record(name="mine", parameters=(Parameter("a", "rad/s", 1.0),), law="u", suspected_of="rate"),  # type: ignore[arg-type]
            "suspected_of: write a tuple",
        ),
        (Record(name="thermal_bias", parameters=(Parameter("a", "rad/s", 1.0),), law="u"), "thermal_bias already"),
    ],
)
def test_a_record_that_is_none_is_refused_with_what_it_lacks(record: Record, said: str) -> None:
    with pytest.raises(EffectError, match=said):
        catalogue.register(record)
