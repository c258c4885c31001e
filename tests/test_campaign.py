"""Campaigns on workers: the same rows whatever becomes of them, never computed twice, reported.

All drive a few laps of the shortest track. Packages of the extra ``campaign`` are imported within
tests, because ``make test`` imports this module without them.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from bayesrace.gp.weights import GpWeights, write_weights
from tests.command_line import Cli, refused
from tests.programs import Race, finish, peanut, run, start, until

pytestmark = [pytest.mark.check, pytest.mark.unmeasured]

PLAN = """
controllers = ["bayesrace"]
weights = "weights.bin"
[grid]
track = "peanut.csv"
laps = 2
mpc.margin_m = [0.005, 0.01, 0.015]
true_grip = [0.95, 1.0]
"""
CASES, LAPS = 6, 12
FAILING = """
controllers = ["worstcase", "bayesrace"]
weights = "weights.bin"
[grid]
track = "peanut.csv"
raceline.margin_m = [0.02, 0.5, 0.6]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, weights: GpWeights) -> Path:
    """Plan, track and weights."""
    path = tmp_path_factory.mktemp("campaign")
    peanut(path / "peanut.csv")
    write_weights(path / "weights.bin", weights)
    (path / "plan.toml").write_text(PLAN)
    return path


@pytest.fixture(scope="module")
def whole(folder: Path) -> Path:
    """The campaign computed by one worker, without a disturbance."""
    done = run("campaign", folder / "plan.toml", "--out", folder / "whole", "--workers", "1")
    assert done.returncode == 0, done.stderr
    assert f"{CASES} cases; computed now: {LAPS} laps" in done.stdout
    return folder / "whole"


def rows(folder: Path) -> list[dict[str, Any]]:
    """Of all columns that may not differ between machines and times, in one order."""
    from studies.campaign.results import MEASURED, read_results

    table = read_results(folder).drop_columns(list(MEASURED))
    return sorted(table.to_pylist(), key=lambda row: (row["key"], row["controller"], row["lap"]))


