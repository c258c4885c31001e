"""``bayesrace learn``: what is given at the start, and the event loop of the job.

One thread handles all messages and waits for nothing else: training is a process of its own, and
another thread waits for the controller's answers. Plant and controller may start, end and start
again at any time.
"""

import os
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, Final

from bayesrace.errors import InputError
from bayesrace.gp.weights import read_weights
from bayesrace.learning.change import said
from bayesrace.learning.settings import TrainingSettings
from bayesrace.learning.sources import read_samples
from bayesrace.learning.training import Trainer, perform
from bayesrace.learning.validation import discretisation_of, recalled
from bayesrace.manifest import read_manifest
from bayesrace.messages import TOPICS, TRUTH, Actuation, Event, State, Status, Telemetry
from bayesrace.operation.learn.collector import Collector, Stretch
from bayesrace.operation.learn.journal import Journal, resumable_settings
from bayesrace.operation.learn.publishing import Publisher
from bayesrace.operation.learn.records import LapRecord, LearnSettings, Record, UpdateRecord
from bayesrace.operation.learn.report import draw
from bayesrace.processes import deferred_interrupt
from bayesrace.tracks import Track, load_track
from bayesrace.transport import NEWEST, Endpoints, Inbox, Item, Kind, open_session

__all__ = ["Learner", "learn"]

_TICK_S: Final = 0.1
_REST_S: Final = 2.0


def learn(
    settings: LearnSettings,
    endpoints: Endpoints,
    folder: Path,
    say: Callable[[str], None],
    *,
    data: Sequence[Path] = (),
    weights: Path | None = None,
    artefact: Path | None = None,
) -> Record:
    """Learns until the settings' number of laps, or a signal; returns the folder's record.

    ``data`` and ``weights`` are to begin with, and not read in a folder to resume. The model is
    that of ``artefact``, of the folder, or of ``weights``, else the settings'. InputError for what
    cannot be used. The job waits for a plant or a controller that is not there.
    """
    car, before = settings.car, resumable_settings(folder)
    track = None if settings.track is None else load_track(settings.track, car.width_m)
    unread = [name for name, one in (("--data", data), ("--weights", weights)) if one]
    if before is not None:
        data, weights = (), None
    # What cannot be used is reported before there is a folder.
    models = {} if before is None else {before.discretisation: str(folder)}
    given = None if weights is None else read_weights(weights)
    if given is not None:
        models[discretisation_of(given.discretisation, car)] = str(weights)
    if artefact is not None:
        manifest = read_manifest(artefact)
        manifest.check_points(settings.points)
        models[discretisation_of(manifest.discretisation, car)] = str(artefact)
    if len(models) > 1:
        raise InputError(f"{' and '.join(models.values())} are for different discretisations")
    model = next(iter(models), settings.discretisation)
    settings = settings.model_copy(update={"discretisation": model})
    samples = read_samples(data, car, "", model).dataset if data else None
    with closing(Journal(folder, settings)) as journal:
        if journal.resumed:
            why = f"; {' and '.join(unread)} not read: only to begin with" if unread else ""
            say(f"resuming in {folder} after lap {len(journal.record.laps)}{why}")
        elif given is not None:
            known = samples is not None and given.dataset_digest == samples.digest()
            kept = None if known else recalled(given, car)
            journal.add_update(UpdateRecord(after_lap=0), given, kept)
        if samples is not None and not journal.resumed:
            journal.add_driven(samples)
        with open_session(endpoints, "learning") as session:
            Learner(session, journal, say, track).run()
        draw(journal.record, folder / "laps.png")
        return journal.record


