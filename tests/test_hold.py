"""The dead man's switch: a held run goes on only while its director's loop goes round."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

from bayesrace.controller.interface import NO_PLAN, StepOutput
from bayesrace.controller.service import Service
from bayesrace.messages import COMMAND, HOLD, Command, Hold, encode
from bayesrace.transport import Item, Kind
from bayesrace.transport import hold as hold_module
from bayesrace.transport.hold import HoldWatch
from tests.cycle_rig import STEP_S, ScriptedLaw, scripted_driver, state
from tests.driven import blank


class Clock:
    """Time stands still unless the test lets it pass."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic_ns(self) -> int:
        return round(self.now_s * 1e9)


class Watched:
    """A watch, and how it hears something."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self._hear: Callable[[Any], None] = lambda _: None
        self.watch = HoldWatch(self, "orca")

    def declare_subscriber(self, key: str, handler: Any) -> None:
        assert key == HOLD.key.format(car="orca")
        self._hear = handler

    def hear(self, epoch: int = 7, run: int = 1, sent_s: float | None = None) -> None:
        """The director's clock is an hour ahead."""
        sent_ns = round(((self.clock.now_s if sent_s is None else sent_s) + 3600) * 1e9)
        self.hear_bytes(encode(Hold(seq=0, source_time_ns=sent_ns, epoch=epoch, run=run)))

    def hear_bytes(self, data: bytes) -> None:
        payload = SimpleNamespace(to_bytes=lambda: data)
        self._hear(SimpleNamespace(payload=payload))

    def missing_after(self, seconds: float) -> bool:
        self.clock.now_s += seconds
        return self.watch.missing


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> Watched:
    clock = Clock()
    monkeypatch.setattr(hold_module, "clock", clock)
    monkeypatch.setattr(hold_module, "in_transport_thread", lambda callback: callback)
    return Watched(clock)


def test_a_held_run_misses_its_director_after_half_a_second(watched: Watched) -> None:
    watched.watch.follow((7, 1), required=True)
    assert not watched.missing_after(0.45)
    for _ in range(20):
        watched.hear()
        assert not watched.missing_after(0.45)
    assert watched.missing_after(0.1)
    # The next run has its own, whatever its number.
    watched.watch.follow((7, 1), required=True)
    assert not watched.missing_after(0.45)
    watched.watch.follow((7, 2))
    assert not watched.missing_after(100.0)


def test_a_run_that_nobody_has_held_needs_no_director(watched: Watched) -> None:
    watched.watch.follow((7, 1))
    assert not watched.missing_after(100.0)
    watched.hear()
    assert watched.missing_after(0.6)


@pytest.mark.parametrize("other", [{"epoch": 8}, {"run": 2}])
def test_the_hold_of_another_run_does_not_count(watched: Watched, other: dict[str, int]) -> None:
    watched.watch.follow((7, 1), required=True)
    for _ in range(7):
        watched.hear(**other)
        watched.missing_after(0.1)
    assert watched.watch.missing
    watched.hear()
    assert not watched.watch.missing


def test_what_is_no_hold_is_counted(watched: Watched) -> None:
    watched.watch.follow((7, 1), required=True)
    watched.clock.now_s += 0.6
    watched.hear_bytes(b"\xc1")
    assert watched.watch.missing
    assert watched.watch.decoder.refused == 1


def test_a_link_that_holds_up_more_and_more_does_not_hold_the_car(watched: Watched) -> None:
    """A message comes every 0.1 s, and nobody holds the car any more."""
    watched.watch.follow((7, 1), required=True)
    sent_s = watched.clock.now_s
    missing = []
    for number in range(20):
        watched.hear(sent_s=sent_s + 0.05 * number)
        missing.append(watched.missing_after(0.1))
    assert missing == [False] * 9 + [True] * 11


def test_clocks_that_run_at_different_rates_do_not_stop_the_car(watched: Watched) -> None:
    """By 100 ppm, for two hours."""
    watched.watch.follow((7, 1), required=True)
    sent_s = watched.clock.now_s
    for _ in range(2 * 3600 * 20):
        watched.hear(sent_s=sent_s)
        sent_s += 0.05 / (1 + 1e-4)
        assert not watched.missing_after(0.05)


