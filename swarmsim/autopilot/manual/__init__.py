"""Flying by hand: keyboard and gamepad (`sticks`), what they command (`pilot`), and who flies now (`helm`)."""
