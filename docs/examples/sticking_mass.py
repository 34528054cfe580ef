"""An effect of one's own: a bias that keeps the direction of the last turn, as a sticking proof mass does.

The law makes all the rest: what is looked for in recordings, what a plan tells, what is undone by the exports to C and
Python, and the formula in the report. ``u`` is the rate about the sense axis; ``estimator/effects/law.toml`` lists all
variables and functions. A command takes the file by ``--plugin sticking_mass.py``, a bench file by
``plugins = ["sticking_mass.py"]``.
"""

import math

from estimator.effects.effect import Parameter, Record

EFFECT = Record(
    name="sticking_mass",
    # The largest size that is plausible, in SI; one parameter for each term of the law.
    parameters=(Parameter("after a turn", "rad/s", math.radians(0.5)),),
    law="last(u)",
    shown_by="rests after turns in both directions",
    confused_with=("scale_asymmetry",),
    # What a residual depends on that holds it, and by which it is suspected.
    depends_on="direction",
    suspected_of=("direction", "rate"),
)
