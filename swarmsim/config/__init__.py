"""Scenario models: validated, immutable, with units in the field names; YAML in, clear errors out."""
