"""The Typer application: commands by task, each imported when it is called, and errors as a line.

All modules, the options of all commands and Rich's boxes take longer than many a command.
"""

import atexit
import gc
import io
import logging
import os
import shutil
import signal
import sys
from importlib import import_module
from tempfile import gettempdir
from typing import Any, Final

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

from bayesrace.errors import PASSING, InputError, RestartError, faults_in
from bayesrace.operation.cli.declaration import Group, configured
from bayesrace.processes import interrupt_cause, remembering_interrupts

__all__ = ["app", "main"]

_INTERRUPTED: Final = 130
_RESTART: Final = 75

_EXTRAS: Final = {
    "fmu": ("fmpy",),
    "race": (
        "PIL", "casadi", "contourpy", "jinja2", "lz4", "matplotlib", "mcap", "rich",
        "scipy", "sklearn", "threadpoolctl", "websockets", "yaml", "zstandard",
    ),
    "campaign": ("bokeh", "dask", "distributed", "optuna", "pandas", "pyarrow"),
    "foxglove": ("foxglove",),
    "ros2": ("rosbags",),
    "slipx": ("slipx",),
}  # fmt: skip
"""Modules that the extras of pyproject.toml install."""

_TASKS: Final = {
    "Race": "race.race race.report view.view",
    "Prepare": "tracks.tracks tracks.cars tracks.raceline learning.collect "
    "learning.import_drive learning.identify learning.train learning.validate export.size "
    "export.build",
    "Drive": "processes.plant processes.controller processes.bridge race.drive processes.status "
    "processes.stop processes.go processes.router processes.doctor processes.ros2 "
    "configuration.config configuration.certs",
    "Learn while driving": "learning.learn learning.publish learning.rollback",
    "Measure": "tracks.limit race.bench race.latency race.paper",
    "Evidence": "evidence.replay evidence.scenario evidence.shadow evidence.timing",
    "Many laps": "race.campaign race.campaign_report race.campaign_scheduler "
    "race.campaign_worker race.tune",
    "Export to other tools": "export.export export.fmu",
}
"""Sections of the help: commands, or groups of them, in the modules of this package."""


def _name(place: str) -> str:
    return place.partition(".")[2].replace("_", "-")


_PLACES: Final = {_name(place): place for places in _TASKS.values() for place in places.split()}


def _declared(name: str) -> Any:
    """The function of a command, or a group of them."""
    module, _, attribute = _PLACES[name].partition(".")
    return getattr(import_module(f"bayesrace.operation.cli.{module}"), attribute)


def _whole(name: str) -> Any:
    """A command, or a group of them, with all options."""
    found = _declared(name)
    group = found if isinstance(found, Group) else None
    made = typer.Typer(
        help=group and group.help,
        no_args_is_help=group is not None,
        add_completion=False,
        rich_markup_mode=None,
    )
    for one, function in (group.commands if group else {name: found}).items():
        made.command(one)(configured(function))
    return get_command(made)


class _Commands(TyperGroup):
    def list_commands(self, ctx: Any) -> list[str]:
        return list(_PLACES)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Name and help of a command, which is what lists show; None for an unknown name."""
        if cmd_name not in _PLACES:
            return None
        found = _declared(cmd_name)
        text = found.help if isinstance(found, Group) else found.__doc__
        return TyperCommand(cmd_name, help=text)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command that is called, with its options."""
        if args[0] in _PLACES:
            return args[0], _whole(args[0]), args[1:]
        self.commands = {name: self.get_command(ctx, name) for name in _PLACES}  # one may be meant
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """A section for each task."""
        for task, places in _TASKS.items():
            names = [_name(place) for place in places.split()]
            texts = [self.get_command(ctx, name).help.split("\n\n")[0].split() for name in names]
            with formatter.section(task):
                formatter.write_dl(list(zip(names, map(" ".join, texts), strict=True)))


app = typer.Typer(
    name="bayesrace",
    help="Real-time GP-MPC racing: a compiled controller that learns from its own laps.",
    no_args_is_help=True,
    rich_markup_mode=None,
    cls=_Commands,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(wanted: bool) -> None:
    if wanted:
        from bayesrace import __version__

        typer.echo(f"bayesrace {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Print the version and exit."
    ),
) -> None:
    from bayesrace.operation.terminal import PrintableFormatter

    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(PrintableFormatter("%(name)s: %(message)s"))
    logging.basicConfig(level=logging.INFO, handlers=[handler])


def main() -> None:
    """Runs the command line; bad input and lost processes end in one line, not in a traceback."""
    if os.getpid() == 1:  # as in a container: the system has no default action for it
        signal.signal(signal.SIGTERM, lambda number, _frame: sys.exit(128 + number))
    # At the very end the interpreter looks for cyclic garbage once more, 0.05 s and longer.
    atexit.register(gc.freeze)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal may lack characters that we print
            stream.reconfigure(errors="replace")
    try:
        # Typer turns Ctrl-C and Exit into the value it returns, and older ones Ctrl-C into Abort.
        with remembering_interrupts():
            code = app(standalone_mode=False, prog_name="bayesrace")
            if code == _INTERRUPTED:
                raise KeyboardInterrupt
        sys.exit(code)
    except (typer.Abort, KeyboardInterrupt):
        cause = interrupt_cause()
        _fail(str(cause or "interrupted"), _code(cause) if cause else _INTERRUPTED)
    except Exception as error:
        text = _in_words(error)
        if text is None:
            raise
        _fail(text, _code(error))


def _code(error: Exception) -> int:
    """The exit code."""
    ours = isinstance(error, RuntimeError) and not isinstance(error, RecursionError)
    system = error.__cause__ if isinstance(error, InputError) else error
    passes = isinstance(system, OSError) and system.errno in PASSING
    restart = passes or isinstance(error, RestartError)
    return _RESTART if restart else 1 if ours else 2


def _in_words(error: Exception) -> str | None:
    """The message for the user; None for a fault of the program's own, which gets a traceback."""
    from pydantic import ValidationError

    match error:
        case InputError():
            return str(error)
        case ValidationError():
            return faults_in(error, "settings")
        case ModuleNotFoundError(name=str(name)):
            return _missing(name.partition(".")[0])
        case shutil.Error():  # of several files: source, target, why
            _, target, why = error.args[0][0]
            return f"{target}: {why}; choose a path that can be written, or make room"
        case OSError():
            where = error.filename or f"the cache, {gettempdir()} or the output"
            return f"{where}: {error.strerror or error}; choose a path that can be read or written"
        case RecursionError():
            return "a file or an option is nested too deeply to be read"
        case RuntimeError():  # our own: RaceError, RaceLineError, CompileError, FmuFault
            return str(error) if type(error).__module__.startswith("bayesrace.") else None
    explain = getattr(error, "format_message", None)  # Click's
    return None if explain is None else str(explain())


def _missing(package: str) -> str | None:
    """What to install for a package; None if no extra brings it."""
    extra = next((name for name, packages in _EXTRAS.items() if package in packages), None)
    if extra is None:
        return None
    return f"this command needs {package}, which is not installed: pip install 'bayesrace[{extra}]'"


def _fail(text: str, code: int = 2) -> None:
    from bayesrace.operation.terminal import printable

    lines = [printable(line.strip()) for line in text.splitlines() if line.strip()]
    several = any(line.startswith("- ") for line in lines)  # faults, as of a map: a line each
    line = ("\n  " if several else "; ").join(lines)
    if not line:  # no command given: the help has been shown
        sys.exit(code)
    typer.secho(f"bayesrace: {line}", err=True, fg=typer.colors.RED)
    sys.exit(code)
