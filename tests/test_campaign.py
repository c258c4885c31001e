"""Campaigns on workers: the same rows whatever becomes of them, never computed twice, reported; and
``bayesrace tune``, which drives by the same workers.

All drive a few laps of the shortest track. Packages of the extra ``campaign`` are imported within
tests, because ``make test`` imports this module without them.
"""

import json
import os
import shutil
import signal
import stat
from pathlib import Path
from typing import Any

import pytest

from bayesrace.gp.weights import Weights, write_weights
from bayesrace.vehicles import default_car, read_car, write_car
from tests.command_line import Cli, refused
from tests.programs import Race, campaign_scheduler, finish, peanut, run, start, until
from tests.shared import session_folder

pytestmark = pytest.mark.check

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
MEASURED = ["step_p50_us", "step_p99_us", "step_max_us", "drive_s", "case_s", "host"]
FAILING = """
controllers = ["worstcase", "bayesrace"]
weights = "weights.bin"
[grid]
track = "peanut.csv"
raceline.margin_m = [0.02, 0.5, 0.6]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, weights: Weights) -> Path:
    """Plan, track and weights."""
    path = tmp_path_factory.mktemp("campaign")
    peanut(path / "peanut.csv")
    write_weights(path / "weights.bin", weights)
    (path / "plan.toml").write_text(PLAN)
    return path


@pytest.fixture(scope="module")
def whole(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The campaign computed by one worker without a disturbance, once for all tests."""

    def make(shared: Path) -> None:
        out = shared / "whole"
        done = run("campaign", folder / "plan.toml", "--out", out, "--workers", "1")
        assert done.returncode == 0, done.stderr
        assert f"{CASES} cases; computed now: {LAPS} laps" in done.stdout

    return session_folder(tmp_path_factory, "campaign", make) / "whole"


def rows(folder: Path) -> list[dict[str, Any]]:
    """Of all columns that may not differ between machines and times, in one order."""
    from bayesrace.studies.campaign.results import read_results

    table = read_results(folder).drop_columns(MEASURED)
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


def test_three_workers_of_which_one_is_killed_compute_the_same_bits_and_nothing_twice(
    folder: Path, whole: Path, cli: Cli
) -> None:
    out = folder / "three"
    campaign = start("campaign", folder / "plan.toml", "--out", out, "--workers", "3")
    until(lambda: parts(out), "a first row")
    os.kill(children(campaign.pid)[0], signal.SIGKILL)
    done = finish(campaign)
    assert done.returncode == 0, done.stderr
    assert len(rows(whole)) == LAPS
    assert rows(out) == rows(whole)
    assert not parts(out)
    before = (out / "laps.parquet").read_bytes()
    again = cli("campaign", folder / "plan.toml", "--out", out)
    assert f"{CASES} of {CASES} cases are there already" in again.out
    assert (out / "laps.parquet").read_bytes() == before


def test_after_ctrl_c_and_a_kill_a_campaign_goes_on(folder: Path, whole: Path, cli: Cli) -> None:
    """What is computed is kept, no process is left, and a second writer is refused meanwhile."""
    out = folder / "interrupted"
    command = ("campaign", folder / "plan.toml", "--out", out, "--workers", "1")
    campaign = start(*command)
    until(lambda: parts(out), "a first row")
    refused(cli(*command), "another campaign writes into")
    campaign.send_signal(signal.SIGINT)
    done = finish(campaign)
    assert done.returncode == 130
    assert done.stderr.strip() == "bayesrace: interrupted"
    kept = rows(out)
    assert 0 < len(kept) < LAPS
    campaign = start(*command)
    until(lambda: parts(out), "one more row")
    workers = children(campaign.pid)
    campaign.kill()
    finish(campaign)
    until(lambda: not any(map(state, workers)), "the workers' end")
    assert len(rows(out)) > len(kept)
    kept = rows(out)
    done = run(*command)
    assert done.returncode == 0, done.stderr
    cases = len({row["key"] for row in kept})
    assert f"{cases} of {CASES} cases are there already" in done.stdout
    assert rows(out) == rows(whole)


