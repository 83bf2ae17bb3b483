"""One mission: groups of vehicles, their state, the step, neighbours, radio and events."""
