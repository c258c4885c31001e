"""A second controller beside the one that drives: it decides in the same situations, and neither
its weights nor its end change what is driven."""

import dataclasses
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest

from bayesrace.configuration import configured
from bayesrace.gp.weights import Weights, write_weights
from bayesrace.log import LogReader
from bayesrace.messages import (
    ACTUATION,
    SHADOW_ACTUATION,
    SHADOW_TELEMETRY,
    STATE,
    TELEMETRY,
    Actuation,
    Event,
    Telemetry,
    topic_of,
)
from bayesrace.operation.run_plan import RunPlan
from bayesrace.operation.system import Child, System, child, started_system
from bayesrace.raceline import write_raceline
from bayesrace.recorder import Recorder
from bayesrace.transport import private_endpoints
from tests.programs import until
from tests.racing import Racing, racing

pytestmark = pytest.mark.wall_clock

RUN, DRIVEN_S = 1, 4.0
"""More than half of a lap at racing speed."""


@pytest.fixture(scope="module")
def raced() -> Racing:
    return racing()


def other_weights(weights: Weights) -> Weights:
    """Their correction is smaller by a third."""
    outputs = tuple(dataclasses.replace(one, alpha=one.alpha * 2 / 3) for one in weights.outputs)
    return dataclasses.replace(weights, version="smaller", outputs=outputs)


@dataclasses.dataclass
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
            until(lambda one=one: "is over" in one.output.read_text() or one.ended(), "its answers")
        return end

    @property
    def log(self) -> Path:
        return self.folder / "run.mcap"


@contextmanager
def rigged(
    folder: Path, racing: Racing, shadows: dict[str, Sequence[str]], lockstep: bool = True
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
            until(lambda one=one: "shadow '" in one.output.read_text() or one.ended(), "a shadow")
            assert not one.ended()
        time.sleep(0.3)  # its links and declarations
        yield Rig(system, recorder, running, folder, racing, lockstep)


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


def test_in_lockstep_a_shadow_with_the_same_weights_decides_the_same_to_the_bit(
    raced: Racing, tmp_path: Path
) -> None:
    """Beside it another with other weights, which decides otherwise; the drive is that without."""
    folder = tmp_path / "with"
    other = tmp_path / "other.bin"
    write_weights(other, other_weights(raced.weights))
    own = ("--weights", str(folder / "weights.bin"))
    with rigged(folder, raced, {"same": own, "other": ("--weights", str(other))}) as rig:
        rig.drive()
        status = rig.system.director.status("plant")
    sent, same, others = inputs(rig.log), answers(rig.log, "same"), answers(rig.log, "other")
    assert len(sent) == round(50 * DRIVEN_S)
    assert same.keys() == others.keys() == sent.keys()
    assert {seq: one.u for seq, one in same.items()} == {seq: one.u for seq, one in sent.items()}
    found = LogReader(rig.log)
    both = [one for one in found.select(SHADOW_TELEMETRY) if one.state_seq in sent]
    assert plans(found.select(TELEMETRY)).items() <= {(one.state_seq, one.plan_x) for one in both}
    apart = [np.subtract(others[seq].u, sent[seq].u) for seq in sent]
    assert np.abs(apart).max() > 0.05
    assert {one.weights_version for one in others.values()} == {"smaller"}
    assert status.counters["rejected"] == status.counters["stale"] == 0
    with rigged(tmp_path / "without", raced, {}) as alone:
        alone.drive()
    assert driven(alone.log) == driven(rig.log)


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


@pytest.mark.parametrize("lockstep", [True, False])
def test_a_shadow_that_is_killed_does_not_touch_the_drive(
    raced: Racing, tmp_path: Path, lockstep: bool
) -> None:
    folder = tmp_path / "run"
    own = ("--weights", str(folder / "weights.bin"))
    with rigged(folder, raced, {"mortal": own}, lockstep) as rig:
        end = rig.drive(lambda: os.kill(rig.shadows["mortal"].pid, signal.SIGKILL))
        status = rig.system.director.status("controller")
    assert end.data["reason"] == "max_time"
    assert 0 < len(answers(rig.log, "mortal")) < 0.7 * len(inputs(rig.log))
    assert status.counters["solution"] >= 0.99 * status.counters["ticks"]


def test_the_keys_of_shadows_are_theirs_alone() -> None:
    assert topic_of("bayesrace/orca/shadow/new-2/actuation") is SHADOW_ACTUATION
    assert topic_of("bayesrace/orca/shadow/new-2/telemetry") is SHADOW_TELEMETRY
    assert topic_of("bayesrace/orca/shadow/new-2/braking") is None
    assert topic_of("bayesrace/orca/shadow/no name/actuation") is None
    assert topic_of("bayesrace/orca/event/new-2") is None
