"""The latency report: every leg from the messages' fields, the bare loop, counting."""

import random
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from hdrh.log import HistogramLogReader

from bayesrace.messages import Actuation, State, Status, Telemetry, Truth
from experiments.latency.bare_loop import BareRun, read_bare_run, run_bare_loop
from experiments.latency.course import Course
from experiments.latency.histograms import LegHistogram, curve, distribution, new_histogram
from experiments.latency.legs import ANSWER, LEGS, Cycles
from experiments.latency.memory import MemoryWatch
from experiments.latency.traffic import counted, traffic

PERIOD_NS = 20_000_000
AHEAD_NS = 7_000_000_000
"""The controller's clock against the plant's in these tests."""


# Legs ------------------------------------------------------------------------------------------


@dataclass
class Loop:
    """A plant and a controller whose every delay is known; messages as they would send them."""

    cycles: Cycles
    epoch: int = 5
    began_ns: int = 10**12
    state_seq: int = 0
    sent: int = 0
    ticks: int = 0
    answers: list[float] = field(default_factory=list)

    def sampled_ns(self, seq: int) -> int:
        return self.began_ns + seq * PERIOD_NS

    def state(self) -> int:
        seq, self.state_seq = self.state_seq, self.state_seq + 1
        answers, self.answers = tuple(self.answers), []
        now_ns = self.sampled_ns(seq)
        time_s = seq * PERIOD_NS * 1e-9
        x, u = (0.0,) * 7, (0.0, 0.0)
        self.cycles.state(State(seq, now_ns, self.epoch, 1, time_s, x, u, 0, False, answers, False))
        return seq

    def tick(self, seq: int, released_ns: int = 700_000, seen: bool = True) -> None:
        """A cycle on state ``seq``, released that long after its sampling; 400 us until sent."""
        sampled_ns = self.sampled_ns(seq) + AHEAD_NS
        sent_ns = sampled_ns + released_ns + 400_000
        telemetry = Telemetry(
            self.sent, sent_ns, 1, seq, 0, 0, 3, self.ticks, sampled_ns + released_ns,
            sampled_ns + 600_000, False, 31.0, 42.0, 150.0, 250.0, 53.0, 0.0, (), (), 0.0, 0.0,
            0.0, 0.0, 0.0, 0, 0.0, 0.0,
        )  # fmt: skip
        actuation = Actuation(self.sent, sent_ns, self.epoch, 1, seq, 0.0, (0.0, 0.0), "", 0)
        self.sent, self.ticks = self.sent + 1, self.ticks + 1
        if seen:
            self.cycles.actuation(actuation)
            self.cycles.telemetry(telemetry)

    def answer(self, seq: int, arrival_s: float = 1.5e-3, acting_s: float = 2.5e-3) -> None:
        self.answers += [float(seq), arrival_s, acting_s]


@dataclass
class Heard:
    """Collects what is emitted."""

    values: dict[str, list[int]] = field(default_factory=dict)

    def __call__(self, leg: str, value_ns: int) -> None:
        self.values.setdefault(leg, []).append(value_ns)


def loop(horizon: int = 64) -> tuple[Loop, dict[str, list[int]]]:
    heard = Heard()
    return Loop(Cycles(heard, lambda ns: ns - AHEAD_NS, horizon)), heard.values


def test_each_leg_is_what_the_messages_say() -> None:
    system, heard = loop()
    for _ in range(3):
        seq = system.state()
        system.tick(seq)
        system.answer(seq)
    system.state()
    system.cycles.finish()
    assert {name: values[0] for name, values in heard.items()} == {
        "wake_up": 31_000,
        "state_transport": 600_000,
        "decode": 42_000,
        "release_wait": 100_000,
        "state_age": 700_000,
        "feedback": 250_000,
        "compute": 400_000,
        "encode": 53_000,
        "actuation_transport": 400_000,  # 1.5 ms after sampling, less 1.1 ms until it was made
        "state_to_actuation": 1_500_000,
        "acting": 2_500_000,
        "prepare": 150_000,
    }
    assert set(heard) == {leg.name for leg in LEGS}
    assert all(len(values) == 3 and len(set(values)) == 1 for values in heard.values())


def test_budget_adds_up_to_the_answer() -> None:
    """Transport, wait, cycle, transport are complementary: together state → actuation."""
    system, heard = loop()
    seq = system.state()
    system.tick(seq, released_ns=913_000)
    system.answer(seq, arrival_s=2.2e-3)
    system.state()
    system.cycles.finish()
    parts = ("state_transport", "release_wait", "compute", "actuation_transport")
    assert sum(heard[name][0] for name in parts) == heard[ANSWER][0] == 2_200_000


