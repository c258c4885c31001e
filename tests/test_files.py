"""Files that are replaced: whole, on the disk before they are seen, nothing left beside them."""

import os
from contextlib import suppress
from pathlib import Path

import pytest

from bayesrace.errors import InputError
from bayesrace.files import claimed, clear_partials, replacing, write_whole


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "laps.json"
    write_whole(path, "first é")
    with suppress(ZeroDivisionError), replacing(path) as partial:
        partial.write_text("sec")
        raise ZeroDivisionError
    assert path.read_text(encoding="utf-8") == "first é"
    with replacing(path) as partial:
        assert partial.suffix == path.suffix, "numpy.savez would write to another file"
        partial.write_bytes(b"second")
        assert path.read_text(encoding="utf-8") == "first é"
    assert path.read_bytes() == b"second"
    assert list(tmp_path.iterdir()) == [path]


def test_the_content_is_on_the_disk_before_the_name_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a power failure could leave an empty file in place of the old one."""
    path, steps = tmp_path / "kept-0001.npz", []

    def fsync(descriptor: int) -> None:
        synced = Path(f"/proc/self/fd/{descriptor}").readlink()
        steps.append((synced.suffix, path.exists()))

    monkeypatch.setattr(os, "fsync", fsync)
    write_whole(path, b"samples")
    assert steps == [(".npz", False), ("", True)]


def test_what_killed_processes_have_begun_is_cleared_away(tmp_path: Path) -> None:
    (tmp_path / ".gitignore").touch()
    (tmp_path / "data.part.npz").touch()
    with replacing(tmp_path / "a.npz") as partial:
        partial.touch()
        (tmp_path / "copy").write_text(partial.name)
    (tmp_path / (tmp_path / "copy").read_text()).touch()
    clear_partials(tmp_path)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {".gitignore", "a.npz", "copy", "data.part.npz"}


def test_a_device_is_not_replaced_by_a_file(tmp_path: Path) -> None:
    """Root could: of 'bayesrace train … --out /dev/null' the null device would be gone."""
    os.mkfifo(path := tmp_path / "pipe")
    with pytest.raises(OSError, match="not a regular file"):
        write_whole(path, b"")
    assert path.is_fifo()


def test_a_folder_is_claimed_by_one_process(tmp_path: Path) -> None:
    """Of two races that begin in one folder at once, the second is refused."""
    folder = tmp_path / "run"
    with (
        claimed(folder),
        pytest.raises(InputError, match="another process writes to"),
        claimed(folder),
    ):
        pass
    with claimed(folder):
        assert folder.is_dir()
