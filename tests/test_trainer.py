"""Learning lap by lap: what is kept stays bounded and useful; weights can be had back as samples;
training in a process of its own."""

import dataclasses
import os
import signal
import tracemalloc
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from bayesrace.gp.expression import evaluate_mean
from bayesrace.gp.weights import GpWeights, write_weights, zero_weights
from bayesrace.integrators import PREDICTION
from bayesrace.learning.dataset import Dataset, concatenate
from bayesrace.learning.settings import TrainingSettings
from bayesrace.learning.subset import MOST_NEW, bounded
from bayesrace.learning.training import NICE, Outcome, Trainer, perform, train
from bayesrace.learning.validation import recalled, residual
from bayesrace.vehicles.models import dynamic
from tests.driven import CAR, QUICK, drive
from tests.programs import until

SMALL = TrainingSettings(**{**QUICK.model_dump(), "capacity": 60})


@pytest.fixture(scope="module")
def driven() -> Dataset:
    return drive(dynamic(CAR), 300, seed=1)


@pytest.fixture(scope="module")
def learned(driven: Dataset) -> GpWeights:
    return train(driven, PREDICTION, SMALL)


def test_as_many_are_kept_as_wanted(driven: Dataset) -> None:
    assert bounded(driven, len(driven)) is driven
    assert len(bounded(driven, 100)) == 100
    many = driven.select(np.arange(MOST_NEW + 5000) % len(driven))
    assert len(bounded(many, 50)) == 50


def test_the_newest_and_the_most_informative_are_kept(driven: Dataset, learned: GpWeights) -> None:
    """One sample unlike all others, long ago, among hundreds of one kind, is not let go."""
    same = driven.select(np.full(400, 7))
    x, x_next = same.x.copy(), same.x_next.copy()
    x[3, 5] += 4.0
    x_next[3, 5] += 4.0
    kept = bounded(dataclasses.replace(same, x=x, x_next=x_next), 40, learned)
    assert len(kept) == 40
    assert kept.x[:, 5].max() == x[3, 5]
    both = concatenate([same, driven])
    kept = bounded(both, 100, learned)
    assert len(kept) == 100
    np.testing.assert_array_equal(kept.x[-25:], driven.x[-25:])
    spread = [np.ptp(one.features, axis=0) for one in (kept, driven)]
    assert (spread[0] > 0.8 * spread[1]).all(), "the wealth of the drive is lost"


def test_laps_without_end_need_no_more_memory(learned: GpWeights) -> None:
    """The bound that is stated: samples times a quarter of what is kept, in doubles, and little."""
    wanted, kept = 200, drive(dynamic(CAR), 100, seed=2)
    lap = drive(dynamic(CAR), 300, seed=3)
    tracemalloc.start()
    for _ in range(10):
        kept = bounded(concatenate([kept, lap]), wanted, learned)
        assert len(kept) == wanted
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 8 * (wanted + 300) * wanted / 4 + 2e6


def test_recalled_samples_teach_what_the_weights_know(driven: Dataset, learned: GpWeights) -> None:
    samples = recalled(learned, CAR)
    known = residual(samples, PREDICTION)
    np.testing.assert_allclose(known, evaluate_mean(learned, samples.features), atol=1e-12)
    again = train(samples, PREDICTION, SMALL)
    z = driven.features[::7]
    truth, before, after = (
        residual(driven, PREDICTION)[::7], evaluate_mean(learned, z), evaluate_mean(again, z)
    )  # fmt: skip
    rms = [np.sqrt(np.mean((one - truth) ** 2, axis=0)) for one in (before, after)]
    assert (rms[1] < 2 * rms[0] + 0.1 * truth.std(axis=0)).all()


def test_weights_that_know_nothing_recall_nothing() -> None:
    name = PREDICTION.identity("e_kinematic", CAR)
    assert len(recalled(zero_weights(CAR.name, name), CAR)) == 0


def test_a_task_learns_from_old_and_new(
    tmp_path: Path, driven: Dataset, learned: GpWeights
) -> None:
    write_weights(tmp_path / "first.bin", learned)
    samples = [driven.select(slice(0, 150)), driven.select(slice(150, None))]
    outcome = perform(PREDICTION, samples, tmp_path / "first.bin", SMALL, keep=150)
    assert (outcome.error, outcome.samples) == ("", 300)
    assert outcome.weights is not None
    assert outcome.weights.counts == (60, 60, 60)
    assert outcome.kept is not None
    assert len(outcome.kept) == 150


def test_what_cannot_be_learned_from_is_kept_all_the_same(driven: Dataset) -> None:
    outcome = perform(PREDICTION, [driven.select(slice(0, 5))], None, SMALL, keep=150)
    assert "5 samples" in outcome.error
    assert outcome.weights is None
    assert outcome.kept is not None
    assert len(outcome.kept) == 5


# The process ---------------------------------------------------------------------------------


def outcome_of(trainer: Trainer) -> Outcome:
    found: list[Outcome] = []

    def poll() -> bool:
        found.extend(filter(None, [trainer.poll()]))
        return bool(found)

    until(poll, "an outcome")
    assert not trainer.busy
    return found[0]


@pytest.mark.check
def test_training_is_a_niced_process_that_may_die_or_hang(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer, samples = Trainer(), [drive(dynamic(CAR), 120, seed=1)]
    task = partial(perform, PREDICTION, samples, settings=QUICK, keep=60)

    def start(initial: Path | None = None) -> int:
        trainer.start(partial(task, initial=initial))
        return process_of(trainer)

    try:
        pid = start()
        first = outcome_of(trainer)
        assert first.kept is not None
        assert (first.error, first.samples, len(first.kept)) == ("", 120, 60)
        assert os.getpriority(os.PRIO_PROCESS, pid) == NICE
        assert start(initial=tmp_path / "gone.bin") == pid
        assert "gone.bin" in outcome_of(trainer).error
        trainer.start(partial(divmod, 1, 0))
        assert outcome_of(trainer).error.startswith("the training failed: ZeroDivisionError: ")
        os.kill(pid, signal.SIGSTOP)  # else it might be done before it is killed
        start()
        os.kill(pid, signal.SIGKILL)
        died = outcome_of(trainer)
        assert (died.error, died.kept) == ("the training was killed by signal 9", None)
        os.kill(start(), signal.SIGSTOP)
        monkeypatch.setattr("bayesrace.learning.training._LONGEST_S", 0.5)
        assert "no result after 0 s and was killed" in outcome_of(trainer).error
        monkeypatch.undo()
        start()
        again = outcome_of(trainer)
        assert first.weights is not None
        assert again.weights is not None
        assert again.weights.version == first.weights.version, "the same samples and weights"
        pid = process_of(trainer)
    finally:
        trainer.stop()
    assert not Path(f"/proc/{pid}").exists()


def process_of(trainer: Trainer) -> int:
    trainer.prepare()
    return trainer._process.pid or 0
