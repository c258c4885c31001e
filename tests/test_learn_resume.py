"""A learning job that ends at any moment, and one that resumes in its folder.

Promises guarded: every sample on file is learned from, and once; what is given at the start is
given once; an answer that is missing when the job is interrupted is noted; a drive that is of no
use says why.
"""

import itertools
import signal
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from msgspec import structs
from rich.console import Console

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.gp.weights import Weights, decode_weights, write_weights, zero_weights
from bayesrace.integrators import PERFECT, PREDICTION
from bayesrace.learning.dataset import Dataset, concatenate
from bayesrace.learning.sources import write_npz
from bayesrace.learning.training import Outcome
from bayesrace.learning.validation import recalled
from bayesrace.messages import HEARTBEAT, STATE, Message, Reply, Role, State, Status, encode
from bayesrace.operation.learn import collector, job, journal, publishing
from bayesrace.operation.learn.publishing import Publisher
from bayesrace.operation.learn.records import LearnSettings, Record
from bayesrace.operation.learn.report import print_laps
from bayesrace.transport import Endpoints, Inbox, Item, Kind
from bayesrace.vehicles.models import dynamic
from tests.driven import CAR, blank, drive, logged
from tests.learning_rig import controller_status
from tests.programs import until

NAME = PREDICTION.identity("e_kinematic", CAR)
FIRST, SECOND = (drive(dynamic(CAR), 60, seed) for seed in (1, 2))

How = Literal["well", "died", "interrupted"]
"""How trainings end."""


class Silent:
    """In place of a Zenoh session, and of all that it declares: nothing ever arrives."""

    def declare_subscriber(self, *_: Any, **__: Any) -> "Silent":
        return self

    def liveliness(self) -> "Silent":
        return self

    @property
    def handler(self) -> "Silent":
        return self

    def try_recv(self) -> None: ...

    def undeclare(self) -> None: ...


class FakeTrainer:
    """Trains at once: keeps all samples; the weights know nothing."""

    def __init__(self, jobs: "Jobs") -> None:
        self._jobs = jobs
        self.busy = False

    def prepare(self) -> None: ...

    def stop(self) -> None: ...

    def start(self, task: partial[Outcome]) -> None:
        self.busy = True
        self._jobs.tasks.append(task)
        if self._jobs.how == "interrupted":
            self._jobs.put(Item(Kind.SIGNAL, "", signal.SIGINT, 0))

    def poll(self) -> Outcome | None:
        if not self.busy or self._jobs.how == "interrupted":
            return None
        self.busy = False
        if self._jobs.how == "died":
            return Outcome("killed")
        samples = concatenate(self._jobs.tasks[-1].args[1])
        weights = zero_weights(CAR.name, NAME, f"v{len(self._jobs.tasks)}")
        return Outcome("", weights, len(samples), kept=samples)


class Jobs:
    """Jobs one after the other, without a network, trainings or figures."""

    def __init__(self, set_attribute: Callable[[Any, str, Any], None] = setattr) -> None:
        self.said: list[str] = []
        self.tasks: list[partial[Outcome]] = []
        self.how: How = "well"
        self._arrive: list[Item] = []
        jobs = self

        class Fed(Inbox):
            @contextmanager
            def stamped(self) -> Iterator[None]:
                jobs.put = self.put
                with super().stamped():
                    for item in jobs._arrive:
                        self.put(item)
                    yield

        self.put: Callable[[Item], None] = self._arrive.append

        @contextmanager
        def no_network(_: Endpoints, _role: Role) -> Iterator[Silent]:
            yield Silent()

        for module, name, value in (
            (collector, "_PATIENCE_S", 0.0),
            (job, "_TICK_S", 0.001),
            (job, "Trainer", lambda: FakeTrainer(jobs)),
            (job, "Inbox", Fed),
            (job, "draw", lambda *_: None),
            (job, "open_session", no_network),
        ):
            set_attribute(module, name, value)

    def run(
        self,
        folder: Path,
        *driven: State,
        data: Path | None = None,
        weights: Path | None = None,
        laps: int = 1,
        controller: str | None = None,
        end: bool = False,
    ) -> Record:
        """A job to its end, which finds all these messages waiting; ``end``: and Ctrl-C.

        ``controller``: one is there and drives with this version.
        """
        settings = LearnSettings(car=CAR, laps=laps)
        self._arrive = [] if controller is None else [message(controller_status(controller))]
        self._arrive += [message(state) for state in driven]
        if end:
            self._arrive.append(Item(Kind.SIGNAL, "", signal.SIGINT, 0))
        given = () if data is None else (data,)
        return job.learn(
            settings, Endpoints(), folder, self.said.append, data=given, weights=weights
        )

    @property
    def learned(self) -> Dataset:
        """Samples of the last training."""
        return concatenate(self.tasks[-1].args[1])


