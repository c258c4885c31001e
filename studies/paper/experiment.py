"""A car with everything that its drives need, and its laps; results that are kept; a published
result beside ours, and what a stated criterion says of the two."""

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from bayesrace.cache import cache_folder, cpu_identity, digest, kept, software
from bayesrace.columns import LogColumns
from bayesrace.controller.assembly import compiled_controller
from bayesrace.controller.process_settings import ControllerSettings
from bayesrace.errors import InputError
from bayesrace.files import read_text
from bayesrace.learning.dataset import Dataset
from bayesrace.learning.sources import dataset_from_columns
from bayesrace.log import LogWriter
from bayesrace.messages import TELEMETRY
from bayesrace.operation.analysis.race import DrivenRun
from bayesrace.operation.analysis.recording import RUN_COLUMNS, runs_of
from bayesrace.operation.closed_loop import ClosedLoop, built_in_car
from bayesrace.operation.preparation import PredictionModel, prepare, updated_weights
from bayesrace.operation.settings import RaceSettings
from bayesrace.operation.terminal.terminal import Stages
from bayesrace.raceline import RaceLine
from bayesrace.studies.campaign.case import software_identity

__all__ = [
    "ELSEWHERE", "GP", "LAPS_OFF", "LAPS_ON", "SOURCE", "Experiment", "Figures", "Finding",
    "Section", "at_most", "stored",
]  # fmt: skip

# Published: its code run again on its ETHZ track (standing start at 0.1 m/s, 50 Hz, horizon 20),
# and its data evaluated again.

SOURCE: Final = (
    "A. Jain, M. O'Kelly, P. Chaudhari, M. Morari: BayesRace: Learning to race autonomously using "
    "prior experience. Conference on Robot Learning, 2020"
)


class _Lap(NamedTuple):
    """From standstill on ETHZ; None where no lap was finished."""

    time_s: float | None
    off_samples: int | None


LAPS_ON: Final = {  # track constraints on
    "worstcase": _Lap(None, None),
    "bayesrace": _Lap(7.988, 9),
    "bayesrace-updated": _Lap(7.932, 11),
    "bestcase": _Lap(7.797, 12),
}
LAPS_OFF: Final = {  # … and off
    "worstcase": _Lap(8.694, 24),
    "bayesrace": _Lap(7.792, 17),
    "bayesrace-updated": _Lap(7.692, 17),
    "bestcase": _Lap(7.681, 14),
}
GP: Final = {  # RMSE without the GP, RMSE and R² before, RMSE and R² after the update
    "vx": (0.0570, 0.00555, 0.932, 0.00065, 0.999),
    "vy": (0.0519, 0.0219, 0.820, 0.00039, 0.9999),
    "omega": (0.384, 0.176, 0.790, 0.142, 0.864),
}

_COLUMNS: Final = {**RUN_COLUMNS, TELEMETRY: f"{RUN_COLUMNS[TELEMETRY]} plan_x plan_u"}


