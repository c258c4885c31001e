"""The loop of the paper without a hand: laps, training on old and new samples, publishing.

One thread waits for everything (:class:`.feed.Feed`) and never for one thing: training is a
process of its own, and a controller's answer is waited for in another thread. Plant and controller
may come, go and be started again at any time.
"""

import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from bayesrace.errors import InputError
from bayesrace.gp.weights import GpWeights, write_weights
from bayesrace.messages import Actuation, Decoder, Event, State, Telemetry
from bayesrace.tracks import Track
from bayesrace.vehicles.parameters import get_car
from experiments.learn.collector import Collector, Driven
from experiments.learn.desk import Desk
from experiments.learn.feed import Feed, Item, What
from experiments.learn.journal import Journal, LapRecord, UpdateRecord
from experiments.learn.settings import LearnSettings
from experiments.learn.trainer import Trainer
from learning.dataset import Dataset, concatenate
from learning.pool import MOST_NEW
from learning.subset import evenly
from learning.training import TrainingSettings
from learning.worker import Outcome, Task

__all__ = ["Learner"]

_TICK_S: Final = 0.1
_LONELY_S: Final = 5.0
"""After this long without plant or controller, that is said."""

_GIVEN: Final = "weights-given.bin"


class Learner:
    """One job: :meth:`run` it once, in the main thread."""

    def __init__(
        self,
        session: Any,
        settings: LearnSettings,
        journal: Journal,
        track: Track | None,
        say: Callable[[str], None],
        draw: Callable[[], None],
    ) -> None:
        """``say``: a line for people. ``draw``: the picture anew, after each training."""
        self._settings, self._journal, self._say, self._draw = settings, journal, say, draw
        self._car = get_car(settings.car)
        self._collector = Collector(self._car, settings.discretisation.step_s, track)
        self._feed = Feed(session, settings.name)
        self._desk = Desk(session, settings.name, journal, self._feed, say)
        self._trainer = Trainer(
            journal.path(Journal.FILES.worker), lambda told: self._feed.put(What.OUTCOME, told)
        )
        self._decoders: dict[What, Decoder[Any]] = {
            What.STATE: Decoder(State),
            What.TELEMETRY: Decoder(Telemetry),
            What.ACTUATION: Decoder(Actuation),
            What.EVENT: Decoder(Event),
        }
        self._new: list[Dataset] = []
        """Driven since the last training began."""
        self._task: Task | None = None
        self._due = False
        """There is something to learn that no training has been asked for."""
        self._recall = True
        """What given weights know counts as samples: the samples themselves are not at hand."""
        self._there: set[str] = set()
        self._waited_s = 0.0
        self._laps = 0
        self._ending = False

    def begin(self, samples: Dataset | None, weights: GpWeights | None) -> None:
        """What is known before the first lap; of a folder gone on with, what was known last."""
        journal = self._journal
        if journal.resumed:
            samples, weights = journal.samples(Journal.FILES.new, self._car), None
            last = len(journal.record.laps)
            self._say(f"going on in {journal.folder} after lap {last}")
        if weights is not None:
            write_weights(journal.path(_GIVEN), weights)
            points = max(weights.counts)
            given = UpdateRecord(after_lap=0, version=weights.version, file=_GIVEN, points=points)
            journal.add_update(given)
        if samples is not None and len(samples):
            self._recall = weights is None or weights.dataset_digest != samples.digest()
            self._new.append(samples)
            self._due = True

    def run(self) -> None:
        """Until the wanted number of laps is learned from, or a signal."""
        feed = self._feed
        self._trainer.prepare()
        try:
            with feed.catching_signals():
                while not self._done():
                    item = feed.next(_TICK_S)
                    if item is not None:
                        self._take(item)
                    self._notice(item is None)
                    for driven in self._collector.take():
                        self._note(driven)
                    self._train()
        finally:
            self._end()

    def _done(self) -> bool:
        if self._ending:
            return True
        enough = self._settings.laps is not None and self._laps >= self._settings.laps
        return enough and not (self._due or self._trainer.busy or self._task or self._desk.busy)

    def _end(self) -> None:
        """What has been driven and not yet learned from is for the next time."""
        self._trainer.stop()
        self._desk.close()
        for driven in self._collector.end():
            self._note(driven, whole=False)
        new = list(self._new)
        if self._task is not None:
            with suppress(InputError):
                waiting = self._journal.samples(Journal.FILES.new, self._car)
                new = new if waiting is None else [waiting, *new]
        if new:
            self._journal.put_samples(Journal.FILES.new, _thinned(new))
        if self._feed.lost:
            self._say(f"{self._feed.lost} messages came faster than they could be read")

    # What happens ------------------------------------------------------------------------------

    def _take(self, item: Item) -> None:
        what, value = item
        if what is What.END:
            self._ending = True
        elif what is What.PRESENCE:
            self._presence(*value)
        elif what is What.OUTCOME:
            self._learned(value)
        elif what is What.ANSWER:
            self._desk.answer(value)
        elif (message := self._decoders[what](value)) is not None:
            self._message(message)

    def _message(self, message: State | Telemetry | Actuation | Event) -> None:
        if isinstance(message, State):
            self._collector.state(message)
        elif isinstance(message, Telemetry):
            self._collector.telemetry(message)
        elif isinstance(message, Actuation):
            self._collector.actuation(message)
        else:
            self._desk.event(message)

    def _presence(self, source: str, there: bool) -> None:
        (self._there.add if there else self._there.discard)(source)
        if there and len(self._there) == 2:
            self._say(f"following car '{self._settings.name}'")
        if source == "controller":
            self._desk.presence(there)
        elif not there:
            self._say("the plant is gone; waiting for it")

    def _notice(self, quiet: bool) -> None:
        """Says once that there is nobody."""
        if len(self._there) == 2 or not quiet:
            self._waited_s = 0.0 if len(self._there) == 2 else self._waited_s
            return
        before, self._waited_s = self._waited_s, self._waited_s + _TICK_S
        if before < _LONELY_S <= self._waited_s:
            missing = " and no ".join(sorted({"plant", "controller"} - self._there))
            self._say(f"no {missing} of car '{self._settings.name}' yet; waiting")

    def _note(self, driven: Driven, whole: bool = True) -> None:
        """A stretch has been driven."""
        samples = driven.samples
        if samples is not None and len(samples):
            self._new = [_thinned([*self._new, samples])]
        lap = driven.lap
        if lap is None or not whole:
            return
        self._laps += 1
        self._due = self._due or bool(self._new)
        record = LapRecord(
            lap=len(self._journal.record.laps) + 1,
            run=lap.run,
            time_s=lap.time_s,
            flying=lap.flying,
            versions=list(lap.versions),
            samples=0 if samples is None else len(samples),
            left_out={} if samples is None else dict(samples.dropped),
            fallbacks=lap.fallbacks,
            off_track_m=lap.off_track_m,
        )
        self._journal.add_lap(record)
        self._say(_lap_words(record))

    # Learning ----------------------------------------------------------------------------------

    def _train(self) -> None:
        """Starts a training, if there is something to learn and nothing under way."""
        if not self._due or not self._new or self._task is not None or self._desk.busy:
            return
        journal, files, settings = self._journal, Journal.FILES, self._settings
        new = journal.put_samples(files.new, _thinned(self._new))
        after = len(journal.record.laps)
        old, given = journal.existing(files.kept), journal.existing(_GIVEN)
        self._task = Task(
            number=after,
            car=settings.car,
            discretisation=settings.discretisation,
            old=old,
            new=(new,),
            recall=given if old is None and self._recall else None,
            initial=self._initial(given),
            training=TrainingSettings(
                capacity=settings.points,
                seed=settings.seed,
                threads=max(1, (os.cpu_count() or 1) - 1),
            ),
            keep=settings.keep,
            weights=self._free(after),
            kept=journal.path(files.next_kept),
        )
        self._new, self._due = [], False
        self._trainer.start(self._task)

    def _initial(self, given: Path | None) -> Path | None:
        """Weights to start the optimiser from; none after a failure, which may be theirs."""
        updates = self._journal.record.updates
        if updates and updates[-1].verdict in ("refused", "rolled back", "failed"):
            return None
        accepted = self._journal.last_accepted()
        return given if accepted is None else self._journal.path(accepted.file)

    def _free(self, lap: int) -> Path:
        """A file name for the weights after this lap: those that were published stay."""
        names = (f"weights-{lap:04d}{suffix}.bin" for suffix in _suffixes())
        return next(path for name in names if not (path := self._journal.path(name)).exists())

    def _learned(self, outcome: Outcome) -> None:
        task, self._task = self._task, None
        if task is None or outcome.number != task.number:
            return
        journal, files = self._journal, Journal.FILES
        kept = journal.existing(files.next_kept)
        if kept is not None:
            kept.replace(journal.path(files.kept))
            journal.path(files.new).unlink(missing_ok=True)
        else:  # the process has died over it: with the next lap once more
            with suppress(InputError):
                waiting = journal.samples(files.new, self._car)
                self._new = self._new if waiting is None else [waiting, *self._new]
        update = UpdateRecord(
            after_lap=task.number,
            version=outcome.version,
            file=task.weights.name if outcome.version else "",
            samples=outcome.samples,
            kept=outcome.kept,
            points=outcome.points,
            training_s=round(outcome.training_s, 3),
            metrics=outcome.metrics,
            verdict="failed" if outcome.error else "waiting",
            answer=outcome.error,
        )
        journal.add_update(update)
        self._draw()
        if outcome.error:
            self._say(f"nothing learned after lap {task.number}: {outcome.error}")
            return
        self._say(
            f"learned after lap {task.number}: {outcome.version}, {outcome.points} points of "
            f"{outcome.samples} samples in {outcome.training_s:.1f} s, {outcome.kept} kept"
        )
        self._desk.offer(update)


def _thinned(datasets: Sequence[Dataset]) -> Dataset:
    """All samples, or as many as may come at once."""
    every = concatenate(datasets)
    return every.select(evenly(len(every), MOST_NEW), "too many at once")


def _suffixes() -> list[str]:
    return ["", *(f"-{number}" for number in range(2, 1000))]


def _lap_words(lap: LapRecord) -> str:
    time = "time unknown" if lap.time_s is None else f"{lap.time_s:.3f} s"
    words = [f"lap {lap.lap}: {time}" + ("" if lap.flying else " from rest")]
    words.append(f"{lap.samples} samples")
    if lap.fallbacks:
        words.append(f"{lap.fallbacks} cycles by the fallback")
    if lap.off_track_m:
        words.append(f"{lap.off_track_m * 1000:.1f} mm off the track")
    return ", ".join(words)
