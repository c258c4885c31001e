"""A run passes if all its laps were driven on the track, by solutions; else the verdict says why.

Bugs guarded: 'drive' ended with exit code 0 after a lap across the infield, a run at standstill,
and one off the track.
"""

from contextlib import closing
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from bayesrace.columns import columns_of
from bayesrace.controller.driver import Level
from bayesrace.learning.sources import CYCLES
from bayesrace.log import LogWriter
from bayesrace.messages import Telemetry
from bayesrace.operation.analysis.laps import Cycles, LapTimes, judge, judge_log
from bayesrace.operation.closed_loop import ClosedLoop
from tests.driven import telemetry
from tests.racing import racing

COUNT = 450
STEP_S = 0.02
LAP = LapTimes((8.5,), (430,), None)
NONE = LapTimes((), (), None)
CUT = LapTimes((), (), 155)


def verdict(
    laps: LapTimes = LAP, off_m: float = -0.1, level: Level = Level.SOLUTION, every: int = 1,
    asked: int = 1, fault: str = "", count: int = COUNT,
) -> Any:  # fmt: skip
    samples = np.array([(k, k * STEP_S) for k in range(count)], [("seq", int), ("time_s", float)])
    answered = range(0, COUNT - 1, every)
    messages = [replace(telemetry(0, k, int(level)), sensor_fault=fault) for k in answered]
    cycles = Cycles(columns_of(Telemetry, messages, CYCLES))
    off_track_m = np.full(COUNT, -0.1)
    off_track_m[200] = off_m
    return judge(samples, off_track_m, laps, cycles, asked)


@pytest.mark.parametrize(
    ("case", "words"),
    [
        (verdict(laps=CUT), "0 of 1 laps driven: at 3.10 s the car left out a piece of the track"),
        (verdict(laps=NONE), "0 of 1 laps driven (cycles: 449 solution)"),
        (verdict(asked=2), "1 of 2 laps driven"),
        (verdict(off_m=0.24), "1 samples off the track, up to 0.240 m"),
        (verdict(level=Level.STOP, laps=NONE), "for 0.00 of 8.98 s (cycles: 449 stop)"),
        (verdict(laps=NONE, fault="frozen"), "449 solution; sensor faults: 449 frozen)"),
        (verdict(every=50), "solutions drove the car for 0.90 of 8.98 s (cycles: 9 solution)"),
        (verdict(count=0), "there is no state of the run"),
    ],
)
def test_a_run_fails_with_the_reason(case: Any, words: str) -> None:
    assert not case.passed
    assert case.text.startswith("failed: ")
    assert words in case.text


def test_a_run_passes() -> None:
    passed = verdict()
    assert passed.passed
    assert passed.text == (
        "passed: 1 lap in 8.500 s, on the track throughout (cycles: 449 solution)"
    )
    assert verdict(every=2, asked=0, laps=NONE).passed  # a controller of half the plant's rate


def test_the_verdict_on_a_log_is_that_on_its_run(tmp_path: Any) -> None:
    race = racing()
    path = tmp_path / "run.mcap"
    with closing(LogWriter(path)) as log:
        loop = ClosedLoop(race.car, race.track, race.line, race.controller(), log=log)
        driven = loop.drive(1, name="one")
        loop.drive(1, max_time_s=1.0, name="two")
    found = judge_log(path, 1, race.track, 1)
    assert found.passed
    assert f"1 lap in {driven.laps_s[0]:.3f} s" in found.text
    assert "0 of 1 laps driven" in judge_log(path, 2, race.track, 1).text
