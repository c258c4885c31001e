"""What every command has beside its own options: those of its settings, and ``--config``."""

import functools
import inspect
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from inspect import Parameter
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

import typer
from typer.models import OptionInfo

from bayesrace.defaults import CONFIGURATION_VARIABLE
from operation.cli.fields import SettingsOptions, inner_type, keyword, metavar

__all__ = ["configured"]

Insecure = Annotated[
    bool,
    typer.Option(
        "--insecure",
        help="Allow endpoints beyond loopback without certificates, where anyone could drive the "
        "car.",
    ),
]
ConfigFile = Annotated[
    Path | None,
    typer.Option(
        "--config",
        metavar="FILE",
        show_default=f"that of {CONFIGURATION_VARIABLE}, if any",
        help="Configuration, as 'bayesrace config example' writes it.",
    ),
]


def configured(command: Callable[..., None]) -> Callable[..., None]:
    """The command as Typer calls it, which is once the configuration has been read.

    It may take ``configuration``, or ``network``, the same with ``--insecure``; and ``settings``,
    if :func:`operation.cli.fields.options_of` marks it. The processes that it starts read the same
    configuration.
    """
    settings = SettingsOptions.of(command)
    own = dict(inspect.signature(command).parameters)
    taken = [name for name in ("configuration", "network") if own.pop(name, None)]
    places = {name: [_with_metavar(one)] for name, one in own.items()}
    if settings is not None:
        places["settings"] = settings.parameters
    if "network" in taken:
        places["insecure"] = [keyword("insecure", Insecure, False)]
    places["config"] = [keyword("config", ConfigFile, None)]
    parameters = [one for place in places.values() for one in place]

    @functools.wraps(command)
    def run(config: Path | None, insecure: bool = False, **options: Any) -> None:
        from bayesrace.configuration import configured as configuration_of_process

        with _named(config):
            found = configuration_of_process()
            if insecure:
                network = found.network.model_copy(update={"insecure": True})
                found = found.model_copy(update={"network": network})
            if settings is not None:
                options["settings"] = settings.given(options)
            command(**options, **dict.fromkeys(taken, found))

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {one.name: one.annotation for one in parameters}
    return run


def _with_metavar(parameter: Parameter) -> Parameter:
    """Of a command's own option, which may lack one."""
    kind, option = parameter.annotation, parameter.default
    if get_origin(kind) is Annotated:
        kind, option = get_args(kind)
    if isinstance(option, OptionInfo) and option.metavar is None:
        option.metavar = metavar(inner_type(kind), parameter.name)
    return parameter.replace(kind=Parameter.KEYWORD_ONLY)


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
