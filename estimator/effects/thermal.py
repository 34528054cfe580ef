"""Effects of temperature. Without a temperature they are nothing: their columns are zero."""

import numpy as np

from estimator.effects.effect import Odds, Parameter, Record

RECORDS = (
    THERMAL_BIAS := Record(  # up to 20 deg/s over 125 K (InvenSense MPU-6050)
        name="thermal_bias",
        parameters=(Parameter("linear", "rad/s/K", float(np.radians(0.16))),),
        law="T",
        shown_by="a temperature that rises and falls",
        confused_with=("warm_up", "bias_drift", "thermal_gradient"),
        depends_on="temperature",
        suspected_of=("temperature",),
    ),
    THERMAL_BIAS_QUADRATIC := Record(  # up to 8 deg/s at 65 K from the reference
        name="thermal_bias_quadratic",
        parameters=(Parameter("quadratic", "rad/s/K2", float(np.radians(0.002))),),
        law="T**2",
        shown_by="three temperatures and more, far apart",
        confused_with=("thermal_bias", "warm_up"),
        depends_on="temperature",
        suspected_of=("temperature",),
        odds=Odds(-1.5),  # what refines a simpler effect is rarer than that effect
    ),
    THERMAL_SCALE := Record(  # up to 500 ppm/K for uncompensated MEMS gyros
        name="thermal_scale",
        parameters=(Parameter("linear", "1/K", 5e-4),),
        law="T*u",
        shown_by="one rate at several temperatures",
        confused_with=("scale_asymmetry",),
        depends_on="temperature",
    ),
    THERMAL_GRADIENT := Record(  # up to 1 deg/s per K/min before the parts are evenly warm
        name="thermal_gradient",
        parameters=(Parameter("per rate of change", "rad/s/(K/s)", float(np.radians(60.0))),),
        law="Tdot",
        shown_by="a temperature that changes at different rates",
        confused_with=("warm_up", "bias_drift", "thermal_bias"),
        depends_on="temperature",
        suspected_of=("temperature",),
        # A bias over temperature is in every data sheet; its gradient without it one part in a hundred may have, while
        # beside it a gradient is no more than a lag between gyro and thermometer.
        odds=Odds(float(np.log(0.01)), beside=("thermal_bias", -1.5)),
        not_live="needs the temperature of the seconds to come",
    ),
)
