"""A validator that ends, hangs or cannot be started is followed by another, but not in haste."""

import itertools
import os
from errno import EAGAIN
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any

import msgpack
import pytest

from controller.weights.states import SharedStates
from controller.weights.supervisor import Supervisor

pytestmark = pytest.mark.wall_clock

HANG_S = 10.0
AGAIN = "weights in use stay, and are not watched until it runs again"


class States(SharedStates):
    """The test says when the last heartbeat was."""

    heartbeat_s = 1000.0


class Stage(Supervisor):
    """A supervisor whose clock and validators are the test's; there are no processes."""

    def __init__(self) -> None:
        self.now_s = 1000.0
        self.refusing = False
        self.others: list[Any] = []
        """The validators' ends of the connections."""
        self.lost: list[str] = []
        self.states = States()
        super().__init__(
            self.states, HANG_S, lambda: {"kind": "context"}, self.lost.append, lambda: self.now_s
        )

    def _start(self) -> Connection:
        if self.refusing:
            raise OSError(EAGAIN, os.strerror(EAGAIN))
        own, other = Pipe()
        self.others.append(other)
        return own

    def answers_ready(self) -> None:
        """The newest validator."""
        self.states.heartbeat_s = self.now_s
        self.others[-1].send_bytes(msgpack.packb({"kind": "ready"}))
        assert self.receive() == {"kind": "ready"}
        assert self.ready

    def ends(self) -> None:
        """The newest validator."""
        count = len(self.lost)
        self.others[-1].close()
        assert self.receive() is None
        assert len(self.lost) == count + 1

    def next_pause_s(self) -> float:
        """Until the next one is started, to the tenth of a second."""
        begin_s, before = self.now_s, len(self.others)
        while len(self.others) == before:
            self.now_s += 0.1
            self.look()
        return round(self.now_s - begin_s, 1)


@pytest.fixture
def stage() -> Stage:
    made = Stage()
    made.look()
    return made


def test_it_is_ready_when_it_answers(stage: Stage) -> None:
    assert (stage.starts, stage.ready, stage.trouble) == (1, False, "")
    assert msgpack.unpackb(stage.others[0].recv_bytes()) == {"kind": "context"}
    stage.answers_ready()
    stage.send({"kind": "check", "data": b"file"})
    assert msgpack.unpackb(stage.others[0].recv_bytes()) == {"kind": "check", "data": b"file"}
    stage.look()
    assert (stage.starts, stage.ready, stage.receive()) == (1, True, None)


def test_one_that_ends_is_followed_by_another_after_a_second(stage: Stage) -> None:
    stage.answers_ready()
    stage.ends()
    assert stage.lost == [stage.trouble]
    assert stage.trouble == f"the validator ended (killed, or by a fault): {AGAIN}"
    stage.send({"kind": "check"})  # to no process
    assert stage.next_pause_s() == pytest.approx(1.0)
    assert "ended" in stage.trouble  # until the next one works
    stage.answers_ready()
    assert (stage.starts, stage.trouble) == (2, "")


def test_the_pause_doubles_until_one_works(stage: Stage) -> None:
    """Ended before they were ready: pauses of 2, 4 s and so on to 30 s; then 1 s again."""
    pauses = []
    for _ in range(6):
        stage.ends()
        pauses.append(stage.next_pause_s())
    assert pauses == pytest.approx([2, 4, 8, 16, 30, 30], abs=0.11)
    stage.answers_ready()
    stage.ends()
    assert stage.next_pause_s() == pytest.approx(1.0, abs=0.11)


def test_one_that_cannot_be_started_is_tried_again_later_and_later() -> None:
    stage, tried_s = Stage(), list[float]()
    stage.refusing = True
    while len(stage.lost) < 7:
        count = len(stage.lost)
        stage.look()
        if len(stage.lost) > count:
            tried_s.append(stage.now_s)
            assert f"the validator cannot be started: {os.strerror(EAGAIN)}" in stage.trouble
        stage.now_s += 0.1
    pauses = [after - before for before, after in itertools.pairwise(tried_s)]
    assert pauses == pytest.approx([2, 4, 8, 16, 30, 30], abs=0.11)
    stage.refusing = False
    stage.next_pause_s()
    stage.answers_ready()
    assert (stage.starts, stage.trouble) == (1, "")


def test_one_that_does_not_become_ready_is_replaced(stage: Stage) -> None:
    stage.now_s += 14.9
    stage.look()
    assert not stage.lost
    stage.now_s += 0.2
    stage.look()
    assert stage.lost == [f"the validator was not ready within 15 s: {AGAIN}"]
    assert stage.next_pause_s() == pytest.approx(2.0, abs=0.11)


def test_one_without_a_heartbeat_is_replaced(stage: Stage) -> None:
    stage.answers_ready()
    for _ in range(5):
        stage.now_s += 0.9 * HANG_S
        stage.states.heartbeat_s = stage.now_s - 0.5 * HANG_S
        stage.look()
    assert not stage.lost
    stage.now_s += 0.6 * HANG_S
    stage.look()
    assert stage.lost == [f"the validator hung, without a heartbeat for 10 s: {AGAIN}"]
    assert stage.next_pause_s() == pytest.approx(1.0, abs=0.11)


def test_a_system_that_starts_no_process_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("controller.weights.supervisor.RUN_MODULE", ("/nowhere/python",))
    lost: list[str] = []
    Supervisor(SharedStates(), HANG_S, dict, lost.append).look()
    assert "cannot be started: No such file or directory" in lost[0]
