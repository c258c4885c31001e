"""The folder of a learning job: whose it is, what stays in it, and how a job goes on there."""

import json
from pathlib import Path
from typing import Any

import pytest

from bayesrace.errors import InputError
from bayesrace.gp.weights import read_weights, write_weights, zero_weights
from bayesrace.integrators import PERFECT, PREDICTION
from bayesrace.transport import Endpoints
from bayesrace.vehicles.models import dynamic
from experiments.learn.job import discretisation_from, learn
from experiments.learn.journal import MOST_WEIGHTS, Journal, UpdateRecord
from experiments.learn.loop import Learner
from experiments.learn.settings import LearnSettings
from experiments.learn.store import SampleStore
from learning.arrays import write_npz
from tests.driven import CAR, drive
from tests.learning_rig import lap

SETTINGS = LearnSettings(car=CAR.name)
NAME = PREDICTION.identity("e_kinematic", CAR)


def test_a_folder_is_gone_on_with(tmp_path: Path) -> None:
    with Journal(tmp_path / "job", SETTINGS) as journal:
        assert not journal.resumed
        journal.add_lap(lap(1, 5.0))
        journal.add_update(UpdateRecord(after_lap=1, version="a", verdict="refused"))
    with Journal(tmp_path / "job", SETTINGS) as again:
        assert again.resumed
        assert again.record == journal.record
        assert again.declined("a")
    content = json.loads((tmp_path / "job/laps.json").read_text())
    assert content["laps"][0]["time_s"] == 5.0


def test_weights_files_stay_bounded(tmp_path: Path) -> None:
    """The newest; those in use and those last accepted, however old; what was given. No orphans."""
    journal = Journal(tmp_path / "job", SETTINGS)
    verdicts = {2: "accepted", 3: "accepted"}
    for k in range(1, MOST_WEIGHTS + 8):
        path = journal.free_weights(k // 2)
        write_weights(path, zero_weights(CAR.name, NAME, f"v{k}"))
        update = UpdateRecord(after_lap=k // 2, version=f"v{k}", file=path.name)
        journal.add_update(update.model_copy(update={"verdict": verdicts.get(k, "refused")}))
        journal.drop_weights(in_use="v2")
    (journal.folder / "weights-given.bin").touch()
    (journal.folder / "weights-9999.bin").touch()
    journal.drop_weights(in_use="v2")
    left = {read_weights(path).version for path in journal.folder.glob("weights-0*.bin")}
    newest = {f"v{k}" for k in range(8, MOST_WEIGHTS + 8)}
    assert left == newest | {"v2", "v3"}
    assert not (journal.folder / "weights-9999.bin").exists()
    assert (journal.folder / "weights-given.bin").exists()
    files = [update.file for update in journal.record.updates]
    assert len(set(files)) == len(files), "a deleted file's name is not given again"


@pytest.mark.parametrize(
    "changes", [{"name": "other"}, {"discretisation": PERFECT}], ids=["name", "discretisation"]
)
def test_a_folder_of_another_job_is_not(tmp_path: Path, changes: dict[str, Any]) -> None:
    Journal(tmp_path / "job", SETTINGS).close()
    with pytest.raises(InputError, match="choose another"):
        Journal(tmp_path / "job", SETTINGS.model_copy(update=changes))
    Journal(tmp_path / "job", SETTINGS).close()


def test_two_jobs_in_one_folder_are_not(tmp_path: Path) -> None:
    """Each would overwrite what the other has written; the lock ends with its owner."""
    folder = tmp_path / "job"
    with Journal(folder, SETTINGS) as journal:
        with pytest.raises(InputError, match=f"at work in {folder}; end it first, or choose"):
            Journal(folder, SETTINGS)
        journal.add_lap(lap(1, 5.0))
    with Journal(folder, SETTINGS) as again:
        assert len(again.record.laps) == 1


def test_a_job_killed_at_its_very_start_leaves_a_folder_to_use(tmp_path: Path) -> None:
    for name in ("lock", ".settings.77.1.part.json"):
        (tmp_path / name).touch()
    with Journal(tmp_path, SETTINGS) as journal:
        assert not journal.resumed
    assert {path.name for path in tmp_path.iterdir()} == {"lock", "settings.json"}


@pytest.mark.parametrize("file", ["kept-0002.npz", "new-0003.npz"])
def test_damaged_samples_are_told_at_once_with_the_remedy(tmp_path: Path, file: str) -> None:
    """Not by each training to come. Without them the numbering goes on."""
    for name in ("kept-0002.npz", "new-0003.npz"):
        write_npz(tmp_path / name, drive(dynamic(CAR), 60, seed=1))
    (tmp_path / file).write_bytes((tmp_path / file).read_bytes()[:500])
    with pytest.raises(InputError, match=rf"{file}.*; delete it to go on without"):
        SampleStore(tmp_path, CAR)
    (tmp_path / file).unlink()
    store = SampleStore(tmp_path, CAR)
    assert (store.kept is None, store.waiting) == ("kept" in file, "kept" in file)
    store.add(drive(dynamic(CAR), 60, seed=2))
    assert store.begin().kept.name == "kept-0003.npz"


def test_going_on_the_beginning_is_not_read_and_that_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, gone, said = tmp_path / "job", tmp_path / "gone", list[str]()
    other = SETTINGS.model_copy(update={"discretisation": PERFECT})
    monkeypatch.setattr(Learner, "run", lambda _: None)
    with pytest.raises(InputError, match="gone"):
        learn(other, Endpoints(), folder, [], gone, said.append)
    assert not folder.exists()
    with Journal(folder, other) as journal:
        journal.add_lap(lap(1, 5.0))
    settings = other.model_copy(
        update={"discretisation": discretisation_from(CAR, gone, None, 400, folder)}
    )
    learn(settings, Endpoints(), folder, [gone], gone, said.append)
    learn(settings, Endpoints(), folder, [], None, said.append)
    going_on = f"going on in {folder} after lap 1"
    assert said == [f"{going_on}; --data and --weights not read: only to begin with", going_on]


def test_a_folder_of_something_else_is_not(tmp_path: Path) -> None:
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(InputError, match="something else"):
        Journal(tmp_path, SETTINGS)
    (tmp_path / "settings.json").write_text("{}x")
    with pytest.raises(InputError, match="no learning job"):
        Journal(tmp_path, SETTINGS)