class Experiment:
    """One car on one track: training drive, weights, and laps from standstill."""

    def __init__(
        self, settings: RaceSettings, stages: Stages,
        models: Sequence[PredictionModel] = ("e_kinematic", "dynamic"),
    ) -> None:  # fmt: skip
        """``models``: that laps are predicted by. Raises as
        :func:`~bayesrace.operation.preparation.prepare`."""
        self.settings, self.car = settings, settings.driven_car
        prepared = prepare(settings, (settings.track,), stages, models, settings.line)
        if prepared.training is None:
            raise RuntimeError("without given weights there is a training drive")
        self.track, self._line = prepared.first.track, prepared.first.line
        self.train_track = prepared.training.driven_on.track
        self.training = prepared.training.samples
        self.weights, self._artefacts = prepared.weights, prepared.artefacts
        self._vehicle = built_in_car(self.car)

    def drive(
        self, controller: str, weights: Path | None = None, constraints: bool = True,
        speed: float = 1.0, line: RaceLine | None = None,
    ) -> DrivenRun:  # fmt: skip
        """A lap from standstill, or up to where the car is farther off than the track is wide.

        ``line``: the prepared one without. ``speed``: share of its speed that is planned.
        """
        line = line or self._line
        line = replace(line, vx_mps=speed * line.vx_mps)
        artefact = self._artefacts[controller == "bestcase"]
        mpc = self.settings.mpc.model_copy(update={"constraints": constraints})
        law = compiled_controller(artefact, self.car, self.track, line, weights, mpc)
        with TemporaryDirectory() as folder:
            path = Path(folder) / "lap.mcap"
            log = LogWriter(path)
            # As published, every state is believed.
            process = ControllerSettings(car=self.car, sensor_tolerance=0)
            loop = ClosedLoop(self.car, self.track, line, law, self._vehicle, log, process)
            loop.drive(1, name=controller)
            log.close()
            record = runs_of(LogColumns(path, _COLUMNS).read())[1]
        run = DrivenRun(record, self.track, line)
        width_m = float(np.max(self.track.width_left_m + self.track.width_right_m))
        lost = np.flatnonzero(run.on_track.off_track_m > width_m)
        if not len(lost):
            return run
        return DrivenRun(replace(record, truth=record.truth[: lost[0] + 1]), self.track, line)

    def samples(self, run: DrivenRun) -> Dataset:
        """What can be learned from a lap."""
        record, step_s = run.record, self.settings.discretisation.step_s
        return dataset_from_columns(record.states, record.telemetry, self.car, step_s)

    def updated(self, lap: DrivenRun) -> Path:
        """Learned from training drive and lap, beginning with the weights before."""
        samples = [self.training, self.samples(lap)]
        return updated_weights(samples, self.settings, self.weights)[0]


def stored(name: str, parts: Iterable[str], make: Callable[[], Any]) -> Any:
    """What ``make`` returned for these parts, this software and this machine, as JSON."""
    sources = ("studies/paper/models.py", "studies/bench.py", "studies/settings.py")
    own = software(sources, ())
    key = digest((*parts, *own, software_identity(), cpu_identity()))

    def read(path: Path) -> Any:
        try:
            return json.loads(read_text(path, "a kept result"))
        except ValueError as error:
            raise InputError(f"{path}: {error}") from error

    def write(path: Path) -> None:
        path.write_text(json.dumps(make()))

    return kept(cache_folder() / f"{name}-{key}.json", write, read)


# Findings ----------------------------------------------------------------------------------------

ELSEWHERE: Final = "another track than the paper's, see --tracks"
"""Why a lap is not compared."""


class Finding(NamedTuple):
    """One published number or statement and its counterpart here.

    ``criterion``: a clause; the two agree if it ``holds`` (None: there is nothing to compare, and
    ``reason`` says why). ``reason``: why they differ, should they.
    """

    what: str
    published: str
    ours: str
    criterion: str
    holds: bool | None
    reason: str = ""

    @property
    def verdict(self) -> str:
        """In one word or two."""
        return {True: "agrees", False: "differs", None: "not compared"}[self.holds]

    @property
    def sentence(self) -> str:
        """The verdict with its criterion, and the reason of a difference."""
        if self.holds is None:
            return f"Not compared: {self.reason}."
        if self.holds:
            return f"Agrees: {self.criterion}."
        because = f"; {self.reason}" if self.reason else ""
        return f"Differs: it does not hold that {self.criterion}{because}."


def at_most(
    what: str, published: float, ours: float | None, unit: str = "", reason: str = "",
    comparable: bool = True,
) -> Finding:  # fmt: skip
    """Of a number of which less is better; None for ours: there is none."""
    form = ".3f" if unit == "s" else ".3g"
    left = f"{published:{form}} {unit}".strip()
    right = "none" if ours is None else f"{ours:{form}} {unit}".strip()
    if not comparable:
        return Finding(what, left, right, "", None, ELSEWHERE)
    holds = ours is not None and bool(ours <= published)
    return Finding(what, left, right, "ours is at most the published one", holds, reason)


Figures = dict[str, Figure]
"""By file name without suffix."""


class Section(NamedTuple):
    """Figures and findings of one part of the paper, its ``place``; ``text``: what is shown."""

    title: str
    place: str
    text: str
    figures: Figures
    findings: Sequence[Finding]
