"""What a bridge makes of its history and of what the controller says of its weights."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from msgspec.structs import replace

from bayesrace.controller.remote import RemoteLink
from bayesrace.controller.remote_weights import RemoteAdoption
from bayesrace.controller.settings import GateSettings
from bayesrace.controller.weights.adoption import AgainError, Ruling, WeightsPort
from bayesrace.controller.weights.store import AcceptedWeights, History
from bayesrace.errors import InputError, RestartError
from bayesrace.messages import PIECE_BYTES, RULING_ERRORS, Updated, from_datagram
from bayesrace.vehicles import Car
from tests.driven import blank

BACK = 3


class Program(RemoteLink):
    """A controller at the other end, and its link."""

    def __init__(self, **says: Any) -> None:
        super().__init__("udp:127.0.0.1:9")
        self.answer = blank(Updated, errors=(1.0,) * RULING_ERRORS, **says)
        self.adopted: list[tuple[str, bool]] = []
        self.silent_on: tuple[str, ...] = ()
        self.note: Any = None
        self._written = b""

    def send(self, data: bytes) -> None:
        self.request = data
        request: Any = from_datagram(data)[1]
        if request.action in self.silent_on:
            return
        if request.action == "write":
            self._written = request.data
        if request.action == "adopt":
            self.adopted.append((self._written.decode(), request.watched))
            self.answer = replace(self.answer, version=self._written.decode())
        self.note(replace(self.answer, seq=request.seq))


def weights(number: int, proven: bool) -> AcceptedWeights:
    return AcceptedWeights(
        number=number, version=f"w{number}", digest=f"{number:064x}", proven=proven
    )  # fmt: skip


@pytest.fixture
def history() -> History:
    """The newest are on trial."""
    return History(entries=[weights(0, True), weights(1, True), weights(2, False)])


def joined(
    program: Program, history: History, artefact: Path, car: Car
) -> tuple[RemoteAdoption, list[Ruling]]:
    port = WeightsPort(artefact, car, history, None)
    made = RemoteAdoption(program, port, GateSettings(), lambda _, version: version.encode())
    ruled: list[Ruling] = []
    made.ruled = lambda _, ruling: ruled.append(ruling)
    program.note = made.note
    made.begin()
    return made, ruled


def test_a_controller_that_has_begun_anew_is_brought_up_to_the_history(
    history: History, kinematic_artefact: Path, car: Car
) -> None:
    """What was on trial is on trial again, beside what was proven."""
    program = Program(version="w0")
    joined(program, history, kinematic_artefact, car)
    assert program.adopted == [("w1", False), ("w2", True)]


def test_what_the_watch_has_done_meanwhile_is_heard_of(
    history: History, kinematic_artefact: Path, car: Car
) -> None:
    program = Program(version="w1", rulings=1, reverted=1, ruling=BACK)
    _, ruled = joined(program, history, kinematic_artefact, car)
    assert [one.action for one in ruled] == ["back"]
    assert not program.adopted


def test_other_weights_than_those_of_the_history_are_refused(
    history: History, kinematic_artefact: Path, car: Car
) -> None:
    with pytest.raises(InputError, match="drives by weights 'other': give their file"):
        joined(Program(version="other"), history, kinematic_artefact, car)


def test_a_controller_that_counts_anew_is_another_one(kinematic_artefact: Path, car: Car) -> None:
    """Also where nothing has been ruled yet, and nothing is on trial."""
    program = Program(version="w0", cycle=500)
    history = History(entries=[weights(0, True)])
    made, _ = joined(program, history, kinematic_artefact, car)
    made.follow()
    assert not made.restarted
    program.answer = replace(program.answer, cycle=3)
    made._looked_s -= 10.0
    made.follow()
    assert made.restarted


def test_how_long_the_pieces_take_does_not_count_for_staging(
    kinematic_artefact: Path, car: Car, monkeypatch: pytest.MonkeyPatch
) -> None:
    program, stages, now_s = Program(version="w0"), iter((True, False)), [0.0]
    made, _ = joined(program, History(entries=[weights(0, True)]), kinematic_artefact, car)

    def note(answer: Updated) -> None:
        request: Any = from_datagram(program.request)[1]
        if request.action == "write":
            now_s[0] += 3.0
        busy = request.action == "stage" and next(stages)
        made.note(replace(answer, busy=busy))

    program.note = note
    clock = SimpleNamespace(monotonic=lambda: now_s[0], sleep=lambda _: None)
    monkeypatch.setattr("bayesrace.controller.remote_weights.time", clock)
    made.adopt(b"", "w" * 5 * PIECE_BYTES, True, 0)
    assert len(program.adopted) == 1


def test_without_an_answer_it_is_not_known_what_drives(
    kinematic_artefact: Path, car: Car, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bayesrace.controller.remote_weights._PATIENCE_S", 0.1)
    monkeypatch.setattr("bayesrace.controller.remote_weights._BEGIN_S", 0.1)
    program = Program(version="w0")
    history = History(entries=[weights(0, True)])
    made, _ = joined(program, history, kinematic_artefact, car)
    program.silent_on = ("adopt",)
    with pytest.raises(AgainError, match="does not answer"):
        made.adopt(b"", "w1", True, 0)
    assert made.restarted
    program.silent_on = ("look",)
    with pytest.raises(RestartError, match="start it first"):
        made.begin()
