"""The Typer application: one module per group of subcommands, and errors as one line."""

import logging
import sys
from typing import Annotated, Final

import typer
from pydantic import ValidationError

from bayesrace import __version__
from bayesrace.errors import InputError
from bayesrace.interrupts import remembering_interrupts
from experiments.cli import evaluation, fmu, latency, learning, operation, parts, preparation

__all__ = ["app", "main"]

_INTERRUPTED: Final = 130
_OUR_OWN: Final = ("bayesrace", "codegen", "experiments", "plant")

app = typer.Typer(
    name="bayesrace",
    help="Real-time GP-MPC racing: a compiled controller that learns from its own laps.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"bayesrace {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print and exit.")
    ] = False,
) -> None:
    logging.basicConfig(level=logging.INFO, format="%(name)s: %(message)s", stream=sys.stderr)


for group in (evaluation, latency, preparation, learning, parts, operation, fmu):
    group.register(app)


def main() -> None:
    """Runs the command line; bad input and lost processes end in one line, not in a traceback."""
    try:
        # Typer turns Ctrl-C and Exit into the value it returns, and older ones Ctrl-C into Abort.
        with remembering_interrupts():
            code = app(standalone_mode=False, prog_name="bayesrace")
            if code == _INTERRUPTED:
                raise KeyboardInterrupt
        sys.exit(code)
    except InputError as error:
        _fail(str(error))
    except ValidationError as error:
        words = "; ".join(
            f"{'.'.join(str(part) for part in one['loc']) or 'settings'}: {one['msg']}"
            for one in error.errors()
        )
        _fail(words)
    except OSError as error:
        where = error.filename or "system"
        _fail(f"{where}: {error.strerror or error}; choose a path that can be read or written")
    except (typer.Abort, KeyboardInterrupt):
        _fail("interrupted", _INTERRUPTED)
    except RuntimeError as error:
        # our own: RaceError, RaceLineError, CompileError, FmuFault
        if type(error).__module__.split(".")[0] not in _OUR_OWN:
            raise
        _fail(str(error), 1)
    except Exception as error:
        click_error = getattr(error, "format_message", None)
        if click_error is None:
            raise
        _fail(click_error())


def _fail(text: str, code: int = 2) -> None:
    lines = list(filter(None, map(str.strip, text.splitlines())))
    several = any(line.startswith("- ") for line in lines)  # faults, as of a map: a line each
    line = ("\n  " if several else "; ").join(lines)
    if not line:  # no command given: the help has been shown
        sys.exit(code)
    typer.secho(f"bayesrace: {line}", err=True, fg=typer.colors.RED)
    sys.exit(code)
