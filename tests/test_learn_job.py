"""Parts of the learning job, each alone: publisher, figure and table."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from bayesrace.errors import InputError
from bayesrace.gp.weights import decode_weights, zero_weights
from bayesrace.integrators import PREDICTION
from bayesrace.messages import Event, Reply, Scalar
from bayesrace.operation.learn import publishing
from bayesrace.operation.learn.journal import Journal
from bayesrace.operation.learn.publishing import Publisher
from bayesrace.operation.learn.records import LapRecord, LearnSettings, Record, UpdateRecord
from bayesrace.operation.learn.report import draw, print_laps, references
from tests.driven import CAR, blank
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
    assert "pending: no controller has" in text
    many: list[LapRecord] = [laps[1].model_copy(update={"lap": k}) for k in range(1, 100)]
    print_laps(Record(laps=many), console)
    assert "the last 40 of 99 laps" in console.export_text()


def test_what_to_compare_with_must_be_a_race(tmp_path: Path) -> None:
    assert references(None) == {}
    with pytest.raises(InputError, match="cannot read"):
        references(tmp_path)
