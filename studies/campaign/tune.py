"""Searches for weights of the OCP, margin, line friction and horizon by which a car laps faster.

Each trial drives the tuning tracks with weights of the Gaussian processes that are learned once;
Optuna proposes what to try next, in batches, so that the result depends on the seed and not on how
many workers there are. Tracks that no trial has seen judge the best one: there the whole race is
driven, training included, by the defaults and by what was found.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import optuna
import pandas as pd
from distributed import Client
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution
from optuna.trial import TrialState
from rich.console import Console
from rich.text import Text

from bayesrace.errors import InputError
from bayesrace.operation.preparation import prepare
from bayesrace.operation.settings import RaceSettings
from bayesrace.operation.terminal.terminal import Stages, plain_table
from bayesrace.studies.campaign.campaign import computed
from bayesrace.studies.campaign.case import FAILED, Case, Controller, Files, Row
from bayesrace.studies.campaign.cluster import Remote, connected
from bayesrace.studies.settings import TuneSettings
from bayesrace.vehicles import Car, write_car

__all__ = ["Verdict", "print_verdict", "tune"]

_SPANS: Final = {
    "r_duty": (0.1, 10.0), "r_delta_rate": (0.1, 10.0), "s_slack": (0.3, 30.0),
    "margin_m": (0.25, 4.0),
}  # fmt: skip
"""As multiples of the car's own; the weight of the position stays, for only ratios matter."""
_FRICTION: Final = FloatDistribution(0.8, 1.2, step=0.025)
"""As a multiple: each value costs a racing line for each track."""
_HORIZONS: Final = (12, 16, 20, 25, 30)

_LAPS: Final = 2
_RUN: Final = ["track", "controller"]
_NUMBERS: Final = ["lap_time_s", "simulated_s", "samples", "off_track_samples"]


class Verdict(NamedTuple):
    """What the search has come to."""

    found: dict[str, float]  # settings of the best trial, resolved
    gain: float  # lap time won over the defaults on the tuning tracks, a share
    judged: pd.DataFrame
    """A row for each held-out ``track`` and ``controller``: ``time_s`` and samples ``off`` the
    track by the defaults, ``time_s_tuned`` and ``off_tuned`` by what was found."""


def tune(
    settings: TuneSettings,
    out: Path,
    file: Path,
    stages: Stages,
    remote: Remote | None,
    workers: int,
) -> Verdict:
    """Searches, judges, and writes the car with what was found to ``out``.

    ``file``: SQLite of the study; a study that is there goes on. ``remote``: the scheduler. Raises
    InputError for tracks that are in both sets, or where a run of the defaults fails.
    """
    if both := sorted({*settings.track} & {*settings.held_out}):
        raise InputError(f"{both[0]} is to tune and to judge on; leave it in one of the two")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    first = RaceSettings(car=settings.car, track=settings.track[0])
    prepared = prepare(first, (first.track,), stages)
    files = Files()
    weights = files.add(prepared.weights, "the weights")
    with connected(remote, workers) as client:
        with stages.stage("tune") as stage:
            study, default = _study(settings, file), None
            while (known := _finished(study)) < settings.trials:
                stage.update(known / settings.trials, f"{known} trials")
                drives = client, files, settings.track, weights
                default = _sound(_driven([settings.car], *drives)) if default is None else default
                count = min(settings.batch, settings.trials - known)
                trials = [study.ask(_space(settings.car)) for _ in range(count)]
                cars = [tuned_car(settings.car, one.params) for one in trials]
                both = _driven(cars, *drives).merge(default, on=_RUN, suffixes=("", "_default"))
                for number, trial in enumerate(trials):
                    own = both[both.car == number]
                    if own.time_s.isna().any():  # such as a friction without a racing line
                        study.tell(trial, state=TrialState.FAIL)
                        continue
                    trial.set_constraint("off track", float((own.off - own.off_default).sum()))
                    study.tell(trial, float((own.time_s / own.time_s_default).mean()))
        best = study.best_trial  # the defaults are feasible, so there is one
        tuned = tuned_car(settings.car, best.params)
        with stages.stage("judge on held-out tracks"):
            both = _sound(_driven([settings.car, tuned], client, files, settings.held_out, ""))
    write_car(out, tuned)
    judged = both[both.car == 0].merge(both[both.car == 1], on=_RUN, suffixes=("", "_tuned"))
    objective = tuned.tuning.objective.model_dump(exclude={"q_position"})
    return Verdict({**objective, "friction": tuned.friction}, 1 - (best.value or 1.0), judged)


def _study(settings: TuneSettings, storage: Path) -> optuna.Study:
    """The study in a file, or a new one, whose first trial is the defaults."""
    url = f"sqlite:///{storage}"
    study = optuna.create_study(study_name="tune", storage=url, load_if_exists=True)
    identity = settings.model_dump_json(exclude={"trials"})
    if study.user_attrs.setdefault("settings", identity) != identity:
        remedy = "of another car, other tracks or another seed; name a new file"
        raise InputError(f"{storage} is the study {remedy}")
    if not study.trials:
        study.set_user_attr("settings", identity)
        own = settings.car.tuning.objective.horizon
        study.enqueue_trial({**dict.fromkeys([*_SPANS, "friction"], 1.0), "horizon": own})
    for trial in study.get_trials(states=(TrialState.RUNNING,)):  # of a killed search
        study.tell(trial.number, state=TrialState.FAIL)
    # Proposals after an interruption must not repeat the first ones.
    study.sampler = optuna.samplers.TPESampler(
        seed=settings.seed + _finished(study), multivariate=True
    )
    return study


