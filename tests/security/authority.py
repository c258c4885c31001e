"""An authority with a certificate for each role, made once a run, and others that do not count."""

import shutil
from pathlib import Path
from typing import Final

import pytest

from bayesrace.messages import Role
from bayesrace.operation.certificates import add, init, revoke
from bayesrace.transport import Credentials, Endpoints
from tests.shared import session_folder

__all__ = ["CAR", "OTHER", "Bundles", "bundles", "make_bundles", "written"]

CAR: Final = "orca"
OTHER: Final = "blue"


class Bundles:
    """Folders of certificates, by name."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, name: str) -> Path:
        """The folder of a certificate."""
        place = self.folder if (self.folder / name).is_dir() else self.folder / "bad"
        return place / name

    def credentials(self, name: str) -> Credentials:
        """What a process reads there."""
        return Credentials.read(self.path(name))

    def endpoints(
        self, name: str, listen: tuple[str, ...] = (), connect: tuple[str, ...] = ()
    ) -> Endpoints:
        """Those of a process with that certificate."""
        return Endpoints(listen=listen, connect=connect, credentials=self.credentials(name))


def make_bundles(folder: Path) -> None:
    """Makes them all."""
    init(folder)
    drivers: tuple[Role, ...] = ("plant", "controller")
    for role in drivers:
        add(folder, role, role, CAR)
        add(folder, f"{OTHER}-{role}", role, OTHER)
    roles: tuple[Role, ...] = ("learning", "director", "viewer", "router")
    for role in roles:
        add(folder, role, role)
    add(folder, "shadow", "shadow", CAR)
    add(folder, "one-viewer", "viewer", CAR)
    bad = folder / "bad"
    bad.mkdir()
    add(folder, "expired", "controller", CAR, days=-0.5)
    add(folder, "stale", "controller", CAR)
    shutil.copytree(folder / "stale", bad / "revoked")  # it does not know yet
    revoke(folder, "stale")
    for name in ("expired", "stale"):
        shutil.move(folder / name, bad / name)
    foreign = folder / "foreign"
    init(foreign)
    add(foreign, "controller", "controller", CAR)
    add(foreign, "plant", "plant", CAR)
    for name in ("controller", "plant"):
        shutil.move(foreign / name, bad / f"foreign-{name}")
    shutil.rmtree(foreign)


@pytest.fixture(scope="session")
def bundles(tmp_path_factory: pytest.TempPathFactory) -> Bundles:
    """Certificates of one authority, and in ``bad`` what does not count."""
    return Bundles(session_folder(tmp_path_factory, "certificates", make_bundles))


def written(folder: Path, bundles: Bundles, plant: str, controller: str, /, **use: str) -> Path:
    """A configuration with these certificates; ``use``: role to certificate."""
    path = folder / "bayesrace.toml"
    names = ", ".join(f'{role} = "{name}"' for role, name in use.items())
    path.write_text(
        f'[network]\nplant = ["{plant}"]\ncontroller = ["{controller}"]\n'
        f'[tls]\nfolder = "{bundles.folder}"\nuse = {{ {names} }}\n'
    )
    return path
