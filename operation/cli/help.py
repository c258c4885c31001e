"""The group of all commands: imports the module of the one that is called, and prints plain help.

All modules, the options of all commands and Rich's boxes take longer than many a command.
"""

from copy import copy
from importlib import import_module
from typing import Any, ClassVar

import typer
from typer.core import TyperGroup
from typer.main import get_command

from operation.cli.configured import configurable, networked

__all__ = ["TaskGroup"]


class TaskGroup(TyperGroup):
    """Lists its commands by task; a subclass names them."""

    tasks: ClassVar[dict[str, tuple[str, ...]]]
    """Task to commands, as ``module.function`` of this package, or of an application of its own."""
    networked: ClassVar[frozenset[str]]
    """Commands that open links to others than they start themselves."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Names in the order of the tasks."""
        return list(self._places())

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command, once its module is imported; None for an unknown name."""
        if cmd_name not in self.commands and cmd_name in (places := self._places()):
            module, _, name = places[cmd_name].partition(".")
            found = getattr(import_module(f"operation.cli.{module}"), name)
            if isinstance(found, typer.Typer):
                found = _configurable(found)
            else:
                own, found = found, typer.Typer(add_completion=False, rich_markup_mode=None)
                with_options = networked if places[cmd_name] in self.networked else configurable
                register = found.command(cmd_name, context_settings=dict(self.context_settings))
                register(with_options(own))
            self.commands[cmd_name] = get_command(found)
        return self.commands.get(cmd_name)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command that is called; for an unknown one, those that it may be are looked at."""
        if args[0] not in self._places():
            for name in self.list_commands(ctx):
                self.get_command(ctx, name)
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """A section for each task."""
        for task, places in self.tasks.items():
            rows = [(_name(place), self._summary(ctx, _name(place))) for place in places]
            with formatter.section(task):
                formatter.write_dl(rows)

    def _summary(self, ctx: Any, name: str) -> str:
        paragraph: str = self.get_command(ctx, name).help.split("\n\n")[0]
        return " ".join(paragraph.split())

    def _places(self) -> dict[str, str]:
        return {_name(place): place for places in self.tasks.values() for place in places}


def _name(place: str) -> str:
    return place.partition(".")[2].replace("_", "-")


def _configurable(group: typer.Typer) -> typer.Typer:
    """A copy whose commands have ``--config``."""
    found = copy(group)
    found.registered_commands = [copy(one) for one in group.registered_commands]
    for one in found.registered_commands:
        if one.callback is not None:
            one.callback = configurable(one.callback)
    return found
