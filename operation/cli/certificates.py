"""``certs``: the certificates by which the processes of a system know each other."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, get_args

import typer

from bayesrace.messages import Role
from operation.cli.configured import current

__all__ = ["certs"]

certs = typer.Typer(
    name="certs",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    help="Certificates: who may drive, learn, command or look on.",
)

Folder = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        show_default="[tls] folder as configured; certs",
        help="Folder of the certificates and of the authority that signs them.",
    ),
]
Name = Annotated[str, typer.Argument(metavar="NAME", help="Name in the certificate.")]
ROLES = ", ".join(get_args(Role))


def _folder(given: Path | None) -> Path:
    return given or current().tls.folder or Path("certs")


@certs.command()
def init(folder: Folder = None) -> None:
    """Make the authority of a system, once; its folder 'authority' belongs on no car."""
    from operation.certificates import init as make

    make(_folder(folder))
    typer.echo(f"{_folder(folder)}: next, 'bayesrace certs add NAME --role ROLE'")


@certs.command()
def add(
    name: Name,
    role: Annotated[
        Role | None, typer.Option(metavar="ROLE", show_default=False, help=f"One of {ROLES}.")
    ] = None,
    car: Annotated[
        str | None,
        typer.Option(
            metavar="CAR", show_default="every car", help="The one car that it is for, by its name."
        ),
    ] = None,
    host: Annotated[
        list[str] | None,
        typer.Option(
            metavar="HOST",
            show_default="loopback only",
            help="Name or address by which others connect to its process; repeatable.",
        ),
    ] = None,
    days: Annotated[
        int, typer.Option(metavar="N", min=1, max=3650, help="Days until it expires.")
    ] = 365,
    renew: Annotated[
        bool, typer.Option("--renew", help="Replace the one of this name; what is not given stays.")
    ] = False,
    folder: Folder = None,
) -> None:
    """Make a certificate: a folder to copy to the machine of its process.

    The list of members in all the folders changes: copy that, too, to where they are, and restart
    the processes there.
    """
    from operation.certificates import add as make

    made = make(_folder(folder), name, role, car, host or (), days, renew)
    typer.echo(f"{made}: copy it to its machine, and members.json in it to the others")


@certs.command("list")
def show(folder: Folder = None) -> None:
    """List the certificates, and when they expire."""
    from operation.certificates import read_register

    for name, one in sorted(read_register(_folder(folder)).items()):
        state = "revoked" if one.revoked else f"until {one.ends:%Y-%m-%d}"
        if not one.revoked and one.ends < datetime.now(UTC):
            state = f"expired {one.ends:%Y-%m-%d}"
        hosts = ", ".join(one.hosts) or "loopback"
        typer.echo(f"{name:<20} {one.role:<10} car {one.car:<12} {state:<18} {hosts}")


@certs.command()
def revoke(name: Name, folder: Folder = None) -> None:
    """Take a certificate off the list of members, for ever.

    It counts no more where the new list is and the process has been restarted.
    """
    from operation.certificates import revoke as take_off

    take_off(_folder(folder), name)
    typer.echo(
        f"'{name}' is revoked: copy members.json to each machine, and restart the processes there; "
        "until then they accept it"
    )
