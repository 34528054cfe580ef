"""Twins of the devices: physics, protocol and wire, kept apart. Nothing here knows the estimator.

Geometry and kinematics are derived here in another way than in the estimator: mounting angles and turned
triads here, tilt axes there; attitude quaternions and their change here, gimbal rates there. So a mistake in
either shows as a residual instead of cancelling.
"""
