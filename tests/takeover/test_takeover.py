"""New weights for a running controller, with real processes: adopted, refused, rolled back.

Promises guarded: the car stays on its track whatever weights are sent; taking over the same weights
changes no bit; accepted weights are in use from the cycle on that the answer names, and survive a
restart; the end of a check does not touch the drive.
"""

import os
import signal
import threading
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayesrace.arrays import Floats
from bayesrace.controller.assembly import predictive_controller
from bayesrace.controller.cycle import Cycle
from bayesrace.controller.driver import Decision
from bayesrace.controller.process_settings import ControllerSettings
from bayesrace.gp.weights import Weights, encode_weights, write_weights, zero_weights
from bayesrace.messages import ACTUATION, State
from bayesrace.transport import Director, Endpoints, free_endpoint, open_session, send_rollback
from bayesrace.vehicles import get_car
from tests.network.cars import Course, start_controller, start_plant
from tests.programs import until
from tests.takeover.rig import DRIVEN_S, Rig, digest, judges, rigged
from tests.takeover.spoilt_weights import SPOILT, spoilt

pytestmark = pytest.mark.wall_clock

CAR = get_car("orca")

# Lockstep ------------------------------------------------------------------------------------


def test_adopting_the_same_weights_changes_no_bit(rig: Rig, good: Weights) -> None:
    long_s = 60.0  # a check takes a second
    rig.drive(1, seconds=long_s)
    for number in range(1, 4):
        answer = rig.send(good)
        assert answer["number"] == number
        assert answer["cycle"] == rig.counters()["ticks"]
    rig.drive(2, seconds=long_s)  # watched
    runs, taken, inside = [1, 2], 3, 0
    while not inside:
        runs.append(runs[-1] + 1)
        assert len(runs) < 8, "no takeover has come before a run was over"
        cycles = rig.drive_and_send(runs[-1], good, long_s)
        ticks = rig.ticks(runs[-1])
        inside = sum(ticks[0] < cycle <= ticks[-1] for cycle in cycles)
        taken += len(cycles)
    first, *others = (digest(rig.states(run)) for run in runs)
    assert others == [first] * len(others)
    assert rig.counters()["weights_accepted"] == taken


def replayed(course: Course, states: Sequence[State], weights: Mapping[int, Weights]) -> Floats:
    """Inputs (n, 2) of a controller that answers these states of a lockstep run, one by one.

    ``weights``: new ones, by the index of the first state that they answer.
    """
    files = course.track_file, course.line_file
    controller = predictive_controller(course.artefact, CAR, *files, weights=course.weights_file)
    cycle = Cycle(controller, CAR, ControllerSettings())
    inputs: list[tuple[float, float]] = []

    def take_over() -> None:
        if len(inputs) in weights:
            controller.native.set_weights(weights[len(inputs)])

    def send(_: State, decision: Decision) -> None:
        inputs.append((decision.d, decision.delta_rate))
        take_over()

    take_over()
    for state in states:
        assert cycle.driver.observe(state)
        cycle.answer(state, send)
    return np.array(inputs)


def test_inputs_jump_by_what_the_new_model_explains(
    rig: Rig, course: Course, again: Weights
) -> None:
    """To rounding: the plan goes on, and nothing else of the controller is changed."""
    rig.start(1, seconds=60.0)
    until(lambda: (state := rig.newest()) and state.seq > 60, "a car that drives")
    cycle = rig.send(again)["cycle"]
    until(lambda: rig.counters()["ticks"] > cycle + 50, "cycles with the new weights")
    rig.director.stop("enough")
    rig.director.wait_for_end(1, 60.0)
    sent = [one for one in rig.reader().select(ACTUATION) if one.run == 1]
    states = [one for one in rig.states(1) if not one.final]
    first = [one.weights_version for one in sent].index(again.version)
    assert rig.ticks(1)[first] == cycle
    assert [one.state_seq for one in sent] == [one.seq for one in states[: len(sent)]]
    states = states[: first + 30]
    inputs = np.array([one.u for one in sent[: len(states)]])
    with_takeover = replayed(course, states, {first: again})
    without = replayed(course, states, {})
    np.testing.assert_allclose(inputs, with_takeover, rtol=0, atol=1e-9)
    np.testing.assert_allclose(inputs[:first], without[:first], rtol=0, atol=1e-9)
    assert np.abs(inputs[first] - without[first]).max() > 1e-3  # or there is nothing to explain


