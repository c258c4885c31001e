"""Clocks of several hosts: the offset found is right within what is stated of it."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bayesrace.studies.latency.legs import ANSWER, ClockMap
from tests.synthetic_latency import PERIOD_NS, Loop, report_of

delays = st.one_of(st.integers(0, 500_000), st.integers(0, 80_000_000))


@settings(deadline=None, max_examples=60)
@given(
    offset_ns=st.integers(-(10**14), 10**14),
    drift_ppm=st.floats(-150, 150),
    ways=st.lists(st.tuples(delays, delays), min_size=2, max_size=60),
    share=st.floats(0, 1),
)
def test_true_offset_is_within_the_stated_uncertainty(
    offset_ns: int, drift_ppm: float, ways: list[tuple[int, int]], share: float
) -> None:
    """However unequal the two ways are, at the exchanges and between them."""

    def controller(plant_ns: int) -> int:
        return plant_ns + offset_ns + round(plant_ns * drift_ppm * 1e-6)

    exchanges = []
    for k, (there_ns, back_ns) in enumerate(ways):
        sampled = 10**15 + k * 333_000_000
        received = sampled + there_ns
        sent = received + 400_000
        exchanges.append((sampled, controller(received), controller(sent), sent + back_ns))
    columns = np.array(exchanges, dtype=float).T
    clock = ClockMap.of(*columns)
    assert clock is not None
    first, last = min(columns[1]), max(columns[1])
    reading = int(first + share * (last - first))
    plant = int(clock.to_plant(np.array([reading], dtype=float))[0])
    if not clock.shared:
        assert abs(controller(plant) - reading) <= clock.uncertainty


def test_the_shortest_exchange_bounds_the_offset() -> None:
    """Of three within half a second, 120 us against two slow ones."""
    ways = np.array([9e5, 4e4, 3e6])
    sampled = np.linspace(0.0, 4e8, 3)
    received = sampled + ways + 5_000_000_000
    clock = ClockMap.of(sampled, received, received, sampled + 4 * ways)
    assert clock is not None
    assert not clock.shared
    assert clock.offset.tolist() == pytest.approx([5_000_000_000], abs=80_002)
    # A fifth of a second away, the clocks may have run apart by 40 us more.
    assert clock.uncertainty == pytest.approx(80_000 + 40_000, abs=1000)


def test_one_clock_needs_no_correction(tmp_path: Path) -> None:
    with Loop(tmp_path / "run.mcap", ahead_ns=0) as system:
        for _ in range(50):
            system.cycle()
    clocks = report_of(tmp_path / "run.mcap").result.clocks
    assert clocks is not None
    assert (clocks.shared, clocks.uncertainty_us, clocks.offset_us) == (True, 0, 0)
    assert clocks.exchanges == 49


@pytest.mark.parametrize("ahead_ns", [10**12, -(10**12), 9_000_000, -2_000_000])
def test_other_clocks_are_corrected_within_the_uncertainty(tmp_path: Path, ahead_ns: int) -> None:
    """The transports, 600 and 400 us, are known within half of their sum."""
    with Loop(tmp_path / "run.mcap", ahead_ns=ahead_ns, drift=75e-6) as system:
        for _ in range(200):
            system.cycle()
    result = report_of(tmp_path / "run.mcap").result
    clocks, legs = result.clocks, result.legs_us
    assert clocks is not None
    assert not clocks.shared
    end_us = (ahead_ns + 75e-6 * 200 * PERIOD_NS) * 1e-3
    assert abs(clocks.offset_us - end_us) <= clocks.uncertainty_us == pytest.approx(500, abs=1)
    for name, true_us in (("state_transport", 600), ("actuation_transport", 400)):
        assert legs[name].uncertainty_us == clocks.uncertainty_us
        assert abs(legs[name].min - true_us) <= clocks.uncertainty_us
        assert abs(legs[name].max - true_us) <= clocks.uncertainty_us
    assert legs[ANSWER].uncertainty_us == 0