@pytest.fixture
def jobs(monkeypatch: pytest.MonkeyPatch) -> Jobs:
    return Jobs(monkeypatch.setattr)


def message(value: Message) -> Item:
    topic = HEARTBEAT if isinstance(value, Status) else STATE
    return Item(Kind.MESSAGE, topic.name, encode(value), 0)


def lap_of(data: Dataset, run: int = 1) -> list[State]:
    """A drive that is a lap: the plant counts it at the last state."""
    states = logged(data, run)
    return [*states[:-1], structs.replace(states[-1], lap=1, final=True)]


def rows(*parts: Dataset) -> Floats:
    """The samples in an order of their own."""
    data = concatenate(parts)
    every = np.hstack((data.x, data.u, data.x_next))
    return every[np.lexsort(every.T)]


def assert_once(data: Dataset, *parts: Dataset) -> None:
    """These samples, each once, in whatever order."""
    np.testing.assert_array_equal(rows(data), rows(*parts))


# Ends of trainings and of jobs ----------------------------------------------------------------


@pytest.mark.parametrize("second", ["died", "interrupted"])
@pytest.mark.parametrize("first", ["died", "interrupted"])
def test_however_trainings_end_every_sample_is_learned_from_once(
    tmp_path: Path, jobs: Jobs, first: How, second: How
) -> None:
    """Those driven meanwhile, too."""
    third, fourth = (drive(dynamic(CAR), 60, seed) for seed in (3, 4))
    jobs.how = first
    jobs.run(tmp_path, *lap_of(FIRST), *logged(SECOND, run=2), end=first == "died", laps=9)
    jobs.how = second
    jobs.run(tmp_path, *lap_of(third, run=3), end=second == "died", laps=9)
    jobs.how = "well"
    jobs.run(tmp_path, *lap_of(fourth, run=4))
    assert_once(jobs.learned, FIRST, SECOND, third, fourth)


