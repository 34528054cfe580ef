"""Numbers only: array geometry, kinematics, error model, filter, batch estimate, recordings.

Conventions, written here once
------------------------------
Units are SI inside: rad, rad/s, s, m/s2, degC. Instants are integer nanoseconds (``t_ns``), durations float
seconds. deg, ppm and arcsec appear only where people read or write.

Frames. The *base* frame stands with the table: z up, x at ``heading`` (clockwise from north), y to the
left of x. The *body* frame is fixed to the innermost gimbal and coincides with the base frame when every
axis is home. Angles and rates are positive by the right-hand rule about their axis.

Signs. Gyro i puts out ``y = (1 - k) pbar . w - b``, with ``pbar = p - sigma_k j + sigma_j k`` and w the body
rate (Li, Guo, Ge, Cheng 2020, eq. 1 and 5): a positive scale factor error k makes the output too small, a
positive bias b lowers it. (p, j, k) is the nominal sense axis and its two tilt axes.
"""

import lazy_loader

# The names are listed in the stub beside this file; a module is imported when one of its names is first used.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
