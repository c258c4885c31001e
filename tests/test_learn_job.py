"""Parts of the learning job, each alone: worker, dealings with the controller, picture."""

import os
import queue
import signal
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from bayesrace.errors import InputError
from bayesrace.gp.weights import write_weights, zero_weights
from bayesrace.integrators import PREDICTION
from bayesrace.messages import Event, Reply, Scalar
from bayesrace.vehicles.models import dynamic
from experiments.learn import desk as desk_module
from experiments.learn import trainer as trainer_module
from experiments.learn.desk import Desk
from experiments.learn.feed import What
from experiments.learn.figure import draw, references
from experiments.learn.journal import Journal, LapRecord, Record, UpdateRecord
from experiments.learn.settings import LearnSettings
from experiments.learn.table import print_laps
from experiments.learn.trainer import NICE, Trainer
from learning.arrays import write_npz
from learning.worker import Outcome, Task
from tests.driven import CAR, QUICK, drive
from tests.learning_rig import lap
from tests.programs import PATIENCE_S

SETTINGS = LearnSettings(car=CAR.name)
NAME = PREDICTION.identity("e_kinematic", CAR)


class Heard:
    """In place of the feed: keeps what is put, and what is said."""

    def __init__(self) -> None:
        self.items: queue.Queue[tuple[What, Any]] = queue.Queue()
        self.said: list[str] = []

    def put(self, what: What, value: Any = None) -> None:
        self.items.put((what, value))


