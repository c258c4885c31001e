"""Latency: every leg from the log, clocks of several hosts, counting, the bare loop, the report."""

import io
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from bayesrace.errors import InputError
from bayesrace.studies.latency.analysis import Analysis, Beside, Memory, Series, analyse
from bayesrace.studies.latency.beside import bare_loop, bare_result
from bayesrace.studies.latency.legs import ANSWER, BESIDE, LEGS, ClockMap
from bayesrace.studies.latency.report import print_report, write_files
from bayesrace.studies.latency.settings import LatencySettings
from bayesrace.transport import Endpoints
from tests.synthetic_latency import PERIOD_NS, Loop, report_of


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run.mcap"


def values(path: Path) -> dict[str, list[int]]:
    """All legs of a log, in order [ns]."""
    return {leg: one.ns.tolist() for leg, one in report_of(path).series.items()}


# Legs ------------------------------------------------------------------------------------------


def test_each_leg_is_what_the_messages_say(path: Path) -> None:
    with Loop(path, ahead_ns=0) as system:
        for _ in range(3):
            system.cycle()
        system.state()
    assert {leg: (one[0], len(set(one)), len(one)) for leg, one in values(path).items()} == {
        leg: (ns, 1, 3)
        for leg, ns in {
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
        }.items()
    }
    assert set(values(path)) == set(LEGS)


@pytest.mark.parametrize("ahead_ns", [0, 7_000_000_000])
def test_budget_adds_up_to_the_answer(path: Path, ahead_ns: int) -> None:
    """Transport, wait, cycle, transport are complementary: together state → actuation."""
    with Loop(path, ahead_ns=ahead_ns) as system:
        seq = system.state()
        system.tick(seq, released_ns=913_000)
        system.answer(seq, arrival_s=2.2e-3)
        system.state()
    found = values(path)
    parts = ("state_transport", "release_wait", "compute", "actuation_transport")
    assert sum(found[name][0] for name in parts) == found[ANSWER][0] == 2_200_000


def test_a_second_answer_to_a_state_is_no_latency_of_it(path: Path) -> None:
    """Without a new state the controller predicts the last one and answers again, a period on."""
    with Loop(path, ahead_ns=0) as system:
        seq = system.state()
        system.tick(seq)
        system.tick(seq, released_ns=PERIOD_NS + 700_000)
        system.answer(seq)
        system.answer(seq, arrival_s=21.5e-3, acting_s=-1.0)
        system.state()
    found, result = values(path), report_of(path).result
    assert found[ANSWER] == [1_500_000]
    assert found["actuation_transport"] == [400_000, 400_000]
    assert found["state_age"] == [700_000, 20_700_000]
    assert found["state_transport"] == [600_000]
    assert found["acting"] == [2_500_000]
    assert (result.repeated_answers, result.overtaken_answers) == (1, 1)


def test_a_late_cycle_is_a_cycle_of_its_release(path: Path) -> None:
    """Its state has the latency that it had; period, rate and skipped releases stay those of the
    releases, and so do the legs that belong to a release."""
    with Loop(path, ahead_ns=0) as system:
        for k in range(10):
            seq = system.state()
            if k == 5:  # the release answers the state before, then this one when it comes
                system.tick(seq - 1, released_ns=PERIOD_NS + 700_000)
                system.answer(seq - 1, arrival_s=21.5e-3)
                system.tick(seq, released_ns=9_000_000, late=True)
                system.answer(seq, arrival_s=9.8e-3)
                system.ticks += 2  # the next two releases are passed over
            elif k not in (6, 7):
                system.tick(seq)
                system.answer(seq)
            if k % 5 == 4:
                system.heartbeats()
        system.state()
    found, result = values(path), report_of(path).result
    assert found[ANSWER] == [*[1_500_000] * 5, 9_800_000, *[1_500_000] * 2]
    assert found["release_wait"] == [*[100_000] * 5, 40_000, *[100_000] * 2]
    assert found["state_transport"][5] == 8_960_000
    assert found["state_age"][5:7] == [20_700_000, 9_000_000]
    assert [len(found[leg]) for leg in ("compute", "feedback", "encode")] == [9, 9, 9]
    assert found["wake_up"] == [31_000] * 8
    assert found["prepare"] == [150_000] * 8
    assert (result.late_states, result.repeated_answers) == (1, 1)
    assert (result.skipped, result.ticks) == (2, 10)
    assert result.mean_period_us == pytest.approx(9 * PERIOD_NS * 1e-3 / 7)
    assert result.rate_error == pytest.approx(2 / 7)


