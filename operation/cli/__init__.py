"""Command line: ``bayesrace``. Each subcommand imports only its own part when it is called."""

from bayesrace.operation.cli.app import main

__all__ = ["main"]