class Learner:
    """One job: :meth:`run` it once, in the main thread."""

    def __init__(
        self, session: Any, journal: Journal, say: Callable[[str], None], track: Track | None
    ) -> None:
        """``say``: prints a line; ``track``: times laps."""
        settings = self._settings = journal.settings
        self._journal, self._say = journal, say
        self._collector = Collector(
            settings.car, settings.discretisation.step_s, track, settings.every
        )
        self._publisher = Publisher(session, journal, say)
        self._trainer = Trainer()
        self._inbox = Inbox(session, settings.name)
        for topic in TOPICS:
            if topic is not TRUTH:
                self._inbox.subscribe(topic, newest=NEWEST)
        for source in ("plant", "controller"):
            self._inbox.watch(source)
        self._handlers: dict[type, Callable[[Any], None]] = {
            State: self._collector.state,
            Telemetry: self._collector.telemetry,
            Actuation: self._collector.actuation,
            Event: self._publisher.event,
            Status: self._publisher.heartbeat,
        }
        self._due = True
        """A training is to start if there are samples, once the one before has its answer."""
        self._laps, self._ending = 0, False

    def run(self) -> None:
        """Follows the car until the wanted number of laps is learned from, or a signal."""
        self._trainer.prepare()
        self._say(f"waiting for plant and controller of car '{self._settings.name}'")
        with self._inbox.stamped():
            try:
                with self._inbox.receive_signals():
                    while not self._done():
                        if (item := self._inbox.get(_TICK_S)) is not None:
                            self._handle(item)
                        for stretch in self._collector.take():
                            self._add(stretch)
                        self._publisher.poll()
                        self._finish_training()
                        self._start_training()
            finally:
                self._end()

    def _done(self) -> bool:
        busy = self._due or self._trainer.busy or self._publisher.unanswered
        return self._ending or (self._enough and not busy)

    @property
    def _enough(self) -> bool:
        """Whether all laps that were wanted have been driven."""
        return self._settings.laps is not None and self._laps >= self._settings.laps

    def _end(self) -> None:
        """Ends the training; what was driven is on file for the next job."""
        with deferred_interrupt():
            self._trainer.stop()
            self._publisher.closed = True
            self._handle_rest()
            for stretch in self._collector.take(at_once=True):
                self._add(stretch)
        if self._publisher.unanswered:
            self._say("waiting for the controller's answer; Ctrl-C ends without it")
        self._publisher.wait()  # for seconds; an interrupt now loses no more than the answer
        self._handle_rest()
        if self._inbox.overflowed:
            self._say(f"{self._inbox.overflowed} messages came faster than they could be read")

    def _handle_rest(self) -> None:
        """What waits; a run that sends without end does not hold up the end of the job."""
        until_s = time.monotonic() + _REST_S
        while time.monotonic() < until_s and (item := self._inbox.get()) is not None:
            self._handle(item)

    def _handle(self, item: Item) -> None:
        if handler := self._handlers.get(type(item.value)):
            handler(item.value)
        elif item.kind is Kind.SIGNAL:
            self._ending = True
        elif item.kind in (Kind.ALIVE, Kind.GONE):
            self._publisher.present &= item.name != "controller"
            if item.kind is Kind.GONE:
                self._say(f"the {item.name} is gone; waiting for it")
            elif missing := {"plant", "controller"} - self._inbox.alive:
                self._say(f"the {item.name} is there; waiting for the {missing.pop()}")
            else:
                self._say(f"following car '{self._settings.name}'")

    def _add(self, stretch: Stretch) -> None:
        self._journal.add_driven(stretch.samples, stretch.lap)
        if stretch.lap is not None:
            self._laps, self._due = self._laps + 1, True
            self._say(_in_words(stretch.lap))
        elif self._settings.every and stretch.samples is not None:
            self._due |= not self._enough
        if stretch.why_not and self._journal.remark(stretch.why_not):
            self._say(f"nothing to learn from: {stretch.why_not}")

    def _start_training(self) -> None:
        journal, settings = self._journal, self._settings
        if not self._due or self._trainer.busy or self._publisher.unanswered:
            return
        self._due, self._after_lap = False, len(journal.record.laps)
        samples, threads = journal.take_samples(), max(1, (os.cpu_count() or 1) - 1)
        how = TrainingSettings(capacity=settings.points, seed=settings.seed, threads=threads)
        if samples is not None:
            model, first, keep = settings.discretisation, journal.initial, settings.keep
            job = partial(perform, model, [samples], first, how, keep, journal.newest)
            self._trainer.start(job)

    def _finish_training(self) -> None:
        if (outcome := self._trainer.poll()) is None:
            return
        failed = outcome.weights is None
        update = UpdateRecord(
            after_lap=self._after_lap,
            samples=outcome.samples,
            moved=outcome.moved,
            training_s=round(outcome.training_s, 3),
            verdict="failed" if failed else "pending",
            answer=outcome.error,
        )
        self._journal.add_update(update, outcome.weights, outcome.kept)
        self._journal.drop_weights(self._publisher.in_use)
        draw(self._journal.record, self._journal.folder / "laps.png")
        if failed:
            self._say(f"nothing learned after lap {update.after_lap}: {update.answer}")
            return
        if update.moved:
            self._say(said(update.moved, update.samples))
        self._say(
            f"learned after lap {update.after_lap}: {update.version}, {update.points} points of "
            f"{update.samples} samples in {update.training_s:.1f} s, {update.kept} kept"
        )
        self._publisher.offer(update)


def _in_words(lap: LapRecord) -> str:
    time = "time unknown" if lap.time_s is None else f"{lap.time_s:.3f} s"
    words = [f"lap {lap.lap}: {time}{'' if lap.flying else ' from rest'}, {lap.samples} samples"]
    if lap.fallbacks:
        words.append(f"{lap.fallbacks} cycles by the fallback")
    if lap.off_track_m:
        words.append(f"{lap.off_track_m * 1000:.1f} mm off the track")
    return ", ".join(words)
