"""Scenarios: what a file may say, how a recording is judged, and those that ship."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from bayesrace.errors import InputError
from bayesrace.messages import QUANTITIES, Reading, State
from bayesrace.operation.terminal.terminal import stages_on
from bayesrace.plant.faults import READING_FAULTS, STATE_FAULTS, FaultPlayer, SensorFault
from bayesrace.plant.process_settings import PlantSettings
from bayesrace.studies.evidence.scenario.checks import Drive, judged
from bayesrace.studies.evidence.scenario.description import (
    KINDS,
    Holds,
    Scenario,
    read_scenario,
    shipped,
)
from bayesrace.studies.evidence.scenario.events import timeline
from bayesrace.studies.evidence.scenario.run import Result, read_grid, run_scenarios, verdict_of
from bayesrace.tracks import load_track
from bayesrace.transport.relay import Link
from tests.programs import ROOT

ELSEWHERE = "endpoints = ['tcp/10.0.0.1:7447']"
PAGE = ROOT / "docs" / "scenarios.md"


def scenario(text: str, tmp_path: Path) -> Scenario:
    path = tmp_path / "own.toml"
    path.write_text(f'why = "to test"\n{text}')
    return read_scenario(path)


# What a file may say ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[[event]]\nat_s = 1\nkind = 'link'\ndelay = 3", "did you mean 'delay_ms'"),
        ("[[event]]\nat_s = 1\nkind = 'flood'", "'link', 'partition'"),
        ("[[event]]\nat_s = 1\nkind = 'sensor'\nfault = 'gone'", "there are frozen"),
        (
            "[[event]]\nat_s = 1\nkind = 'sensor'\nfault = 'frozen'\ninstrument = 'gps'",
            "measured as a whole",
        ),
        ("[[event]]\nat_s = 50\nkind = 'stop'", "the run ends at 40 s"),
        ("[[event]]\nat_s = 1\nkind = 'grip'\nshare = 0.8\nalong_m = 1", "give both, or none"),
        ("[holds]\nlap = 3", "did you mean 'laps'"),
        ("[holds]\ndetected_within_s = 1", "no sensor event"),
        ("[holds]\nunaccounted = 0\n[[event]]\nat_s = 1\nkind = 'kill'", "has received"),
        ("[controller]\nname = 'x'", "controller.name follows"),
        (ELSEWHERE, "realtime"),
        (
            f"mode = 'realtime'\n{ELSEWHERE}\n[[event]]\nat_s = 1\nkind = 'kill'",
            "started elsewhere",
        ),
        ("weights = 'nowhere.bin'\nlaps = 'two'", "laps = 'two'"),
    ],
)
def test_what_cannot_be_is_refused_by_name_with_a_remedy(
    tmp_path: Path, text: str, words: str
) -> None:
    with pytest.raises(InputError) as error:
        scenario(text, tmp_path)
    assert words in str(error.value)
    assert "own.toml" in str(error.value)
    assert "\n" not in str(error.value)


def test_values_are_set_by_their_place(tmp_path: Path) -> None:
    changed = {"event.0.delay_ms": 7, "controller.rate_hz": 100.0}
    one = read_scenario("delay", changed)
    assert (one.event[0].model_dump()["delay_ms"], one.states_hz) == (7, 100)
    with pytest.raises(InputError, match="there are 0 to 0"):
        read_scenario("delay", {"event.1.delay_ms": 7})


def test_a_grid_is_the_scenario_with_each_combination(tmp_path: Path) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text("[grid]\nevent.0.delay_ms = [0, 10]\nevent.0.loss = [0.0, 0.1, 0.2]\n")
    grid = read_grid(plan, "delay")
    assert len({one.name for one in grid}) == 6
    assert {(o.event[0].delay_ms, o.event[0].loss) for o in grid} == {  # type: ignore[union-attr]
        (ms, share) for ms in (0, 10) for share in (0.0, 0.1, 0.2)
    }
    plan.write_text("[grid]\nevent.0.delay = [0]\n")
    with pytest.raises(InputError, match="delay_ms"):
        read_grid(plan, "delay")


def test_the_page_names_every_event_check_fault_and_scenario() -> None:
    page = PAGE.read_text()
    names = (*KINDS, *Holds.model_fields, *STATE_FAULTS, *READING_FAULTS, *shipped())
    assert [one for one in names if f"`{one}`" not in page] == []


def test_the_page_shows_a_scenario_that_is_one(tmp_path: Path) -> None:
    first = PAGE.read_text().split("```toml\n")[1].split("```")[0]
    path = tmp_path / "shown.toml"
    path.write_text(first)
    read_scenario(path)


def test_at_least_thirty_ship_each_with_a_sentence() -> None:
    every = {name: read_scenario(name) for name in shipped()}
    assert len(every) >= 30
    assert all(one.why.endswith(".") for one in every.values())
    kinds = {event.kind for one in every.values() for event in one.event}
    assert kinds == set(KINDS)


# What happens -------------------------------------------------------------------------------------


class Heard:
    """Notes what is done to it."""

    def __init__(self) -> None:
        self.did: list[Any] = []

    def __getattr__(self, name: str) -> Any:
        return lambda *given: self.did.append((name, *given))


def test_events_happen_in_their_order_and_end(tmp_path: Path) -> None:
    one = scenario(
        "[[event]]\nkind = 'partition'\nto = 'plant'\nat_s = 3\nfor_s = 2\n"
        "[[event]]\nkind = 'link'\nto = 'controller'\nat_s = 1\nfor_s = 3\ndelay_ms = 20\n"
        "[[event]]\nkind = 'kill'\nat_s = 4.5\n[[event]]\nkind = 'weights'\nat_s = 2\n"
        "weights = 'w'\n",
        tmp_path,
    )
    heard: Any = Heard()
    steps = list(timeline(one.event, Path))
    for _, act in steps:
        act(heard)
    assert [at_s for at_s, _ in steps] == [1, 2, 3, 4, 4.5, 5]
    assert heard.did == [
        ("set_link", "controller", Link(0.02)), ("publish", Path("w")), ("hold", "plant"),
        ("set_link", "controller", Link()), ("kill",), ("release", "plant"),
    ]  # fmt: skip


def test_a_place_is_along_the_track() -> None:
    track = load_track("harbour", 0.0)
    [puddle] = read_scenario("puddle").world(track).root
    at = track.position(4.0)
    assert puddle.share_at(1.0, at[0], at[1]) == 0.85
    assert puddle.share_at(1.0, at[0] + 0.31, at[1]) == 1.0


def state(k: int, readings: tuple[Reading, ...] = ()) -> State:
    return State(
        seq=k, source_time_ns=0, epoch=1, run=1, time_s=0.02 * k, x=(0.02 * k,) * 7,
        u_applied=(0.0, 0.0), lap=0, estimated=bool(readings), readings=readings, lockstep=False,
        actuation_delays=(), final=False,
    )  # fmt: skip


def test_a_plant_plays_faults_from_their_time_on_and_until_their_end() -> None:
    player = FaultPlayer([SensorFault(fault="frozen", from_s=0.1, until_s=0.2)])
    said = [player.report(state(k)).x[0] for k in range(12)]
    expected = [0.02 * k for k in range(5)] + [0.1] * 5 + [0.2, 0.22]
    assert said == pytest.approx(expected, abs=1e-12)
    stopped = FaultPlayer([SensorFault(fault="stopped", instrument="gyro", from_s=0.1)])
    readings = tuple(
        Reading(instrument=name, time_s=time_s, values={"omega": (1.0, 0.1)})
        for name in ("gyro", "other") for time_s in (0.09, 0.11)
    )  # fmt: skip
    kept = stopped.report(state(6, readings)).readings
    assert [(one.instrument, one.time_s) for one in kept] == [
        ("gyro", 0.09), ("other", 0.09), ("other", 0.11),
    ]  # fmt: skip


def test_each_fault_changes_what_is_reported() -> None:
    states = [state(k) for k in range(8)]
    for name, fault in STATE_FAULTS.items():
        if name in ("x and y exchanged", "vx and vy exchanged"):  # equal numbers
            continue
        assert fault(states) != states[-1], name
    values = dict.fromkeys(QUANTITIES, (1.5, 0.1))
    good, new = (Reading(instrument="a", time_s=t, values=values) for t in (0.5, 1.0))
    new = Reading(instrument="a", time_s=1.0, values=dict.fromkeys(QUANTITIES, (2.5, 0.1)))
    for name, reported in READING_FAULTS.items():
        assert reported(new, good) != new, name


def test_a_fault_of_what_is_not_there_is_refused() -> None:
    fault = SensorFault(fault="stopped", instrument="gyro")
    with pytest.raises(ValueError, match="there is none"):
        PlantSettings(sensor_faults=(fault,))


# What must hold -----------------------------------------------------------------------------------


def drive(**changed: Any) -> Drive:
    """Ten seconds along the centreline of harbour at 2 m/s, but for what is changed."""
    track, count = load_track("harbour", 0.0), 500
    time_s = 0.02 * np.arange(count)
    truth = np.zeros(count, [("seq", int), ("run", int), ("x", float, 7), ("time_s", float)])
    truth["seq"], truth["time_s"] = np.arange(count), time_s
    truth["x"][:, :2] = track.position((2.0 * time_s) % track.length_m)
    truth["x"][:, 3] = 2.0
    cycles = np.zeros(count, [("state_seq", int), ("fallback", int), ("sensor_fault", object)])
    cycles["state_seq"], cycles["sensor_fault"] = np.arange(count), ""
    states = np.zeros(count, [("seq", int), ("actuation_delays", object)])
    for k in range(count):
        states["actuation_delays"][k] = (float(k), 0.001 * (1 + k % 2), 0.0)
    events = np.zeros(1, [("source", object), ("kind", object), ("data", object)])
    events[0] = "plant", "run_ended", {"reason": "laps"}
    beats = np.zeros(2, [("source", object), ("counters", object)])
    beats[0] = "plant", {"states_sent": 500, "actuations_received": 490, "actuations_lost": 9}
    beats[1] = "controller", {"actuations_sent": 500, "states_received": 500, "states_lost": 0}
    whole = Drive(track, truth, states, cycles, events, beats)
    return replace(whole, **changed)


def verdicts(text: str, tmp_path: Path, of: Drive, alone: Drive | None = None) -> list[bool]:
    """Of the checks that are asked for."""
    holds = scenario(text, tmp_path)
    return [one.passed for one in judged(holds, of, alone)]


def test_checks_hold_and_fail_at_their_bounds(tmp_path: Path) -> None:
    only = "[holds]\noff_track_samples = 0\n"
    good = drive()
    assert verdicts(only, tmp_path, good) == [True]
    slid = drive()
    slid.truth["x"][10:12, :2] += 5.0
    assert verdicts(only, tmp_path, slid) == [False]
    assert verdicts("[holds]\noff_track_samples = 2", tmp_path, slid) == [True]
    for text, found in (
        ("unaccounted = 0", False), ("unaccounted = 1", True), ("ends = 'laps'", True),
        ("ends = 'max_time'", False), ("stands = true", False), ("stands = false", True),
        ("latency_p50_ms = 1.4", False), ("latency_p50_ms = 1.6", True),
        ("latency_p99_ms = 2.1", True), ("happens = 'run_ended'", True),
        ("happens = ['stop']", False), ("happens_not = ['run_ended']", False),
        ("fallback_share = 0.0", True), ("laps = 5", False), ("lap_s = 99.0", False),
    ):  # fmt: skip
        assert verdicts(f"{only}{text}", tmp_path, good) == [True, found], text


def test_a_fault_is_found_in_time_or_not(tmp_path: Path) -> None:
    text = (
        "[holds]\ndetected_within_s = 0.06\ndetected = ['frozen']\n"
        "[[event]]\nkind = 'sensor'\nfault = 'frozen'\nat_s = 2\n"
    )
    assert verdicts(text, tmp_path, drive()) == [True, False, False]
    for first, kind, found in ((103, "frozen", True), (104, "frozen", False)):
        named = drive()
        named.cycles["sensor_fault"][50] = "frozen"  # before it, a false alarm
        named.cycles["sensor_fault"][first:] = kind
        assert verdicts(text, tmp_path, named) == [True, found, True]


def test_driving_on_is_by_solutions_and_for_a_while(tmp_path: Path) -> None:
    text = "[holds]\ndrives_on_within_s = 1.0\n[[event]]\nkind = 'partition'\nat_s = 2\nfor_s = 1\n"
    for last, found in ((190, True), (205, False)):
        stopped = drive()
        stopped.cycles["fallback"][100:last] = 2
        stopped.cycles["fallback"][155] = 0  # a single solution is not driving
        assert verdicts(text, tmp_path, stopped) == [True, found]


# Drives -------------------------------------------------------------------------------------------


def driven(*scenarios: Scenario) -> list[Result]:
    with stages_on(Console(quiet=True)) as stages:
        return run_scenarios(scenarios, None, stages, 1)


def test_a_scenario_is_the_same_to_the_bit_and_fails_where_it_must() -> None:
    bad = {"laps": 1, "holds.lap_over_undisturbed": 9.0, "holds.laps": 1}
    one, again = (driven(read_scenario("lost-messages", bad))[0] for _ in range(2))
    assert one.trajectory_sha256 == again.trajectory_sha256
    assert [c.found for c in one.checks] == [c.found for c in again.checks]
    assert [c.name for c in one.checks if not c.passed] == ["lap over undisturbed: at most 9"]
    [blind] = driven(read_scenario("sensor-frozen", {"controller.sensor_tolerance": 0.0}))
    assert not blind.passed
    assert "nothing" in [c.found for c in blind.checks if not c.passed]
    assert verdict_of([one, blind]).exit_code == 1


@pytest.mark.parametrize("name", ["partition", "controller-killed", "sensor-vx-negative"])
def test_what_happens_leaves_the_car_on_its_track(name: str) -> None:
    [one] = driven(read_scenario(name))
    assert [(c.name, c.found) for c in one.checks if not c.passed] == []


@pytest.mark.check
@pytest.mark.timeout(1500)  # the first by odometry learns by two smoothings a drive, for all others
@pytest.mark.parametrize("name", [n for n in shipped() if not n.startswith("realtime")])
def test_every_scenario_that_ships_passes(name: str) -> None:
    [one] = driven(read_scenario(name))
    assert [(c.name, c.found) for c in one.checks if not c.passed] == []


@pytest.mark.check
@pytest.mark.wall_clock
@pytest.mark.parametrize("name", [n for n in shipped() if n.startswith("realtime")])
def test_every_scenario_in_real_time_passes(name: str) -> None:
    [one] = driven(read_scenario(name))
    assert [(c.name, c.found) for c in one.checks if not c.passed] == []
