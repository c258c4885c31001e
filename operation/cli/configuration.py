"""``config``, ``certs``: where the processes of a system are, and how they know each other."""

import os
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, get_args

import typer

from bayesrace.errors import InputError
from bayesrace.files import write_whole
from bayesrace.messages import Role
from bayesrace.operation.cli import options
from bayesrace.operation.cli.declaration import Group

if TYPE_CHECKING:
    from bayesrace.configuration import Configuration

__all__ = ["certs", "config"]

_FOLDER: Final = options.value(
    "Folder of the certificates and of the authority that signs them.",
    metavar="DIR",
    shown="[tls] folder as configured; certs",
)
_VARIABLE: Final = "BAYESRACE_PASSPHRASE"
_NAME: Final = options.argument("NAME", "Name in the certificate.")


def show(configuration: "Configuration") -> None:
    """Print the configuration that commands use here: the file, and the defaults of all else."""
    from bayesrace.configuration import as_toml

    typer.echo(as_toml(configuration), nl=False)


def check(
    configuration: "Configuration",
    file: Path | None = options.argument(
        "FILE", "Configuration.", None, "the one that commands use here"
    ),
) -> None:
    """Check a configuration: each value, and the certificates that it names.

    'bayesrace doctor' tries the links, too.
    """
    from bayesrace.configuration import read_configuration
    from bayesrace.operation.doctor import check_configuration

    found = configuration if file is None else read_configuration(file)
    typer.echo(f"{file or 'configuration'}: {check_configuration(found)}")


def example(
    out: Path | None = options.value(
        "File to write; never over another one.",
        None,
        "--out",
        "-o",
        shown="printed",
        callback=options.writable,
    ),
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


def firewall(
    configuration: "Configuration",
    role: Literal["plant", "controller", "router"] = options.argument(
        "ROLE", "plant, controller or router."
    ),
    listen: list[str] = options.value(
        "Endpoint where it listens; repeatable.", (), metavar="ENDPOINT", shown="as configured"
    ),
    out: Path | None = options.new_file("File to write.", "--out", "-o"),
) -> None:
    """Make the rules of nftables for a process: who may connect to it, and how often.

    Those are the hosts that [network] names; 'nft -f' loads the rules (docs/security.md).
    """
    from bayesrace.operation.firewall import rules

    text = rules(configuration.network, role, listen)
    typer.echo(text, nl=False) if out is None else write_whole(out, text)


def _folder(given: Path | None, configuration: "Configuration") -> Path:
    return given or configuration.tls.folder or Path("certs")


def _passphrase(new: bool = False) -> str:
    """Of the authority's key: from the environment, or from who sits at the terminal."""
    if given := os.environ.get(_VARIABLE):
        return given
    if not sys.stdin.isatty():
        raise InputError(
            f"the authority's key has a passphrase: give it in {_VARIABLE}, or at a terminal"
        )
    text = "Passphrase of the authority's key"
    return str(typer.prompt(text, hide_input=True, confirmation_prompt=new, err=True))


def init(
    configuration: "Configuration",
    passphrase: bool = options.flag(
        "--passphrase",
        f"Encrypt its key; 'certs add' and 'revoke' then ask, or read {_VARIABLE}.",
    ),
    folder: Path | None = _FOLDER,
) -> None:
    """Make the authority of a system, once; its folder 'authority' belongs on no car."""
    from bayesrace.operation.certificates import init as make

    where = _folder(folder, configuration)
    make(where, _passphrase(new=True) if passphrase else "")
    typer.echo(f"{where}: next, 'bayesrace certs add NAME --role ROLE'")


def add(
    configuration: "Configuration",
    name: str = _NAME,
    role: Role | None = options.value(f"One of {', '.join(get_args(Role))}."),
    car: str | None = options.value("The one car that it is for, by its name.", shown="every car"),
    host: list[str] = options.value(
        "Name or address by which others connect to its process; repeatable.",
        (),
        shown="loopback only",
    ),
    days: float = options.value(
        "Days until it expires.", 365.0, metavar="D", min=1 / 24, max=3650.0
    ),
    renew: bool = options.flag("--renew", "Replace the one of this name; what is not given stays."),
    folder: Path | None = _FOLDER,
) -> None:
    """Make a certificate: a folder to copy to the machine of its process.

    The list of members in all the folders changes: copy that, too, to where they are. Processes
    there use it at once, or after a run.
    """
    from bayesrace.operation.certificates import add as make

    where = _folder(folder, configuration)
    made = make(where, name, role, car, host, days, renew, _passphrase)
    typer.echo(f"{made}: copy it to its machine, and members.json in it to the others")


def members(configuration: "Configuration", folder: Path | None = _FOLDER) -> None:
    """List the certificates, and when they expire."""
    from bayesrace.operation.certificates import read_register

    for name, one in sorted(read_register(_folder(folder, configuration)).items()):
        state = "revoked" if one.revoked else f"until {one.ends:%Y-%m-%d %H:%M}"
        if not one.revoked and one.ends < datetime.now(UTC):
            state = f"expired {one.ends:%Y-%m-%d %H:%M}"
        hosts = ", ".join(one.hosts) or "loopback"
        typer.echo(f"{name:<20} {one.role:<10} car {one.car:<12} {state:<24} {hosts}")


def revoke(
    configuration: "Configuration", name: str = _NAME, folder: Path | None = _FOLDER
) -> None:
    """Take a certificate off the list of members, for ever.

    Its links are closed within a second where the new list is.
    """
    from bayesrace.operation.certificates import revoke as take_off

    take_off(_folder(folder, configuration), name, _passphrase)
    typer.echo(
        f"'{name}' is revoked: copy members.json to each machine; until then processes there "
        "accept it"
    )


config = Group(
    "The configuration, bayesrace.toml: where processes are, how they are secured.",
    {"show": show, "check": check, "example": example, "firewall": firewall},
)
certs = Group(
    "Certificates: who may drive, learn, command or look on.",
    {"init": init, "add": add, "list": members, "revoke": revoke},
)