def test_where_going_back_is_no_better_the_car_slows_down_and_says_so(
    tmp_path: Path, course: Course, good: Weights
) -> None:
    """At speed, no correction, as at the start, is worse than one that errs in vx alone."""
    start, gate, mpc = (tmp_path / name for name in ("none.bin", "gate.json", "mpc.json"))
    write_weights(start, zero_weights("orca", good.discretisation))
    gate.write_text('{"watch_least": 60}')
    mpc.write_text('{"caution": 0}')  # it would be slow from the start
    at_start = replace(course, weights_file=start)
    options = "--gate", str(gate), "--settings", str(mpc)
    with rigged(tmp_path, at_start, *options) as rig:
        sent = rig.send(spoilt(good, "flip vx"))
        assert sent["unknown_s"] == 0, "nothing is asked for without caution"
        rig.drive(1)
        (slowed,) = rig.events("weights_slowed")
        assert "predicted vx worse, and the proven ones" in slowed.text
        limit_mps = float(slowed.data["speed_limit_mps"])
        speeds = [state.x[3] for state in rig.states(1)]
        assert max(speeds) > limit_mps + 0.2
        assert max(speeds[-50:]) < limit_mps + 0.1
        assert rig.off_track_m(1) < 0.0
        # At the lower speed no weights are no worse: the watch goes back, and the limit stays.
        (back,) = rig.events("weights_rolled_back")
        assert back.seq > slowed.seq
        assert rig.counters()["weights_slowed"] is True
        rig.send(good)
        assert rig.counters()["weights_slowed"] is False


def test_the_event_says_what_a_lap_loses_where_weights_do_not_know_the_car(
    rig: Rig, good: Weights
) -> None:
    lost_s = rig.send(spoilt(good, "flip vx"))["unknown_s"]
    assert lost_s > 0.1
    rig.drive(1)
    assert f"{lost_s:.2f} s a lap are lost" in rig.events("weights_accepted")[-1].text


QUICK = ("flip all", "swap vy omega")


@pytest.mark.parametrize(
    "what",
    [*QUICK, *(pytest.param(one, marks=pytest.mark.check) for one in SPOILT if one not in QUICK)],
)
def test_spoilt_weights_never_take_the_car_off_its_track(
    rig: Rig, good: Weights, what: str
) -> None:
    """Without a sample they are adopted, and rolled back; with samples they are refused."""
    absurd = what == "swap vy omega"  # one of them is ten times the other
    if absurd:
        assert "absurd" in rig.refusal(encode_weights(spoilt(good, what)))
    else:
        answer = rig.send(spoilt(good, what))
        assert (answer["probation"], answer["samples"]) == (True, 0)
    end = rig.drive(1)
    assert end.data["reason"] == "max_time"
    assert rig.off_track_m(1) < 0.0
    rolled_back = rig.events("weights_rolled_back")
    if not absurd:
        assert [event.data["by"] for event in rolled_back] == ["watch"]
        assert rolled_back[0].data["version"] == good.version
        assert "worse" in rolled_back[0].text
        assert "rolled back before" in rig.refusal(encode_weights(spoilt(good, what)))
    again = replace(spoilt(good, what), version="again")
    reason = "absurd" if absurd else "worse than those in use"
    assert reason in rig.refusal(encode_weights(again))
    rig.drive(2)
    assert rig.off_track_m(2) < 0.0
    assert rig.status().weights_version == good.version


@pytest.mark.check
def test_two_rollbacks_by_the_watch_are_equal_to_the_bit(
    tmp_path: Path, course: Course, good: Weights
) -> None:
    found = []
    for _ in range(2):
        with rigged(tmp_path, course) as rig:
            rig.send(spoilt(good, "flip vy"))
            rig.drive(1)
            event = rig.events("weights_rolled_back")[0]
            found.append((digest(rig.states(1)), event.data["cycle"], event.data["driven"]))
    assert found[0] == found[1]


def test_what_is_no_weights_file_is_refused(rig: Rig, good: Weights) -> None:
    data = encode_weights(good)
    spoilt_at = len(data) // 2
    corrupt = data[:spoilt_at] + bytes([data[spoilt_at] ^ 1]) + data[spoilt_at + 1 :]
    reasons = {
        b"": "not the size of a weights file",
        data[:-100]: "checksum mismatch",
        corrupt: "checksum mismatch",
        b"x" * 1000: "not a weights file",
        bytes(1_000_000): "1000000 bytes are more than any weights that would fit",
    }
    for bad, reason in reasons.items():
        assert reason in rig.refusal(bad)
    other = replace(good, discretisation="dynamic/rk4x4/0.02s/orca-0")
    assert "were learned for" in rig.refusal(encode_weights(other))
    assert "'rover'" in rig.refusal(encode_weights(replace(good, car="rover")))
    counters = rig.counters()
    assert (counters["weights_refused"], counters["weights_accepted"]) == (7, 0)
    assert len(rig.events("weights_refused")) == 7
    assert rig.status().weights_version == good.version


