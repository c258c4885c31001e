"""Searches for weights of the OCP, margin, line friction and horizon by which a car laps faster.

Each trial drives the tuning tracks with weights of the Gaussian processes that are learned once;
Optuna proposes what to try next, in batches, so that the result depends on the seed and not on how
many workers there are. Tracks that no trial has seen judge the best one: there the whole race is
driven, training included, by the defaults and by what was found.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import optuna
from distributed import Client
from pydantic import BaseModel, ConfigDict, Field
from rich.console import Console
from rich.text import Text

from bayesrace.errors import InputError
from bayesrace.files import read_whole
from bayesrace.vehicles import CarParameters, CarSetting, default_car, write_car
from operation.preparation import prepare
from operation.settings import RaceSettings
from operation.terminal.progress import Stages
from operation.terminal.terminal import plain_table
from studies.campaign.case import Case, Controller, Files, named_file
from studies.campaign.cluster import computed, connected
from studies.campaign.execute import FAILED, Row

__all__ = ["Judgement", "TuneSettings", "Verdict", "print_verdict", "tune"]

_SPANS: Final = {
    "r_duty": (0.1, 10.0),
    "r_delta_rate": (0.1, 10.0),
    "s_slack": (0.3, 30.0),
    "margin_m": (0.25, 4.0),
}
"""As multiples of the car's own; the weight of the position stays, for only ratios matter."""
_FRICTION: Final = (0.8, 1.2, 0.025)
"""Least and largest multiple, and the step: each value costs a racing line for each track."""
_HORIZONS: Final = (12, 16, 20, 25, 30)

_LAPS: Final = 2
_STUDY: Final = "tune"


class TuneSettings(BaseModel):
    """What is searched, and on which tracks."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    car: CarSetting = Field(default_factory=default_car)
    tracks: tuple[str, ...] = Field(min_length=1, description="the trials drive on")
    held_out: tuple[str, ...] = Field(min_length=1, description="judge the best trial")
    trials: int = Field(60, ge=1, le=100_000)
    batch: int = Field(4, ge=1, le=1000, description="trials that are proposed at once")
    seed: int = Field(0, ge=0)


@dataclass(frozen=True)
class Driven:
    """Both laps on one track."""

    time_s: float
    """Mean of standing and flying lap; with the run's time limit for what was not finished."""
    off_track: int
    """Samples, and all of a lap that was not finished."""


@dataclass(frozen=True)
class Judgement:
    """One held-out track and controller."""

    track: str
    controller: str
    default: Driven
    tuned: Driven


@dataclass(frozen=True)
class Verdict:
    """What the search has come to."""

    found: dict[str, float]
    """Settings of the best trial, resolved."""
    gain: float
    """Lap time won over the defaults on the tuning tracks, a share."""
    judged: tuple[Judgement, ...]

    @property
    def held_out_gain(self) -> float:
        """The same on the held-out tracks, both controllers."""
        shares = [1 - one.tuned.time_s / one.default.time_s for one in self.judged]
        return sum(shares) / len(shares)

    @property
    def off_track(self) -> tuple[int, int]:
        """Samples off the held-out tracks by the defaults, and by what was found."""
        return (
            sum(one.default.off_track for one in self.judged),
            sum(one.tuned.off_track for one in self.judged),
        )

    @property
    def wins(self) -> bool:
        """Faster on the held-out tracks, and off them no more than the defaults."""
        before, after = self.off_track
        return self.held_out_gain > 0 and after <= before