def test_an_interruption_while_an_answer_is_missing_loses_no_samples(
    tmp_path: Path, jobs: Jobs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C a second time does not wait for the controller; no lap is needed either."""

    def interrupt(_: Publisher) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Publisher, "wait", interrupt)
        with pytest.raises(KeyboardInterrupt):
            jobs.run(tmp_path, *logged(FIRST, run=1), end=True)
    assert jobs.tasks == []
    jobs.run(tmp_path, *lap_of(SECOND, run=2))
    assert_once(jobs.learned, FIRST, SECOND)


# What is given at the start ------------------------------------------------------------------


def given(folder: Path, weights: Weights) -> Path:
    write_weights(folder / "given.bin", weights)
    return folder / "given.bin"


@pytest.mark.parametrize("known", [True, False], ids=["of these samples", "of others"])
def test_what_is_given_at_the_start_is_given_once(
    tmp_path: Path, jobs: Jobs, known: bool, learned: Weights
) -> None:
    """What the weights know counts as samples, unless they were learned from these very ones.

    A resumed job does not read what is given, and says so.
    """
    write_npz(tmp_path / "data.npz", FIRST)
    weights = replace(learned, dataset_digest=FIRST.digest() if known else "")
    data, file = tmp_path / "data.npz", given(tmp_path, weights)
    folder = tmp_path / "job"
    jobs.how = "interrupted"
    jobs.run(folder, laps=9, data=data, weights=file)
    data.unlink()
    file.unlink()
    jobs.how = "well"
    record = jobs.run(folder, *lap_of(SECOND), data=data, weights=file)
    assert_once(jobs.learned, FIRST, SECOND, *([] if known else [recalled(weights, CAR)]))
    assert [one.version for one in record.updates].count(weights.version) == 1
    resuming = f"resuming in {folder} after lap 0"
    assert f"{resuming}; --data and --weights not read: only to begin with" in jobs.said


@pytest.fixture(scope="module")
def learned() -> Weights:
    """Weights that know something at a few points."""
    weights = zero_weights(CAR.name, NAME, "given")
    known = replace(weights.outputs[0], inputs=FIRST.features[:5], alpha=np.ones(5))
    return replace(weights, outputs=(known, *weights.outputs[1:]))


def test_a_resumed_job_learns_for_the_same_discretisation(tmp_path: Path, jobs: Jobs) -> None:
    """Weights to begin with are not read."""
    perfect = LearnSettings(car=CAR, discretisation=PERFECT)
    with closing(journal.Journal(tmp_path / "job", perfect)) as opened:
        opened.add_driven(FIRST)
    jobs.run(tmp_path / "job", weights=tmp_path / "gone", end=True)
    resumable = journal.resumable_settings(tmp_path / "job")
    assert resumable is not None
    assert resumable.discretisation == PERFECT


def test_what_cannot_be_used_leaves_no_folder(tmp_path: Path, jobs: Jobs) -> None:
    with pytest.raises(InputError, match="gone"):
        jobs.run(tmp_path / "job", weights=tmp_path / "gone")
    assert not (tmp_path / "job").exists()


# The controller's answer -----------------------------------------------------------------------


def test_an_answer_that_is_missing_when_interrupted_is_noted(
    tmp_path: Path, jobs: Jobs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The weights are in use: the table must not say that they are pending."""

    def send(*_: Any) -> Reply:
        jobs.put(Item(Kind.SIGNAL, "", signal.SIGINT, 0))
        until(lambda: any("waiting for the controller" in line for line in jobs.said), "the end")
        return blank(Reply, accepted=True, text="taken", data={"cycle": 7, "number": 1})

    monkeypatch.setattr(publishing, "send_weights", send)
    record = jobs.run(tmp_path, *lap_of(FIRST), laps=9, controller="")
    assert [(one.verdict, one.cycle) for one in record.updates] == [("accepted", 7)]


def test_pending_weights_are_sent_by_the_next_job_and_accepted_ones_by_the_one_after(
    tmp_path: Path, jobs: Jobs, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = []

    def send(_session: Any, _car: str, data: bytes) -> Reply:
        sent.append(decode_weights(data).version)
        return blank(Reply, accepted=True, text="taken", data={"cycle": 7, "number": 1})

    monkeypatch.setattr(publishing, "send_weights", send)
    record = jobs.run(tmp_path, *lap_of(FIRST))
    assert [one.verdict for one in record.updates] == ["pending"]
    for version in ("", "", "v1"):
        record = jobs.run(tmp_path, controller=version, laps=9, end=True)
        assert [one.verdict for one in record.updates] == ["accepted"]
    assert sent == ["v1", "v1"]
    jobs.run(tmp_path, *lap_of(SECOND, run=2))
    assert jobs.tasks[-1].args[2] == tmp_path / "weights-0000.bin"


# Drives of no use ------------------------------------------------------------------------------


def test_a_plant_with_another_period_is_said_once_and_noted(tmp_path: Path, jobs: Jobs) -> None:
    """Also where the run ends before its first lap."""
    slow = [structs.replace(one, time_s=2 * one.time_s) for one in logged(FIRST, run=1)]
    twice_as_fast = [
        [structs.replace(state, time_s=state.time_s / 2) for state in lap_of(FIRST, run)]
        for run in (2, 3)
    ]
    jobs.run(tmp_path, *slow, *itertools.chain(*twice_as_fast), laps=2)
    assert jobs.tasks == []
    said = [line for line in jobs.said if "nothing to learn from" in line]
    assert ["0.04 s apart" in said[0], "0.01 s apart" in said[1], len(said)] == [True, True, 2]
    assert "the model's step is 0.02 s; drive with --rate 50" in said[1]
    record = jobs.run(tmp_path, end=True)
    assert [lap.samples for lap in record.laps] == [0, 0]
    console = Console(record=True, width=400)
    print_laps(record, console)
    text = console.export_text()
    assert [text.count(remark) for remark in record.remarks] == [1, 1]
