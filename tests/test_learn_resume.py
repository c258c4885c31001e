"""A learning job that ends, or is killed, at any moment, and one that goes on in its folder.

Promises guarded: every sample is learned from, and once; what was given at the start is given once;
an answer under way when the job is interrupted is noted; a drive that is of no use says why.
"""

import itertools
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console

from bayesrace.errors import InputError
from bayesrace.gp.weights import GpWeights, decode_weights, write_weights, zero_weights
from bayesrace.integrators import PREDICTION
from bayesrace.messages import Reply, State, encode
from bayesrace.transport import Endpoints, open_session
from bayesrace.vehicles.models import dynamic
from experiments.learn import collector, loop
from experiments.learn import desk as desk_module
from experiments.learn import journal as journal_module
from experiments.learn.desk import Desk
from experiments.learn.feed import What
from experiments.learn.journal import Journal
from experiments.learn.loop import Learner
from experiments.learn.settings import LearnSettings
from experiments.learn.table import print_laps
from experiments.learn.usable import why_unusable
from learning.arrays import dataset_from_npz, write_npz
from learning.dataset import Dataset, concatenate
from learning.logs import dataset_from_messages
from learning.worker import Outcome, Task
from tests.driven import CAR, STEP_S, drive, logged
from tests.programs import until

NAME = PREDICTION.identity("e_kinematic", CAR)
FIRST, SECOND = (drive(dynamic(CAR), 60, seed) for seed in (1, 2))


How = Literal["well", "died", "interrupted", "interrupted late"]
"""How a training ends: ``late`` is after it has written what it keeps, and before it tells."""


class Jobs:
    """Jobs one after the other; what they have said, and what they have learned from."""

    def __init__(self, root: Path, session: Any) -> None:
        self.root, self.session = root, session
        self.said: list[str] = []
        self.tasks: list[Task] = []
        self.learned: list[Dataset] = []
        """Samples of each training."""
        self.how: How = "well"
        self.at: Callable[[str], None] = lambda _moment: None
        self._learner: Learner

    def run(
        self,
        folder: Path,
        *driven: State,
        given: Dataset | None = None,
        weights: GpWeights | None = None,
        laps: int = 1,
        controller: bool = False,
        end: bool = False,
    ) -> Journal:
        """A job to its end, which finds all these messages waiting; ``end``: and Ctrl-C."""
        settings = LearnSettings(car=CAR.name, laps=laps)
        with Journal(folder, settings) as journal:
            learner = self._learner = Learner(
                self.session, settings, journal, None, self.said.append, lambda: self.at("noted")
            )
            learner.begin(given, weights)
            if controller:
                self.put(What.PRESENCE, ("controller", True))
            for state in driven:
                self.put(What.STATE, encode(state))
            if end:
                self.put(What.END)
            learner.run()
        return journal

    @property
    def ending(self) -> bool:
        """The job has noticed Ctrl-C."""
        return self._learner._ending

    def put(self, what: What, value: Any = None) -> None:
        """Something happens."""
        self._learner._feed.put(what, value)

    def train(self, task: Task, told: Callable[[Outcome], None]) -> None:
        """In place of the worker: keeps all samples; the weights know nothing."""
        paths = [path for path in (task.old, *task.new) if path is not None]
        samples = concatenate([dataset_from_npz(path) for path in paths])
        self.tasks.append(task)
        self.learned.append(samples)
        self.at("handed over")
        version = f"v{len(self.tasks)}"
        write_weights(task.weights, zero_weights(CAR.name, NAME, version))
        if self.how in ("well", "interrupted late"):
            write_npz(task.kept, samples)
        self.at("kept")
        count = len(samples)
        if self.how == "well":
            told(Outcome(number=task.number, version=version, samples=count, kept=count))
            return
        if self.how == "died":
            told(Outcome(number=task.number, error="killed"))
        self.put(What.END)


class FakeTrainer:
    """Trains at once, in the job's thread."""

    busy = False

    def __init__(self, jobs: Jobs, told: Callable[[Outcome], None]) -> None:
        self._jobs, self._told = jobs, told

    def prepare(self) -> None: ...

    def start(self, task: Task) -> None:
        self._jobs.train(task, self._told)

    def stop(self) -> None: ...


@pytest.fixture
def jobs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Jobs]:
    with open_session(Endpoints()) as session:
        made = Jobs(tmp_path, session)
        monkeypatch.setattr(collector, "_PATIENCE_S", 0.0)
        monkeypatch.setattr(loop, "Trainer", lambda _output, told: FakeTrainer(made, told))
        yield made


def lap_of(data: Dataset, run: int = 1) -> list[State]:
    """A drive that is a lap: the plant counts it at the last state."""
    states = logged(data, run)
    return [*states[:-1], replace(states[-1], lap=1, final=True)]


def rows(data: Dataset) -> NDArray[np.float64]:
    every = np.hstack((data.x, data.u, data.x_next))
    return every[np.lexsort(every.T)]


