"""The report: figures and tables put into the template, and the files beside the page."""

import platform
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from matplotlib.figure import Figure
from pydantic import ValidationError

from bayesrace.files import write_whole
from bayesrace.manifest import Manifest
from bayesrace.operation.analysis.race import DrivenRun, RaceAnalysis, read_race
from bayesrace.operation.analysis.results import RaceResult, write_result
from bayesrace.operation.report.gp import gp_figures
from bayesrace.operation.report.maps import LapMaps
from bayesrace.operation.report.runs import coverage_figures, solve_figure
from bayesrace.operation.report.style import figure_style, inline_svg, look, png
from bayesrace.operation.report.traces import (
    caution_figures,
    cornering_figures,
    deviation_figures,
    input_figures,
    speed_figures,
    time_figures,
)
from bayesrace.operation.terminal.notation import UNCERTAIN
from bayesrace.operation.terminal.race_table import COLUMNS, GP_COLUMNS, drive_text, gp_cells
from bayesrace.processes import raise_if_interrupted

__all__ = ["PICTURE", "REPORT", "RESULT", "template", "write_report"]

RESULT: Final = "result.json"
REPORT: Final = "report.html"
PICTURE: Final = "lap.png"

_TEMPLATE: Final = "report.html.j2"
_PACKAGES: Final = ("bayesrace", "casadi", "numpy", "scipy", "eclipse-zenoh")


def write_report(run_dir: Path, analysis: RaceAnalysis | None = None) -> Path:
    """Writes ``result.json``, ``lap.png`` and ``report.html`` into the run directory; returns the
    page's path.

    ``analysis`` saves reading the log a second time. Nothing is written before everything has been
    computed and drawn: an earlier report stays as it is otherwise. InputError if it is no run
    directory.
    """
    run_dir = Path(run_dir)
    analysis = analysis or read_race(run_dir)
    with figure_style():
        figures = _svg(_panels(analysis, analysis.result))
        maps, picture = _maps(analysis)
        figures |= _svg(maps)
    page = _page(run_dir, analysis, figures)
    raise_if_interrupted()
    write_result(run_dir / RESULT, analysis.result)
    write_whole(run_dir / PICTURE, picture)
    write_whole(run_dir / REPORT, page)
    return run_dir / REPORT


def _page(run_dir: Path, analysis: RaceAnalysis, figures: Mapping[str, Sequence[str]]) -> str:
    result = analysis.result
    return template(_TEMPLATE).render(
        result=result,
        columns=COLUMNS,
        gp_columns=GP_COLUMNS,
        gp_cells=gp_cells,
        drive_text=drive_text,
        look=look,
        best=result.lap("bestcase"),
        facts=_facts(analysis, result),
        versions=_versions(run_dir),
        figures=figures,
        uncertain=_uncertain(analysis),
        period_us=round(analysis.recording.settings.discretisation.step_s * 1e6),
        limit_sigma=UNCERTAIN,
        caution=analysis.recording.settings.mpc.caution,
        title=f"{result.settings.track} · {analysis.track.length_m:.2f} m",
    )


def template(name: str, folder: Path | None = None) -> Template:
    """The template of a page, in this folder or another one; it can include the style."""
    here = Path(__file__).parent
    environment = Environment(
        loader=FileSystemLoader([folder or here, here]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(name)


def _facts(analysis: RaceAnalysis, result: RaceResult) -> list[tuple[str, str]]:
    summary, line = result.settings, analysis.line
    started_ns = analysis.recording.started_ns
    facts = [
        ("driven", "–" if started_ns is None else _calendar(started_ns)),
        ("car", f"{summary.car}, simulated by {summary.fmu}" if summary.fmu else summary.car),
        ("trained on", summary.train_track),
        ("mode", summary.mode),
        ("seed", str(summary.seed)),
        ("track constraints", "on" if summary.constraints else "off"),
        ("racing line, flying", f"{line.lap_time_s:.3f} s"),
        ("judged by", result.judged_by),
        *((f"fastest possible, {kind}", f"{time:.3f} s") for kind, time in result.limit_s.items()),
    ]
    if result.real_time_factor is not None:
        facts.append(("lockstep at", f"{result.real_time_factor:.1f} × real time"))
    return facts


def _calendar(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns * 1e-9, tz=UTC).strftime("%Y-%m-%d %H:%M UTC")


def _versions(run_dir: Path) -> list[tuple[str, str]]:
    found = [("Python", platform.python_version())]
    for package in _PACKAGES:
        try:
            found.append((package, version(package)))
        except PackageNotFoundError:  # run from a checkout that is not installed
            continue
    return found + _compilers(run_dir)


def _compilers(run_dir: Path) -> list[tuple[str, str]]:
    """What built the controllers, by those of the run's manifests that this program can read."""
    found = []
    for path in sorted(run_dir.glob("manifest*.json")):
        with suppress(OSError, ValidationError):
            one = Manifest.model_validate_json(path.read_bytes())
            found.append(
                (f"{one.problem.name}, {one.model} step", f"{one.build_hash[:12]}, {one.compiler}")
            )
    return found


def _uncertain(analysis: RaceAnalysis) -> list[tuple[str, int, int]]:
    """(name of the controller, samples with a large sigma, all samples) for each GP."""
    return [
        (look(controller).name, int(validation.uncertain(UNCERTAIN).sum()), len(validation.sigma))
        for controller, validation in analysis.validations.items()
    ]


def _maps(analysis: RaceAnalysis) -> tuple[dict[str, list[Figure]], bytes]:
    """Laps on the track and the training drive, as panels, and the picture of the laps as PNG."""
    driven = _driven(analysis)
    maps = LapMaps(driven, analysis.track, analysis.line)
    picture = png(maps.picture())
    figures = {"laps": maps.figures()}
    if (found := analysis.recording.training) is not None and analysis.training is not None:
        training = LapMaps([analysis.training], found.track, found.line)
        figures["training"] = [*training.figures(), *coverage_figures(analysis.training, driven)]
    return figures, picture


def _panels(analysis: RaceAnalysis, result: RaceResult) -> dict[str, list[Figure]]:
    """What is drawn over the track's length, and the execution times; what has nothing to show is
    left out."""
    driven, track, line = _driven(analysis), analysis.track, analysis.line
    figures: dict[str, list[Figure]] = {}
    if driven:
        figures["time"] = time_figures(driven, track)
        figures["speed"] = speed_figures(driven, track, line)
        figures["inputs"] = input_figures(driven, track, analysis.recording.settings.car)
        figures["cornering"] = cornering_figures(driven, track, result.settings.friction)
        figures["deviation"] = deviation_figures(driven, track)
        figures["caution"] = caution_figures(driven, track)
    data = analysis.best_case
    if data is not None and analysis.validations:
        progress = track.project_path(data.x[:, :2]).progress_m
        figures["gp"] = gp_figures(analysis.validations, progress, track.length_m)
    if any(len(run.record.telemetry) for run in driven):
        figures["solve"] = [solve_figure(driven)]
    return figures


def _driven(analysis: RaceAnalysis) -> list[DrivenRun]:
    return [run for run in analysis.runs if len(run.record.truth) > 1]


def _svg(figures: Mapping[str, Sequence[Figure]]) -> dict[str, list[str]]:
    return {name: [inline_svg(one) for one in some] for name, some in figures.items() if some}
