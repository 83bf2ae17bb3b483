"""The command line ``swarmsim``."""

from swarmsim.cli.commands import app
from swarmsim.cli.entry import EXIT_INPUT, EXIT_INTERRUPTED, describe, main

__all__ = ["EXIT_INPUT", "EXIT_INTERRUPTED", "app", "describe", "main"]