def tune(
    settings: TuneSettings,
    out: Path,
    storage: Path,
    stages: Stages,
    scheduler: str | None = None,
    workers: int = 0,
) -> Verdict:
    """Searches, judges, and writes the car with what was found to ``out``.

    ``storage``: SQLite file of the study; a study that is there goes on. Raises InputError for
    tracks that are in both sets, or where a run of the defaults fails.
    """
    if both := sorted({*settings.tracks} & {*settings.held_out}):
        raise InputError(f"{both[0]} is to tune and to judge on; leave it in one of the two")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    first = RaceSettings(car=settings.car, track=settings.tracks[0])
    prepared = prepare(first, (first.track,), stages)
    data = read_whole(prepared.weights, "the weights", 1 << 28)
    weights = named_file(prepared.weights, data)
    with connected(scheduler, workers) as client:
        search = _Search(settings, client, {weights: data}, weights)
        with stages.stage("tune") as stage:
            study = _study(settings, storage)
            while (known := _finished(study)) < settings.trials:
                stage.update(known / settings.trials, f"{known} trials")
                search.batch(study, min(settings.batch, settings.trials - known))
        best = study.best_trial  # the defaults are feasible, so there is one
        tuned = tuned_car(settings.car, best.params)
        with stages.stage("judge on held-out tracks"):
            judged = search.judge(tuned)
    write_car(out, tuned)
    objective = tuned.tuning.objective.model_dump(exclude={"q_position"})
    return Verdict({**objective, "friction": tuned.friction}, 1 - (best.value or 1.0), judged)


def _study(settings: TuneSettings, storage: Path) -> optuna.Study:
    """The study in a file, or a new one, whose first trial is the defaults."""
    url = f"sqlite:///{storage}"
    study = optuna.create_study(study_name=_STUDY, storage=url, load_if_exists=True)
    identity = settings.model_dump_json(exclude={"trials"})
    if study.user_attrs.setdefault("settings", identity) != identity:
        raise InputError(
            f"{storage} is the study of another car, other tracks or another seed; name a new file"
        )
    if not study.trials:
        study.set_user_attr("settings", identity)
        own = settings.car.tuning.objective.horizon
        study.enqueue_trial({**dict.fromkeys([*_SPANS, "friction"], 1.0), "horizon": own})
    for trial in study.get_trials(states=(optuna.trial.TrialState.RUNNING,)):
        study.tell(trial.number, state=optuna.trial.TrialState.FAIL)  # of a killed search
    # Proposals after an interruption must not repeat the first ones.
    study.sampler = optuna.samplers.TPESampler(
        seed=settings.seed + _finished(study), multivariate=True
    )
    return study


def _finished(study: optuna.Study) -> int:
    return sum(trial.state.is_finished() for trial in study.get_trials(deepcopy=False))


def tuned_car(car: CarParameters, params: Mapping[str, Any]) -> CarParameters:
    """The car with what a trial proposes, in multiples of its own values."""
    own = car.tuning.objective
    changed = {name: float(f"{params[name] * getattr(own, name):.4g}") for name in _SPANS}
    objective = own.model_copy(update={**changed, "horizon": int(params["horizon"])})
    return car.model_copy(
        update={
            "friction": float(f"{params['friction'] * car.friction:.4g}"),
            "tuning": car.tuning.model_copy(update={"objective": objective}),
        }
    )


class _Search:
    def __init__(self, settings: TuneSettings, client: Client, files: Files, weights: str) -> None:
        self._settings, self._client = settings, client
        self._files, self._weights = files, weights
        self._default: dict[str, Driven] = {}

    def batch(self, study: optuna.Study, count: int) -> None:
        """Proposes, drives and reports this many trials."""
        trials = [study.ask() for _ in range(count)]
        car, tracks = self._settings.car, self._settings.tracks
        cars = [tuned_car(car, _proposal(trial, car)) for trial in trials]
        if not self._default:
            (own,) = self._drive([car], tracks, self._weights)
            self._default = {track: _sound(laps)["bayesrace"] for track, laps in own.items()}
        driven = self._drive(cars, tracks, self._weights)
        for trial, by_track in zip(trials, driven, strict=True):
            if not all(by_track.values()):  # such as a friction without a racing line
                study.tell(trial, state=optuna.trial.TrialState.FAIL)
                continue
            laps = {track: one["bayesrace"] for track, one in by_track.items()}
            shares = [one.time_s / self._default[track].time_s for track, one in laps.items()]
            more = sum(
                one.off_track - self._default[track].off_track for track, one in laps.items()
            )
            trial.set_constraint("off track", float(more))
            study.tell(trial, sum(shares) / len(shares))

    def judge(self, tuned: CarParameters) -> tuple[Judgement, ...]:
        """The held-out tracks, driven by the defaults and by the tuned car, each trained anew."""
        tracks = self._settings.held_out
        default, found = self._drive([self._settings.car, tuned], tracks, "")
        return tuple(
            Judgement(track, controller, own, _sound(found[track])[controller])
            for track in tracks
            for controller, own in _sound(default[track]).items()
        )

    def _drive(
        self, cars: Sequence[CarParameters], tracks: Sequence[str], weights: str
    ) -> list[dict[str, dict[str, Driven]]]:
        """For each car: track → controller → its laps; all at once on the workers.

        A track on which something failed has no controllers.
        """
        both: tuple[Controller, ...] = ("bayesrace", "bayesrace-updated")
        who = both[:1] if weights else both
        cases = [
            [Case(RaceSettings(car=car, track=one, laps=_LAPS), who, weights) for one in tracks]
            for car in cars
        ]
        rows: dict[str, list[Row]] = {}
        every = {case.key: case for some in cases for case in some}
        for batch in computed(self._client, every.items(), self._files):
            rows |= dict(batch)
        return [
            {case.settings.track: _driven(rows[case.key], who) for case in some} for some in cases
        ]


