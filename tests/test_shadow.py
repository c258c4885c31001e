"""A second controller beside the one that drives: it decides in the same situations, and neither
its weights nor its end change what is driven."""

import json
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from bayesrace.configuration import configured
from bayesrace.gp.weights import Weights, write_weights
from bayesrace.log import LogReader, LogWriter
from bayesrace.messages import (
    ACTUATION,
    SHADOW_ACTUATION,
    SHADOW_TELEMETRY,
    STATE,
    TELEMETRY,
    Actuation,
    Event,
    Telemetry,
    encode,
    topic_of,
)
from bayesrace.operation.run_plan import RunPlan
from bayesrace.operation.system import Child, System, child, started_system
from bayesrace.raceline import write_raceline
from bayesrace.recorder import Recorder
from bayesrace.studies.evidence.shadow.comparison import plan_errors
from bayesrace.studies.evidence.shadow.cycles import Beside, Side
from bayesrace.tracks import load_track
from bayesrace.transport import private_endpoints
from tests.command_line import Cli, cli, refused
from tests.programs import until
from tests.racing import Racing, racing

__all__ = ["cli"]

pytestmark = pytest.mark.wall_clock

RUN, DRIVEN_S = 1, 4.0
"""More than half of a lap at racing speed."""


@pytest.fixture(scope="module")
def raced() -> Racing:
    return racing()


def other_weights(weights: Weights) -> Weights:
    """Their correction is smaller by a third."""
    vx, vy, omega = (replace(one, alpha=one.alpha * 2 / 3) for one in weights.outputs)
    return replace(weights, version="smaller", outputs=(vx, vy, omega))


@dataclass
class Rig:
    """A plant, a controller and shadows, and the drive's log."""

    system: System
    recorder: Recorder
    shadows: dict[str, Child]
    folder: Path
    racing: Racing
    lockstep: bool

    def drive(self, halfway: Callable[[], None] = lambda: None) -> Event:
        """``halfway``: what happens then; the car waits for it in lockstep."""
        pause_s = DRIVEN_S / 2 if self.lockstep else 0.0
        plan = RunPlan(RUN, "test", 5, DRIVEN_S, self.lockstep, pause_s=pause_s)
        timer = threading.Timer(DRIVEN_S / 2, (lambda: None) if self.lockstep else halfway)
        timer.start()
        end = self.system.drive(self.racing.track, plan, self.recorder, lambda _: halfway())
        timer.join()
        for one in self.shadows.values():
            if not one.ended():
                said(one, "is over")
        return end

    @property
    def log(self) -> Path:
        return self.folder / "run.mcap"


@contextmanager
def rigged(
    folder: Path, racing: Racing, shadows: Mapping[str, Sequence[str]], lockstep: bool = True
) -> Iterator[Rig]:
    """``shadows``: their options beside those of the controller, by name."""
    folder.mkdir()
    weights = folder / "weights.bin"
    write_weights(weights, racing.weights)
    prepared = ("--artefact", racing.artefact, "--track", "harbour", "--raceline", line(folder))
    own = [str(one) for one in prepared]
    at = private_endpoints("plant", "controller", *shadows)
    with at as (plant, controller, *others), ExitStack() as stack:
        network = configured().plain(plant, controller)
        update = {"shadow": tuple(others)}
        network = network.model_copy(update={"network": network.network.model_copy(update=update)})
        system = stack.enter_context(
            started_system("orca", folder, configuration=network, lockstep=lockstep)
        )
        recorder = Recorder(system.recording, "orca", folder / "run.mcap")
        stack.enter_context(recorder)
        stack.enter_context(system.controller([*own, "--weights", str(weights)]))
        running = {}
        for (name, options), where in zip(shadows.items(), others, strict=True):
            words = ["controller", "--shadow", name, "--listen", where, *own, *options]
            words += ["--config", str(folder / "bayesrace.toml")]
            words += ["--low-latency"] if lockstep else []
            running[name] = stack.enter_context(child(words, folder / f"{name}.log"))
        for one in running.values():
            said(one, "has its links")
        time.sleep(0.5)  # its declarations
        yield Rig(system, recorder, running, folder, racing, lockstep)


def said(one: Child, words: str) -> None:
    until(lambda: words in one.output.read_text() or bool(one.ended()), f"{words} of a shadow")
    assert not one.ended()


def line(folder: Path) -> Path:
    file = folder / "raceline.csv"
    write_raceline(file, racing().line)
    return file