def test_a_second_answer_to_a_state_is_no_latency_of_it() -> None:
    """Without a new state the controller predicts the last one and answers again, a period on."""
    system, heard = loop()
    seq = system.state()
    system.tick(seq)
    system.tick(seq, released_ns=PERIOD_NS + 700_000)
    system.answer(seq)
    system.answer(seq, arrival_s=21.5e-3, acting_s=-1.0)
    system.state()
    system.cycles.finish()
    assert heard[ANSWER] == [1_500_000]
    assert heard["actuation_transport"] == [400_000, 400_000]
    assert heard["state_age"] == [700_000, 20_700_000]
    assert heard["state_transport"] == [600_000]
    assert heard["acting"] == [2_500_000]
    assert (system.cycles.tally.repeated, system.cycles.tally.overtaken) == (1, 1)


def test_a_lost_answer_is_not_taken_for_another() -> None:
    """Of two answers one arrived, and nobody says which: no transport is made up."""
    system, heard = loop()
    seq = system.state()
    system.tick(seq)
    system.tick(seq, released_ns=PERIOD_NS + 700_000)
    system.answer(seq, arrival_s=21.5e-3)
    system.state()
    system.cycles.finish()
    assert "actuation_transport" not in heard
    assert heard[ANSWER] == [21_500_000]


def test_the_order_of_the_streams_does_not_matter_within_the_horizon() -> None:
    """Topics are taken in one after the other, so all states of a while come first."""
    system, heard = loop(horizon=64)
    for _ in range(60):
        system.answer(system.state())
    for seq in range(60):
        system.tick(seq)
    system.state()
    system.cycles.settle()
    assert not heard
    system.cycles.finish()
    assert heard["actuation_transport"] == [400_000] * 60


def test_a_restarted_plant_is_not_mixed_with_the_one_before() -> None:
    system, heard = loop()
    for _ in range(5):
        system.tick(system.state())
    system.epoch, system.state_seq, system.began_ns = 6, 0, 2 * 10**12
    seq = system.state()
    system.tick(seq)
    system.answer(seq)
    system.state()
    system.cycles.finish()
    assert heard["state_transport"] == [600_000]
    assert system.cycles.tally.restarts == 1


def test_cycles_skipped_and_messages_unobserved_are_told_apart() -> None:
    system, _ = loop()
    for k in range(20):
        seq = system.state()
        if k == 7:  # two releases passed over
            system.ticks += 2
        system.tick(seq, seen=k not in (12, 13))
    tally = system.cycles.tally
    assert tally.skipped == 2
    assert tally.unobserved == 4  # two actuations, two telemetries
    assert tally.cycles == 18
    assert tally.mean_period_ns == PERIOD_NS


def test_memory_is_bounded_whatever_the_messages_claim() -> None:
    system, _ = loop(horizon=64)
    for k in range(3000):
        system.state()
        system.tick(10**9 + k)  # states that were never sent
        system.tick(system.state_seq - 1)
        system.cycles.settle()
    assert len(system.cycles._open) <= 70


# Histograms and the bare loop ------------------------------------------------------------------


def test_histogram_logs_are_read_back_by_the_library(tmp_path: Path) -> None:
    path = tmp_path / "leg.hlog"
    leg = LegHistogram(path, "state → actuation", 1.8e9)
    values = [random.Random(1).randrange(100_000, 9_000_000) for _ in range(999)]
    for k, value in enumerate([*values, -40]):
        leg.record(value)
        if k % 100 == 99:
            leg.roll(k / 100)
    leg.close()
    reader = HistogramLogReader(str(path), new_histogram())
    total = new_histogram()
    intervals = 0
    while (interval := reader.get_next_interval_histogram()) is not None:
        total.add(interval)
        intervals += 1
    assert (intervals, total.get_total_count()) == (10, 1000)
    assert distribution(total) == distribution(leg.total)
    assert (leg.below_zero, leg.lowest_ns) == (1, -40)
    assert len(leg.medians) == 10


def test_percentiles_are_those_of_the_values() -> None:
    histogram = new_histogram()
    for value in range(1, 10_001):
        histogram.record_value(value * 1000)
    found = distribution(histogram)
    assert found is not None
    expected = (5000, 9000, 9900, 9990, 10_000)
    given_ = (found.p50, found.p90, found.p99, found.p999, found.max)
    assert given_ == pytest.approx(expected, rel=2e-3)
    x, y = curve(histogram)
    assert x[0] == 1.0
    assert 1000 <= x[-1] <= 10_000  # neighbours among the largest share a bucket
    assert y == sorted(y)
    assert distribution(new_histogram()) is None


@dataclass
class Simulated:
    """A clock that moves only in sleep, which stalls at some releases."""

    stalls: dict[int, int]
    now_ns: int = 0

    def clock(self) -> int:
        return self.now_ns

    def sleep(self, until_ns: int) -> None:
        self.now_ns = max(until_ns, self.now_ns) + 50_000
        self.now_ns += self.stalls.pop(until_ns, 0)


