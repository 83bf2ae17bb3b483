"""How vehicles move: the two engines behind one signature, contact with the ground, and wind."""