PRESENCE = {"node": "1", "listens": (), "connects": (), "seen": {}, "calendar_s": 0.0}


class Controller:
    """The controller's side of it: a car that answers each state, and its service."""

    def __init__(self, artefact: Path, clock: Clock, **settings: Any) -> None:
        law = ScriptedLaw(lambda _: StepOutput(u=np.array([0.5, 0.0]), plan_u=NO_PLAN))
        self.driver = scripted_driver(artefact, law, **settings)
        self.service = Service(
            MagicMock(),
            MagicMock(),
            "orca",
            50.0,
            self.driver,
            lambda: {"ticks": 0},
            lambda: PRESENCE,
        )
        self.clock, self._watched = clock, Watched(clock)
        self.service.hold = self._watched.watch
        self._seq = 0

    def drive(self, run: int, seconds: float, held: bool) -> str:
        """The phase after so long."""
        if self.driver.newest is not None and self.driver.newest.run != run:
            self.driver.lost(silent=False)
        for _ in range(round(seconds / STEP_S)):
            self._seq += 1
            fast = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
            assert self.driver.observe(state(self._seq, epoch=7, run=run, x=fast))
            self.driver.decide(self._seq * STEP_S)
            self.service.check_hold()
            if held:
                self._watched.hear(run=run)
            self._watched.clock.now_s += STEP_S
        return self.driver.phase.value

    def command(self, word: str) -> None:
        request = SimpleNamespace(
            service=COMMAND,
            payload=encode(blank(Command, command=word)),
            by={},
            reply=lambda *_: None,
        )
        self.service.react(Item(Kind.REQUEST, COMMAND.name, request, 0))


@pytest.fixture
def controlled(kinematic_artefact: Path, watched: Watched) -> Callable[..., Controller]:
    return lambda **settings: Controller(kinematic_artefact, watched.clock, **settings)


def test_a_controller_stops_for_good_when_its_director_is_missing(
    controlled: Callable[..., Controller],
) -> None:
    controller = controlled()
    assert controller.drive(1, 1.0, held=True) == "driving"
    assert controller.drive(1, 0.4, held=False) == "driving"
    assert controller.drive(1, 0.3, held=False) == "stopped"
    assert controller.drive(1, 1.0, held=True) == "stopped"
    status = controller.service.status()
    assert status.counters["holds_lost"] == 1
    assert "hold-to-run" in status.text
    assert controller.drive(2, 1.0, held=False) == "driving"


def test_go_drives_on_only_while_the_director_is_there(
    controlled: Callable[..., Controller],
) -> None:
    controller = controlled()
    controller.drive(1, 1.0, held=True)
    assert controller.drive(1, 1.0, held=False) == "stopped"
    controller.command("go")
    assert controller.drive(1, 0.2, held=False) == "stopped"
    controller.drive(1, 0.2, held=True)
    controller.command("go")
    assert controller.drive(1, 0.2, held=True) == "driving"


@pytest.mark.parametrize("settings", [{}, {"hold": True}], ids=["stop", "--hold"])
def test_a_new_run_does_not_undo_what_a_person_has_stopped(
    controlled: Callable[..., Controller], settings: dict[str, Any]
) -> None:
    controller = controlled(**settings)
    phase = controller.drive(1, 1.0, held=True)
    controller.drive(1, 1.0, held=False)
    if phase == "driving":
        controller.command("stop")
    assert controller.drive(2, 1.0, held=True) == ("stopped" if phase == "driving" else "ready")


def test_who_stops_the_car_as_its_director_dies_has_stopped_it(
    controlled: Callable[..., Controller],
) -> None:
    """Both in one cycle of the controller."""
    controller = controlled()
    assert controller.drive(1, 1.0, held=True) == "driving"
    assert controller.drive(1, 0.48, held=False) == "driving"
    controller.clock.now_s += 0.1
    controller.command("stop")
    controller.service.check_hold()
    assert controller.drive(1, 0.1, held=False) == "stopped"
    assert controller.drive(2, 1.0, held=True) == "stopped"
    controller.command("go")
    assert controller.drive(2, 0.2, held=True) == "driving"
