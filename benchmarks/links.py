"""Racing speed over bad links, in simulated time: delay x jitter x loss, by TCP and by UDP.

    python -m benchmarks.links [--track harbour] [--seeds 3] [--picture FILE]

Two laps by learned weights, for each link and seed; the worst seed counts. The loops of plant and
controller run on a simulated clock and network (``operation/simulation``), so nothing depends on
the machine. Each link is driven without a jitter buffer, and with one whose delay the controller
knows (``--delay``), as docs/results/links.md advises: by UDP twice the delay, the jitter and 5 ms;
by TCP with losses four times the delay more, after which it sends again.
"""

import io
import logging
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from rich.console import Console

from bayesrace.controller.assembly import compiled_controller
from bayesrace.controller.process_settings import ControllerSettings
from bayesrace.controller.settings import MpcSettings
from bayesrace.log import LogWriter
from bayesrace.operation.analysis.laps import laps_in
from bayesrace.operation.preparation import Prepared, prepare
from bayesrace.operation.report.style import figure_style, write_png
from bayesrace.operation.run_plan import RunPlan
from bayesrace.operation.settings import PreparationSettings
from bayesrace.operation.simulation import SimulatedSystem
from bayesrace.operation.terminal.terminal import Stages
from bayesrace.plant.process_settings import PlantSettings
from bayesrace.transport.relay import AGAIN, Link
from benchmarks.harness import Row, arguments, report

_DELAYS_MS = (0, 5, 10, 20, 30, 40, 60)
_JITTERS_MS = (0, 5, 10, 20)
_LOSSES = (0.0, 0.01, 0.05)
_SUBSTEP_MS = 1
"""An input acts from the next one on."""
_LAPS = 2
_LIMIT_S = 40.0


class Case(NamedTuple):
    """One link each way."""

    track: str
    ordered: bool
    buffered: bool
    loss: float
    delay_ms: float
    jitter_ms: float
    seed: int

    @property
    def link(self) -> Link:
        """As the simulation takes it."""
        return Link(1e-3 * self.delay_ms, 1e-3 * self.jitter_ms, self.loss, self.ordered)

    @property
    def buffer_ms(self) -> float:
        """As advised."""
        again = AGAIN if self.ordered and self.loss else 0
        return (2 + again) * self.delay_ms + self.jitter_ms + 5 if self.buffered else 0.0


class Driven(NamedTuple):
    """What became of it."""

    flying_s: float
    """NaN: the laps were not driven."""
    off: int
    deepest_mm: float


@cache
def prepared(track: str) -> Prepared:
    """Lines, weights and controllers, from the cache."""
    return prepare(PreparationSettings(), (track,), Stages(Console(file=io.StringIO()), None))


def drive(case: Case) -> Driven:
    """Two laps over that link."""
    logging.disable(logging.WARNING)
    made, settings = prepared(case.track), PreparationSettings()
    place = made.first

    def make() -> Any:
        files = made.artefacts[0], settings.car, place.track, place.line, made.weights
        return compiled_controller(*files, MpcSettings())

    plant = PlantSettings(car=settings.car, buffer_s=1e-3 * case.buffer_ms)
    known = f"{case.buffer_ms + _SUBSTEP_MS}" if case.buffered else "measured"
    controller = ControllerSettings.model_validate({"car": settings.car, "compensation": known})
    with TemporaryDirectory() as folder:
        log = LogWriter(Path(folder) / "run.mcap")
        with SimulatedSystem(
            place.track, make, log, plant, controller, link=case.link, seed=case.seed
        ) as system:
            system.drive(RunPlan(1, "bayesrace", _LAPS, _LIMIT_S, lockstep=False))
        log.close()
        driven = laps_in(Path(folder) / "run.mcap", 1, place.track)
    laps_s, off_m = driven.laps.times_s, driven.off_track_m
    done = len(laps_s) == _LAPS
    return Driven(laps_s[-1] if done else np.nan, int((off_m > 0).sum()), 1e3 * float(off_m.max()))


def cases(track: str, seeds: int) -> Iterator[Case]:
    """All of them; without chance one seed is enough, and a jitter is no more than the delay."""
    grid = product((True, False), (False, True), _LOSSES, _DELAYS_MS, _JITTERS_MS)
    for ordered, buffered, loss, delay_ms, jitter_ms in grid:
        if jitter_ms <= delay_ms:
            for seed in range(seeds if loss or jitter_ms else 1):
                yield Case(track, ordered, buffered, loss, delay_ms, jitter_ms, seed)


