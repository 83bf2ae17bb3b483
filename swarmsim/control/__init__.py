"""From a setpoint to rotor and wheel commands."""