def assert_once(data: Dataset, *parts: Dataset) -> None:
    """These samples, each once, in whatever order."""
    np.testing.assert_array_equal(rows(data), rows(concatenate(parts)))


@pytest.mark.parametrize("moment", ["handed over", "kept", "noted"])
def test_after_a_kill_every_sample_is_learned_from_once(jobs: Jobs, moment: str) -> None:
    """And nothing is left over of what the killed job had begun."""
    folder, killed = jobs.root / "job", jobs.root / "killed"

    def copy(now: str) -> None:
        if now == moment:
            shutil.copytree(folder, killed)

    jobs.at = copy
    jobs.run(folder, *lap_of(FIRST))
    assert_once(jobs.learned[-1], FIRST)
    jobs.at = lambda _moment: None
    for partial in (
        ".kept-0002.77.1.part.npz",
        ".weights-0001.77.1.part.bin",
        ".laps.77.1.part.json",
    ):
        (killed / partial).touch()
    journal = jobs.run(killed, *lap_of(SECOND, run=2))
    assert_once(jobs.learned[-1], FIRST, SECOND)
    names = {path.name for path in killed.iterdir() if path.suffix in (".npz", ".bin")}
    kept = {jobs.tasks[-1].kept.name}
    assert names == kept | {update.file for update in journal.record.updates}
    assert not list(killed.glob(".*"))


@pytest.mark.parametrize("second", ["died", "interrupted", "interrupted late"])
@pytest.mark.parametrize("first", ["died", "interrupted", "interrupted late"])
def test_however_trainings_end_every_sample_is_learned_from_once(
    jobs: Jobs, first: How, second: How
) -> None:
    """Those driven meanwhile, too."""
    jobs.how = first
    jobs.run(jobs.root, *lap_of(FIRST), *logged(SECOND, run=2), laps=9)
    third, fourth = (drive(dynamic(CAR), 60, seed) for seed in (3, 4))
    jobs.how = second
    jobs.run(jobs.root, *lap_of(third, run=3), laps=9)
    jobs.how = "well"
    jobs.run(jobs.root, *lap_of(fourth, run=4))
    assert_once(jobs.learned[-1], FIRST, SECOND, third, fourth)


def test_what_was_driven_before_the_first_lap_is_learned_from_by_the_next_job(jobs: Jobs) -> None:
    jobs.run(jobs.root, *logged(FIRST, run=1), end=True)
    assert jobs.learned == []
    jobs.run(jobs.root, *lap_of(SECOND, run=2))
    assert_once(jobs.learned[-1], FIRST, SECOND)


