"""A stand-in for a real autopilot: MAVLink, the behaviour of PX4 or ArduPilot, and the simulator's physics.

For tests, and for users without an autopilot. What it reproduces are the points at which companion computers fail, as
seen with PX4 1.17 and ArduPilot 4.6; it estimates nothing (its EKF is the truth) and knows no sensors.
"""
