"""``config``: the configuration file, shown, checked and begun."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bayesrace.errors import InputError
from bayesrace.files import write_whole
from bayesrace.messages import Role
from operation.cli.configured import current
from operation.cli.options import writable

if TYPE_CHECKING:
    from bayesrace.configuration import Configuration

__all__ = ["config"]

config = typer.Typer(
    name="config",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    help="The configuration, bayesrace.toml: where processes are, how they are secured.",
)


@config.command()
def show() -> None:
    """Print the configuration that commands use here: the file, and the defaults of all else."""
    from bayesrace.configuration import as_toml

    typer.echo(as_toml(current()), nl=False)


@config.command()
def check(
    file: Annotated[
        Path | None,
        typer.Argument(
            metavar="FILE", show_default="the one that commands use here", help="Configuration."
        ),
    ] = None,
) -> None:
    """Check a configuration: each value, and the certificates that it names.

    'bayesrace doctor' tries the links, too.
    """
    from bayesrace.configuration import configured, read_configuration

    found = configured() if file is None else read_configuration(file)
    found.network.check()
    typer.echo(f"{file or 'configuration'}: {_certificates(found)}")


def _certificates(found: "Configuration") -> str:
    """What there is of certificates, each of which is read; InputError if one cannot be used."""
    from bayesrace.transport.session import zenoh_config

    names: tuple[Role, ...] = ("plant", "controller", "director", "router")
    if found.tls.folder is None:
        for role in names:
            (ends := found.endpoints(role)).check()
            zenoh_config(ends, role)
        reach = "open to everyone in the network" if found.network.insecure else "for loopback only"
        return f"fine; no certificates, so links are {reach}"
    there = found.tls.certificates()
    if not there:
        raise InputError(
            f"no certificates in {found.tls.folder}: make them with 'bayesrace certs', or correct "
            "[tls] folder"
        )
    roles = {one.name: "revoked" if one.member is None else one.member.role for one in there}
    for role in names:
        if role in roles.values():
            (ends := found.endpoints(role)).check()
            zenoh_config(ends, role)
    return "fine; certificates " + ", ".join(f"'{name}' ({role})" for name, role in roles.items())


@config.command()
def example(
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="FILE",
            callback=writable,
            show_default="printed",
            help="File to write; never over another one.",
        ),
    ] = None,
) -> None:
    """Write a configuration to start from: every setting with its default and its meaning."""
    from bayesrace.configuration import Configuration, as_toml

    text = as_toml(Configuration(), explained=True)
    if out is None:
        typer.echo(text, nl=False)
    elif out.exists():
        raise InputError(f"{out} exists: name another file, or remove it")
    else:
        write_whole(out, text)
