"""Vehicles of a mission behind real autopilot firmware: our physics in lockstep with PX4 and ArduPilot."""