def _finished(study: optuna.Study) -> int:
    return sum(trial.state.is_finished() for trial in study.get_trials(deepcopy=False))


def _space(car: Car) -> dict[str, BaseDistribution]:
    """What a trial may propose."""
    spans = {name: FloatDistribution(*span, log=True) for name, span in _SPANS.items()}
    horizons = CategoricalDistribution(sorted({*_HORIZONS, car.tuning.objective.horizon}))
    return {**spans, "friction": _FRICTION, "horizon": horizons}


def tuned_car(car: Car, params: Mapping[str, Any]) -> Car:
    """The car with what a trial proposes, in multiples of its own values."""
    own = car.tuning.objective
    changed = {name: float(f"{params[name] * getattr(own, name):.4g}") for name in _SPANS}
    objective = own.model_copy(update={**changed, "horizon": int(params["horizon"])})
    tuning = car.tuning.model_copy(update={"objective": objective})
    friction = float(f"{params['friction'] * car.friction:.4g}")
    return car.model_copy(update={"friction": friction, "tuning": tuning})


def _driven(
    cars: Sequence[Car], client: Client, files: Files, tracks: Sequence[str], weights: str
) -> pd.DataFrame:
    """A row for each ``car`` by its number, ``track`` and ``controller``.

    ``time_s``: mean of standing and flying lap, with the run's time for what was not finished.
    ``off``: samples off the track, and all of a lap that was not finished. Neither is a number
    where a run of the case failed.
    """
    both: tuple[Controller, ...] = ("bayesrace", "bayesrace-updated")
    who = both[:1] if weights else both
    cases = {
        (number, track): Case(RaceSettings(car=car, track=track, laps=_LAPS), who, weights)
        for number, car in enumerate(cars)
        for track in tracks
    }
    rows: dict[str, list[Row]] = {}
    for batch in computed(client, {one.key: one for one in cases.values()}.items(), files):
        rows |= dict(batch)
    laps = pd.DataFrame(
        [{"car": n, "track": t} | row for (n, t), one in cases.items() for row in rows[one.key]],
        columns=["car", *_RUN, "ended", *_NUMBERS],
    ).astype(dict.fromkeys(_NUMBERS, float))
    failed = laps.ended.eq(FAILED).groupby([laps.car, laps.track]).transform("any")
    laps["off"] = laps.off_track_samples.where(laps.lap_time_s.notna(), laps.samples)
    runs = laps[~failed].groupby(["car", *_RUN])
    late_s = runs.simulated_s.first().where(runs.lap_time_s.count() < _LAPS, 0.0)
    time_s = (runs.lap_time_s.sum() + late_s) / _LAPS
    every = pd.MultiIndex.from_product([range(len(cars)), tracks, who], names=["car", *_RUN])
    return pd.DataFrame({"time_s": time_s, "off": runs.off.sum()}).reindex(every).reset_index()


def _sound(driven: pd.DataFrame) -> pd.DataFrame:
    """The same; InputError if a run failed."""
    if driven.time_s.isna().any():
        remedy = "'bayesrace race' on the same tracks says why; leave that track out"
        raise InputError(f"a run failed that the search compares with: {remedy}")
    return driven


def print_verdict(verdict: Verdict, console: Console) -> None:
    """What was found, a row for each held-out track and controller, and who wins: what is faster
    on these tracks, and off them no more than the defaults."""
    found = ", ".join(f"{name} {value:g}" for name, value in verdict.found.items())
    gain = f"on the tuning tracks {100 * verdict.gain:+.2f} % faster than the defaults"
    console.print(Text(f"best: {found}\n{gain}"))
    table = plain_table(
        "held-out track", "controller", "default\ns", "tuned\ns", "faster\n%", "default\noff",
        "tuned\noff", left=2,
    )  # fmt: skip
    judged = verdict.judged.assign(gain=1 - verdict.judged.time_s_tuned / verdict.judged.time_s)
    for one in judged.itertuples():
        table.add_row(
            one.track, one.controller, f"{one.time_s:.3f}", f"{one.time_s_tuned:.3f}",
            f"{100 * one.gain:+.2f}", f"{one.off:.0f}", f"{one.off_tuned:.0f}",
        )  # fmt: skip
    console.print(table)
    legend = "s: mean of standing and flying lap; off: samples off the track"
    console.print(Text(legend, style="dim"))
    gain, before, after = judged.gain.mean(), judged.off.sum(), judged.off_tuned.sum()
    winner = "the tuned car wins" if gain > 0 and after <= before else "the defaults win"
    found = f"{100 * gain:+.2f} % faster, samples off track {before:.0f} → {after:.0f}"
    console.print(Text(f"held-out tracks: {found}: {winner}"))