def test_a_second_interruption_loses_no_samples(
    jobs: Jobs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever does not want to wait for the controller's answer presses Ctrl-C once more."""

    with monkeypatch.context() as patched:
        patched.setattr(Desk, "wait", interrupt)
        with pytest.raises(KeyboardInterrupt):
            jobs.run(jobs.root, *logged(FIRST, run=1), end=True)
    jobs.run(jobs.root, *lap_of(SECOND, run=2))
    assert_once(jobs.learned[-1], FIRST, SECOND)


@pytest.mark.parametrize("whole", [False, True], ids=["beginning killed", "beginning done"])
def test_what_is_given_at_the_start_is_given_once(
    jobs: Jobs, monkeypatch: pytest.MonkeyPatch, whole: bool
) -> None:
    """Samples are not learned from a second time as what the weights know of them."""
    known = replace(zero_weights(CAR.name, NAME, "given"), dataset_digest=FIRST.digest())
    jobs.how = "interrupted"
    with monkeypatch.context() as patched, suppress(KeyboardInterrupt):
        if not whole:
            patched.setattr(Journal, "begin", interrupt)
        jobs.run(jobs.root, given=FIRST, weights=known, laps=9)
    jobs.how = "well"
    journal = jobs.run(jobs.root, *lap_of(SECOND), given=FIRST, weights=known)
    assert_once(jobs.learned[-1], FIRST, SECOND)
    assert [task.recall for task in jobs.tasks] == [None] * len(jobs.tasks)
    assert [one.version for one in journal.record.updates].count("given") == 1


def test_what_given_weights_know_counts_until_samples_are_kept(jobs: Jobs) -> None:
    """After an end before that, too."""
    jobs.how = "interrupted"
    jobs.run(jobs.root, *lap_of(FIRST), weights=zero_weights(CAR.name, NAME, "given"), laps=9)
    jobs.how = "well"
    jobs.run(jobs.root, *lap_of(SECOND, run=2))
    given = jobs.root / "weights-given.bin"
    assert [task.recall for task in jobs.tasks] == [given, given, None]


# The controller's answer -----------------------------------------------------------------------


def test_an_answer_under_way_when_interrupted_is_noted(
    jobs: Jobs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The weights are in use: the table must not say that they wait."""

    def send(*_: Any) -> Reply:
        jobs.put(What.END)
        until(lambda: jobs.ending, "the job ends")
        return Reply(0, 0, True, "taken", {"version": "v1", "cycle": 7, "number": 1})

    monkeypatch.setattr(desk_module, "send_weights", send)
    monkeypatch.setattr(desk_module, "ask", silence)
    journal = jobs.run(jobs.root, *lap_of(FIRST), laps=9, controller=True)
    (update,) = journal.record.updates
    assert (update.verdict, update.cycle) == ("accepted", 7)
    assert any("waiting for the controller's answer" in line for line in jobs.said)


def test_after_not_now_the_next_training_begins_where_the_last_left_off(
    jobs: Jobs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And the weights that it was said to are kept for a controller that takes them."""
    not_now = Reply(0, 0, False, "the controller ends", {"again": True})
    monkeypatch.setattr(desk_module, "send_weights", lambda *_: not_now)
    monkeypatch.setattr(desk_module, "ask", silence)
    given = zero_weights(CAR.name, NAME, "given")
    first = jobs.run(jobs.root, *lap_of(FIRST), weights=given, controller=True)
    assert [one.verdict for one in first.record.updates] == ["no answer", "waiting"]
    jobs.run(jobs.root, *lap_of(SECOND, run=2))
    assert [task.initial for task in jobs.tasks] == [jobs.root / "weights-given.bin"] * 2


def test_what_was_not_sent_is_sent_by_the_next_job(
    jobs: Jobs, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = []

    def send(_session: Any, _car: str, data: bytes) -> Reply:
        sent.append(decode_weights(data).version)
        return Reply(0, 0, True, "taken", {"cycle": 7, "number": 1})

    monkeypatch.setattr(desk_module, "send_weights", send)
    monkeypatch.setattr(desk_module, "ask", silence)
    first = jobs.run(jobs.root, *lap_of(FIRST))
    assert [one.verdict for one in first.record.updates] == ["waiting"]
    second = jobs.run(jobs.root, *lap_of(SECOND, run=2), controller=True)
    assert sent == ["v1", "v2"]
    assert [one.verdict for one in second.record.updates] == ["accepted"] * 2


def test_old_weights_go_while_the_job_runs(jobs: Jobs, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_module, "MOST_WEIGHTS", 2)
    for run in range(1, 5):
        jobs.run(jobs.root, *lap_of(FIRST, run))
    names = {path.name for path in jobs.root.glob("weights-*.bin")}
    assert names == {"weights-0003.bin", "weights-0004.bin"}


# Drives of no use ------------------------------------------------------------------------------


def test_a_plant_with_another_period_is_said_once_and_noted(jobs: Jobs) -> None:
    twice_as_fast = [
        [replace(state, time_s=state.time_s / 2) for state in lap_of(FIRST, run)] for run in (1, 2)
    ]
    journal = jobs.run(jobs.root, *itertools.chain(*twice_as_fast), laps=2)
    assert jobs.tasks == []
    (said,) = (line for line in jobs.said if "nothing to learn from" in line)
    assert "0.01 s apart, the model's step is 0.02 s" in said
    assert "--rate 50" in said
    with Journal(jobs.root, LearnSettings(car=CAR.name)) as again:
        (noted,) = again.record.remarks
    assert noted in said
    assert [lap.samples for lap in journal.record.laps] == [0, 0]
    console = Console(record=True, width=400)
    print_laps(journal.record, console)
    assert console.export_text().count(noted) == 1


def test_a_run_that_ends_before_its_first_lap_says_why_too(jobs: Jobs) -> None:
    slow = [replace(one, time_s=2 * one.time_s) for one in logged(FIRST, run=1)]
    jobs.run(jobs.root, *slow, end=True)
    assert any("0.04 s apart" in line for line in jobs.said)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda one: replace(one, x=(*one.x[:3], 0.0, *one.x[4:])), "bayesrace status"),
        (lambda one: replace(one, x=(*one.x[:6], 0.5)), "--car"),
        (lambda one: replace(one, u_applied=(0.1, 0.0)), "the FMU's map"),
        (lambda one: replace(one, seq=2 * one.seq), "loses messages"),
        (lambda one: one, ""),
    ],
    ids=["standstill", "another car", "steering", "gaps", "good"],
)
def test_each_cause_has_its_remedy(spoil: Callable[[State], State], words: str) -> None:
    states = [spoil(one) for one in logged(FIRST, run=1)]
    try:
        samples = dataset_from_messages(states, (), CAR, STEP_S)
    except InputError:
        samples = None
    why_not = why_unusable(states, samples, CAR, STEP_S)
    assert words in why_not
    assert bool(words) == bool(why_not)
    fallback = [(1, k) for k in range(61)]
    samples = dataset_from_messages(logged(FIRST, 1), fallback, CAR, STEP_S)
    assert "the fallback drove" in why_unusable(states, samples, CAR, STEP_S)


def interrupt(*_: Any, **__: Any) -> None:
    raise KeyboardInterrupt


def silence(*_: Any) -> None:
    raise InputError("nobody answers")
