"""What a run of scenarios leaves: a page with a row each, and their numbers as JSON."""

from collections.abc import Sequence
from pathlib import Path

from pydantic import TypeAdapter

from bayesrace.files import write_whole
from bayesrace.operation.report.render import template
from bayesrace.studies.evidence.scenario.run import Result, verdict_of

__all__ = ["write_report"]


def write_report(results: Sequence[Result], out: Path) -> Path:
    """Writes ``scenarios.json`` and ``report.html``; returns the page's path."""
    out.mkdir(parents=True, exist_ok=True)
    write_whole(
        out / "scenarios.json", TypeAdapter(list[Result]).dump_json(list(results), indent=1)
    )
    page = template("scenario.html.j2", Path(__file__).parent).render(
        results=results, verdict=verdict_of(results)
    )
    write_whole(out / "report.html", page)
    return out / "report.html"
