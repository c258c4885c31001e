"""Parts of the learning job, each alone: publisher, figure and table, and its folder: which job may
use it, and how a job resumes there."""

import json
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from bayesrace.errors import InputError
from bayesrace.gp.weights import decode_weights, read_weights, zero_weights
from bayesrace.integrators import PERFECT, PREDICTION
from bayesrace.learning.dataset import concatenate
from bayesrace.learning.subset import MOST_NEW
from bayesrace.messages import Event, Reply, Scalar
from bayesrace.operation.learn import publishing
from bayesrace.operation.learn.journal import MOST_WEIGHTS, Journal
from bayesrace.operation.learn.publishing import Publisher
from bayesrace.operation.learn.records import LapRecord, LearnSettings, Record, UpdateRecord
from bayesrace.operation.learn.report import draw, print_laps
from bayesrace.vehicles.models import dynamic
from tests.driven import CAR, blank, drive
from tests.learning_rig import controller_status, lap

SETTINGS = LearnSettings(car=CAR)
NAME = PREDICTION.identity("e_kinematic", CAR)


def no(text: str, **data: Scalar) -> Reply:
    return blank(Reply, text=text, data=data)


NOT_NOW = no("the controller ends", again=True)


class PublisherRig:
    """A publisher whose controller answers as prepared; without an answer, none comes."""

    def __init__(self, journal: Journal, monkeypatch: pytest.MonkeyPatch) -> None:
        self.journal = journal
        self.answers: dict[str, Reply] = {}
        self.sent: list[str] = []
        self.said: list[str] = []
        monkeypatch.setattr(publishing, "send_weights", self._send)
        self.publisher = Publisher(None, journal, self.said.append)

    def _send(self, _session: Any, _car: str, data: bytes) -> Reply:
        version = decode_weights(data).version
        self.sent.append(version)
        if version not in self.answers:
            raise InputError("no answer")
        return self.answers[version]

    def learn(self, version: str, answer: Reply | None = None) -> None:
        """New weights are published, and answered."""
        if answer is not None:
            self.answers[version] = answer
        self.offer(version)
        self.work()

    def offer(self, version: str) -> None:
        update = UpdateRecord(after_lap=1)
        self.journal.add_update(update, zero_weights(CAR.name, NAME, version))
        self.publisher.offer(update)

    def work(self) -> None:
        """Until no answer is missing."""
        self.publisher._thread.submit(int).result()
        self.publisher.poll()
        assert not self.publisher.unanswered

    def heartbeat(self, drives_with: str) -> None:
        self.publisher.heartbeat(controller_status(drives_with))
        self.work()

    def start_controller(self, drives_with: str = "") -> None:
        self.publisher.present = False
        self.heartbeat(drives_with)

    def roll_back(self, version: str) -> None:
        data: dict[str, Scalar] = {"from_version": version}
        kind, source = "weights_rolled_back", "controller"
        self.publisher.event(blank(Event, source=source, kind=kind, text="because", data=data))

    def update(self, version: str) -> UpdateRecord:
        update = self.journal.update_of(version)
        assert update is not None
        return update

    def verdict(self, version: str) -> str:
        return self.update(version).verdict


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[PublisherRig]:
    with closing(Journal(tmp_path / "job", SETTINGS)) as journal:
        yield PublisherRig(journal, monkeypatch)


def yes(version: str, number: int = 1) -> Reply:
    data: dict[str, Scalar] = {"version": version, "cycle": 40 + number, "number": number}
    return blank(Reply, accepted=True, text="taken", data=data)


def test_accepted_weights_are_noted_with_their_cycle(rig: PublisherRig) -> None:
    rig.start_controller()
    rig.learn("a", yes("a"))
    update = rig.update("a")
    assert (update.verdict, update.cycle, update.acceptance) == ("accepted", 41, 1)
    assert rig.said == ["a: taken over at cycle 41 (acceptance 1)"]


def test_declined_weights_are_reported_and_not_sent_again(rig: PublisherRig) -> None:
    rig.start_controller()
    rig.learn("bad", no("worse than those in use"))
    rig.learn("back", yes("back"))
    rig.roll_back("back")
    assert (rig.verdict("bad"), rig.verdict("back")) == ("refused", "rolled back")
    assert "bad: refused: worse than those in use" in rig.said
    assert "rolled back: back (learned after lap 1): because" in rig.said
    for version in ("bad", "back"):
        rig.learn(version, yes(version))
        assert rig.verdict(version) == "not sent"
    assert rig.sent == ["bad", "back"]
    assert rig.journal.last_accepted is None


