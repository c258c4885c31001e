"""A gatekeeper that ends, hangs or cannot be started is followed by another, but not in haste."""

import itertools
import os
import socket
from errno import EAGAIN

import pytest

from controller.gate.channel import Channel
from controller.gate.link import Link
from controller.gate.memory import Memory
from controller.gate.supervisor import Supervisor

pytestmark = pytest.mark.wall_clock

HANG_S = 10.0
AGAIN = "weights in use stay and are not watched until it is there again"


class Puppet(Link):
    """A gatekeeper that does what the test says, without a process."""

    def __init__(self) -> None:
        own, its = socket.socketpair()
        self._channel, self.its_end = Channel(own), Channel(its)
        self.closed = False

    def close(self) -> None:
        self.closed = True
        self._channel.close()


class Stage:
    """A supervisor whose clock and gatekeepers are the test's."""

    def __init__(self) -> None:
        self.now_s = self.alive_s = 1000.0
        self.refusing = False
        self.puppets: list[Puppet] = []
        self.supervisor = Supervisor(
            self._start, lambda: self.alive_s, HANG_S, clock_s=lambda: self.now_s
        )

    def _start(self) -> Puppet:
        if self.refusing:
            raise OSError(EAGAIN, os.strerror(EAGAIN))
        self.puppets.append(Puppet())
        return self.puppets[-1]

    def ready(self) -> None:
        """The newest one says so."""
        self.alive_s = self.now_s
        self.puppets[-1].its_end.send("ready")
        heard = self.supervisor.hear()
        assert heard is not None
        assert self.supervisor.ready

    def ends(self) -> None:
        """The newest one."""
        self.puppets[-1].its_end.close()
        assert self.supervisor.hear() is None

    def pause_s(self) -> float:
        """Until the next one is started, to the tenth of a second."""
        begin_s, before = self.now_s, len(self.puppets)
        while len(self.puppets) == before:
            assert self.supervisor.patience_s > 0
            self.now_s += 0.1
            assert self.supervisor.look()
        return round(self.now_s - begin_s, 1)


@pytest.fixture
def stage() -> Stage:
    made = Stage()
    assert made.supervisor.look()
    return made


def test_it_is_ready_when_it_says_so(stage: Stage) -> None:
    supervisor, puppet = stage.supervisor, stage.puppets[0]
    assert (supervisor.starts, supervisor.ready, supervisor.text) == (1, False, "")
    assert supervisor.fileno() == puppet.fileno()
    stage.ready()
    supervisor.tell("check", b"file", number=3)
    assert puppet.its_end.receive() == ({"kind": "check", "number": 3}, b"file")
    puppet.its_end.send("refused", text="no")
    assert supervisor.hear() == ({"kind": "refused", "text": "no"}, b"")
    assert (supervisor.look(), supervisor.starts, supervisor.ready) == (True, 1, True)


def test_one_that_ends_is_followed_by_another_after_a_second(stage: Stage) -> None:
    stage.ready()
    stage.ends()
    supervisor = stage.supervisor
    assert (supervisor.ready, supervisor.fileno()) == (False, None)
    assert supervisor.text == f"the gatekeeper ended or hung (killed, or by a fault): {AGAIN}"
    supervisor.tell("check")  # nobody is there
    assert stage.pause_s() == pytest.approx(1.0)
    assert "ended" in supervisor.text  # until the next one works
    stage.ready()
    assert (supervisor.starts, supervisor.text) == (2, "")


def test_the_pause_doubles_until_one_works(stage: Stage) -> None:
    """Ended before they were ready: pauses of 2, 4 s and so on to 30 s; then 1 s again."""
    pauses = []
    for _ in range(6):
        stage.ends()
        pauses.append(stage.pause_s())
    assert pauses == pytest.approx([2, 4, 8, 16, 30, 30], abs=0.11)
    stage.ready()
    stage.ends()
    assert stage.pause_s() == pytest.approx(1.0, abs=0.11)


def test_one_that_cannot_be_started_is_tried_again_later_and_later() -> None:
    stage = Stage()
    stage.refusing = True
    supervisor, tried_s = stage.supervisor, list[float]()
    while len(tried_s) < 7:
        if not supervisor.look():
            tried_s.append(stage.now_s)
            assert supervisor.text == f"the gatekeeper cannot be started: {os.strerror(EAGAIN)}"
        stage.now_s += 0.1
    pauses = [after - before for before, after in itertools.pairwise(tried_s)]
    assert pauses == pytest.approx([2, 4, 8, 16, 30, 30], abs=0.11)
    assert (supervisor.starts, supervisor.fileno()) == (0, None)
    stage.refusing = False
    stage.pause_s()
    stage.ready()
    assert (supervisor.starts, supervisor.text) == (1, "")


def test_one_that_does_not_become_ready_is_replaced(stage: Stage) -> None:
    supervisor = stage.supervisor
    stage.now_s += 14.9
    assert supervisor.look()
    stage.now_s += 0.2
    assert not supervisor.look()
    assert stage.puppets[0].closed
    assert supervisor.text == f"the gatekeeper was not ready within 15 s: {AGAIN}"
    assert stage.pause_s() == pytest.approx(2.0, abs=0.11)


def test_one_without_a_sign_of_life_is_replaced(stage: Stage) -> None:
    supervisor = stage.supervisor
    stage.ready()
    assert supervisor.patience_s < HANG_S / 2
    for _ in range(5):
        stage.now_s += 0.9 * HANG_S
        stage.alive_s = stage.now_s - 0.5 * HANG_S
        assert supervisor.look()
    stage.now_s += 0.6 * HANG_S
    assert not supervisor.look()
    assert stage.puppets[0].closed
    assert supervisor.text == f"the gatekeeper hung, without a sign of life for 10 s: {AGAIN}"
    assert stage.pause_s() == pytest.approx(1.0, abs=0.11)


def test_the_next_one_waits_for_leave(stage: Stage) -> None:
    stage.ends()
    stage.now_s += 100.0
    assert stage.supervisor.look(may_start=False)
    assert stage.supervisor.starts == 1
    assert stage.supervisor.look()
    assert stage.supervisor.starts == 2


def test_a_system_that_starts_no_process_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.executable", "/nowhere/python")
    with pytest.raises(OSError, match="No such file or directory"):
        Link(Memory(16))
