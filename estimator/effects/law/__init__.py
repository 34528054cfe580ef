"""Laws: the error that an effect adds to the output of a gyro, as an expression of the gyro's conditions.

A law is text, as ``lag(T, 58)*gx``: names of variables, numbers, products, powers, quotients, and some functions. Three
of these remember: ``lag(x, c)`` follows x as a first-order lag of c seconds, ``play(x, c)`` as a linkage with a play of
c follows its drive (Krasnosel'skii, Pokrovskii 1989); ``last(x, c)`` is the sign that x had last beyond c, ``last(x)``
beyond a twentieth of its largest size: of the recording, or so far where conditions are causal. Terms of one law are
separated by semicolons, each with a coefficient of its own. Memory passes over what is not finite.

A law is parsed and compiled once; its variables are worked out once for each gyro under the same conditions.
"""

from estimator.effects.law.evaluation import columns_of, compiled, settled
from estimator.effects.law.grammar import (
    VARIABLES,
    LawError,
    axes_of,
    functions_of,
    needs_of,
    of_each_gyro,
    parsed,
    variables_of,
)
from estimator.effects.law.memory import LAST_SHARE, lagged, last_sign, played
from estimator.effects.law.words import in_words

__all__ = [
    "LAST_SHARE",
    "VARIABLES",
    "LawError",
    "axes_of",
    "columns_of",
    "compiled",
    "functions_of",
    "in_words",
    "lagged",
    "last_sign",
    "needs_of",
    "of_each_gyro",
    "parsed",
    "played",
    "settled",
    "variables_of",
]
