"""What runs a simulation: compiled programs and how they are kept."""