class Office:
    """A desk whose controller answers as it is told to."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.journal = Journal(folder, SETTINGS)
        self.heard = Heard()
        self.answers: dict[str, Reply] = {}
        self.sent: list[str] = []
        self.drives_with: str | None = ""
        monkeypatch.setattr(desk_module, "send_weights", self._send)
        monkeypatch.setattr(desk_module, "ask", self._ask)
        feed: Any = self.heard
        self.desk = Desk(None, "orca", self.journal, feed, self.heard.said.append)

    def _send(self, _session: Any, _car: str, data: bytes) -> Reply:
        version = next(one.version for one in self.journal.record.updates
                       if self.journal.path(one.file).read_bytes() == data)  # fmt: skip
        self.sent.append(version)
        if version not in self.answers:
            raise InputError("nobody answers")
        return self.answers[version]

    def _ask(self, *_: Any) -> Any:
        if self.drives_with is None:
            raise InputError("nobody answers")

        class Told:
            weights_version = self.drives_with

        return Told

    def learn(self, version: str, answer: Reply | None = None) -> UpdateRecord:
        path = self.journal.path(f"{version}.bin")
        write_weights(path, zero_weights(CAR.name, NAME, version))
        update = UpdateRecord(after_lap=1, version=version, file=path.name)
        self.journal.add_update(update)
        if answer is not None:
            self.answers[version] = answer
        return update

    def work(self) -> None:
        """Until no answer is missing."""
        while self.desk.busy:
            what, value = self.heard.items.get(timeout=5)
            assert what is What.ANSWER
            self.desk.answer(value)

    def come(self, drives_with: str | None = "") -> None:
        self.drives_with = drives_with
        self.desk.presence(there=True)
        self.work()

    def offer(self, version: str, answer: Reply | None = None) -> None:
        self.desk.offer(self.learn(version, answer))
        self.work()

    def verdict(self, version: str) -> str:
        update = self.journal.update_of(version)
        assert update is not None
        return update.verdict

    def event(self, kind: str, **data: Scalar) -> None:
        self.desk.event(Event(0, 0, 1, "controller", kind, "because", data))


@pytest.fixture
def office(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Office:
    return Office(tmp_path / "job", monkeypatch)


def yes(version: str, number: int = 1) -> Reply:
    data: dict[str, Scalar] = {"version": version, "cycle": 40 + number, "number": number}
    return Reply(0, 0, True, "taken", data)


def test_what_is_accepted_is_noted_with_its_cycle(office: Office) -> None:
    office.come()
    office.offer("a", yes("a"))
    update = office.journal.update_of("a")
    assert update is not None
    assert (update.verdict, update.cycle, update.acceptance) == ("accepted", 41, 1)
    assert office.journal.last_accepted() == update


def test_what_is_refused_is_said_and_not_sent_again(office: Office) -> None:
    office.come()
    office.offer("bad", Reply(0, 0, False, "worse than those in use", {}))
    assert office.verdict("bad") == "refused"
    assert any("worse than those in use" in line for line in office.heard.said)
    office.offer("bad")
    assert office.sent == ["bad"]
    assert office.verdict("bad") == "not sent"


def test_what_is_rolled_back_is_said_and_not_sent_again(office: Office) -> None:
    office.come()
    office.offer("a", yes("a"))
    office.offer("b", yes("b", 2))
    office.event("weights_rolled_back", version="a", from_version="b", by="watch")
    assert (office.verdict("a"), office.verdict("b")) == ("accepted", "rolled back")
    assert any(line.startswith("rolled back: b") for line in office.heard.said)
    office.offer("b", yes("b", 3))
    assert office.sent == ["a", "b"]
    accepted = office.journal.last_accepted()
    assert accepted is not None
    assert accepted.version == "a"


def test_what_nobody_answers_for_waits_for_a_controller(office: Office) -> None:
    office.offer("a", yes("a"))
    assert (office.sent, office.verdict("a")) == ([], "waiting")
    office.come()
    assert (office.sent, office.verdict("a")) == (["a"], "accepted")
    office.offer("b")
    assert office.verdict("b") == "waiting"
    office.answers["b"] = yes("b", 2)
    office.desk.presence(there=False)
    office.come("a")
    assert office.verdict("b") == "accepted"


def test_a_controller_that_lost_its_weights_gets_them_again(office: Office) -> None:
    office.come("old")
    office.offer("a", yes("a"))
    office.desk.presence(there=False)
    office.come("a")  # it has kept them
    assert office.sent == ["a"]
    office.desk.presence(there=False)
    office.come("old")
    assert office.sent == ["a", "a"]


def test_weights_of_somebody_else_are_left_alone(office: Office) -> None:
    office.come("old")
    office.offer("a", yes("a"))
    office.event("weights_accepted", version="theirs")
    office.desk.presence(there=False)
    office.come("old")
    assert office.sent == ["a"]


def test_not_now_is_no_refusal(office: Office) -> None:
    """It waits for a controller that takes it, which learning goes on from meanwhile."""
    office.come()
    office.offer("a", Reply(0, 0, False, "the controller ends", {"again": True}))
    update = office.journal.update_of("a")
    assert update is not None
    assert update.verdict == "waiting"
    assert update.answer == "refused for now, try again: the controller ends"
    assert any("the controller ends" in line for line in office.heard.said)
    office.desk.presence(there=False)
    office.answers["a"] = yes("a")
    office.come()
    assert (office.sent, office.verdict("a")) == (["a", "a"], "accepted")


def test_not_now_to_what_was_in_use_before_is_no_refusal_either(office: Office) -> None:
    """The newest weights are given to the next controller, too."""
    office.come("old")
    office.offer("a", yes("a"))
    for answer in (Reply(0, 0, False, "the controller ends", {"again": True}), yes("a")):
        office.answers["a"] = answer
        office.desk.presence(there=False)
        office.come("old")
    assert (office.sent, office.verdict("a")) == (["a"] * 3, "accepted")


def test_an_acceptance_without_an_answer_is_noted(office: Office) -> None:
    """The answer was lost, came too late, or newer weights were quicker than it: they drive."""
    office.come()
    office.offer("a")
    assert office.verdict("a") == "waiting"
    office.event("weights_accepted", version="a", cycle=7, number=3)
    update = office.journal.update_of("a")
    assert update is not None
    assert (update.verdict, update.cycle, update.acceptance) == ("accepted", 7, 3)
    office.offer("b")
    office.offer("c")
    assert office.verdict("b") == "no answer"
    office.event("weights_accepted", version="b", cycle=8, number=4)
    assert office.verdict("b") == "accepted"
    assert office.desk.in_use == "b"


def test_an_acceptance_that_is_known_already_is_said_once(office: Office) -> None:
    """The event may come before the answer; what is in use waits for nobody."""
    office.come()
    office.desk.offer(office.learn("a", yes("a")))
    office.event("weights_accepted", version="a", cycle=41, number=1)
    office.work()
    office.desk.offer(office.learn("b"))
    office.event("weights_accepted", version="b", cycle=42, number=2)
    office.work()
    assert [office.verdict(version) for version in "ab"] == ["accepted"] * 2
    for version, cycle in (("a", 41), ("b", 42)):
        words = f"{version}: taken over at cycle {cycle}"
        assert len([line for line in office.heard.said if line.startswith(words)]) == 1


def test_what_nobody_answered_for_waits_no_longer_than_for_newer_weights(office: Office) -> None:
    office.come()
    office.offer("a")
    assert office.verdict("a") == "waiting"
    office.offer("b", yes("b"))
    assert (office.verdict("a"), office.verdict("b")) == ("no answer", "accepted")
    update = office.journal.update_of("a")
    assert update is not None
    assert update.answer == "nobody answers"


def test_what_the_training_processes_say_does_not_grow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither from job to job nor from task to task."""
    output = tmp_path / "worker.log"
    output.write_text("of the job before")
    trainer = Trainer(output, lambda _: None)
    monkeypatch.setattr(Trainer, "prepare", lambda _: None)
    assert output.read_text() == ""
    monkeypatch.setattr(trainer_module, "_MOST_OUTPUT", 10)
    task = Task(
        number=1, car=CAR.name, discretisation=PREDICTION, keep=60, weights=output, kept=output
    )
    for words, left in (("few words", "few words"), (", and more", "")):
        with output.open("a") as file:
            file.write(words)
        trainer.start(task)
        assert output.read_text() == left


