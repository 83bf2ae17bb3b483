"""What vehicles measure: each sensor has its own period, exposure and error model."""
