"""Hidden faults of the twins: effects of gyros, of their converters, and of the table.

Written from the physics, not from the formulas by which the estimator looks for them: a delay is a look at the past, a
low pass runs through the samples, a tilted axis is turned about. Everything that is added to a gyro's output is in
rad/s. Times are those of a bench clock that goes on from run to run.
"""

from sims.physics.hidden.effects import KINDS as KINDS, Hidden as Hidden
from sims.physics.hidden.fields import HiddenError as HiddenError
from sims.physics.hidden.temperature import Temperature as Temperature
