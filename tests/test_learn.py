"""The learning job beside a driving car: laps get no slower, and everything may be started again.

Promises guarded: samples come from the running car, each update is answered by the controller and
noted; what is kept stays bounded; the job survives the end of the plant, of the controller, of its
worker and its own; what a controller declines is not sent again.
"""

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from bayesrace.gp.weights import read_weights, write_weights, zero_weights
from bayesrace.learning.sources import write_npz
from bayesrace.vehicles.models import dynamic
from tests.driven import CAR, drive
from tests.learning_rig import Rig, learn_arguments, record, rigged
from tests.network.cars import Course, Program, gentle_course
from tests.programs import PATIENCE_S, until

pytestmark = pytest.mark.wall_clock

KEEP = 300
SMALL = ("--points", "120", "--keep", str(KEEP))


@pytest.fixture(scope="module")
def course(tmp_path_factory: pytest.TempPathFactory) -> Course:
    return gentle_course(tmp_path_factory.mktemp("course"), speed_mps=1.6)


@contextmanager
def learning(rig: Rig, out: Path, *options: str | Path) -> Iterator[Program]:
    """A job that follows the rig; killed at the end of the block."""
    arguments = learn_arguments(rig, out, *SMALL, *options)
    output = rig.folder / f"{out.name}-{time.monotonic_ns()}.txt"
    with Program(output, *map(str, arguments)) as job:
        until(lambda: "following" in job.said() or job.process.poll(), "a job")
        yield job


def answered(out: Path, count: int) -> list[dict[str, Any]]:
    """Waits until ``count`` updates have an answer; returns all of them."""

    def enough() -> bool:
        updates = record(out)["updates"]
        return len(updates) >= count and updates[-1]["verdict"] != "pending"

    until(enough, f"{count} updates")
    updates: list[dict[str, Any]] = record(out)["updates"]
    return updates


def test_laps_in_lockstep_get_faster_and_stay_on_the_track(tmp_path: Path, course: Course) -> None:
    """From a controller that knows nothing: it snakes, and off the track, at this speed. The first
    weights put an end to that."""
    out = tmp_path / "job"
    blank = replace(course, weights_file=tmp_path / "nothing.bin")
    name = read_weights(course.weights_file).discretisation
    write_weights(blank.weights_file, zero_weights("orca", name))
    with rigged(tmp_path, blank) as rig, learning(rig, out, "--laps", "4") as job:
        for number in range(2):
            rig.drive(2)
            answered(out, number + 1)
        assert job.process.wait(PATIENCE_S) == 0, job.said()
        last = rig.version()
    content = record(out)
    laps, updates = content["laps"], content["updates"]
    assert [lap["lap"] for lap in laps] == [1, 2, 3, 4]
    assert [lap["flying"] for lap in laps] == [False, True] * 2
    learned = [lap for lap in laps if "worstcase" not in lap["versions"]]
    assert [lap["lap"] for lap in learned] == [3, 4]
    assert all(lap["off_track_m"] == 0 for lap in learned)
    assert laps[2]["time_s"] < laps[0]["time_s"] - 0.1
    assert laps[3]["time_s"] < laps[1]["time_s"] - 0.1
    assert {update["verdict"] for update in updates} == {"accepted"}
    assert all(update["kept"] <= KEEP for update in updates)
    assert last == updates[-1]["version"] == read_weights(out / updates[-1]["file"]).version
    assert (out / "laps.png").stat().st_size > 5000
    assert "Traceback" not in job.said()


@pytest.mark.check
def test_weights_change_within_the_lap(tmp_path: Path, course: Course) -> None:
    """After some seconds of driving, in place of the end of a lap; none is sent after the last."""
    for count in (4, 20):  # on a busy machine learning takes longer than four laps
        out = tmp_path / str(count)
        out.mkdir()
        with rigged(out, course) as rig:
            every = ("--every", "2", "--laps", str(count), "--weights", course.weights_file)
            with learning(rig, out / "job", *every) as learner:
                rig.drive(count, lockstep=False)
                assert learner.process.wait(PATIENCE_S) == 0, learner.said()
                last = rig.version()
        content = record(out / "job")
        laps, updates = content["laps"], content["updates"]
        if any(len(lap["versions"]) > 1 for lap in laps):
            break
    assert [lap["lap"] for lap in laps] == list(range(1, count + 1))
    learned = [one for one in updates if one["samples"]]
    assert len([one for one in learned if one["after_lap"] == 0]) >= 1
    assert len(learned) >= 2
    assert all(one["verdict"] in ("accepted", "superseded", "refused") for one in learned)
    assert any(len(lap["versions"]) > 1 for lap in laps)
    assert last == [one["version"] for one in updates if one["verdict"] == "accepted"][-1]
    assert all(lap["off_track_m"] == 0 for lap in laps)


@pytest.mark.check
def test_everything_may_be_killed_and_started_again(tmp_path: Path, course: Course) -> None:
    """Job, then plant and controller; the second controller, without a store, is given again what
    the first had accepted. Given weights and their samples are the beginning, once. SIGINT ends
    the job in order."""
    out, data = tmp_path / "job", tmp_path / "samples.npz"
    write_npz(data, drive(dynamic(CAR), 100, seed=5))
    given = ("--data", data, "--weights", course.weights_file)
    with rigged(tmp_path, course) as rig:
        with learning(rig, out, *given) as job:
            first = answered(out, 2)
            assert [update["after_lap"] for update in first] == [0, 0]
            assert first[0]["answer"] == "in use already"
            rig.drive(1)
            answered(out, 3)
            job.kill()
        with learning(rig, out, *given) as job:
            assert "resuming" in job.said()
            rig.drive(1)
            updates = answered(out, 4)
            assert rig.version() == updates[-1]["version"]
            rig.kill_both()
            until(lambda: "controller is gone" in job.said(), "the loss")
            rig.start_plant()
            rig.start_controller()
            rig.wait()
            newest = updates[-1]["version"]
            until(lambda: rig.version() == newest, "the weights given again")
            rig.drive(1, lockstep=False)
            assert answered(out, 5)[-1]["verdict"] == "accepted"
            job.process.send_signal(signal.SIGINT)
            assert job.process.wait(PATIENCE_S) == 0, job.said()
    laps = record(out)["laps"]
    assert [lap["lap"] for lap in laps] == [1, 2, 3]
    assert all(lap["off_track_m"] == 0 for lap in laps)
    assert "Traceback" not in job.said()
    assert (out / "laps.png").exists()
