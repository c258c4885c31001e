"""Clocks of several hosts: the offset found is right within what is stated of it."""

import random
from dataclasses import dataclass

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from experiments.latency.clocks import ClockPair, Exchange, OffsetEstimator


@dataclass(frozen=True)
class Remote:
    """A clock with an offset that drifts: ``reading`` at own time."""

    offset_ns: int
    drift_ppm: float

    def reading(self, own_ns: int) -> int:
        return own_ns + self.offset_ns + round(own_ns * self.drift_ppm * 1e-6)


def exchange(remote: Remote, at_ns: int, there_ns: int, back_ns: int) -> Exchange:
    return Exchange(at_ns, remote.reading(at_ns + there_ns), at_ns + there_ns + back_ns)


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
    """However unequal the two ways are, at the exchanges and between them, in both directions."""
    remote = Remote(offset_ns, drift_ppm)
    estimator = OffsetEstimator()
    for k, (there_ns, back_ns) in enumerate(ways):
        estimator.add(exchange(remote, 200_000_000 + k * 333_000_000, there_ns, back_ns))
    estimator.flush()
    last_ns = 200_000_000 + len(ways) * 333_000_000
    own_ns = round(share * last_ns)
    back, bound = estimator.to_own(remote.reading(own_ns))
    assert abs(back - own_ns) <= bound
    there, bound = estimator.to_other(own_ns)
    assert abs(there - remote.reading(own_ns)) <= bound


def test_smallest_round_trip_of_a_second_wins() -> None:
    remote = Remote(5_000_000_000, 0.0)
    estimator = OffsetEstimator()
    for k, way_ns in enumerate((900_000, 40_000, 3_000_000)):
        estimator.add(exchange(remote, k * 100_000_000, way_ns, way_ns * 3))
    estimator.flush()
    assert estimator.last.uncertainty == pytest.approx(80_000, abs=2)
    assert estimator.last.offset == pytest.approx(5_000_000_000, abs=80_002)


def test_drift_between_two_estimates_is_followed() -> None:
    """Asymmetric but steady delays: the error stays constant, the drift is exact."""
    remote = Remote(10**9, 80.0)
    estimator = OffsetEstimator()
    for k in range(100):
        estimator.add(exchange(remote, k * 250_000_000, 100_000, 100_000))
    estimator.flush()
    assert estimator.drift_ppm is not None
    drift, bound = estimator.drift_ppm
    assert abs(drift - 80.0) <= bound < 10
    half_way_ns = 12_345_678_901
    assert estimator.to_other(half_way_ns)[0] == pytest.approx(remote.reading(half_way_ns), abs=100)


def test_another_clock_behind_the_same_name_starts_afresh() -> None:
    """A process that comes back on a rebooted host reads less than before."""
    estimator = OffsetEstimator()
    for k in range(10):
        estimator.add(exchange(Remote(10**12, 0.0), k * 500_000_000, 1000, 1000))
    for k in range(10, 20):
        estimator.add(exchange(Remote(-(10**9), 0.0), k * 500_000_000, 1000, 1000))
    estimator.flush()
    assert estimator.to_own(9_000_000_000)[0] == pytest.approx(10_000_000_000, abs=5000)


def test_estimates_are_bounded_in_number() -> None:
    estimator = OffsetEstimator()
    for k in range(10_000):
        estimator.add(exchange(Remote(0, 10.0), k * 1_100_000_000, 1000, 1000))
    assert len(estimator._nodes) <= 4096
    assert estimator.to_own(Remote(0, 10.0).reading(9_000 * 1_100_000_000))[1] < 2000


def pair(plant: Remote, controller: Remote, hosts: tuple[str, str]) -> ClockPair:
    clocks, chance = ClockPair(), random.Random(3)
    for k in range(200):
        for estimator, remote in ((clocks.plant, plant), (clocks.controller, controller)):
            there_ns, back_ns = (chance.randrange(20_000, 400_000) for _ in range(2))
            estimator.add(exchange(remote, k * 200_000_000, there_ns, back_ns))
    for estimator in (clocks.plant, clocks.controller):
        estimator.flush()
    clocks.hosts.update(plant=hosts[0], controller=hosts[1])
    clocks.decide()
    return clocks


def test_one_host_and_one_clock_need_no_correction() -> None:
    """Seen from a third host: their offsets are far from 0, but the same."""
    clocks = pair(Remote(10**12, 20.0), Remote(10**12, 20.0), ("pit", "pit"))
    assert clocks.shared
    assert clocks.to_plant(123_456_789) == 123_456_789
    assert clocks.uncertainty_ns == 0


@pytest.mark.parametrize(
    ("ahead_ns", "hosts"),
    [(1_000_000_000_000, ("pit", "pit")), (9_000_000, ("pit", "pit")), (0, ("pit", "car"))],
    ids=["time namespace", "9 ms apart", "two hosts"],
)
def test_other_clocks_are_corrected_within_the_uncertainty(
    ahead_ns: int, hosts: tuple[str, str]
) -> None:
    plant, controller = Remote(10**9 + ahead_ns, -30.0), Remote(10**9, 45.0)
    clocks = pair(plant, controller, hosts)
    assert not clocks.shared
    for own_ns in range(1_000_000_000, 39_000_000_000, 777_777_777):
        converted = clocks.to_plant(controller.reading(own_ns))
        assert abs(converted - plant.reading(own_ns)) <= clocks.uncertainty_ns
    assert clocks.uncertainty_ns < 1_000_000