def test_an_answer_after_the_rollback_changes_nothing(rig: PublisherRig) -> None:
    rig.start_controller()
    rig.answers["a"] = yes("a")
    rig.offer("a")
    rig.roll_back("a")
    rig.work()
    assert rig.verdict("a") == "rolled back"


@pytest.mark.parametrize("answer", [None, NOT_NOW], ids=["no answer", "refused for now"])
def test_weights_without_an_answer_are_sent_to_the_next_controller(
    rig: PublisherRig, answer: Reply | None
) -> None:
    rig.learn("a", yes("a"))
    assert (rig.sent, rig.verdict("a")) == ([], "pending")
    rig.start_controller()
    assert (rig.sent, rig.verdict("a")) == (["a"], "accepted")
    rig.learn("b", answer)
    assert rig.verdict("b") == "pending"
    assert rig.update("b").answer == rig.said[-1].removeprefix("b: ") != ""
    rig.answers["b"] = yes("b", 2)
    rig.start_controller("a")
    assert (rig.sent, rig.verdict("b")) == (["a", "b", "b"], "accepted")


def test_newer_weights_supersede_pending_ones(rig: PublisherRig) -> None:
    rig.start_controller()
    rig.learn("a")
    rig.learn("b", yes("b"))
    assert (rig.verdict("a"), rig.verdict("b")) == ("superseded", "accepted")


def test_weights_in_use_without_an_answer_are_accepted(rig: PublisherRig) -> None:
    """The answer was lost, or they were given to the controller at its start."""
    rig.start_controller("old")
    rig.learn("a")
    rig.heartbeat("a")
    assert rig.verdict("a") == "accepted"
    rig.learn("a")
    assert (rig.sent, rig.update("a").answer) == (["a"], "in use already")


def test_a_controller_without_the_last_accepted_weights_gets_them(rig: PublisherRig) -> None:
    """As often as it takes; those refused on the way are not the last accepted."""
    rig.start_controller("old")
    rig.learn("a", yes("a"))
    rig.learn("bad", no("worse"))
    rig.start_controller("a")  # it has kept them
    assert rig.sent == ["a", "bad"]
    rig.answers["a"] = NOT_NOW
    rig.start_controller("old")
    rig.answers["a"] = yes("a", 2)
    rig.start_controller("")
    assert rig.sent == ["a", "bad", "a", "a"]
    assert (rig.verdict("a"), rig.update("a").acceptance) == ("accepted", 2)
    assert "the controller drives with no weights; sending a" in rig.said
    rig.answers["a"] = no("older than those in use")
    rig.start_controller("theirs")
    assert rig.verdict("a") == "refused"


# Figure and table ----------------------------------------------------------------------------


def test_figure_and_table_show_every_kind_of_lap(tmp_path: Path) -> None:
    laps = [lap(1, 8.0, flying=False), lap(2, 7.5), lap(3, None), lap(4, 7.4, off_m=0.01)]
    laps.append(lap(5, 160.0))
    updates = [
        UpdateRecord(after_lap=k, version=f"v{k}", verdict=verdict, samples=10)
        for k, verdict in enumerate(("accepted", "refused", "rolled back", "failed", "pending"))
    ]
    record = Record(laps=laps, updates=updates, remarks=["the car stood"])
    draw(record, tmp_path / "laps.png")
    assert (tmp_path / "laps.png").stat().st_size > 5000
    draw(Record(laps=laps[:1]), tmp_path / "rest.png")
    assert (tmp_path / "rest.png").exists()
    draw(Record(laps=[lap(1, None)]), tmp_path / "none.png")
    assert not (tmp_path / "none.png").exists()
    console = Console(record=True, width=80)
    print_laps(record, console)
    text = console.export_text()
    for words in ("8.000*", "7.400!", "refused", "rolled back", "v3"):
        assert words in text
    assert "nothing to learn from: the car stood" in text
    assert "pending: no controller has" in text
    many: list[LapRecord] = [laps[1].model_copy(update={"lap": k}) for k in range(1, 100)]
    print_laps(Record(laps=many), console)
    assert "the last 40 of 99 laps" in console.export_text()


# The folder ---------------------------------------------------------------------------------------


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
