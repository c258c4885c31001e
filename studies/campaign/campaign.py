"""Runs a campaign to its end: hands out what is not computed yet, keeps what comes back."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from distributed import Client
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from bayesrace.files import write_whole
from bayesrace.interrupts import raise_if_interrupted
from bayesrace.vehicles import write_car
from studies.campaign.case import Case, car_identity
from studies.campaign.cluster import computed, connected
from studies.campaign.execute import FAILED, Row
from studies.campaign.plan import Campaign
from studies.campaign.results import Results, writing

__all__ = ["CARS", "PLAN", "Outcome", "run_campaign"]

PLAN: Final = "plan.toml"
CARS: Final = "cars"

_LINE_S: Final = 10.0
"""Between two lines of progress where there is no terminal."""


@dataclass
class Outcome:
    """What this process has computed of a campaign."""

    cases: int = 0
    laps: int = 0
    failed: int = 0
    simulated_s: float = 0.0

    def add(self, rows: Sequence[Row]) -> None:
        """All rows of one case."""
        self.cases += 1
        self.laps += sum(row.get("lap_time_s") is not None for row in rows)
        self.failed += any(row["ended"] == FAILED for row in rows)
        self.simulated_s += sum(row["simulated_s"] for row in rows if row.get("lap") == 1)

    def __str__(self) -> str:
        return f"{self.laps} laps" + (f", {self.failed} failed" if self.failed else "")


def run_campaign(
    campaign: Campaign,
    out: Path,
    console: Console,
    scheduler: str | None = None,
    workers: int = 0,
    again: bool = False,
) -> Outcome:
    """Computes the cases that ``out`` has no results of; ``again``: those that failed, too.

    Raises InputError if there is no scheduler, CampaignError if the workers are lost, and
    KeyboardInterrupt on Ctrl-C; what was computed is kept in every case.
    """
    with writing(out) as results:
        write_whole(out / PLAN, campaign.text)
        (out / CARS).mkdir(exist_ok=True)
        for car in campaign.cars:
            write_car(out / CARS / f"{car_identity(car)}.toml", car)
        done = results.done(again)
        # By key, and so in no order: neighbours rarely wait for the same line or weights.
        left = {key: case for key, case in sorted(campaign.cases.items()) if key not in done}
        if known := len(campaign.cases) - len(left):
            console.print(f"{known} of {len(campaign.cases)} cases are there already")
        if not left:
            return Outcome()
        with connected(scheduler, workers) as client:
            console.print(f"live: {client.dashboard_link}", highlight=False, soft_wrap=True)
            with _Shown(console, len(left)) as shown:
                return _compute(left, campaign, results, client, shown)


def _compute(
    left: dict[str, Case], campaign: Campaign, results: Results, client: Client, shown: "_Shown"
) -> Outcome:
    outcome = Outcome()
    for batch in computed(client, left.items(), campaign.files):
        rows: list[Row] = []
        for key, own in batch:
            about = left[key].columns
            rows += [about | row for row in own]
            outcome.add(own)
        results.add(rows)
        shown.update(outcome)
        raise_if_interrupted()
    return outcome


class _Shown:
    """Progress with its estimated end: a bar on a terminal, elsewhere a line now and then."""

    def __init__(self, console: Console, total: int) -> None:
        self._console, self._total = console, total
        self._begun = self._line = time.monotonic()
        self._bar: Progress | None = None
        self._task = TaskID(0)
        if console.is_terminal:
            self._bar = Progress(
                BarColumn(bar_width=24),
                MofNCompleteColumn(),
                TimeElapsedColumn(),
                TextColumn("[dim]left"),
                TimeRemainingColumn(),
                TextColumn("[dim]{task.fields[note]}"),
                console=console,
                speed_estimate_period=300,
            )
            self._task = self._bar.add_task("", total=total, note="")

    def __enter__(self) -> "_Shown":
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def update(self, outcome: Outcome) -> None:
        """Shows how far the campaign has come."""
        now = time.monotonic()
        if self._bar is not None:
            self._bar.update(self._task, completed=outcome.cases, note=str(outcome))
        elif now > self._line + _LINE_S or outcome.cases == self._total:
            self._line = now
            left_s = (now - self._begun) * (self._total / outcome.cases - 1)
            text = f"{outcome.cases} of {self._total} cases, {outcome}, {left_s:.0f} s left"
            self._console.print(text, highlight=False)
