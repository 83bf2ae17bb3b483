"""The commands: thin, and quick to start. What they need is imported when they run.

Importing this package registers every command with `swarmsim.cli.app.app`.
"""

from swarmsim.cli.app import app
from swarmsim.cli.commands import autopilots, configurations, missions

__all__ = ["app", "autopilots", "configurations", "missions"]