def answers(log: Path, name: str) -> dict[int, Actuation]:
    return {
        one.message.state_seq: one.message
        for one in LogReader(log).messages((SHADOW_ACTUATION,))
        if one.key == f"bayesrace/orca/shadow/{name}/actuation"
    }


def inputs(log: Path) -> dict[int, Actuation]:
    return {one.state_seq: one for one in LogReader(log).select(ACTUATION)}


def driven(log: Path) -> list[tuple[float, ...]]:
    return [(one.time_s, *one.x, *one.u_applied) for one in LogReader(log).select(STATE)]


def plans(telemetry: list[Telemetry]) -> dict[int, tuple[float, ...]]:
    return {one.state_seq: one.plan_x for one in telemetry}


@pytest.fixture(scope="module")
def lockstep(raced: Racing, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the log of a drive with two shadows, and the weights of both."""
    folder = tmp_path_factory.mktemp("lockstep")
    own, other = folder / "run/weights.bin", folder / "other.bin"
    write_weights(other, other_weights(raced.weights))
    shadows = {"same": ("--weights", str(own)), "other": ("--weights", str(other))}
    with rigged(folder / "run", raced, shadows) as rig:
        rig.drive()
        counters = rig.system.director.status("plant").counters
        assert counters["rejected"] == counters["stale"] == 0
    return folder


def test_in_lockstep_a_shadow_with_the_same_weights_decides_the_same_to_the_bit(
    raced: Racing, lockstep: Path, tmp_path: Path
) -> None:
    """Beside it another with other weights, which decides otherwise; the drive is that without."""
    log = lockstep / "run/run.mcap"
    sent, same, others = inputs(log), answers(log, "same"), answers(log, "other")
    assert len(sent) == round(50 * DRIVEN_S)
    assert same.keys() == others.keys() == sent.keys()
    assert {seq: one.u for seq, one in same.items()} == {seq: one.u for seq, one in sent.items()}
    found = LogReader(log)
    both = [one for one in found.select(SHADOW_TELEMETRY) if one.state_seq in sent]
    assert plans(found.select(TELEMETRY)).items() <= {(one.state_seq, one.plan_x) for one in both}
    apart = [np.subtract(others[seq].u, sent[seq].u) for seq in sent]
    assert np.abs(apart).max() > 0.05
    assert {one.weights_version for one in others.values()} == {"smaller"}
    with rigged(tmp_path / "without", raced, {}) as alone:
        alone.drive()
    assert driven(alone.log) == driven(log)


def test_the_report_judges_each_shadow(cli: Cli, lockstep: Path, tmp_path: Path) -> None:
    log, own, other = (lockstep / one for one in ("run/run.mcap", "run/weights.bin", "other.bin"))
    command = ("shadow", log, "--at-most", "d=1e-9", "--out", "found", "--track", "harbour")
    judged = cli(*command, "--weights", other, "--against", own, "--junit", "j.xml")
    assert judged.code == 1, judged.err
    suites = ElementTree.parse(tmp_path / "j.xml").getroot()  # noqa: S314 (our own)
    failed = {(suite.attrib["name"].split()[-1], case.attrib["name"].split()[0])
              for suite in suites for case in suite if len(case)}  # fmt: skip
    assert failed == {("'other'", "d"), ("'smaller'", "one-step")}
    others, same = json.loads((tmp_path / "found/shadow.json").read_text())
    assert (same["shadow"], same["apart"]["d"]["max"], same["places"]) == ("same", 0, [])
    for one in same["promises"]:
        assert one["shadow"] == one["controller"]
        assert one["alike"] == one["plans"]
        assert one["came_m"] == pytest.approx(one["controller"]["way_m"], rel=0.02)
    assert [one["after_s"] for one in same["promises"]] == [0.1, 0.2, 0.4]
    assert others["apart"]["d"]["max"] > 0.05
    place = others["places"][0]
    xy = load_track("harbour").position(np.array([place["s_m"]]))[0]
    assert np.hypot(*(xy - (place["x_m"], place["y_m"]))) < 0.2
    assert (tmp_path / "found/run-1-other.png").stat().st_size > 10_000
    alike = cli("shadow", log, "--weights", own, "--against", own)
    assert "none worse" in alike.out


def test_a_log_that_tells_nothing_of_shadows_is_refused(
    cli: Cli, lockstep: Path, tmp_path: Path
) -> None:
    entries = list(LogReader(lockstep / "run/run.mcap").messages())
    for name, times in (("without", 0), ("twice", 2)):
        writer = LogWriter(tmp_path / f"{name}.mcap")
        for one in entries:
            for _ in range(times if "/shadow/" in one.key else 1):
                writer.write(one.key, encode(one.message), time.monotonic_ns())
        writer.close()
    refused(cli("shadow", "without.mcap"), "no shadow", "--shadow NAME")
    refused(cli("shadow", "twice.mcap"), "two shadows 'other'", "name of its own")
    for text in ("d=-1", "d", "x=1"):
        refused(cli("shadow", "without.mcap", "--at-most", text), "--at-most", "d=0.1,delta_rate=1")
    refused(cli("shadow", "without.mcap", "--against", "a.bin"), "--weights")


def test_plans_are_compared_with_the_way_that_came() -> None:
    """A car that goes straight on at 2 m/s, in real time; its plans lead off to the left."""
    came_s, begins_s = np.arange(0, 2, 0.02), np.arange(0.013, 1, 0.02)
    came = np.zeros((len(came_s), 7))
    came[:, 0], came[:, 3] = 2 * came_s, 2.0
    ahead_s = 0.02 * np.arange(21)
    plans = [np.column_stack([2 * (begin_s + ahead_s), 0.1 * ahead_s, np.zeros((21, 5))])
             for begin_s in begins_s]  # fmt: skip
    none = np.zeros(len(begins_s), dtype=np.int64)
    side = Side(np.zeros((len(none), 2)), none, np.zeros(len(none)), 0, begins_s, plans, 0.02, ())
    one = Beside(1, "a", False, len(none), side, side, begins_s, came[: len(none)], came_s, came)
    off_m, planned_m, came_m = plan_errors(one, side, 0.2).T
    assert off_m == pytest.approx(0.02, abs=1e-9)
    assert planned_m == pytest.approx(0.2 * np.hypot(2, 0.1), abs=1e-9)
    assert came_m == pytest.approx(0.4, abs=1e-9)
    assert np.isnan(plan_errors(one, side, 1.5)).all()


def test_a_shadow_keeps_and_holds_nothing(cli: Cli) -> None:
    given = ("--artefact", "x", "--track", "harbour", "--raceline", "x")
    refused(cli("controller", "--shadow", "a", *given, "--store", "kept"), "leave out --store")
    refused(cli("controller", "--shadow", "a", *given, "--hold"), "leave out --hold")
    refused(cli("controller", "--shadow", "no name", *given), "--shadow")


def test_in_real_time_it_decides_as_the_controller_in_its_situation(
    raced: Racing, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    own = ("--weights", str(folder / "weights.bin"))
    with rigged(folder, raced, {"same": own}, lockstep=False) as rig:
        rig.drive()
    sent, same = inputs(rig.log), answers(rig.log, "same")
    assert len(same.keys() & sent.keys()) > 0.95 * len(sent)
    assert all(same[seq].decided_at_s <= sent[seq].decided_at_s for seq in same.keys() & sent)
    apart = np.abs([np.subtract(same[seq].u, sent[seq].u) for seq in same.keys() & sent])
    assert np.median(apart, axis=0) == pytest.approx([0, 0], abs=1e-3)


@pytest.mark.parametrize("in_lockstep", [True, False])
def test_a_shadow_that_is_killed_does_not_touch_the_drive(
    raced: Racing, lockstep: Path, tmp_path: Path, in_lockstep: bool
) -> None:
    folder = tmp_path / "run"
    own = ("--weights", str(folder / "weights.bin"))
    with rigged(folder, raced, {"mortal": own}, in_lockstep) as rig:

        def killed() -> None:
            until(lambda: bool(answers(rig.log, "mortal")), "a first answer")
            os.kill(rig.shadows["mortal"].pid, signal.SIGKILL)

        end = rig.drive(killed)
        status = rig.system.director.status("controller")
    assert end.data["reason"] == "max_time"
    assert 0 < len(answers(rig.log, "mortal")) < len(inputs(rig.log))
    if in_lockstep:
        assert driven(rig.log) == driven(lockstep / "run/run.mcap")
    assert int(status.counters["solution"]) >= 0.5 * int(status.counters["ticks"])


def test_the_keys_of_shadows_are_theirs_alone() -> None:
    assert topic_of("bayesrace/orca/shadow/new-2/actuation") is SHADOW_ACTUATION
    assert topic_of("bayesrace/orca/shadow/new-2/telemetry") is SHADOW_TELEMETRY
    assert topic_of("bayesrace/orca/shadow/new-2/braking") is None
    assert topic_of("bayesrace/orca/shadow/no name/actuation") is None
    assert topic_of("bayesrace/orca/event/new-2") is None
