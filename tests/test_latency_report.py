"""The latency report on the terminal, as JSON and as a picture."""

import io
import json
import random
from pathlib import Path
from typing import Any

import pytest
from hdrh.histogram import HdrHistogram
from rich.console import Console

from experiments.latency.histograms import distribution, new_histogram
from experiments.latency.legs import ANSWER, LEGS
from experiments.latency.plot import plot
from experiments.latency.report import print_report
from experiments.latency.results import (
    ClockResult,
    Clocks,
    LatencyResult,
    LegResult,
    Memory,
    Percentiles,
    Traffic,
)


def result() -> tuple[LatencyResult, dict[str, Any], dict[str, list[tuple[float, float]]]]:
    histograms, medians = {}, {}
    for number, leg in enumerate(LEGS):
        histogram, chance = new_histogram(), random.Random(number)
        for _ in range(500):
            histogram.record_value(int(chance.lognormvariate(10 + number / 3, 0.4)))
        histograms[leg.name] = histogram
        medians[leg.name] = [(float(k), 50.0 + number) for k in range(1, 6)]
    legs = {}
    for leg in LEGS:
        found = distribution(histograms[leg.name])
        assert found is not None
        margin = 137.0 if leg.clock == "both" else 0.0
        legs[leg.name] = LegResult(
            **found.model_dump(), clock=leg.clock, uncertainty_us=margin, min=1.0, below_zero=0
        )
    answer = legs[ANSWER].model_dump(include=set(Percentiles.model_fields))
    clock = ClockResult(
        host="pit", offset_us=0.0, uncertainty_us=60.0, drift_ppm=0.0,
        drift_uncertainty_ppm=None, exchanges=9, failed=0,
    )  # fmt: skip
    one = Traffic(sent=250, received=249, lost=1, in_flight=0, complete=True)
    other = Traffic(sent=250, received=245, lost=1, in_flight=4, complete=False)
    clocks = Clocks(
        shared=False, text="two clocks", uncertainty_us=137.0, plant=clock, controller=clock
    )
    made = LatencyResult(
        car="orca", track="harbour", rate_hz=50.0, duration_s=5.0, load=2, attached=True,
        started="2026-11-21T12:00:00", host="pit",
        state_to_actuation_us=Percentiles.model_validate(answer), legs_us=legs, ticks=250,
        skipped=0, deadline_misses=3, overruns=4, fallbacks=5, bare_loop_misses=1,
        bare_loop_us=None, mean_period_us=20_001.0, rate_error=5e-5, sent=500, received=494,
        lost=2, traffic={"states": one, "actuations": other}, rss_growth_bytes=4096,
        rss={"plant": Memory(begin_bytes=2**26, most_bytes=2**26 + 4096)}, repeated_answers=0,
        overtaken_answers=0, unobserved=0, restarts=0, laps=1, states=250, off_track_samples=6,
        clocks=clocks, notes=["ended early: the sun went down"],
    )  # fmt: skip
    return made, histograms, medians


def test_table_fits_a_terminal_of_80_columns_and_says_everything() -> None:
    made, _, _ = result()
    out = io.StringIO()
    print_report(made, Console(file=out, width=80))
    text = out.getvalue()
    assert all(leg.title in text for leg in LEGS)
    assert "…" not in text
    for words in (
        "3 deadlines missed (bare loop 1)", "250 sent = 249 received + 1 lost",
        "NOT ACCOUNTED FOR", "off track 6 of 250", "137", "two clocks", "the sun went down",
        "+0.0050%",
    ):  # fmt: skip
        assert words in " ".join(text.split()), words


def test_json_has_the_promised_names() -> None:
    content = json.loads(result()[0].model_dump_json())
    promised = {
        "state_to_actuation_us", "deadline_misses", "bare_loop_misses", "ticks", "sent",
        "received", "lost", "rss_growth_bytes",
    }  # fmt: skip
    assert promised <= set(content)
    assert set(content["state_to_actuation_us"]) == {"p50", "p90", "p99", "p999", "max"}


@pytest.mark.parametrize("measured", [True, False])
def test_picture_is_made_of_whatever_was_measured(tmp_path: Path, measured: bool) -> None:
    made, histograms, medians = result()
    bare: HdrHistogram | None = new_histogram() if measured else None
    if not measured:
        histograms, medians = {}, {}
    plot(tmp_path / "latency.png", made, histograms, medians, bare)
    assert (tmp_path / "latency.png").read_bytes().startswith(b"\x89PNG")
