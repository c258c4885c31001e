"""Images of the Dockerfile, built for real without a daemon: by buildah, on debootstrap's base."""

import os
import re
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from tests.programs import ROOT
from tests.shared import shared_folder

__all__ = ["Container", "Store", "missing_tools"]

_PACKAGES: Final = "python3,python3-venv,ca-certificates"
_SUITE: Final = "bookworm"


def missing_tools() -> str:
    """Why no image can be built here; empty if one can."""
    missing = [one for one in ("buildah", "debootstrap") if shutil.which(one) is None]
    if missing:
        return f"needs {' and '.join(missing)}, see .ci/tools"
    return "" if os.geteuid() == 0 else "needs root: buildah runs each step in a chroot"


def _run(*command: str | Path) -> str:
    done = subprocess.run([str(word) for word in command], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, f"{command}: {done.stdout[-2000:]}{done.stderr[-2000:]}"
    return done.stdout.strip()


def _base_archive() -> Path:
    """Debian with Python, made once on this machine."""

    def make(folder: Path) -> None:
        listed = _run(
            "apt-get", "indextargets", "--format", "$(REPO_URI) $(ORIGIN)", "Created-By: Packages"
        )
        debian = next(line.split()[0] for line in listed.splitlines() if line.endswith("Debian"))
        root = folder / "root"
        _run("debootstrap", "--variant=minbase", f"--include={_PACKAGES}", _SUITE, root, debian)
        _run("tar", "-C", root, "-cf", folder / "base.tar", ".")
        shutil.rmtree(root)

    return shared_folder("container-base", (_SUITE, _PACKAGES), make) / "base.tar"


def _host_files() -> list[str]:
    """Where pip of this machine finds packages and authorities, for pip in the build."""
    listed = subprocess.run(["pip", "config", "list"], capture_output=True, text=True).stdout
    found = {Path(path) for path in re.findall(r"(?:file://)?(/[^\s']+)", listed)}
    known = {Path("/etc/pip.conf"), Path("/etc/xdg/pip"), Path("/etc/ssl/certs")}
    there = sorted(path for path in found | known if path.exists())
    return [word for path in there for word in ("--volume", f"{path}:{path}:ro")]


class Store:
    """Images of this run, in a folder of their own."""

    def __init__(self, folder: Path) -> None:
        # overlay shares layers; where a sandbox refuses it, vfs copies each.
        for driver in ("overlay", "vfs"):
            self._buildah = [
                "buildah", "--root", str(folder / driver), "--runroot", str(folder / "run"),
                "--storage-driver", driver,
            ]  # fmt: skip
            tried = subprocess.run([*self._buildah, "from", "scratch"], capture_output=True)
            if tried.returncode == 0:
                break

    def buildah(self, *words: str | Path) -> str:
        """What a command of buildah prints; AssertionError if it fails."""
        return _run(*self._buildah, *words)

    def build(self, targets: Sequence[str]) -> None:
        """The images of these targets of the Dockerfile."""
        container = self.buildah("from", "scratch")
        self.buildah("add", "--quiet", container, _base_archive(), "/")
        self.buildah("commit", "--quiet", "--rm", container, "base")
        for target in targets:
            self.buildah(
                "bud", "--isolation", "chroot", "--layers", "--file", "docker/Dockerfile",
                "--ignorefile", "docker/Dockerfile.dockerignore",
                "--build-arg", "BASE=localhost/base", "--target", target, *_host_files(),
                "--tag", target, ".",
            )  # fmt: skip

    @contextmanager
    def container(self, target: str, *volumes: str) -> Iterator["Container"]:
        """One of an image, for the block; ``volumes``: HOST:CONTAINER."""
        name = self.buildah("from", f"localhost/{target}")
        shared = [word for one in volumes for word in ("--volume", one)]
        try:
            yield Container([*self._buildah, "run", "--isolation", "chroot", *shared, name, "--"])
        finally:
            self.buildah("rm", name)


class Container:
    """Its processes are those of the image's user, on this machine's network."""

    def __init__(self, command: list[str]) -> None:
        self._command = command

    def line(self, *words: str | Path) -> list[str]:
        """A command line that runs ``bayesrace`` with these words in it."""
        return [*self._command, "bayesrace", *map(str, words)]

    def run(self, *words: str) -> str:
        """What a program in it prints; AssertionError if it fails."""
        return _run(*self._command, *words)