def test_workers_elsewhere_compute_for_a_scheduler(
    folder: Path, whole: Path, cli: Cli, tmp_path: Path
) -> None:
    """All three have the key that the scheduler made; a campaign with another one is refused."""
    out = folder / "elsewhere"
    command = ("campaign", folder / "plan.toml", "--out", out)
    with campaign_scheduler(folder) as (address, key):
        assert stat.S_IMODE(key.stat().st_mode) == 0o600
        with campaign_scheduler(tmp_path) as (_, other):
            refused(cli(*command, "--scheduler", address, "--key", other), address, "the same key")
        worker = start("campaign-worker", address, "--key", key, "--workers", "2")
        done = run(*command, "--scheduler", address, "--key", key)
        assert done.returncode == 0, done.stderr
    assert finish(worker).returncode == 0
    assert rows(out) == rows(whole)


def test_a_failed_case_says_why_and_is_computed_again_when_asked(folder: Path, cli: Cli) -> None:
    (folder / "failing.toml").write_text(FAILING)
    out = folder / "failing"
    command = ("campaign", folder / "failing.toml", "--out", out, "--workers", "1")
    done = cli(*command)
    assert done.code == 0, done.err
    assert "3 cases" in done.out
    assert "2 failed" in done.out
    before = rows(out)
    failed = [row for row in before if row["ended"] == "failed"]
    assert [row["controller"] for row in failed] == ["bayesrace", "worstcase"] * 2
    assert all("margin" in row["reason"] for row in failed)
    page = (out / "report.html").read_text()
    assert "2 × worstcase" in page
    assert page.count("RaceLine") + page.count("InputError") == 1
    once_more = cli(*command, "--again")
    assert "1 of 3 cases are there already" in once_more.out
    assert "2 failed" in once_more.out
    assert rows(out) == before


def test_the_report_is_made_of_the_parquet_files(whole: Path, cli: Cli, tmp_path: Path) -> None:
    own = shutil.copytree(whole, tmp_path / "whole")
    page = own / "report.html"
    text = page.read_text()
    page.unlink()
    assert cli("campaign-report", own).out.strip() == str(page)
    assert page.read_text() == text
    for word in ("mpc.margin_m", "true_grip", "BayesRace", "95 % interval"):
        assert word in text
    assert text.count("<svg") == 2 * 2 + 2
    refused(cli("campaign-report", tmp_path), "holds no results", "bayesrace campaign")


def test_a_case_whose_workers_die_is_a_failed_row_and_reported(tmp_path: Path) -> None:
    from distributed.scheduler import KilledWorker

    from bayesrace.operation.settings import RaceSettings
    from bayesrace.studies.campaign.campaign import rows_of
    from bayesrace.studies.campaign.case import Case
    from bayesrace.studies.campaign.cluster import CampaignError
    from bayesrace.studies.campaign.report import render_campaign
    from bayesrace.studies.campaign.results import writing

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


def test_rows_are_those_of_a_race_over_zenoh(
    peanut_race: Race, peanut_track: Path, tmp_path: Path
) -> None:
    plan = tmp_path / "race.toml"
    from bayesrace.studies.campaign.case import CONTROLLERS

    controllers = f"controllers = {json.dumps(CONTROLLERS)}\n"
    tracks = f'[grid]\ntrack = "{peanut_track}"\ntrain_track = "{peanut_track}"\n'
    plan.write_text(f"{controllers}{tracks}progress_drives = 2\n")
    done = run("campaign", plan, "--out", tmp_path / "out", "--workers", "1")
    assert done.returncode == 0, done.stderr
    found = rows(tmp_path / "out")
    last = {lap["controller"]: lap for lap in peanut_race.result["laps"]}
    for lap in last.values():
        own = [row for row in found if row["controller"] == lap["controller"]]
        assert [row["lap_time_s"] for row in own if row["lap_time_s"]] == lap["lap_times_s"]
        assert {row["trajectory_sha256"] for row in own} == {lap["trajectory_sha256"]}
        assert {row["weights"] for row in own} == {lap["weights_version"]}
        counted = [row for row in own if row["lap_time_s"]] or own
        assert sum(row["off_track_samples"] for row in counted) == lap["off_track_samples"]


