"""One race on the shortest track, driven once for all tests that look at a race."""

import shutil
import subprocess
from pathlib import Path

import pytest

from tests.programs import Race, leftovers, peanut
from tests.shared import session_folder

__all__ = ["peanut_race", "peanut_track"]


@pytest.fixture(scope="session")
def peanut_track(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """File of the shortest track."""
    folder = session_folder(tmp_path_factory, "track", lambda path: peanut(path / "peanut.csv"))
    return folder / "peanut.csv"


@pytest.fixture(scope="session")
def peanut_race(peanut_track: Path, tmp_path_factory: pytest.TempPathFactory) -> Race:
    """A race that collects and drives on the shortest track, all else by default."""

    def make(folder: Path) -> None:
        out = tmp_path_factory.mktemp("race") / "driven"
        tracks = ("--track", peanut_track, "--train-track", peanut_track, "--progress-drives", "2")
        race = Race.running(out, *tracks)()
        assert leftovers(race.pid) == {}
        shutil.copytree(race.out, folder / "run")
        (folder / "stdout").write_text(race.process.stdout)

    folder = session_folder(tmp_path_factory, "race", make)
    text = (folder / "stdout").read_text()
    return Race(folder / "run", 0, subprocess.CompletedProcess([], 0, text, ""))