def worst(found: dict[Case, Driven]) -> dict[Case, Driven]:
    """Of the seeds, under the first one."""
    links: dict[Case, list[Driven]] = {}
    for case, one in found.items():
        links.setdefault(case._replace(seed=0), []).append(one)
    return {
        case: Driven(
            float(np.max([one.flying_s for one in some])),  # NaN if one is
            max(one.off for one in some),
            max(one.deepest_mm for one in some),
        )
        for case, some in links.items()
    }


def picture(path: Path, found: dict[Case, Driven]) -> None:
    """A panel for each transport and loss; a cell for each delay and jitter."""
    best_s = min(one.flying_s for one in found.values())
    by_link = {case[1:]: one for case, one in found.items()}
    with figure_style():
        figure = Figure(figsize=(11.0, 8.6), layout="constrained")
        panels = figure.subplots(4, len(_LOSSES), sharex=True, sharey=True)
        for row, (ordered, buffered) in enumerate(product((True, False), (False, True))):
            for axes, loss in zip(panels[row], _LOSSES, strict=True):
                how = f"{'TCP' if ordered else 'UDP'}{', jitter buffer' if buffered else ''}"
                axes.set_title(f"{how}, {loss:.0%} lost", fontsize=9)
                axes.set_xticks(range(len(_DELAYS_MS)), map(str, _DELAYS_MS))
                axes.set_yticks(range(len(_JITTERS_MS)), map(str, _JITTERS_MS))
                axes.set_xlim(-0.5, len(_DELAYS_MS) - 0.5)
                axes.set_ylim(-0.5, len(_JITTERS_MS) - 0.5)
                for x, y in product(range(len(_DELAYS_MS)), range(len(_JITTERS_MS))):
                    link = ordered, buffered, loss, _DELAYS_MS[x], _JITTERS_MS[y], 0
                    if (one := by_link.get(link)) is not None:
                        _cell(axes, x, y, one, best_s)
        figure.supxlabel("delay each way [ms]", fontsize=9)
        figure.supylabel("jitter [ms]", fontsize=9)
        figure.suptitle(
            f"Flying lap lost to {best_s:.3f} s [%], and samples off the track; worst of the seeds",
            fontsize=10,
        )
        write_png(figure, path)


def _cell(axes: Any, x: int, y: int, one: Driven, best_s: float) -> None:
    """Green: on the track and within 1 %; yellow: on the track; red: off, or no lap."""
    lost = 100 * (one.flying_s / best_s - 1)
    done = np.isfinite(one.flying_s)
    colour = "#D55E00" if one.off or not done else "#009E73" if lost <= 1 else "#F0E442"
    axes.add_patch(
        Rectangle((x - 0.48, y - 0.48), 0.96, 0.96, color=colour, alpha=0.55, linewidth=0)
    )
    text = f"{lost:.1f}" if done else "–"
    axes.text(x, y, text + (f"\n{one.off} off" if one.off else ""), ha="center", va="center",
              fontsize=6.5)  # fmt: skip


def rows(found: dict[Case, Driven]) -> list[Row]:
    """One for each link."""
    return [
        {
            "what": f"{'TCP' if case.ordered else 'UDP'} {case.delay_ms:g} ± {case.jitter_ms:g} ms "
            f"{case.loss:.0%} lost {'buffered' if case.buffered else 'bare'}",
            "flying lap [s]": one.flying_s if np.isfinite(one.flying_s) else -1.0,
            "samples off": one.off, "deepest [mm]": one.deepest_mm,
        }
        for case, one in found.items()
    ]  # fmt: skip


def main() -> None:
    """Drives all, and writes the picture."""
    options = arguments(__doc__, track="harbour", seeds=3, picture="links.png")
    prepared(options.track)  # once, for all processes
    every = list(cases(options.track, options.seeds))
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        found = worst(dict(zip(every, pool.map(drive, every), strict=True)))
    picture(Path(options.picture), found)
    report(options, f"{options.track}, flying lap of {_LAPS}", rows(found))


if __name__ == "__main__":
    main()