def test_back_and_back_to_the_start(rig: Rig, good: Weights) -> None:
    for version in ("one", "two"):
        rig.send(replace(good, version=version))
    data = send_rollback(rig.session, "orca", "the test says so").data
    assert (data["version"], data["number"], data["by"]) == ("one", 1, "request")
    assert (data["from_version"], data["from_number"]) == ("two", 2)
    assert rig.send(replace(good, version="three"))["number"] == 3
    for expected in ("one", good.version):
        assert send_rollback(rig.session, "orca", "further").data["version"] == expected
        assert rig.status().weights_version == expected
    refused = send_rollback(rig.session, "orca", "too far")
    assert (refused.accepted, refused.text) == (False, "there are no weights before those in use")
    assert [event.data["version"] for event in rig.events("weights_rolled_back")] == [
        "one", "one", good.version
    ]  # fmt: skip
    rig.drive(1)
    assert {one.weights_version for one in rig.reader().select(ACTUATION)} == {good.version}


# Free-running --------------------------------------------------------------------------------


@pytest.mark.check
def test_spoilt_weights_are_rolled_back_in_real_time(rig: Rig, good: Weights) -> None:
    rig.send(spoilt(good, "flip all"))
    rig.start(1, lockstep=False, seconds=DRIVEN_S)
    end = rig.director.wait_for_end(1, 60.0)
    assert rig.status().weights_version == good.version
    assert rig.counters()["weights_rolled_back"] == 1
    assert rig.held_up(end) or rig.off_track_m(1) < 0.0


@pytest.mark.check
def test_two_publishers_at_once_leave_one_order(rig: Rig, good: Weights) -> None:
    rig.start(1, lockstep=False, seconds=DRIVEN_S)
    answers: list[dict[str, Any]] = []

    def publish(name: str) -> None:
        director = Director(rig.session, "orca")
        for number in range(5):
            data = encode_weights(replace(good, version=f"{name}{number}"))
            answers.append(dict(director.send_weights(data).data))

    threads = [threading.Thread(target=publish, args=(name,)) for name in "ab"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    by_number = {answer["number"]: answer["version"] for answer in answers}
    assert sorted(by_number) == list(range(1, 11))
    assert rig.status().weights_version == by_number[10]
    for name in "ab":
        mine = [by_number[n] for n in sorted(by_number) if by_number[n].startswith(name)]
        assert mine == [f"{name}{number}" for number in range(5)]
    rig.director.wait_for_end(1, 30.0)


# Processes that end ---------------------------------------------------------------------------


def test_a_check_that_is_killed_does_not_touch_the_drive(rig: Rig, good: Weights) -> None:
    """The request is refused, and the drive is the same, to the bit, as one undisturbed."""
    rig.drive(1, seconds=10.0)
    rig.start(2, seconds=600.0)
    pid = rig.controller.process.pid
    refused: list[str] = []
    request = threading.Thread(target=lambda: refused.append(rig.refusal(encode_weights(good))))
    request.start()
    until(lambda: judges(pid) != [], "a check")
    os.kill(judges(pid)[0], signal.SIGKILL)
    request.join()
    assert "ended with code -9" in refused[0]
    assert rig.send(replace(good, version="after"))["number"] == 1
    rig.director.stop("enough")
    rig.director.wait_for_end(2, 60.0)
    undisturbed, disturbed = ([one for one in rig.states(run) if not one.final] for run in (1, 2))
    count = min(len(undisturbed), len(disturbed))
    assert count > 100
    assert digest(disturbed[:count]) == digest(undisturbed[:count])
    assert rig.off_track_m(1) < 0.0


def test_accepted_weights_survive_a_restart(tmp_path: Path, course: Course, good: Weights) -> None:
    """Killed right after the answer; another --weights does not matter any more."""
    store = str(tmp_path / "store")
    at_plant, at_controller = free_endpoint(), free_endpoint()
    where = tmp_path, course, at_plant, at_controller, "--store", store
    with (
        start_plant(tmp_path, at_plant),
        open_session(Endpoints(connect=(at_plant, at_controller))) as session,
    ):
        director = Director(session, "orca")
        with start_controller(*where) as controller:
            director.wait_for(("controller",), 20.0)
            director.send_weights(encode_weights(replace(good, version="one")))
            director.send_weights(encode_weights(replace(good, version="two")))
            controller.kill()
        director.wait_until_gone("controller", 20.0)
        with start_controller(*where) as controller:
            director.wait_for(("controller",), 20.0)
            status = director.status("controller")
            assert (status.weights_version, status.counters["weights_number"]) == ("two", 2)
            assert send_rollback(session, "orca", "to see").data["version"] == "one"
            assert (
                director.send_weights(encode_weights(replace(good, version="x"))).data["number"]
                == 3
            )
            controller.end()
        director.wait_until_gone("controller", 20.0)
        with start_controller(*where) as controller:
            director.wait_for(("controller",), 20.0)
            assert director.status("controller").weights_version == "x"
            assert send_rollback(session, "orca", "to see").data["version"] == "one"
            assert send_rollback(session, "orca", "to the start").data["version"] == good.version
            controller.end()
