"""Temporary folders: private, deleted, and those of killed processes cleared away by the next."""

import os
import signal
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from bayesrace.files import temporary_folder

HOLD = """
import time
from bayesrace.files import temporary_folder
with temporary_folder() as folder:
    (folder / "content").touch()
    print(folder, flush=True)
    time.sleep(60)
"""


def test_a_folder_goes_with_its_owner_or_after_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with subprocess.Popen(
        [sys.executable, "-c", HOLD], env=os.environ | {"TMPDIR": str(tmp_path)},
        stdout=subprocess.PIPE, text=True,
    ) as owner:  # fmt: skip
        assert owner.stdout is not None
        theirs = Path(owner.stdout.readline().strip())
        os.utime(theirs, (0, 0))
        with temporary_folder() as folder:
            assert stat.S_IMODE(folder.stat().st_mode) == 0o700
            assert theirs.is_dir()
        assert not folder.exists()
        owner.send_signal(signal.SIGKILL)
    with temporary_folder():
        assert not theirs.exists()


def test_a_new_folder_may_not_be_locked_yet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with temporary_folder() as folder:
        new = tmp_path / f"{folder.name}x"
        new.mkdir()
    with temporary_folder():
        assert new.is_dir()