class Workshop:
    """A trainer and what it tells."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.told: queue.Queue[Outcome] = queue.Queue()
        self.trainer = Trainer(folder / "worker.log", self.told.put)
        write_npz(folder / "new.npz", drive(dynamic(CAR), 120, seed=1))

    def start(self, number: int, **changes: Any) -> None:
        task = Task(
            number=number, car=CAR.name, discretisation=PREDICTION,
            new=(self.folder / "new.npz",), training=QUICK, keep=60,
            weights=self.folder / "w.bin", kept=self.folder / "kept.npz",
        )  # fmt: skip
        self.trainer.start(task.model_copy(update=changes))

    def outcome(self) -> Outcome:
        return self.told.get(timeout=PATIENCE_S)

    def pid(self) -> int:
        process = self.trainer._process
        assert process is not None
        return process.pid


@pytest.mark.check
def test_training_is_a_niced_process_that_may_die(tmp_path: Path) -> None:
    workshop = Workshop(tmp_path)
    try:
        workshop.start(1)
        first = workshop.outcome()
        assert (first.number, first.error, first.kept) == (1, "", 60)
        assert not workshop.trainer.busy
        assert os.getpriority(os.PRIO_PROCESS, workshop.pid()) == NICE
        workshop.start(2, new=(tmp_path / "gone.npz",))
        assert "gone.npz" in workshop.outcome().error
        os.kill(workshop.pid(), signal.SIGSTOP)  # else it might be done before it is killed
        workshop.start(3)
        os.kill(workshop.pid(), signal.SIGKILL)
        assert workshop.outcome() == Outcome(number=3, error="the training was killed by signal 9")
        workshop.start(4)
        assert workshop.outcome().version == first.version, "the same samples, the same weights"
    finally:
        workshop.trainer.stop()


def test_picture_and_table_show_every_kind_of_lap(tmp_path: Path) -> None:
    laps = [lap(1, 8.0, flying=False), lap(2, 7.5), lap(3, None), lap(4, 7.4, off_m=0.01)]
    laps.append(lap(5, 160.0))
    updates = [
        UpdateRecord(after_lap=k, version=f"v{k}", verdict=verdict, samples=10)
        for k, verdict in enumerate(("accepted", "refused", "rolled back", "failed", "waiting"))
    ]
    record = Record(laps=laps, updates=updates, remarks=["the car stood"])
    draw(record, {"bestcase": 7.39}, tmp_path / "laps.png")
    assert (tmp_path / "laps.png").stat().st_size > 5000
    draw(Record(laps=laps[:1]), {}, tmp_path / "rest.png")
    assert (tmp_path / "rest.png").exists()
    draw(Record(laps=[lap(1, None)]), {}, tmp_path / "none.png")
    assert not (tmp_path / "none.png").exists()
    console = Console(record=True, width=80)
    print_laps(record, console)
    text = console.export_text()
    for words in ("8.000*", "7.400!", "refused", "rolled back", "v3"):
        assert words in text
    assert "nothing to learn from: the car stood" in text
    assert "waiting: no controller has answered" in text
    print_laps(Record(laps=[replace_number(laps[1], k) for k in range(1, 100)]), console)
    assert "the last 40 of 99 laps" in console.export_text()


def replace_number(one: LapRecord, number: int) -> LapRecord:
    return one.model_copy(update={"lap": number})


def test_what_to_compare_with_must_be_a_race(tmp_path: Path) -> None:
    assert references(None) == {}
    with pytest.raises(InputError, match="cannot read"):
        references(tmp_path)