def test_a_scheduler_that_is_not_there_or_not_secured_is_named(folder: Path, cli: Cli) -> None:
    with campaign_scheduler(folder) as (address, key):
        taken = run("campaign-scheduler", "--key", key, "--listen", address)
    assert taken.returncode == 2
    assert taken.stderr.splitlines()[-1].startswith(f"bayesrace: cannot listen at {address}")
    command = ("campaign", folder / "plan.toml", "--out", folder / "none")
    gone = cli(*command, "--scheduler", address, "--key", key)
    refused(gone, address, "bayesrace campaign-scheduler")
    for plain in ("tcp://127.0.0.1:1", "127.0.0.1:1", "tls://127.0.0.1", "tls://127.0.0.1:99999"):
        refused(cli(*command, "--scheduler", plain, "--key", key), plain, "tls://HOST:8786")
        refused(cli("campaign-worker", plain, "--key", key), plain, "tls://HOST:8786")
        refused(cli("campaign-scheduler", "--listen", plain, "--key", key), plain, "tls://HOST")
    refused(cli(*command, "--scheduler", address), "--key", "campaign-scheduler")
    refused(cli(*command, "--key", key), "--scheduler")
    refused(cli("campaign-worker", address, "--key", folder / "no.pem"), "no.pem", "copy")
    other = folder / "other.pem"
    other.write_text("no key")
    other.chmod(0o600)
    refused(cli("campaign-worker", address, "--key", other), "other.pem holds no key", "copy")
    key.chmod(0o644)
    refused(cli("campaign-worker", address, "--key", key), "others can read", "chmod 600")


# Tuning ------------------------------------------------------------------------------------------


def test_a_study_finds_judges_writes_a_car_and_goes_on(tmp_path: Path) -> None:
    """On the shortest track, with a training drive of four seconds."""
    peanut(tmp_path / "peanut.csv")
    peanut(tmp_path / "other.csv")
    car = default_car()
    pursuit = car.tuning.pursuit.model_copy(update={"drive_s": 4.0})
    quick = car.model_copy(update={"tuning": car.tuning.model_copy(update={"pursuit": pursuit})})
    write_car(tmp_path / "quick.toml", quick)
    options = (
        "--car", tmp_path / "quick.toml", "--track", tmp_path / "peanut.csv",
        "--held-out", tmp_path / "other.csv", "--out", tmp_path / "tuned.toml",
        "--batch", "2", "--workers", "1",
    )  # fmt: skip
    done = run("tune", *options, "--trials", "1")
    assert done.returncode == 0, done.stderr
    assert read_car(tmp_path / "tuned.toml") == quick  # the first trial is the defaults
    assert "held-out tracks: +0.00 % faster" in done.stdout
    assert "the defaults win" in done.stdout
    done = run("tune", *options, "--trials", "3")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "tuned.sqlite").exists()
    tuned = read_car(tmp_path / "tuned.toml")
    assert tuned.identity == quick.identity  # weights fit both
    objective = tuned.tuning.objective
    assert objective.q_position == car.tuning.objective.q_position
    assert 0.8 * car.friction <= tuned.friction <= 1.2 * car.friction
    for name in ("r_duty", "margin_m", "horizon", "friction"):
        assert name in done.stdout
    assert "other" in done.stdout
    assert "held-out tracks: " in done.stdout


def test_a_track_cannot_tune_and_judge(cli: Cli) -> None:
    refused(cli("tune", "--track", "random:1..3", "--held-out", "random:3"), "random:3")