def state(pid: int | str) -> list[str]:
    """State and parent of a process, as /proc has them; nothing of one that has ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return []
    return [] if fields[0] == "Z" else fields


def children(parent: int) -> list[int]:
    """Worker processes of a campaign."""
    found = [one.name for one in Path("/proc").glob("[0-9]*")]
    return [
        int(pid)
        for pid in found
        if state(pid)[1:2] == [str(parent)]
        and "spawn_main" in Path(f"/proc/{pid}/cmdline").read_text()
    ]


def parts(folder: Path) -> list[Path]:
    return list((folder / "parts").glob("[0-9]*.parquet"))


def test_three_workers_compute_the_same_bits_and_nothing_twice(folder: Path, whole: Path) -> None:
    out = folder / "three"
    assert run("campaign", folder / "plan.toml", "--out", out, "--workers", "3").returncode == 0
    assert len(rows(whole)) == LAPS
    assert rows(out) == rows(whole)
    assert not parts(out)
    before = (out / "laps.parquet").read_bytes()
    again = run("campaign", folder / "plan.toml", "--out", out)
    assert f"{CASES} of {CASES} cases are there already" in again.stdout
    assert (out / "laps.parquet").read_bytes() == before


def test_a_killed_worker_loses_no_row(folder: Path, whole: Path) -> None:
    out = folder / "worker"
    campaign = start("campaign", folder / "plan.toml", "--out", out, "--workers", "2")
    until(lambda: parts(out), "a first row")
    os.kill(children(campaign.pid)[0], signal.SIGKILL)
    done = finish(campaign)
    assert done.returncode == 0, done.stderr
    assert rows(out) == rows(whole)


def test_a_killed_campaign_leaves_no_process_and_goes_on(folder: Path, whole: Path) -> None:
    out = folder / "killed"
    campaign = start("campaign", folder / "plan.toml", "--out", out, "--workers", "1")
    until(lambda: parts(out), "a first row")
    workers = children(campaign.pid)
    campaign.kill()
    finish(campaign)
    until(lambda: not any(map(state, workers)), "the workers' end")
    kept = rows(out)
    assert kept
    done = run("campaign", folder / "plan.toml", "--out", out)
    assert done.returncode == 0, done.stderr
    cases = len({row["key"] for row in kept})
    assert f"{cases} of {CASES} cases are there already" in done.stdout or not cases
    assert rows(out) == rows(whole)


def test_ctrl_c_keeps_what_is_there_and_a_second_writer_is_refused(
    folder: Path, whole: Path
) -> None:
    out = folder / "interrupted"
    campaign = start("campaign", folder / "plan.toml", "--out", out, "--workers", "1")
    until(lambda: parts(out), "a first row")
    second = run("campaign", folder / "plan.toml", "--out", out)
    assert second.returncode == 2
    assert "another campaign writes into" in second.stderr
    campaign.send_signal(signal.SIGINT)
    done = finish(campaign)
    assert done.returncode == 130
    assert done.stderr.strip() == "bayesrace: interrupted"
    kept = rows(out)
    assert 0 < len(kept) < LAPS
    assert all(row in rows(whole) for row in kept)


@contextmanager
def scheduler(folder: Path) -> Iterator[str]:
    """A Dask scheduler of its own."""
    file = folder / "scheduler.json"
    command = [str(Path(sys.executable).with_name("dask")), "scheduler", "--host", "127.0.0.1"]
    options = ["--port", "0", "--no-dashboard", "--scheduler-file", str(file)]
    process = subprocess.Popen(
        [*command, *options], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        until(file.exists, "the scheduler's address")
        time.sleep(0.2)
        yield file.read_text().split('"address": "')[1].split('"')[0]
    finally:
        process.terminate()
        process.wait()


def test_workers_elsewhere_compute_for_a_scheduler(folder: Path, whole: Path) -> None:
    out = folder / "elsewhere"
    with scheduler(folder) as address:
        worker = start("campaign-worker", address, "--workers", "2")
        done = run("campaign", folder / "plan.toml", "--out", out, "--scheduler", address)
        assert done.returncode == 0, done.stderr
    assert finish(worker).returncode == 0
    assert rows(out) == rows(whole)


def test_a_failed_case_says_why_and_is_computed_again_when_asked(folder: Path) -> None:
    (folder / "failing.toml").write_text(FAILING)
    out = folder / "failing"
    done = run("campaign", folder / "failing.toml", "--out", out, "--workers", "1")
    assert done.returncode == 0, done.stderr
    assert "3 cases" in done.stdout
    assert "2 failed" in done.stdout
    before = rows(out)
    failed = [row for row in before if row["ended"] == "failed"]
    assert [row["controller"] for row in failed] == ["bayesrace", "worstcase"] * 2
    assert all("margin" in row["reason"] for row in failed)
    page = (out / "report.html").read_text()
    assert "2 × worstcase" in page
    assert page.count("RaceLine") + page.count("InputError") == 1
    once_more = run("campaign", folder / "failing.toml", "--out", out, "--workers", "1", "--again")
    assert "1 of 3 cases are there already" in once_more.stdout
    assert "2 failed" in once_more.stdout
    assert rows(out) == before


def test_the_report_is_made_of_the_parquet_files(whole: Path, cli: Cli) -> None:
    page = whole / "report.html"
    text = page.read_text()
    page.unlink()
    assert cli("campaign-report", whole).out.strip() == str(page)
    assert page.read_text() == text
    for word in ("mpc.margin_m", "true_grip", "BayesRace", "95 % interval"):
        assert word in text
    assert text.count("<svg") == 2 * 2 + 2
    refused(cli("campaign-report", whole.parent), "holds no results", "bayesrace campaign")


def test_a_case_whose_workers_die_is_a_failed_row_and_reported(tmp_path: Path) -> None:
    from distributed.scheduler import KilledWorker

    from operation.settings import RaceSettings
    from studies.campaign.case import Case
    from studies.campaign.cluster import CampaignError, rows_of
    from studies.campaign.page import render_campaign
    from studies.campaign.results import writing

    class Lost:
        status = "error"

        def __init__(self, error: Exception) -> None:
            self.exception = lambda: error

    killed = rows_of(Lost(KilledWorker("case", None, 6)), None)
    assert [row["ended"] for row in killed] == ["failed"]
    with writing(tmp_path) as results:
        results.add([Case(RaceSettings()).columns | row for row in killed])
    assert "each worker that computed this case has died" in render_campaign(tmp_path).read_text()
    with pytest.raises(CampaignError, match="No module named 'plant'"):
        rows_of(Lost(ModuleNotFoundError("No module named 'plant'")), None)


def test_rows_are_those_of_a_race_over_zenoh(folder: Path, tmp_path: Path) -> None:
    track = folder / "peanut.csv"
    race: Callable[[], Race] = Race.running(
        tmp_path / "race", "--track", track, "--train-track", track
    )
    result = race().result
    text = '[grid]\ntrack = "peanut.csv"\ntrain_track = "peanut.csv"\n'
    (folder / "race.toml").write_text(text)
    done = run("campaign", folder / "race.toml", "--out", tmp_path / "out", "--workers", "1")
    assert done.returncode == 0, done.stderr
    found = rows(tmp_path / "out")
    for lap in result["laps"]:
        own = [row for row in found if row["controller"] == lap["controller"]]
        assert [row["lap_time_s"] for row in own if row["lap_time_s"]] == lap["lap_times_s"]
        assert {row["trajectory_sha256"] for row in own} == {lap["trajectory_sha256"]}
        assert {row["weights"] for row in own} == {lap["weights_version"]}
        counted = [row for row in own if row["lap_time_s"]] or own
        assert sum(row["off_track_samples"] for row in counted) == lap["off_track_samples"]


def test_a_scheduler_that_is_not_there_is_named(folder: Path, cli: Cli) -> None:
    options = ("--out", folder / "none", "--scheduler", "tcp://127.0.0.1:1")
    refused(cli("campaign", folder / "plan.toml", *options), "tcp://127.0.0.1:1", "dask scheduler")
