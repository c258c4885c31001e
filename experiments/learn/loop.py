"""The loop of the paper without a hand: laps, training on old and new samples, publishing.

One thread waits for everything (:class:`.feed.Feed`) and never for one thing: training is a
process of its own, and a controller's answer is waited for in another thread. Plant and controller
may come, go and be started again at any time.
"""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from bayesrace.gp.weights import GpWeights, write_weights
from bayesrace.interrupts import catching_signals, deferred_interrupt
from bayesrace.messages import Actuation, Decoder, Event, State, Telemetry
from bayesrace.tracks import Track
from experiments.learn.collector import Collector, Driven, Lap
from experiments.learn.desk import Desk
from experiments.learn.feed import Feed, Item, What
from experiments.learn.journal import Journal, LapRecord, UpdateRecord
from experiments.learn.settings import LearnSettings
from experiments.learn.store import SampleStore
from experiments.learn.trainer import Trainer
from learning.dataset import Dataset
from learning.training import TrainingSettings
from learning.worker import Outcome, Task

__all__ = ["Learner"]

_TICK_S: Final = 0.1
_LONELY_S: Final = 5.0
"""After this long without plant or controller, that is said."""


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
        self._car = settings.car
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
        self._store = SampleStore(journal.folder, self._car)
        self._task: Task | None = None
        self._due = False
        """There is something to learn that no training has been asked for."""
        self._remarked: set[str] = set()
        self._there: set[str] = set()
        self._waited_s = 0.0
        self._laps = 0
        self._ending = False

    def begin(
        self, samples: Dataset | None, weights: GpWeights | None, unread: Sequence[str] = ()
    ) -> None:
        """What is known before the first lap; of a folder gone on with, what was known last.

        ``unread``: options that have not been read therefore.
        """
        journal, store = self._journal, self._store
        if journal.resumed:
            why = f"; {' and '.join(unread)} not read: only to begin with" if unread else ""
            self._say(f"going on in {journal.folder} after lap {len(journal.record.laps)}{why}")
        else:  # what an unfinished beginning has left is given once more
            store.clear()
            journal.path(Journal.FILES.given).unlink(missing_ok=True)
            if samples is not None:
                store.add(samples)
                store.save()
            given = None if weights is None else self._given(weights)
            if given is not None or store.waiting:
                journal.begin(given, recall=not _known(weights, samples))
        self._due = store.waiting

    def _given(self, weights: GpWeights) -> UpdateRecord:
        path = self._journal.path(Journal.FILES.given)
        write_weights(path, weights)
        points = max(weights.counts)
        return UpdateRecord(after_lap=0, version=weights.version, file=path.name, points=points)

    def run(self) -> None:
        """Until the wanted number of laps is learned from, or a signal."""
        feed = self._feed
        self._trainer.prepare()
        try:
            with catching_signals(lambda _number: feed.put(What.END)):
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
        with deferred_interrupt():
            self._trainer.stop()
            self._desk.close()
            self._take_rest()
            for driven in self._collector.end():
                self._note(driven, whole=False)
            self._store.end()
            if self._store.waiting:
                self._journal.save()
                self._store.save()
        if self._desk.busy:
            self._say("waiting for the controller's answer; Ctrl-C ends without it")
        self._desk.wait()  # seconds, perhaps; who interrupts now loses no more than the answer
        self._take_rest()
        if self._feed.lost:
            self._say(f"{self._feed.lost} messages came faster than they could be read")

    def _take_rest(self) -> None:
        for item in self._feed.waiting():
            self._take(item)

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
        if driven.samples is not None:
            self._store.add(driven.samples)
        if driven.lap is not None and whole:
            self._note_lap(driven.lap, driven.samples)
        if driven.why_not:
            self._remark(driven.why_not)

    def _note_lap(self, lap: Lap, samples: Dataset | None) -> None:
        self._laps += 1
        self._due = self._due or self._store.waiting
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

    def _remark(self, why_not: str) -> None:
        """Why nothing is learned from what was driven: once for each cause."""
        self._journal.remark(why_not)
        if why_not not in self._remarked:
            self._remarked.add(why_not)
            self._say(f"nothing to learn from: {why_not}")

    # Learning ----------------------------------------------------------------------------------

    def _train(self) -> None:
        """Starts a training, if there is something to learn and nothing under way."""
        waiting = self._due and self._store.waiting
        if not waiting or self._task is not None or self._desk.busy:
            return
        journal, settings = self._journal, self._settings
        after, given = len(journal.record.laps), journal.existing(Journal.FILES.given)
        batch = self._store.begin()
        self._task = Task(
            number=after,
            car=settings.car,
            discretisation=settings.discretisation,
            old=batch.old,
            new=(batch.new,),
            recall=given if batch.old is None and journal.record.recall else None,
            initial=self._initial(given),
            training=TrainingSettings(
                capacity=settings.points,
                seed=settings.seed,
                threads=max(1, (os.cpu_count() or 1) - 1),
            ),
            keep=settings.keep,
            weights=journal.free_weights(after),
            kept=batch.kept,
        )
        self._due = False
        self._trainer.start(self._task)

    def _initial(self, given: Path | None) -> Path | None:
        """Weights to start the optimiser from; none after a failure, which may be theirs."""
        updates = self._journal.record.updates
        if updates and updates[-1].verdict in ("refused", "rolled back", "failed"):
            return None
        accepted = self._journal.last_accepted()
        return given if accepted is None else self._journal.path(accepted.file)

    def _learned(self, outcome: Outcome) -> None:
        task = self._task
        if task is None or outcome.number != task.number:
            return
        self._task = None
        self._store.end()
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
        self._journal.add_update(update)
        self._journal.drop_weights(self._desk.in_use)
        self._draw()
        if outcome.error:
            self._say(f"nothing learned after lap {task.number}: {outcome.error}")
            return
        self._say(
            f"learned after lap {task.number}: {outcome.version}, {outcome.points} points of "
            f"{outcome.samples} samples in {outcome.training_s:.1f} s, {outcome.kept} kept"
        )
        self._desk.offer(update)


def _known(weights: GpWeights | None, samples: Dataset | None) -> bool:
    """The weights were learned from these very samples."""
    if weights is None or samples is None:
        return False
    return weights.dataset_digest == samples.digest()


def _lap_words(lap: LapRecord) -> str:
    time = "time unknown" if lap.time_s is None else f"{lap.time_s:.3f} s"
    words = [f"lap {lap.lap}: {time}" + ("" if lap.flying else " from rest")]
    words.append(f"{lap.samples} samples")
    if lap.fallbacks:
        words.append(f"{lap.fallbacks} cycles by the fallback")
    if lap.off_track_m:
        words.append(f"{lap.off_track_m * 1000:.1f} mm off the track")
    return ", ".join(words)
