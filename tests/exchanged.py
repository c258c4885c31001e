"""What passes between a closed loop and its controller in Python, and the same states answered by
the controller without Python: to the bit, so whatever the one promises the other keeps."""

from collections.abc import Callable
from typing import Any, Final

import pytest
from msgspec.structs import asdict

from bayesrace.controller.driver import Decision, Driver
from bayesrace.messages import Actuation, Message, State, Telemetry
from bayesrace.operation.closed_loop import ClosedLoop
from bayesrace.operation.host import HostProgram
from tests.racing import prepared
from tests.recovery import hosted

__all__ = ["Alike", "answered_alike", "racing_host", "without_clocks"]

CLOCKS: Final = {
    "source_time_ns", "released_ns", "received_ns", "decode_us", "solve_us", "encode_us",
    "prepare_us", "wake_us",
}  # fmt: skip
"""Fields that say what a clock said."""

Alike = Callable[[], int]


def without_clocks(message: Message) -> dict[str, Any]:
    return {name: value for name, value in asdict(message).items() if name not in CLOCKS}


@pytest.fixture(scope="session")
def racing_host(tmp_path_factory: pytest.TempPathFactory) -> HostProgram:
    """The controller without Python for the race of :func:`tests.racing.racing`."""
    return hosted(prepared(), tmp_path_factory.mktemp("host"))


@pytest.fixture
def answered_alike(racing_host: HostProgram, monkeypatch: pytest.MonkeyPatch) -> Alike:
    """Compares the answers to what the controllers of this test have been shown so far, each field
    of actuations and telemetry; how many there are."""
    seen: list[State] = []
    sent: list[tuple[Actuation, Telemetry]] = []
    observe, send = Driver.observe, ClosedLoop._send

    def observing(driver: Driver, state: State) -> bool:
        seen.append(state)
        return observe(driver, state)

    def sending(loop: ClosedLoop, state: State, decision: Decision) -> None:
        send(loop, state, decision)
        seq, cycle = len(sent), loop._cycle
        sent.append(
            (cycle.actuation(seq, state, decision), cycle.telemetry(seq, state, decision, 0))
        )

    monkeypatch.setattr(Driver, "observe", observing)
    monkeypatch.setattr(ClosedLoop, "_send", sending)

    def compare() -> int:
        answers = racing_host.answers(seen)
        for expected, found in zip(sent, answers, strict=True):
            assert [*map(without_clocks, found)] == [*map(without_clocks, expected)]
        return len(answers)

    return compare
