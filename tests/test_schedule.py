"""The loop keeps its rate, and its releases meet the states, without any clock being read."""

import re
from pathlib import Path

import numpy as np
import pytest
from cffi import FFI
from hypothesis import given
from hypothesis import strategies as st

from bayesrace.codegen.build import NATIVE
from bayesrace.codegen.compiler import find_compiler
from bayesrace.controller.schedule import Schedule

MS = 1_000_000


def locked(
    schedule: Schedule, first_ns: float, interval_ns: float, jitter_ns: float, count: int
) -> list[float]:
    """Drives the schedule by states that are apart by an interval; their distances to a release."""
    random = np.random.default_rng(1)
    errors = []
    arrival = first_ns
    nominal_s = round(interval_ns, -6) * 1e-9
    for k in range(count):
        # one in ten is held up for long
        held_up = 10.0 if random.random() < 0.1 else 1.0
        observed = int(arrival + abs(random.normal()) * jitter_ns * held_up)
        while schedule.release_ns < observed - schedule.period_ns / 2:
            schedule.advance(schedule.release_ns)
        schedule.observe(observed, k * nominal_s, nominal_s)
        errors.append(schedule.release_ns - arrival)
        arrival += interval_ns
    return errors


def test_releases_are_exactly_a_period_apart() -> None:
    schedule = Schedule(500.0)
    schedule.start(7)
    for k in range(1, 1000):
        assert schedule.advance(schedule.release_ns + MS) == 0
        assert schedule.release_ns == 7 + k * 2 * MS


def test_a_long_cycle_skips_releases_and_keeps_the_phase() -> None:
    schedule = Schedule(50.0)
    schedule.start(0)
    # done at 39 ms: the release at 20 is late, but its deadline is at 40
    assert schedule.advance(39 * MS) == 0
    assert schedule.release_ns == 20 * MS
    # done at 95 ms: those at 40 and 60 are over
    assert schedule.advance(95 * MS) == 2
    assert schedule.release_ns == 80 * MS


@pytest.mark.parametrize("offset_ms", [0.5, 4.0, 9.0, -6.0])
def test_the_phase_locks_to_the_states(offset_ms: float) -> None:
    schedule = Schedule(50.0)
    schedule.start(0)
    errors = locked(schedule, offset_ms * MS, 20 * MS, 50e3, 600)
    assert max(abs(e) for e in errors[-50:]) < 0.05 * MS


def test_it_follows_a_plant_whose_clock_runs_fast() -> None:
    schedule = Schedule(50.0)
    schedule.start(0)
    errors = locked(schedule, 0.0, 20 * MS * (1 - 200e-6), 20e3, 2000)
    assert max(abs(e) for e in errors[-500:]) < 0.2 * MS


def test_messages_held_up_do_not_change_the_rate() -> None:
    """Seen late they may look early for the release after: with a mean of arrivals, the loop ran
    .2 % fast on a loaded machine."""
    schedule = Schedule(500.0)
    schedule.start(0)
    random = np.random.default_rng(3)
    count = 20_000
    for k in range(count):
        seen = k * 2 * MS + (1.9 * MS if random.random() < 0.3 else 0.05 * MS * random.random())
        while schedule.release_ns < seen - MS:
            schedule.advance(schedule.release_ns)
        schedule.observe(int(seen), k * 0.002, 0.002)
    assert schedule.release_ns == pytest.approx((count - 1) * 2 * MS, abs=0.1 * MS)


@pytest.mark.parametrize(("rate_hz", "interval_ms"), [(500.0, 20), (50.0, 2), (100.0, 20)])
def test_it_locks_where_one_period_is_a_multiple_of_the_other(
    rate_hz: float, interval_ms: int
) -> None:
    schedule = Schedule(rate_hz)
    schedule.start(0)
    locked(schedule, 0.3 * MS, interval_ms * MS, 0.0, 3000)
    grid = min(schedule.period_ns, interval_ms * MS)
    away = (schedule.release_ns - 0.3 * MS + grid / 2) % grid - grid / 2
    assert abs(away) < 0.02 * grid


def test_there_is_no_lock_to_states_of_another_rhythm() -> None:
    schedule = Schedule(50.0)
    schedule.start(0)
    schedule.observe(13 * MS, 0.0, 0.017)
    schedule.observe(13 * MS, 0.02, 0.0)
    assert schedule.release_ns == 0


