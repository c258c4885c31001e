"""Training as a process of its own.

    python -m learning.worker [PARENT]

reads tasks from standard input, one line of JSON each (:class:`Task`), and answers each with a
line (:class:`Outcome`) when it is done. Samples and weights travel as files. It ends with its
input, or with the process of number PARENT.
"""

import sys
import time
from collections.abc import Mapping
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from bayesrace.clock import die_with_parent
from bayesrace.errors import InputError
from bayesrace.files import replacing
from bayesrace.gp.weights import OUTPUTS, GpWeights, read_weights, write_weights
from bayesrace.integrators import Discretisation
from bayesrace.vehicles import CarSetting
from learning.arrays import dataset_from_npz, write_npz
from learning.dataset import Dataset, concatenate
from learning.pool import bounded, recalled
from learning.training import TrainingSettings, train

__all__ = ["Outcome", "Task", "main", "perform"]


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Task(_Frozen):
    """Learn from old and new samples; keep a bounded part of them."""

    number: int = Field(description="comes back in the outcome")
    car: CarSetting
    discretisation: Discretisation
    old: Path | None = Field(None, description="samples kept so far (.npz)")
    new: tuple[Path, ...] = Field((), description="samples driven since (.npz)")
    recall: Path | None = Field(None, description="weights whose knowledge counts as old samples")
    initial: Path | None = Field(None, description="weights to start the optimiser from")
    training: TrainingSettings = TrainingSettings()
    keep: int = Field(ge=1, description="samples to keep at most")
    weights: Path = Field(description="file for the weights")
    kept: Path = Field(description="file for the samples kept")


class Outcome(_Frozen):
    """What became of a task; the samples kept are written in any case."""

    number: int
    error: str = Field("", description="why there are no weights; empty if there are")
    version: str = ""
    samples: int = Field(0, description="learned from")
    kept: int = Field(0, description="samples kept")
    points: int = Field(0, description="training points per output, the most")
    training_s: float = Field(0.0, description="reading and writing included")
    metrics: Mapping[str, Mapping[str, float]] = Field(
        default_factory=dict, description="held out, per output"
    )


def _samples(task: Task) -> Dataset:
    car, step_s = task.car, task.discretisation.step_s
    found = [recalled(read_weights(task.recall), car)] if task.recall is not None else []
    old = [task.old] if task.old is not None else []
    found += [dataset_from_npz(path, car, step_s) for path in (*old, *task.new)]
    return concatenate(found)


def perform(task: Task) -> Outcome:
    """Does it. InputError if the samples cannot be read; what cannot be learned is in the outcome.

    Weights that cannot be started from, of another model or damaged, are an error too.
    """
    begin_s = time.monotonic()
    samples = _samples(task)
    initial = None if task.initial is None else read_weights(task.initial)
    weights: GpWeights | None = None
    error = ""
    try:
        weights = train(samples, task.discretisation, task.training, initial)
    except (InputError, ArithmeticError, ValueError) as reason:  # LinAlgError is a ValueError
        error = str(reason) or type(reason).__name__
    if weights is not None:
        write_weights(task.weights, weights)
    kept = bounded(samples, task.keep, weights or initial)
    with replacing(task.kept) as partial:
        write_npz(partial, kept)
    outcome = Outcome(
        number=task.number,
        error=error,
        samples=len(samples),
        kept=len(kept),
        training_s=time.monotonic() - begin_s,
    )
    if weights is None:
        return outcome
    held_out = {name: dict(weights.metrics[name]) for name in OUTPUTS}
    return outcome.model_copy(
        update={
            "version": weights.version, "points": max(weights.counts), "metrics": held_out,
        }
    )  # fmt: skip


def main(parent: int | None = None) -> None:
    """Tasks until the input ends."""
    die_with_parent(parent)
    for line in sys.stdin:
        task = Task.model_validate_json(line)
        try:
            outcome = perform(task)
        except (InputError, ValidationError, OSError, MemoryError) as error:
            outcome = Outcome(number=task.number, error=str(error) or type(error).__name__)
        sys.stdout.write(outcome.model_dump_json() + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else None)
