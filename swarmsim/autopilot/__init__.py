"""Real autopilots: fly one vehicle of a mission on one, and stand in for one.

Everything outside this package is in east-north-up and forward-left-up; what autopilots speak (north-east-down,
forward-right-down, latitudes and longitudes) stays inside it.
"""
