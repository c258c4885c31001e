"""How an inbox waits, in simulated time: no clock is read, so no stall of the machine matters."""

from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest

from bayesrace.messages import STATE, encode
from bayesrace.transport import Inbox
from bayesrace.transport import inbox as inbox_module
from tests.cycle_rig import state


def test_a_peer_that_polls_sleeps_while_no_answer_can_be_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In simulated time: a look takes 1 us, a sleep 60 us more than it should."""
    now_s, looks, due_s = 0.0, 0, 0.0

    def sleep(duration_s: float) -> None:
        nonlocal now_s
        now_s += duration_s + 60e-6

    def look() -> Any:
        nonlocal now_s, looks
        now_s, looks = now_s + 1e-6, looks + 1
        return sample if now_s >= due_s else None

    clock = SimpleNamespace(
        monotonic=lambda: now_s, monotonic_ns=lambda: round(1e9 * now_s), sleep=sleep
    )
    monkeypatch.setattr(inbox_module, "time", clock)
    sample = SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: encode(state(0))))
    session = MagicMock()
    session.declare_subscriber().handler.try_recv = look
    box = Inbox(session, "car")
    box.subscribe(STATE, newest=1)
    box.spin_s = 0.002

    def late_s(answer_s: float) -> float:
        """After an answer that takes so long: how much later it is noticed."""
        nonlocal due_s
        due_s = now_s + answer_s
        assert box.get(0.1) is not None
        return now_s - due_s

    for _ in range(300):  # learns how long an answer takes
        assert late_s(500e-6) < 5e-6
    looks = 0
    late_s(500e-6)
    assert looks < 60  # it would be 500 without a sleep
    late = [late_s(200e-6) for _ in range(40)]  # answers become faster than the sleep is long
    assert max(late) < 400e-6
    assert late[-1] < 5e-6
