"""Answers recorded cycles once more: in Python, by a C program, or by the controller's FMU.

Python feeds all that a recording says: states as they were taken, commands, weights, speed limits,
and in real time the moments of decisions and where their time ran out. The C program and the FMU
have one file of weights and no commands; they answer lockstep runs for as long as that is all.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from bayesrace.codegen.fmu import FmuDefinition, controller_fmu, pack
from bayesrace.controller.cycle import Cycle as Timed
from bayesrace.controller.driver import Decision, Driver
from bayesrace.files import temporary_folder
from bayesrace.gp.weights import pack_weights
from bayesrace.manifest import read_manifest
from bayesrace.messages import QUANTITIES, Telemetry
from bayesrace.operation.host import HostProgram, drives_by
from bayesrace.studies.evidence.replay.controller import Setup
from bayesrace.studies.evidence.replay.recording import Cycle, Life

__all__ = ["Answer", "answers"]

_BUDGET_S: Final = 2.0**-10
"""Of a repeated step: any above 0, as its clock does not count; a power of two adds no rounding."""


@dataclass(frozen=True)
class Answer:
    """What is answered in place of a recorded cycle."""

    cycle: Cycle
    u: tuple[float, float]
    status: int
    level: int
    how: Telemetry | None = None
    """With the plan; None of a host that does not say."""
    version: str = ""
    """Of the weights."""
    accepted: bool = True
    """The newest state was taken, not refused as stale or foreign."""


def answers(setup: Setup, life: Life) -> Iterator[Answer]:
    """Those of one controller process, in order; of cycles that the host cannot answer none.

    InputError if the host is not available, or no weights are there.
    """
    if setup.given.host == "python":
        yield from _Replay(setup, life).answers()
        return
    host = _c_host if setup.given.host == "c" else _fmu
    for run in life.runs():
        yield from host(setup, _plain(run))


class _Replay:
    """A driver that is told what another was told."""

    def __init__(self, setup: Setup, life: Life) -> None:
        self._setup, self._life = setup, life
        self._version = life.cycles[0].sent.weights_version
        self._controller = setup.controller(self._version)
        settings = setup.cycle.model_copy(update={"hold": life.hold})
        self._timed = Timed(self._controller, setup.car, settings)
        self._driver: Driver = self._timed.driver
        self._let_go = False

    def answers(self) -> Iterator[Answer]:
        cycles = self._life.cycles
        slow_down_mps2 = self._setup.car.tuning.driving.stop_mps2
        for cycle, after in itertools.zip_longest(cycles, cycles[1:]):
            accepted = self._take(cycle)
            if self._driver.newest is None:
                continue
            around = cycle.limits(self._driver.vx_mps, slow_down_mps2)
            lockstep = cycle.answered.lockstep
            if lockstep:
                decision = self._timed.decide(self._driver.time_s, environment=around)
            else:
                self._driver.repeat(cycle.how.refused)
                times = cycle.sent.decided_at_s, _BUDGET_S, _BUDGET_S + cycle.how.late_s
                decision = self._timed.decide(*times, around)
            yield self._answer(cycle, decision, accepted)
            if after is None:
                return
            if after.run == cycle.run:
                self._use(after.sent.weights_version)
            if lockstep or after.how.prepared_s < 0:
                self._driver.prepare(self._driver.interval_s)
            elif after.how.prepared_s > 0:
                self._driver.repeat(after.how.prepared_refused)
                self._driver.prepare(after.how.prepared_s, _BUDGET_S)

    def _take(self, cycle: Cycle) -> bool:
        """Commands and states before a cycle; whether the newest state counts."""
        driver, accepted = self._driver, True
        for command in cycle.commands:
            driver.go() if command == "go" else driver.stop()
            self._let_go = command == "hold_lost"
        for state in cycle.states:
            newest = driver.newest
            begins = newest is not None and (state.epoch, state.run) != (newest.epoch, newest.run)
            if begins:
                driver.lost(silent=False)
                self._use(cycle.sent.weights_version)
            accepted = driver.observe(state)
            if begins and self._let_go:
                driver.go()
                self._let_go = False
        return accepted

    def _use(self, version: str) -> None:
        """Weights that were adopted between two cycles."""
        if version == self._version or self._setup.given.weights is not None:
            return
        weights, step = self._setup.weights(version), self._controller.native
        step.stage_weights(b"" if weights is None else pack_weights(weights))
        step.adopt_weights(version)
        self._version = version

    def _answer(self, cycle: Cycle, decision: Decision, accepted: bool) -> Answer:
        how = self._timed.telemetry(cycle.how.seq, cycle.answered, decision, 0)
        u, version = (decision.d, decision.delta_rate), self._controller.weights_version
        return Answer(cycle, u, decision.status, int(decision.level), how, version, accepted)


# Hosts without Python ----------------------------------------------------------------------------


def _plain(run: Sequence[Cycle]) -> list[Cycle]:
    """The beginning of a run that states and the first weights alone determine."""
    first = run[0]

    def simple(cycle: Cycle) -> bool:
        told = bool(cycle.commands) or cycle.limit_mps is not None or not cycle.states
        same = cycle.sent.weights_version == first.sent.weights_version
        return same and cycle.answered.lockstep and not told

    return list(itertools.takewhile(simple, run))


def _c_host(setup: Setup, run: Sequence[Cycle]) -> Iterator[Answer]:
    """By the program of controller/host, compiled here."""
    if not run:
        return
    weights = setup.weights(run[0].sent.weights_version)
    every = (state for cycle in run for state in cycle.states)
    with temporary_folder() as folder:
        host = HostProgram.made(
            folder, setup.artefact, setup.car, setup.track, setup.line, weights, setup.mpc
        )
        answers = host.answers(one for one in every if (one.epoch, one.run) == run[0].run)
    found = {sent.state_seq: (sent, how) for sent, how in answers}
    for cycle in run:
        if answer := found.get(cycle.sent.state_seq):
            sent, how = answer
            u = sent.u[0], sent.u[1]
            yield Answer(cycle, u, sent.status, how.fallback, how, sent.weights_version)


def _fmu(setup: Setup, run: Sequence[Cycle]) -> Iterator[Answer]:
    """By the controller's FMU, made here and loaded by fmpy; measured states alone."""
    run = list(itertools.takewhile(lambda one: not one.answered.estimated, run))
    if not run:
        return
    import fmpy
    from fmpy.fmi2 import FMU2Slave

    with temporary_folder() as folder:
        path = pack(_definition(setup, run[0].sent.weights_version), folder / "controller.fmu")
        fmpy.extract(str(path), unzipdir=str(folder / "unpacked"))
        described = fmpy.read_model_description(str(folder / "unpacked"), validate=False)
        of = {one.name: one.valueReference for one in described.modelVariables}
        fmu = FMU2Slave(
            guid=described.guid, unzipDirectory=str(folder / "unpacked"), instanceName="replay",
            modelIdentifier=described.coSimulation.modelIdentifier,
        )  # fmt: skip
        fmu.instantiate()
        fmu.setupExperiment(startTime=0.0)
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        given = [of[name] for name in (*QUANTITIES, "d_applied")]
        time_s = 0.0
        for cycle, after in itertools.zip_longest(run, run[1:]):
            state = cycle.answered
            step_s = read_manifest(setup.artefact).step_s
            if after is not None:
                step_s = after.answered.time_s - state.time_s
            fmu.setReal(given, [*state.x, state.u_applied[0]])
            fmu.doStep(currentCommunicationPoint=time_s, communicationStepSize=step_s)
            time_s += step_s
            u = tuple(fmu.getReal([of["d"], of["delta_rate"]]))
            status, level = fmu.getInteger([of["status"], of["fallback_level"]])
            yield Answer(cycle, u, status, level)
        fmu.terminate()
        fmu.freeInstance()


def _definition(setup: Setup, version: str) -> FmuDefinition:
    car, weights = setup.car, setup.weights(version)
    given = drives_by(setup.artefact, car, setup.track, setup.line, weights, setup.mpc)
    fallback = setup.cycle.fallback.model_dump() | {"brake_fade_mps": car.brake_fade_mps}
    return controller_fmu(setup.artefact, car, **given, fallback=fallback, version=2)
