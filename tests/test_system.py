"""Plant and controllers as processes: started for a block, immune, never left behind."""

import subprocess
import sys
from pathlib import Path

import pytest

from bayesrace.errors import InputError
from bayesrace.operation.system import started_system
from bayesrace.vehicles import DEFAULT_CAR
from tests.programs import until

pytestmark = pytest.mark.wall_clock

PARTS = ("codegen", "controller", "learning", "operation", "plant", "studies")


def test_a_users_files_of_our_names_are_not_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in PARTS:
        (tmp_path / f"{name}.py").write_text("raise SystemExit('the wrong file')\n")
    monkeypatch.chdir(tmp_path)
    line = [sys.executable, "-c", "from bayesrace.operation.closed_loop import ClosedLoop"]
    subprocess.run(line, check=True)
    (tmp_path / "bayesrace.py").write_text("raise SystemExit('the wrong file')\n")
    with started_system(DEFAULT_CAR, tmp_path) as system:
        system.director.wait_for(("plant",), 60.0)
        plant = system.children["plant"]
    assert plant.ended()


def test_a_process_that_cannot_start_is_explained_by_its_last_message(tmp_path: Path) -> None:
    with started_system(DEFAULT_CAR, tmp_path) as system:
        with (
            pytest.raises(InputError, match=r"controller ended with code 2.*CSV file no"),
            system.controller(["--artefact", "nowhere", "--track", "harbour", "--raceline", "no"]),
        ):
            pass
        assert not system.children["plant"].ended()
    until(system.children["plant"].ended, "the plant's end", 10.0)