def test_a_lost_answer_is_not_taken_for_another(path: Path) -> None:
    """Of two answers one arrived, and no message says which: no transport is made up."""
    with Loop(path, ahead_ns=0) as system:
        system.cycle()
        seq = system.state()
        system.tick(seq)
        system.tick(seq, released_ns=PERIOD_NS + 700_000)
        system.answer(seq, arrival_s=21.5e-3)
        system.state()
    found = values(path)
    assert found["actuation_transport"] == [400_000]
    assert found[ANSWER] == [1_500_000, 21_500_000]


@pytest.mark.parametrize("restarted", ["plant", "controller"])
def test_restarted_processes_are_not_mixed_with_those_before(path: Path, restarted: str) -> None:
    """A plant's clock may begin anew, too, as after a reboot; so may a controller's."""
    with Loop(path) as system:
        for _ in range(5):
            system.cycle()
        if restarted == "plant":
            system.epoch, system.state_seq, system.began_ns = 6, 0, 2 * 10**12
            system.delays.clear()
        else:
            system.sent, system.ahead_ns = 0, 9_000_000_000
        for _ in range(3):
            system.cycle()
        system.state()
    result = report_of(path).result
    assert result.restarts == 1
    assert result.legs_us["state_transport"].max < 1001
    assert result.legs_us[ANSWER].max == 1500


def test_cycles_skipped_and_messages_unobserved_are_counted_apart(path: Path) -> None:
    with Loop(path) as system:
        for k in range(20):
            seq = system.state(seen=k != 15)
            if k == 7:  # two releases passed over
                system.ticks += 2
            system.tick(seq, seen=k not in (12, 13))
        system.state()
    result = report_of(path).result
    assert result.skipped == 2
    assert result.unobserved == 5  # two actuations, two of telemetry, a state
    assert result.ticks == 17 + 2
    assert result.mean_period_us == pytest.approx(PERIOD_NS * 1e-3)


def test_warm_up_and_what_comes_after_the_duration_do_not_count(path: Path) -> None:
    with Loop(path) as system:
        for _ in range(250):
            system.cycle()
    result = report_of(path, warm_up_s=1.0, duration_s=2.0).result
    assert result.legs_us["decode"].count == 100
    assert result.states == 151  # all of the drive until then, and its laps
    assert result.laps == 1
    with pytest.raises(InputError, match="no states"):
        report_of(path, warm_up_s=6.0)


def test_cycles_after_the_end_of_a_run_do_not_count(path: Path) -> None:
    """The controller predicts the last state forward and falls back, until it gives up."""
    with Loop(path) as system:
        system.cycle()
        seq = system.state()
        for k in range(20):
            system.tick(seq, released_ns=k * PERIOD_NS)
    result = report_of(path).result
    assert result.ticks == result.legs_us["state_age"].count == 1


def test_a_log_in_lockstep_gives_the_legs_of_the_controller(path: Path) -> None:
    with Loop(path, lockstep=True) as system:
        for _ in range(5):
            system.tick(system.state())
        system.state()
    result = report_of(path).result
    assert result.legs_us["compute"].count == 5
    assert ANSWER not in result.legs_us
    assert result.clocks is None
    assert any("lockstep" in note for note in result.notes)


def test_a_log_of_another_car_is_refused_by_name(path: Path) -> None:
    with Loop(path) as system:
        system.cycle()
    with pytest.raises(InputError, match="cars orca; choose one with --name"):
        report_of(path, name="blue")


def test_laps_and_samples_off_the_track(path: Path) -> None:
    from tests.conftest import make_circuit

    with Loop(path) as system:  # at the origin, which is not on the track
        for _ in range(201):
            system.cycle()
    settings = LatencySettings(log=path, warm_up_s=0.0)
    result = analyse(path, settings, make_circuit().track, Beside()).result
    assert (result.laps, result.states, result.off_track_samples) == (2, 201, 201)


# Messages --------------------------------------------------------------------------------------


