"""What is asked for, all sections in order, and the page."""

import json
from collections import Counter
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Final

from bayesrace.files import write_whole
from bayesrace.integrators import PREDICTION
from bayesrace.learning.sources import dataset_from_npz
from bayesrace.operation.preparation import training_settings
from bayesrace.operation.report.render import template
from bayesrace.operation.report.style import figure_style, inline_svg, write_pdf
from bayesrace.operation.settings import PreparationSettings
from bayesrace.operation.terminal.terminal import Stages
from bayesrace.raceline import write_raceline
from bayesrace.studies.bench import BenchResult, run_bench
from bayesrace.studies.paper.experiment import SOURCE, Experiment, Finding, Section, stored
from bayesrace.studies.paper.loop import line_section, loop_sections, published_line, tenth_section
from bayesrace.studies.paper.models import (
    Learned,
    kernel_section,
    learned,
    learning_sections,
    model_section,
    smoothness,
)
from bayesrace.studies.settings import LINE, BenchSettings, PaperSettings

__all__ = ["make_paper"]

_SAMPLES: Final = 400
"""Of each published drive, as the paper uses them."""
_PAPER_MS: Final = 260.0, 100.0
"""Published solve time, mean and standard deviation."""
_PAGE: Final = "paper.html"
_FIGURES: Final = "figures"


def make_paper(settings: PaperSettings, out: Path, stages: Stages) -> tuple[Path, list[Section]]:
    """Writes the page into the folder; its path, and what is on it.

    Raises InputError for missing files, and as :func:`~bayesrace.operation.preparation.prepare`.
    """
    orca, tenth, drives = settings.orca, settings.tenth, settings.drives
    out.mkdir(parents=True, exist_ok=True)
    one = Experiment(orca, stages)
    weights = {"bayesrace": one.weights, "worstcase": None, "bestcase": None}
    with stages.stage("drive the laps"):
        pairs = product(weights, (True, False))
        laps = {pair: one.drive(pair[0], weights[pair[0]], pair[1]) for pair in pairs}
    with stages.stage("update the residual, drive again"):
        after, updated = one.updated(laps["bayesrace", True]), "bayesrace-updated"
        laps |= {(updated, on): one.drive(updated, after, on) for on in (True, False)}
    published = []
    if settings.line is not None:
        with stages.stage("drive the published racing line"):
            line = published_line(settings.line, one.track, one.car)
            write_raceline(out / LINE, line)
            published = [line_section(one, line, laps)]
    tracks, test = (one.train_track, one.track), one.samples(laps["bestcase", True])
    every = [Learned("our", one.training, test, tracks, (one.weights, after))]
    if drives:
        arrays = [dataset_from_npz(path, one.car, PREDICTION.step_s) for path in drives]
        own = training_settings(orca).model_copy(update={"capacity": 2 * _SAMPLES})
        shown = (None, None) if settings.tracks is None else tracks
        every.append(learned([x.select(slice(_SAMPLES)) for x in arrays], own, shown, stages))
    points, seeds, problems, peers = (100, 2, 60, 3) if settings.quick else (320, 5, 300, 15)
    smooth = []
    for data in every:
        with stages.stage(f"smoothness of the kernel, {data.name} data") as stage:
            smooth.append(smoothness(*data[:3], points, seeds, stage))
    prepared = orca.model_dump(include=set(PreparationSettings.model_fields))
    asked = {"tracks": (orca.track,), "published": True, "problems": problems, "peers": peers}
    bench = BenchSettings.model_validate(prepared | asked)
    with stages.stage("solve times"):
        key = bench.model_dump_json()
        solved = stored("bench", [key], lambda: run_bench(bench, stages).model_dump())
    small = Experiment(tenth, stages, ("e_kinematic",))
    with figure_style(), stages.stage("figures and page"):
        sections = [
            model_section(one.car),
            *learning_sections(every),
            *loop_sections(laps, one),
            *published,
            kernel_section(smooth, points),
            tenth_section(small),
            _solving(BenchResult.model_validate(solved)),
        ]
        how = f"{'quick' if settings.quick else 'in full'}, seed {settings.seed}"
        facts = {"tracks": f"{one.train_track.name}, {one.track.name}", "how": how}
        facts |= {"racing line": settings.raceline.name} if settings.raceline else {}
        return _write(out, sections, facts), sections


def _solving(result: BenchResult) -> Section:
    """The paper's solver there and here, and the compiled step."""
    (mean, spread), peer, step = _PAPER_MS, result.ipopt, result.published.us
    ipopt = peer.us
    text = (
        f"One step of the GP-MPC with {result.gp_points} points per GP, by bayesrace bench on this "
        f"machine: {result.problems} steps of a drive, of which IPOPT solves {peer.peers}. The "
        "paper's machine is a 2.9 GHz dual-core Core i5."
    )
    paper, what = f"{mean:.0f} ± {spread:.0f} ms", "the paper's formulation in CasADi and IPOPT"
    ours = f"{ipopt.p50 / 1e3:.0f} ms at the median, at most {ipopt.max / 1e3:.0f} ms"
    near, reason = "our median is within the published deviation", "the machine is another one"
    fast = f"{peer.speedup_p50:.0f} times as fast: p50 {step.p50:.0f}, p99 {step.p99:.0f} µs"
    ten = "the compiled step is at least ten times as fast"
    expected = "an order of magnitude is expected of FORCES PRO"
    findings = [
        Finding(what, paper, ours, near, abs(ipopt.p50 / 1e3 - mean) <= spread, reason),
        Finding("a faster solver", expected, fast, ten, peer.speedup_p50 >= 10),
    ]
    return Section("Time to solve", "appendix B", text, {}, findings)


def _write(out: Path, sections: Sequence[Section], facts: dict[str, str]) -> Path:
    """Writes page, numbers and figures into the folder; returns the page's path."""
    folder = out / _FIGURES
    folder.mkdir(parents=True, exist_ok=True)
    drawn = {}
    for name, figure in (pair for section in sections for pair in section.figures.items()):
        drawn[name] = inline_svg(figure)
        write_whole(folder / f"{name}.svg", drawn[name])
        write_pdf(figure, folder / f"{name}.pdf")
    rows = [
        {"section": section.title, "verdict": one.verdict, **one._asdict()}
        for section in sections
        for one in section.findings
    ]
    write_whole(out / "numbers.json", json.dumps(rows, indent=1, ensure_ascii=False) + "\n")
    counts = Counter(row["verdict"] for row in rows)
    facts |= {verdict: f"{count} findings" for verdict, count in counts.most_common()}
    page = template(f"{_PAGE}.j2", Path(__file__).parent)
    shown = {"sections": sections, "drawn": drawn, "facts": facts, "folder": _FIGURES}
    write_whole(out / _PAGE, page.render(source=SOURCE, **shown))
    return out / _PAGE
