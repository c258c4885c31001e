"""``--config`` of every command, and what the file and the options say together."""

import functools
import inspect
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bayesrace.defaults import CONFIGURATION_VARIABLE

if TYPE_CHECKING:
    from bayesrace.configuration import Configuration
    from bayesrace.messages import Role
    from bayesrace.realtime import RealtimeSettings
    from bayesrace.transport.endpoints import Endpoints

__all__ = ["configurable", "connect_to", "current", "networked", "realtime"]

ConfigFile = Annotated[
    Path | None,
    typer.Option(
        "--config",
        metavar="FILE",
        show_default=f"that of {CONFIGURATION_VARIABLE}, if any",
        help="Configuration, as 'bayesrace config example' writes it.",
    ),
]
Insecure = Annotated[
    bool,
    typer.Option(
        "--insecure",
        help="Allow endpoints beyond loopback without certificates, where anyone could drive the "
        "car.",
    ),
]

_current: ContextVar["Configuration | None"] = ContextVar("configuration", default=None)


def current() -> "Configuration":
    """The configuration of the command that runs."""
    from bayesrace.configuration import configured

    return _current.get() or configured()


def configurable(command: Callable[..., None]) -> Callable[..., None]:
    """The command with ``--config``: read before it runs, and by the processes that it starts."""

    def run(config: Path | None, **options: Any) -> None:
        from bayesrace.configuration import configured

        with _named(config), _used(configured()):
            command(**options)

    return _extended(command, run, {"config": (ConfigFile, None)})


def networked(command: Callable[..., None]) -> Callable[..., None]:
    """The same of a command that opens links, with ``--insecure``."""

    def run(config: Path | None, insecure: bool, **options: Any) -> None:
        from bayesrace.configuration import configured

        with _named(config):
            found = configured()
            network = found.network.model_copy(
                update={"insecure": insecure or found.network.insecure}
            )
            with _used(found.model_copy(update={"network": network})):
                command(**options)

    return _extended(command, run, {"insecure": (Insecure, False), "config": (ConfigFile, None)})


def connect_to(given: list[str] | None, role: "Role") -> "Endpoints":
    """What a command connects to: the endpoints given, or those of the configuration."""
    return current().endpoints(role, connect=given or None)


def realtime(
    cpu: int | None = None, fifo: int | None = None, lock_memory: bool = False
) -> "RealtimeSettings":
    """What is given, else as configured."""
    given = {"cpu": cpu, "fifo": fifo, "lock_memory": lock_memory or None}
    update = {name: value for name, value in given.items() if value is not None}
    return current().realtime.model_copy(update=update)


@contextmanager
def _named(config: Path | None) -> Iterator[None]:
    """For the block, the environment variable names the file, for this process and its children."""
    before = os.environ.get(CONFIGURATION_VARIABLE)
    if config is not None:
        os.environ[CONFIGURATION_VARIABLE] = str(config.absolute())
    try:
        yield
    finally:
        if config is not None and before is None:
            del os.environ[CONFIGURATION_VARIABLE]
        elif before is not None:
            os.environ[CONFIGURATION_VARIABLE] = before


@contextmanager
def _used(configuration: "Configuration") -> Iterator[None]:
    token = _current.set(configuration)
    try:
        yield
    finally:
        _current.reset(token)


def _extended(
    command: Callable[..., None], run: Callable[..., None], added: dict[str, tuple[Any, Any]]
) -> Callable[..., None]:
    """``run`` with the command's options and more, as Typer reads them off a signature."""
    signature = inspect.signature(command)
    extra = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)
        for name, (kind, default) in added.items()
    ]
    functools.update_wrapper(run, command)
    run.__signature__ = signature.replace(  # type: ignore[attr-defined]
        parameters=[*signature.parameters.values(), *extra]
    )
    kinds = {name: kind for name, (kind, _) in added.items()}
    run.__annotations__ = {**command.__annotations__, **kinds}
    return run
