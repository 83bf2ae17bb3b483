"""The command line ``swarmsim``."""

from swarmsim.cli.commands import EXIT_INPUT, EXIT_INTERRUPTED, app, describe, main

__all__ = ["EXIT_INPUT", "EXIT_INTERRUPTED", "app", "describe", "main"]