def _proposal(trial: optuna.Trial, car: CarParameters) -> dict[str, Any]:
    low, high, step = _FRICTION
    values: dict[str, Any] = {
        name: trial.suggest_float(name, *span, log=True) for name, span in _SPANS.items()
    }
    values["friction"] = trial.suggest_float("friction", low, high, step=step)
    horizons = sorted({*_HORIZONS, car.tuning.objective.horizon})
    values["horizon"] = trial.suggest_categorical("horizon", horizons)
    return values


def _sound(laps: dict[str, Driven]) -> dict[str, Driven]:
    """The same; InputError if there are none."""
    if not laps:
        raise InputError(
            "a run failed that the search compares with: 'bayesrace race' on the same tracks says "
            "why; leave that track out"
        )
    return laps


def _driven(rows: Sequence[Row], controllers: Sequence[Controller]) -> dict[str, Driven]:
    """The laps of each controller; none of any if a run failed."""
    if any(row["ended"] == FAILED for row in rows):
        return {}
    found: dict[str, Driven] = {}
    for controller in controllers:
        own = [row for row in rows if row["controller"] == controller]
        finished = [row["lap_time_s"] for row in own if row["lap_time_s"] is not None]
        late_s = own[0]["simulated_s"] if len(finished) < _LAPS else 0.0
        found[controller] = Driven(
            (sum(finished) + late_s) / _LAPS,
            sum(
                row["off_track_samples"] if row["lap_time_s"] is not None else row["samples"]
                for row in own
            ),
        )
    return found


def print_verdict(verdict: Verdict, console: Console) -> None:
    """What was found, a row for each held-out track and controller, and who wins."""
    found = ", ".join(f"{name} {value:g}" for name, value in verdict.found.items())
    console.print(Text(f"best: {found}"))
    console.print(
        Text(f"on the tuning tracks {100 * verdict.gain:+.2f} % faster than the defaults")
    )
    table = plain_table(
        "held-out track", "controller", "default\ns", "tuned\ns", "faster\n%", "default\noff",
        "tuned\noff", left=2,
    )  # fmt: skip
    for one in verdict.judged:
        share = 100 * (1 - one.tuned.time_s / one.default.time_s)
        table.add_row(
            one.track, one.controller, f"{one.default.time_s:.3f}", f"{one.tuned.time_s:.3f}",
            f"{share:+.2f}", str(one.default.off_track), str(one.tuned.off_track),
        )  # fmt: skip
    console.print(table)
    console.print(
        Text("s: mean of standing and flying lap; off: samples off the track", style="dim")
    )
    before, after = verdict.off_track
    found = f"{100 * verdict.held_out_gain:+.2f} % faster, samples off track {before} → {after}"
    winner = "the tuned car wins" if verdict.wins else "the defaults win"
    console.print(Text(f"held-out tracks: {found}: {winner}"))
