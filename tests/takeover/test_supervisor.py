"""A validator that ends, hangs or cannot be started is followed by another, but not in haste."""

import itertools
import os
from errno import EAGAIN
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any

import msgpack
import pytest

from controller.weights.supervisor import Supervisor

HANG_S = 10.0
AGAIN = "weights in use stay, and are not watched until it runs again"


class Stage(Supervisor):
    """A supervisor whose clock and validators are the test's; there are no processes."""

    def __init__(self) -> None:
        self.now_s = 1000.0
        self.refusing = False
        self.others: list[Any] = []
        """The validators' ends of the connections."""
        self.lost: list[str] = []
        super().__init__((), HANG_S, self.lost.append, lambda: self.now_s)

    def _start(self) -> Connection:
        if self.refusing:
            raise OSError(EAGAIN, os.strerror(EAGAIN))
        own, other = Pipe()
        self.others.append(other)
        return own

    def answers(self) -> None:
        """The newest validator."""
        self.others[-1].send_bytes(msgpack.packb({}))
        assert self.receive() == {}
        assert (self.ready, self.idle) == (True, True)

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
            self.receive()
        return self.now_s - begin_s


@pytest.fixture
def stage() -> Stage:
    made = Stage()
    made.receive()
    return made


def test_it_is_ready_when_it_answers_and_messages_alternate(stage: Stage) -> None:
    assert (stage.starts, stage.ready, stage.idle, stage.trouble) == (1, False, False, "")
    stage.answers()
    stage.send({"check": b"file"})
    assert msgpack.unpackb(stage.others[0].recv_bytes()) == {"check": b"file"}
    assert (stage.receive(), stage.ready, stage.idle) == (None, True, False)
    stage.answers()


def test_one_that_ends_is_followed_by_another_after_a_second(stage: Stage) -> None:
    stage.answers()
    stage.ends()
    assert stage.lost == [stage.trouble]
    assert stage.trouble == f"the validator ended (killed, or by a fault): {AGAIN}"
    assert stage.next_pause_s() == pytest.approx(1.0, abs=0.11)
    assert "ended" in stage.trouble  # until the next one works
    stage.answers()
    assert (stage.starts, stage.trouble) == (2, "")


def test_after_one_that_was_never_ready_the_pause_is_longer(stage: Stage) -> None:
    for _ in range(3):
        stage.ends()
        assert stage.next_pause_s() == pytest.approx(15.0, abs=0.11)
    stage.answers()
    stage.ends()
    assert stage.next_pause_s() == pytest.approx(1.0, abs=0.11)


def test_one_that_cannot_be_started_is_tried_again(stage: Stage) -> None:
    stage.refusing, tried_s = True, list[float]()
    stage.ends()
    while len(stage.lost) < 4:
        count = len(stage.lost)
        stage.now_s += 0.1
        stage.receive()
        if len(stage.lost) > count:
            tried_s.append(stage.now_s)
            assert f"the validator cannot be started: {os.strerror(EAGAIN)}" in stage.trouble
    pauses = [after - before for before, after in itertools.pairwise(tried_s)]
    assert pauses == pytest.approx([15.0, 15.0], abs=0.11)
    stage.refusing = False
    stage.next_pause_s()
    stage.answers()
    assert (stage.starts, stage.trouble) == (2, "")


def test_one_that_does_not_become_ready_is_replaced(stage: Stage) -> None:
    stage.now_s += 14.9
    stage.receive()
    assert not stage.lost
    stage.now_s += 0.2
    stage.receive()
    assert stage.lost == [f"the validator was not ready within 15 s: {AGAIN}"]


def test_one_that_does_not_answer_is_replaced(stage: Stage) -> None:
    stage.answers()
    stage.now_s += 10 * HANG_S  # it was sent nothing
    for _ in range(5):
        stage.send({})
        stage.now_s += 0.9 * HANG_S
        stage.answers()
    assert not stage.lost
    stage.send({})
    stage.now_s += 1.1 * HANG_S
    stage.receive()
    assert stage.lost == [f"the validator hung, without an answer for 10 s: {AGAIN}"]
    assert stage.next_pause_s() == pytest.approx(1.0, abs=0.11)


def test_a_system_that_starts_no_process_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("controller.weights.supervisor.RUN_MODULE", ("/nowhere/python",))
    lost: list[str] = []
    Supervisor((), HANG_S, lost.append).receive()
    assert "cannot be started: No such file or directory" in lost[0]
