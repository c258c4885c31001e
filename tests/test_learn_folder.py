"""The folder of a learning job: which job may use it, and how a job resumes there."""

import json
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from bayesrace.errors import InputError
from bayesrace.gp.weights import read_weights, zero_weights
from bayesrace.integrators import PERFECT, PREDICTION
from bayesrace.learning.dataset import concatenate
from bayesrace.learning.subset import MOST_NEW
from bayesrace.operation.learn.journal import MOST_WEIGHTS, Journal
from bayesrace.operation.learn.records import LearnSettings, UpdateRecord
from bayesrace.vehicles.models import dynamic
from tests.driven import CAR, drive
from tests.learning_rig import lap

SETTINGS = LearnSettings(car=CAR)
NAME = PREDICTION.identity("e_kinematic", CAR)


@contextmanager
def opened(folder: Path, settings: LearnSettings = SETTINGS) -> Iterator[Journal]:
    with closing(Journal(folder, settings)) as journal:
        yield journal


def test_a_job_resumes_with_the_record_and_the_samples(tmp_path: Path) -> None:
    """A sample that was being learned from is learned from again."""
    samples = drive(dynamic(CAR), 60, seed=1)
    kept = samples.select(slice(20))
    with opened(tmp_path / "job") as journal:
        assert not journal.resumed
        journal.add_driven(samples, lap(1, 5.0))
        journal.take_samples()
        journal.add_update(UpdateRecord(after_lap=1, version="a", verdict="refused"), None, kept)
        journal.add_update(UpdateRecord(after_lap=1, verdict="failed"), None)
        journal.add_driven(samples)
        journal.take_samples()
        record = journal.record
    (tmp_path / "job/.laps.1.part.json").touch()
    with opened(tmp_path / "job") as again:
        assert again.resumed
        assert again.record == record
        taken = again.take_samples()
        assert taken is not None
        assert taken.digest() == concatenate([kept, samples]).digest()
    assert {path.name for path in (tmp_path / "job").iterdir()} == {"laps.json", "samples.npz"}
    content = json.loads((tmp_path / "job/laps.json").read_text())
    assert content["laps"][0]["time_s"] == 5.0


def test_samples_stay_bounded(tmp_path: Path) -> None:
    """Of too many at once evenly spread ones are learned from."""
    samples = drive(dynamic(CAR), 100, seed=1)
    many = samples.select([k % 100 for k in range(15_000)])
    with opened(tmp_path) as journal:
        for _ in range(2):
            journal.add_driven(many)
        assert len(journal.take_samples() or ()) == MOST_NEW


def test_weights_files_stay_bounded(tmp_path: Path) -> None:
    """The newest; those in use and those last accepted, however old. No orphans."""
    with opened(tmp_path) as journal:
        for k in range(MOST_WEIGHTS + 8):
            verdict = "accepted" if k in (2, 3) else "refused"
            update = UpdateRecord(after_lap=k // 2, verdict=verdict)
            journal.add_update(update, zero_weights(CAR.name, NAME, f"v{k}"))
            journal.drop_weights(in_use="v2")
        (tmp_path / "weights-9999.bin").touch()
        journal.drop_weights(in_use="v2")
        files = [update.file for update in journal.record.updates]
    left = {read_weights(path).version for path in tmp_path.glob("weights-*.bin")}
    assert left == {f"v{k}" for k in range(8, MOST_WEIGHTS + 8)} | {"v2", "v3"}
    assert len(set(files)) == len(files), "a deleted file's name is not given again"


@pytest.mark.parametrize(
    "changes", [{"name": "other"}, {"discretisation": PERFECT}], ids=["name", "discretisation"]
)
def test_a_job_of_another_car_or_model_does_not_resume(
    tmp_path: Path, changes: dict[str, Any]
) -> None:
    with opened(tmp_path) as journal:
        journal.add_driven(None, lap(1, 5.0))
    with pytest.raises(InputError, match="choose another"):
        Journal(tmp_path, SETTINGS.model_copy(update=changes))
    with opened(tmp_path) as journal:
        assert journal.resumed


def test_two_jobs_in_one_folder_are_refused(tmp_path: Path) -> None:
    """Each would overwrite what the other has written; the lock ends with its owner."""
    folder = tmp_path / "job"
    with opened(folder) as journal:
        with pytest.raises(
            InputError, match=f"another process writes to {folder}: wait for its end"
        ):
            Journal(folder, SETTINGS)
        journal.add_driven(None, lap(1, 5.0))
    with opened(folder) as again:
        assert len(again.record.laps) == 1


@pytest.mark.parametrize("name", ["laps.json", "samples.npz"])
def test_a_damaged_file_is_reported_at_once_with_the_remedy(tmp_path: Path, name: str) -> None:
    """Not by each training to come."""
    with opened(tmp_path) as journal:
        journal.add_driven(drive(dynamic(CAR), 200, seed=1))
    path = tmp_path / name
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match=f"{name}.* restore it, or choose another folder"):
        Journal(tmp_path, SETTINGS)


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(InputError, match="something else"):
        Journal(tmp_path, SETTINGS)