@given(st.floats(0, 1e9))
def test_one_state_moves_a_release_by_half_a_percent_at_most(arrival_ns: float) -> None:
    """A message held up on its way must not throw the loop out of its rate."""
    schedule = Schedule(50.0)
    schedule.start(0)
    schedule.observe(int(arrival_ns), 0.0, 0.02)
    assert abs(schedule.release_ns) <= 0.005 * 20 * MS


@pytest.mark.parametrize(
    ("rate_hz", "interval_s", "missing"),
    [
        # by the age of the newest state at a release, in ms
        (50.0, 0.02, {0: 0, 4: 0, 14: 0, 16: 1, 20: 1, 24: 1, 34: 1, 36: 2, 44: 2, 60: 3}),
        (50.0, 0.0, {0: 0, 14: 0, 16: 1, 24: 1, 40: 2}),  # the interval is not known yet
        (500.0, 0.02, {0: 0, 2: 0, 10: 0, 18: 0, 19.6: 1, 20.4: 1, 22: 0, 39.6: 2, 42: 0}),
        (50.0, 0.002, {0: 0, 2: 0, 14: 0, 16: 1, 20: 1, 40: 2}),
        (50.0, 0.014, {0: 0, 7: 0, 14: 0, 16: 1, 20: 1}),
    ],
)
def test_a_release_knows_which_states_are_missing(
    rate_hz: float, interval_s: float, missing: dict[float, int]
) -> None:
    """By plant time: when the newest state arrived, and how late, makes no difference."""
    schedule = Schedule(rate_hz)
    schedule.start(100 * MS)
    schedule.observe(100 * MS, 5.0, 0.0)
    ages = {age_ms: schedule.missing(5.0 - age_ms * 1e-3, interval_s) for age_ms in missing}
    assert ages == missing


@pytest.mark.parametrize("rate_hz", [50.0, 500.0, 33.3])
@pytest.mark.parametrize("interval_s", [0.02, 0.01, 0.021])
def test_the_schedule_in_c_keeps_the_same_releases(
    tmp_path: Path, rate_hz: float, interval_s: float
) -> None:
    """States that are late, lost, or after a jump of the clock; cycles that take too long."""
    source = NATIVE.parent / "host" / "br_schedule.c"
    out = tmp_path / "schedule.so"
    find_compiler().run("-O2", "-fPIC", "-shared", source, "-lm", "-o", out)
    ffi, header = FFI(), source.with_suffix(".h").read_text()
    most = re.search(r"#define BR_WINDOW (\d+)", header)
    assert most is not None
    ffi.cdef(re.sub(r"^#.*$", "", header, flags=re.M).replace("BR_WINDOW", most[1]))
    library, random = ffi.dlopen(str(out)), np.random.default_rng(7)
    one, other = Schedule(rate_hz), ffi.new("br_schedule *")
    other.period_ns = one.period_ns
    begin_ns, ahead_ns = 10**15, 0
    one.start(begin_ns)
    library.br_schedule_start(other, begin_ns)
    for k in range(3000):
        ahead_ns += 7 * MS * int(random.random() < 0.002)
        late_ns = int(random.exponential(5e4) * (100 if random.random() < 0.02 else 1))
        arrival_ns = begin_ns + ahead_ns + late_ns + round(k * interval_s * 1e9)
        if random.random() > 0.05:
            known = k > 0
            one.observe(arrival_ns, k * interval_s, interval_s * known)
            library.br_schedule_observe(other, arrival_ns, k * interval_s, interval_s * known)
        while one.release_ns < arrival_ns:
            now_ns = arrival_ns + int(random.integers(0, 60 * MS) * (random.random() < 0.01))
            assert library.br_schedule_advance(other, now_ns) == one.advance(now_ns)
        assert other.release_ns == one.release_ns
        time_s = (k - int(random.integers(0, 3))) * interval_s
        missing = library.br_schedule_missing(other, time_s, interval_s)
        assert missing == one.missing(time_s, interval_s)
        assert library.br_schedule_window_end_ns(other) == one.window_end_ns
        plant_s = library.br_schedule_plant_time_s(other, arrival_ns)
        assert plant_s == pytest.approx(one.plant_time_s(arrival_ns), abs=1e-12)
