"""After a stall of 0.6 s of any process the car is driven again, whichever controller drives."""

from collections.abc import Callable

import pytest

from bayesrace.operation.host import HostProgram
from tests.exchanged import racing_host
from tests.racing import prepared
from tests.recovery import WITHIN_S, by_datagrams, by_network

__all__ = ["racing_host"]  # a fixture

pytestmark = [pytest.mark.check, pytest.mark.wall_clock]


@pytest.mark.parametrize(
    ("by", "stalled"),
    [
        *((by_datagrams, what) for what in ("program", "plant")),
        *((by_network, what) for what in ("program", "bridge", "controller")),
    ],
)
def test_the_car_is_driven_again_at_once(
    by: Callable[..., list[float]], stalled: str, racing_host: HostProgram
) -> None:
    """Each time; how soon ``python -m tests.recovery`` measures, here most of the times."""
    drives = None if stalled == "controller" else racing_host
    times = sorted(by(prepared(), drives, stalled, count=3, pause_s=0.6, rate_hz=50.0))
    assert times[-1] < 2.0
    assert times[1] < WITHIN_S
