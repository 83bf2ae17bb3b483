"""Logs of flights: MAVLink ``.tlog``, ArduPilot's dataflash ``.bin`` and PX4's ``.ulg``, read into one form."""
