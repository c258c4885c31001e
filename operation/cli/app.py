"""The Typer application: subcommands grouped by task, and errors as one line."""

import atexit
import gc
import io
import logging
import shutil
import sys
from tempfile import gettempdir
from typing import Annotated, ClassVar, Final

import typer

from bayesrace.errors import InputError, faults_in
from bayesrace.interrupts import remembering_interrupts
from operation.cli.help import TaskGroup

__all__ = ["app", "main"]

_INTERRUPTED: Final = 130
_OUR_OWN: Final = ("bayesrace", "codegen", "operation", "plant", "studies")

_FMU_PACKAGES: Final = ("fmpy", "pint")
_RACE_PACKAGES: Final = (
    "PIL", "casadi", "contourpy", "hdrh", "jinja2", "lz4", "matplotlib", "mcap", "rich", "scipy",
    "sklearn", "threadpoolctl", "yaml", "zstandard",
)  # fmt: skip
_SLIPX_PACKAGES: Final = ("slipx",)
_CERTIFICATE_PACKAGES: Final = ("cryptography",)
_CAMPAIGN_PACKAGES: Final = ("bokeh", "dask", "distributed", "optuna", "pandas", "pyarrow")
"""Modules that the extras of pyproject.toml install."""


class _Commands(TaskGroup):
    tasks: ClassVar[dict[str, tuple[str, ...]]] = {
        "Race": ("evaluation.race", "evaluation.report"),
        "Prepare": (
            "tracks.tracks", "preparation.cars", "raceline.raceline", "preparation.collect",
            "preparation.train", "learning.validate", "preparation.build",
        ),
        "Drive": (
            "parts.plant", "parts.controller", "evaluation.drive", "operation.status",
            "operation.stop", "operation.go", "operation.router", "operation.doctor",
            "configuration.config", "certificates.certs",
        ),
        "Learn while driving": ("learning.learn", "learning.publish", "learning.rollback"),
        "Measure": ("limit.limit", "evaluation.bench", "latency.latency", "paper.paper"),
        "Many laps": (
            "campaign.campaign", "campaign.campaign_report", "campaign.campaign_worker",
            "campaign.tune",
        ),
        "Export to other tools": ("preparation.export", "fmu.fmu"),
    }  # fmt: skip
    networked = frozenset({
        "parts.plant", "parts.controller", "evaluation.drive", "operation.status", "operation.stop",
        "operation.go", "operation.router", "operation.doctor", "learning.learn",
        "learning.publish", "learning.rollback", "latency.latency",
    })  # fmt: skip


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
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    from operation.terminal.printable import PrintableFormatter

    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(PrintableFormatter("%(name)s: %(message)s"))
    logging.basicConfig(level=logging.INFO, handlers=[handler])


def main() -> None:
    """Runs the command line; bad input and lost processes end in one line, not in a traceback."""
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
        _fail("interrupted", _INTERRUPTED)
    except Exception as error:
        text = _in_words(error)
        if text is None:
            raise
        ours = isinstance(error, RuntimeError) and not isinstance(error, RecursionError)
        _fail(text, 1 if ours else 2)


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
            return str(error) if type(error).__module__.split(".")[0] in _OUR_OWN else None
    explain = getattr(error, "format_message", None)  # Click's
    return None if explain is None else str(explain())


def _missing(package: str) -> str | None:
    """What to install for a package; None if no extra brings it."""
    extras = {
        "fmu": _FMU_PACKAGES, "race": _RACE_PACKAGES, "campaign": _CAMPAIGN_PACKAGES,
        "slipx": _SLIPX_PACKAGES, "certificates": _CERTIFICATE_PACKAGES,
    }  # fmt: skip
    extra = next((name for name, packages in extras.items() if package in packages), None)
    if extra is None:
        return None
    return f"this command needs {package}, which is not installed: pip install 'bayesrace[{extra}]'"


def _fail(text: str, code: int = 2) -> None:
    from operation.terminal.printable import printable

    lines = [printable(line.strip()) for line in text.splitlines() if line.strip()]
    several = any(line.startswith("- ") for line in lines)  # faults, as of a map: a line each
    line = ("\n  " if several else "; ").join(lines)
    if not line:  # no command given: the help has been shown
        sys.exit(code)
    typer.secho(f"bayesrace: {line}", err=True, fg=typer.colors.RED)
    sys.exit(code)
