"""The report: figures and tables put into the template, and the files beside the page."""

import platform
from collections.abc import Iterator, Mapping, Sequence
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
from bayesrace.operation.analysis.race import RaceAnalysis, read_race
from bayesrace.operation.analysis.results import RaceResult, write_result
from bayesrace.operation.look import look
from bayesrace.operation.report.coverage import coverage_figures
from bayesrace.operation.report.gp import gp_figures
from bayesrace.operation.report.maps import lap_map
from bayesrace.operation.report.panels import cornering_figure, solve_figure
from bayesrace.operation.report.style import figure_style, inline_svg
from bayesrace.operation.terminal import UNCERTAIN
from bayesrace.operation.terminal.tables import COLUMNS, GP_COLUMNS, drive_text, gp_cells
from bayesrace.operation.view.errors import StepErrors
from bayesrace.operation.view.page import page_part
from bayesrace.operation.view.sources import Source, all_updates
from bayesrace.processes import raise_if_interrupted

__all__ = ["REPORT", "RESULT", "template", "write_report"]

RESULT: Final = "result.json"
REPORT: Final = "report.html"

_TEMPLATE: Final = "report.html.j2"
_PACKAGES: Final = ("bayesrace", "casadi", "numpy", "scipy", "eclipse-zenoh")


def write_report(run_dir: Path, analysis: RaceAnalysis | None = None) -> Path:
    """Writes ``result.json`` and ``report.html`` into the run directory; returns the page's path.

    ``analysis`` saves computing it a second time. Nothing is written before everything has been
    computed and drawn: an earlier report stays as it is otherwise. InputError if it is no run
    directory.
    """
    run_dir = Path(run_dir)
    analysis = analysis or read_race(run_dir)
    with figure_style():
        drawn = {name: [inline_svg(one) for one in some] for name, some in _figures(analysis)}
    page = _page(run_dir, analysis, {name: some for name, some in drawn.items() if some})
    raise_if_interrupted()
    write_result(run_dir / RESULT, analysis.result)
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
        period_us=_period_us(analysis),
        limit_sigma=UNCERTAIN,
        title=f"{result.settings.track} · {analysis.track.length_m:.2f} m",
        view=_view(run_dir, analysis),
    )


def _view(run_dir: Path, analysis: RaceAnalysis) -> str:
    """The laps over the track, to go through; empty if none was driven."""
    car, title = analysis.recording.settings.car, analysis.track.name
    errors = StepErrors(run_dir, car)
    source = Source(run_dir / "run.mcap", analysis.track, analysis.line, car, title, errors)
    source.read_all()
    updates = all_updates(source)
    return page_part(updates, embedded=True) if len(updates) > 1 else ""


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
        with suppress(PackageNotFoundError):  # run from a checkout that is not installed
            found.append((package, version(package)))
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


def _figures(analysis: RaceAnalysis) -> Iterator[tuple[str, list[Figure]]]:
    """The figures of each section of the page."""
    runs = [run for run in analysis.runs if len(run.record.truth) > 1]
    recording, track, line = analysis.recording, analysis.track, analysis.line
    if runs:
        yield "cornering", [cornering_figure(runs, track, analysis.result.settings.friction)]
    data = analysis.best_case
    if data is not None and analysis.validations:
        progress = track.project_path(data.x[:, :2]).progress_m
        yield "gp", gp_figures(analysis.validations, progress, track.length_m)
    drives = [analysis.training, *analysis.practices.values()]
    driven = zip(drives, [recording.training, *recording.practices], strict=True)
    maps = [lap_map(run, on.track, on.line) for run, on in driven if run and on]
    if analysis.coverage is not None:
        maps += coverage_figures(analysis.coverage, track, line)
    if maps:
        yield "training", maps
    if any(len(run.record.telemetry) for run in runs):
        yield "solve", [solve_figure(runs, _period_us(analysis))]


def _period_us(analysis: RaceAnalysis) -> int:
    return round(analysis.recording.settings.discretisation.step_s * 1e6)
