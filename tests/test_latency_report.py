"""The latency report on the terminal, as JSON and as a picture."""

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from bayesrace.studies.latency.analysis import Analysis, Beside, analyse
from bayesrace.studies.latency.beside import bare_result
from bayesrace.studies.latency.legs import BESIDE, LEGS
from bayesrace.studies.latency.report import print_report, write_files
from bayesrace.studies.latency.results import Memory, Series
from bayesrace.studies.latency.settings import LatencySettings
from bayesrace.transport import Endpoints
from tests.synthetic_latency import PERIOD_NS, Loop


@pytest.fixture
def analysis(tmp_path: Path) -> Analysis:
    """A run with two clocks, a lost message and everything that can be measured."""
    with Loop(tmp_path / "run.mcap", state_seq=100_000) as system:
        for k in range(200):
            system.cycle()
            if k % 5 == 4:
                system.heartbeats(lost=5 if k > 100 else 0)
    settings = LatencySettings(
        log=tmp_path / "run.mcap",
        warm_up_s=0.0,
        track="",
        load=2,
        attach=Endpoints(connect=("tcp/pit:1",)),
    )
    late_ns = np.full(250, 80_000)
    late_ns[9] = PERIOD_NS + 1
    rss = {"plant": Memory(begin_bytes=2**26, most_bytes=2**26 + 4096)}
    bare = bare_result(late_ns, PERIOD_NS, [])
    passed = Series(np.linspace(0.0, 4.98, 250), np.full(250, 300_000.0))
    beside = Beside("pit", bare, passed, rss, ["ended early: the sun went down"])
    return analyse(tmp_path / "run.mcap", settings, None, beside)


def test_table_fits_a_terminal_of_80_columns_and_says_everything(analysis: Analysis) -> None:
    out = io.StringIO()
    changes = {"off_track_samples": 6, "deadline_misses": 3, "late_states": 2}
    result = analysis.result.model_copy(update=changes)
    print_report(result, Console(file=out, width=80))
    text = out.getvalue()
    assert all(title in text for title, _ in LEGS.values())
    assert "…" not in text
    for words in (
        "3 deadlines missed (bare loop 1)", "190 sent = 190 received + 0 lost",
        "185 received + 0 lost +5 NOT ACCOUNTED FOR", "off track 6 of 200", "± 500 us", "laps 1",
        "7.000100 s ahead of the plant's", "the sun went down", "+0.0000%", "attached", "load 2",
        "on this machine, pit", "4 kB on 64.0 MB", "0 repeated answers, 2 late states",
        *BESIDE.values(),
    ):  # fmt: skip
        assert words in " ".join(text.split()), words


@pytest.mark.parametrize("measured", [True, False])
def test_files_are_made_of_whatever_was_measured(
    analysis: Analysis, tmp_path: Path, measured: bool
) -> None:
    write_files(tmp_path, analysis if measured else replace(analysis, series={}))
    assert (tmp_path / "latency.png").read_bytes().startswith(b"\x89PNG")
    logs = {path.stem for path in tmp_path.glob("*.hlog")}
    assert logs == ({*LEGS, *BESIDE} if measured else set())
    content = json.loads((tmp_path / "latency.json").read_text())
    assert content == json.loads(analysis.result.model_dump_json())
    promised = {
        "state_to_actuation_us", "deadline_misses", "bare_loop_misses", "ticks", "sent",
        "received", "lost", "rss_growth_bytes", "repeated_answers", "late_states",
    }  # fmt: skip
    assert promised <= set(content)
    assert {"p50", "p90", "p99", "p999", "max"} <= set(content["state_to_actuation_us"])