def account(path: Path, lost: int, unheard: int) -> Loop:
    """A run of 4 s in which five states go missing; the controller notices ``lost`` of them."""
    with Loop(path) as system:
        for k in range(200):
            system.cycle()
            if k % 5 == 4:
                system.heartbeats(unheard if k > 100 else 0, overruns=k // 50)
    return system


def test_messages_sent_are_received_or_lost(path: Path) -> None:
    account(path, 0, 0)
    result = report_of(path).result
    assert result.traffic["states"].model_dump() == {
        "sent": 190, "received": 190, "lost": 0, "in_flight": 0, "complete": True,
    }  # fmt: skip
    assert result.traffic["actuations"].complete
    assert (result.sent, result.received, result.lost) == (380, 380, 0)
    assert (result.overruns, result.rate_hz) == (3, 50.0)


def test_messages_that_neither_side_counted_are_shown(path: Path) -> None:
    account(path, 0, 5)
    found = report_of(path).result.traffic
    assert (found["states"].in_flight, found["states"].complete) == (5, False)
    assert found["actuations"].complete


# Percentiles and the bare loop ------------------------------------------------------------------


def test_percentiles_are_those_of_the_values() -> None:
    found = Series(np.arange(10_000.0), np.linspace(1e3, 1e7, 10_000)).distribution()
    assert list(found.model_dump().values()) == pytest.approx(
        [5000, 9000, 9900, 9990, 10_000, 10_000], abs=1
    )


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
    simulated = Simulated(stall)
    late_ns = bare_loop(
        290, PERIOD_NS, 10 * PERIOD_NS, clock=simulated.clock, sleep=simulated.sleep
    )
    series, result = bare_result(late_ns, PERIOD_NS, ["no priority"])
    assert (result.misses, result.skipped, result.ticks, result.count) == (1, 3, 290, 287)
    assert (result.p50, result.max) == (50, 70_050)
    assert result.mean_period_us == pytest.approx(20_000 * 289 / 286)
    assert series.at_s[-1] == pytest.approx(289 * 0.02)
    assert result.refused == ["no priority"]


# Clocks -------------------------------------------------------------------------------------------


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


# Report -------------------------------------------------------------------------------------------


@pytest.fixture
def analysis(tmp_path: Path) -> Analysis:
    """A run with two clocks, a lost message and everything that can be measured."""
    with Loop(tmp_path / "run.mcap", state_seq=100_000) as system:
        for k in range(200):
            system.cycle()
            if k % 5 == 4:
                system.heartbeats(lost=5 if k > 100 else 0)
    settings = LatencySettings(
        log=tmp_path / "run.mcap",
        warm_up_s=0.0,
        track="",
        load=2,
        attach=Endpoints(connect=("tcp/pit:1",)),
    )
    late_ns = np.full(250, 80_000)
    late_ns[9] = PERIOD_NS + 1
    rss = {"plant": Memory(begin_bytes=2**26, most_bytes=2**26 + 4096)}
    bare = bare_result(late_ns, PERIOD_NS, [])
    passed = Series(np.linspace(0.0, 4.98, 250), np.full(250, 300_000.0))
    beside = Beside("pit", bare, passed, rss, ["ended early: the sun went down"])
    return analyse(tmp_path / "run.mcap", settings, None, beside)


def test_table_fits_a_terminal_of_80_columns_and_says_everything(analysis: Analysis) -> None:
    out = io.StringIO()
    changes = {"off_track_samples": 6, "deadline_misses": 3, "late_states": 2}
    result = analysis.result.model_copy(update=changes)
    print_report(result, Console(file=out, width=80))
    text = out.getvalue()
    assert all(title in text for title, _ in LEGS.values())
    assert "…" not in text
    for words in (
        "3 deadlines missed (bare loop 1)", "190 sent = 190 received + 0 lost",
        "185 received + 0 lost +5 NOT ACCOUNTED FOR", "off track 6 of 200", "± 500 us", "laps 1",
        "7.000100 s ahead of the plant's", "the sun went down", "+0.0000%", "attached", "load 2",
        "on this machine, pit", "4 kB on 64.0 MB", "0 repeated answers, 2 late states",
        *BESIDE.values(),
    ):  # fmt: skip
        assert words in " ".join(text.split()), words


@pytest.mark.parametrize("measured", [True, False])
def test_files_are_made_of_whatever_was_measured(
    analysis: Analysis, tmp_path: Path, measured: bool
) -> None:
    write_files(tmp_path, analysis if measured else replace(analysis, series={}))
    assert (tmp_path / "latency.png").read_bytes().startswith(b"\x89PNG")
    with np.load(tmp_path / "legs.npz") as values:
        assert set(values) == ({*LEGS, *BESIDE} if measured else set())
        for name in values:
            np.testing.assert_array_equal(values[name][1], analysis.series[name].ns)
    content = json.loads((tmp_path / "latency.json").read_text())
    assert content == json.loads(analysis.result.model_dump_json())
    promised = {
        "state_to_actuation_us", "deadline_misses", "bare_loop_misses", "ticks", "sent",
        "received", "lost", "rss_growth_bytes", "repeated_answers", "late_states",
    }  # fmt: skip
    assert promised <= set(content)
    assert {"p50", "p90", "p99", "p999", "max"} <= set(content["state_to_actuation_us"])