def test_bare_loop_counts_as_the_controller_does() -> None:
    """A stall of 3.5 periods: one release missed, the three releases it lasted over skipped."""
    stall = {100 * PERIOD_NS: 7 * PERIOD_NS // 2, 200 * PERIOD_NS: PERIOD_NS // 2}
    simulated, run = Simulated(stall), BareRun()
    begin_ns, end_ns = 10 * PERIOD_NS, 300 * PERIOD_NS
    run_bare_loop(PERIOD_NS, begin_ns, end_ns, run, simulated.clock, simulated.sleep)
    assert (run.misses, run.skipped, run.ticks) == (1, 3, 290)
    result = run.result()
    assert result is not None
    assert result.p50 == pytest.approx(50, rel=2e-3)
    assert result.max == pytest.approx(70_050, rel=2e-3)
    assert result.count == 287


def test_bare_loop_that_never_woke_is_no_result() -> None:
    assert BareRun().result() is None


def test_a_broken_bare_loop_is_told(tmp_path: Path) -> None:
    path = tmp_path / "bare.log"
    path.write_text("Traceback: nothing good\n")
    with pytest.raises(ValueError, match="nothing good"):
        read_bare_run(path)


# Counting --------------------------------------------------------------------------------------


def status(source: str, **counters: int) -> Status:
    return Status(0, 0, source, "running", 1, 1, "", "", 50.0, 0.0, 0.0, counters)


def team(states: tuple[int, int, int], actuations: tuple[int, int, int]) -> dict[str, Any]:
    """Sent, received, lost."""
    return {
        "plant": status(
            "plant", states_sent=states[0], actuations_received=actuations[1],
            actuations_lost=actuations[2],
        ),
        "controller": status(
            "controller", actuations_sent=actuations[0], states_received=states[1],
            states_lost=states[2],
        ),
    }  # fmt: skip


def differences(begin: dict[str, Any], end: dict[str, Any]) -> dict[str, Any]:
    return {name: counted(begin[name], end[name]) for name in begin}


def test_messages_sent_are_received_or_lost() -> None:
    begin, end = team((100, 98, 2), (90, 90, 0)), team((400, 395, 5), (390, 388, 2))
    found = traffic(differences(begin, end), 50.0, 0.0)
    assert found["states"].model_dump() == {
        "sent": 300, "received": 297, "lost": 3, "in_flight": 0, "complete": True,
    }  # fmt: skip
    assert found["actuations"].complete


def test_a_message_that_nobody_counted_is_told() -> None:
    begin, end = team((0, 0, 0), (0, 0, 0)), team((300, 290, 5), (300, 300, 0))
    found = traffic(differences(begin, end), 50.0, 0.02)
    assert (found["states"].in_flight, found["states"].complete) == (5, False)
    assert found["actuations"].complete


def test_what_is_under_way_while_counting_is_allowed() -> None:
    """20 ms of network and 50 Hz: a message or two are between the two counts."""
    begin, end = team((0, 0, 0), (0, 0, 0)), team((300, 298, 0), (300, 300, 0))
    assert traffic(differences(begin, end), 50.0, 0.06)["states"].complete


def test_counters_of_a_restarted_process_begin_at_nothing() -> None:
    found = counted(status("controller", ticks=500, skipped=1), status("controller", ticks=40))
    assert found.restarted
    assert found["ticks"] == 40


def test_memory_growth_counts_after_the_warm_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first minute, or the first third of a shorter run, is warming up."""
    resident = {"now": 0}
    monkeypatch.setattr("experiments.latency.memory.resident_bytes", lambda _pid: resident["now"])
    for duration_s, warm_s in ((600.0, 60), (90.0, 30)):
        watch = MemoryWatch({"plant": 1}, duration_s)
        for second in range(int(duration_s)):
            resident["now"] = 1000 * min(second, warm_s) + (700 if second == warm_s + 5 else 0)
            watch.look(float(second))
        assert watch.result()["plant"].growth_bytes == 700


def test_course_counts_laps_and_samples_off_the_track() -> None:
    from tests.conftest import make_circuit

    track = make_circuit().track
    course = Course(track)
    on, off = track.position(1.0), track.position(1.0) + track.normal(1.0) * 0.5
    for k in range(700):
        x, y = off if k % 100 == 99 else on
        place = (float(x), float(y), 0.0, 1.0, 0.0, 0.0, 0.0)
        course.truth(Truth(k, 0, 1, 1, 0.0, place, (0.0, 0.0), 3 + k // 300))
    assert (course.laps, course.states, course.off_track_samples) == (2, 700, 7)
    assert Course(None).off_track_samples is None
