"""The page in the browser: what it is told of a log, over which links, and what it then shows."""

import json
import os
import re
import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from bayesrace.log import Entry, LogReader
from bayesrace.messages import STATE, Telemetry
from bayesrace.operation.analysis.race import read_race
from bayesrace.operation.doctor import probe
from bayesrace.operation.view import Runs, Source, Viewer, run_source, whole_page
from bayesrace.operation.view.network import AbsentError, NetworkSource, network_source
from bayesrace.operation.view.sources import all_updates, driven_race, race_logs
from bayesrace.tracks import load_track
from bayesrace.transport import Endpoints, free_endpoint, open_session
from bayesrace.vehicles import get_car, write_car
from tests.browser import Page, needs_browser, page
from tests.command_line import Cli, refused
from tests.fake_processes import Fakes, fakes, where
from tests.programs import PATIENCE_S, Race, start, until
from tests.synthetic_race import LAP_S, Drive, circle, write_race
from tests.test_analysis import TWO_LAPS
from tests.test_drive_command import LONG, course, ended, waiting
from tests.test_drive_command import Waiting as WaitingCar
from tests.test_foxglove_server import viewer as viewer_of_foxglove

__all__ = ["course", "ended", "fakes", "page", "waiting"]


def raced(path: Path, *drives: Drive, **how: Any) -> Path:
    """A race as a viewer reads it; without drives one of two laps by BestCase alone."""
    write_race(path, drives or [Drive("bestcase", circle(TWO_LAPS, 1.05))], **how)
    write_car(path / "car.toml", get_car("orca"))
    return path


def shown(path: Path, car: str = "") -> Source:
    source = run_source(path, car=car)
    source.read_all()
    return source


def entries(path: Path) -> list[Entry[Any]]:
    return list(LogReader(path).messages())


def test_rows_and_laps_are_those_of_the_analysis(peanut_race: Race) -> None:
    source = shown(peanut_race.out)
    told, analysed = list(source.runs.all_updates()), read_race(peanut_race.out).runs
    laps = [[time for _, _, time in one["laps"]] for one in told]
    for own, run in zip(laps, analysed, strict=True):
        np.testing.assert_allclose(own, run.laps.times_s, atol=1e-9)
    length_m = source.course()["length"]
    for one, run in zip(told, analysed, strict=True):
        rows, count = one["rows"], len(one["rows"]["t"])
        assert count == len(run.record.time_s)
        np.testing.assert_allclose(rows["t"], run.record.time_s, atol=1e-4)
        np.testing.assert_allclose(rows["x"], run.record.x[:, 0], atol=1e-4)
        np.testing.assert_allclose(rows["v"], run.record.x[:, 3], atol=1e-3)
        off = (np.array(rows["s"]) - run.on_track.progress_m + length_m / 2) % length_m
        np.testing.assert_allclose(off, length_m / 2, atol=1e-3)
        levels = [level for level in rows["level"] if level is not None]
        assert len(levels) >= count - 1  # the last state is not answered
        assert one["text"].startswith(f"run {run.record.plan.run} ended")
        assert len(one["plans"]) > 0.08 * count


def test_the_car_is_off_an_earlier_plan_by_less_where_the_model_is_right(peanut_race: Race) -> None:
    source = shown(peanut_race.out)
    errors = {
        one["label"]: np.median(np.abs([mm for mm in one["rows"]["error_mm"] if mm is not None]))
        for one in source.runs.updates({})
    }
    assert errors["WorstCase"] > 10 * errors["BayesRace"] > 0


def test_what_comes_piece_by_piece_and_out_of_order_is_the_same(peanut_race: Race) -> None:
    """A recorder hears plant and controller over links of their own."""
    all_of_it, source = entries(peanut_race.out / "run.mcap"), run_source(peanut_race.out)
    whole, pieces = Runs(source.track), Runs(source.track)
    whole.take(all_of_it, whole=True)
    rows: dict[str, list[Any]] = {}
    known: dict[str, tuple[int, int, int, str]] = {}
    shuffled = [
        one for at in range(0, len(all_of_it), 7)
        for one in sorted(all_of_it[at : at + 7], key=lambda entry: entry.key.endswith("state"))
    ]  # fmt: skip
    for at in range(0, len(shuffled), 50):
        pieces.take(shuffled[at : at + 50], whole=at + 50 >= len(shuffled))
        for one in pieces.updates(known):
            assert one["from"] == len(rows.setdefault(one["key"], []))
            rows[one["key"]] += zip(
                *(one["rows"][name] for name in ("t", "x", "level")), strict=True
            )
    expected = {
        one["key"]: list(zip(*(one["rows"][name] for name in ("t", "x", "level")), strict=True))
        for one in whole.updates({})
    }
    assert rows == expected
    assert pieces.updates(known) == []


def test_a_long_run_keeps_its_newest_rows_and_all_lap_times(
    peanut_race: Race, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = {one["key"]: one["laps"] for one in shown(peanut_race.out).runs.all_updates()}
    monkeypatch.setattr("bayesrace.operation.view.runs._MOST_ROWS", 100)
    source = run_source(peanut_race.out)
    all_of_it = entries(peanut_race.out / "run.mcap")
    for at in range(0, len(all_of_it), 100):
        source.runs.take(all_of_it[at : at + 100])
    source.runs.take((), whole=True)
    told = list(source.runs.all_updates())
    assert {one["key"]: one["laps"] for one in told} == whole
    assert all(one["from"] > 0 and 100 <= len(one["rows"]["t"]) <= 300 for one in told)


def test_a_shadow_is_not_taken_for_the_controller_that_drives(peanut_race: Race) -> None:
    all_of_it, source = entries(peanut_race.out / "run.mcap"), run_source(peanut_race.out)
    with_shadow = [
        found for one in all_of_it
        for found in (
            [one, replace(
                one, key="bayesrace/orca/shadow/other/telemetry",
                message=structs.replace(one.message, fallback=3),
            )] if isinstance(one.message, Telemetry) else [one]
        )
    ]  # fmt: skip
    alone, beside = Runs(source.track), Runs(source.track)
    alone.take(all_of_it, whole=True)
    beside.take(with_shadow, whole=True)
    assert len(with_shadow) > len(all_of_it)
    assert beside.updates({}) == alone.updates({})


def test_who_joins_in_mid_run_counts_laps_as_the_car_does(peanut_race: Race) -> None:
    """The lap that is being driven then has no time."""
    source = run_source(peanut_race.out)
    all_of_it = entries(peanut_race.out / "run.mcap")
    run = max(entry.message.run for entry in all_of_it if entry.key.endswith("/state"))
    own = [entry for entry in all_of_it if getattr(entry.message, "run", 0) == run]
    source.runs.take(own, whole=True)
    (whole,) = source.runs.all_updates()
    late = Runs(source.track, source.line)
    begin_s = 0.4 * whole["laps"][0][2]
    late.take(
        [one for one in own if getattr(one.message, "time_s", begin_s) >= begin_s], whole=True
    )
    (joined,) = late.all_updates()
    np.testing.assert_allclose(joined["laps"], whole["laps"][1:], atol=1e-6)
    assert joined["begun"] == pytest.approx(whole["begun"])
    missing = len(whole["rows"]["s"]) - len(joined["rows"]["s"])
    np.testing.assert_allclose(joined["rows"]["s"], whole["rows"]["s"][missing:], atol=1e-3)


def test_a_plan_of_a_single_row_and_no_telemetry_at_all_are_drawn(tmp_path: Path) -> None:
    some = entries(raced(tmp_path) / "run.mcap")
    bare = [one for one in some if not isinstance(one.message, Telemetry)]
    short = [
        replace(one, message=structs.replace(one.message, plan_x=(0.0,) * 7, plan_u=(), tube_m=()))
        if isinstance(one.message, Telemetry) else one
        for one in some
    ]  # fmt: skip
    for given in (bare, short):
        runs = Runs()
        runs.take(given, whole=True)
        (run,) = runs.all_updates()
        assert len(run["rows"]["x"]) > 100


def test_a_log_that_another_one_takes_the_place_of_is_noticed(tmp_path: Path) -> None:
    source = shown(raced(tmp_path / "a"))
    assert not source.replaced
    raced(tmp_path / "b")
    (tmp_path / "b" / "run.mcap").replace(tmp_path / "a" / "run.mcap")
    assert source.replaced


def test_a_car_that_is_gone_leaves_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bayesrace.operation.view.network._MOST_CARS", 1)
    with open_session(Endpoints()) as session, ExitStack() as stack:
        source = NetworkSource(stack, session, tmp_path, "", "", None, get_car("orca"))
        source.notice("one", "")
        source.notice("two", "")
        assert source.faults == {"two": "car 'two' is left out: no more than 1 are shown"}
        monkeypatch.setattr("bayesrace.operation.view.network._SILENT_S", 0.0)
        source.notice("two", "")
        assert (source.faults, list(source._readers)) == ({}, ["two"])


def test_a_log_that_another_one_is_written_over_is_noticed(tmp_path: Path) -> None:
    source = shown(raced(tmp_path))
    path = tmp_path / "run.mcap"
    path.write_bytes(path.read_bytes()[:5000])  # in place, as by 'drive --log'
    assert source.replaced


def test_of_logs_that_are_dated_ahead_none_is_the_newest(tmp_path: Path) -> None:
    """As of a machine whose clock was set back since."""
    for name, at_s in (("now", time.time()), ("ahead", time.time() + 1e6)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.mcap").write_bytes(b"")
        os.utime(tmp_path / name / "run.mcap", (at_s, at_s))
    assert [one.parent.name for one in race_logs(tmp_path)] == ["ahead", "now"]


def test_a_damaged_log_says_so(tmp_path: Path) -> None:
    path = raced(tmp_path) / "run.mcap"
    data = path.read_bytes()
    path.write_bytes(data[: 2 * len(data) // 3])
    told = all_updates(shown(tmp_path))
    assert [one["text"] for one in told if one["kind"] == "fault"] == [
        "the log is cut off or damaged: what could be read is shown"
    ]


def test_of_many_runs_the_newest_are_kept(tmp_path: Path) -> None:
    states = [
        entry for entry in entries(raced(tmp_path) / "run.mcap") if entry.key.endswith("state")
    ]
    runs, known = Runs(), dict[str, tuple[int, int, int, str]]()
    for number in range(60):
        some = [
            replace(one, message=structs.replace(one.message, run=number)) for one in states[:9]
        ]
        runs.take(some, whole=True)
        runs.updates(known)
    assert len(runs.updates({})) == len(runs._by_number) == 40


def test_a_message_names_all_runs_and_has_few_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A page finds the runs that its address names in the first one."""
    drives = [Drive(name, circle(TWO_LAPS, 1.05)) for name in ("bestcase", "worstcase")]
    runs, known = shown(raced(tmp_path, *drives)).runs, dict[str, tuple[int, int, int, str]]()
    whole = [len(one["rows"]["t"]) for one in runs.all_updates()]
    monkeypatch.setattr("bayesrace.operation.view.runs._ROWS_AT_ONCE", 40)
    counts = [0] * len(whole)
    while new := runs.updates(known):
        rows = [len(one["rows"]["t"]) for one in new]
        assert sum(rows) <= 40
        assert any(counts) or len(new) == len(whole)
        for one, more in zip(new, rows, strict=True):
            counts[list(known).index(one["key"])] += more
    assert counts == whole


def test_runs_of_several_cars_name_theirs(tmp_path: Path) -> None:
    one = entries(raced(tmp_path) / "run.mcap")
    other = [replace(entry, key=entry.key.replace("orca", "b")) for entry in one]
    runs, known = Runs(), dict[str, tuple[int, int, int, str]]()
    runs.take(one, whole=True)
    (first,) = runs.updates(known)
    assert (first["label"], runs.updates(known)) == ("BestCase", [])
    runs.take(other, whole=True)
    again, second = runs.updates(known)
    assert (again["label"], again["rows"]["t"]) == ("orca: BestCase", [])
    assert (second["label"], second["text"]) == ("b: BestCase", first["text"])
    assert again["colour"] == first["colour"] != second["colour"]


@pytest.fixture
def viewer(tmp_path: Path) -> Iterator[Viewer]:
    with Viewer(port=0) as viewer:
        viewer.show(shown(raced(tmp_path)))
        yield viewer


def updates_of(viewer: Viewer) -> str:
    return viewer.address.replace("http", "ws").replace("/?", "/updates?") + (
        "" if "?" in viewer.address else "updates"
    )


def test_a_page_is_told_everything_and_a_reconnected_one_again(viewer: Viewer) -> None:
    for _ in range(2):
        with connect(updates_of(viewer)) as link:
            told = json.loads(link.recv(10))
        assert [one["kind"] for one in told] == ["course", "run"]


def test_a_page_begins_anew_with_another_source(viewer: Viewer, tmp_path: Path) -> None:
    with connect(updates_of(viewer)) as link:
        link.recv(10)
        viewer.show(shown(raced(tmp_path / "b")))
        first = json.loads(link.recv(10))
        assert first[0]["title"] == "b"


def asked(viewer: Viewer, path: str = "/", **headers: str) -> tuple[int, str]:
    host, port = viewer.address.split("/")[2].split(":")
    link = HTTPConnection(host, int(port), timeout=10)
    link.request("GET", path, headers=headers)
    answer = link.getresponse()
    return answer.status, answer.read().decode()


def test_only_this_machine_and_no_other_site_is_answered(viewer: Viewer) -> None:
    status, page = asked(viewer)
    assert (status, "<canvas" in page) == (200, True)
    assert asked(viewer, "/etc/passwd")[0] == 404
    assert asked(viewer, Host="evil.example")[0] == 403  # a name that is made to lead here
    with pytest.raises(InvalidStatus):
        connect(updates_of(viewer), origin="http://evil.example")


def test_beyond_loopback_a_token_is_needed() -> None:
    with Viewer("0.0.0.0", 0) as viewer:  # noqa: S104
        token = viewer.address.partition("?token=")[2]
        assert len(token) > 16
        assert [asked(viewer, path)[0] for path in ("/", "/?token=x", f"/?token={token}")] == [
            403, 403, 200,
        ]  # fmt: skip
        with pytest.raises(InvalidStatus):
            connect(viewer.address.replace("http", "ws").partition("?")[0] + "updates")


def test_a_race_whose_log_grows_is_found(tmp_path: Path) -> None:
    assert driven_race(tmp_path) is None
    path = raced(tmp_path / "one")
    found = driven_race(tmp_path)
    assert found is not None
    assert (found.log, driven_race(tmp_path, found)) == (path / "run.mcap", None)
    old = time.time() - 10
    os.utime(path / "run.mcap", (old, old))
    assert driven_race(tmp_path) is None


def test_what_cannot_be_shown_is_named(cli: Cli, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    refused(cli("view"), "no run in", "bayesrace race")
    refused(cli("view", str(tmp_path / "none")), "none")
    refused(cli("view", str(tmp_path), "--live"), "--live", "contradict")
    refused(cli("view", "--live", "--track", "nowhere"), "no track 'nowhere'")
    refused(cli("view", "--name", "orca"), "--name is for --live")
    refused(cli("view", str(raced(tmp_path / "run2")), "--track", "harbour"), "of a race")
    with socket.create_server(("127.0.0.1", 0)) as busy:
        path = raced(tmp_path / "run")
        port = str(busy.getsockname()[1])
        refused(cli("view", str(path), "--port", port), port, "--port")


@needs_browser
@pytest.mark.parametrize(("width", "dark"), [(1400, False), (800, True), (400, False)])
def test_a_finished_run_is_one_file(
    peanut_race: Race, cli: Cli, tmp_path: Path, page: Page, width: int, dark: bool
) -> None:
    out = tmp_path / "page.html"
    assert cli("view", str(peanut_race.out), "--out", str(out)).code == 0
    assert out.stat().st_size < 3_000_000
    assert not re.search(r"""(src|href)\s*=\s*["'](?!#|data:)""", out.read_text())
    page.open(f"{out.as_uri()}#lap=0&t=1&run=2", width, dark=dark)
    page.until("document.querySelectorAll('.uplot').length >= 7")
    laps = [run.laps.times_s[0] for run in read_race(peanut_race.out).runs if run.finished]
    shown = page.value("el('runs').innerText")
    assert all(f"{lap:.3f}" in shown for lap in laps)
    assert page.value("document.documentElement.scrollWidth <= innerWidth")
    assert page.value("el('view').dataset.theme") == ("dark" if dark else "light")
    assert page.value("el('now').textContent") == "1.000 s"
    assert "BayesRace" in page.value("el('legend').textContent")
    page.picture(tmp_path / "page.png")
    assert page.errors == []


@needs_browser
def test_keys_links_and_lines_lead_through_a_run(
    peanut_race: Race, cli: Cli, tmp_path: Path, page: Page
) -> None:
    out = tmp_path / "page.html"
    cli("view", str(peanut_race.out), "--out", str(out))
    page.open(out.as_uri())
    page.until("document.querySelectorAll('.uplot').length >= 7")
    assert page.value("el('lap').value") == "fastest"
    page.press("ArrowDown")
    page.until("el('lap').value === '0'")
    page.press("1")
    page.until("shown().length === runs.size - 1")
    page.press("ArrowRight")
    page.until("choice.t > 0.09")
    page.until("location.hash.includes('t=0.1')")
    page.press(" ")
    page.until("choice.t > 0.3")
    page.press(" ")
    # A moment of a chart is one of the map: the pointer over a place shows all cars there.
    page.value(
        "(() => { const over = plots[1].chart.over, at = over.getBoundingClientRect();"
        "over.dispatchEvent(new MouseEvent('mousemove', {clientX: at.x + at.width / 2,"
        "clientY: at.y + 9, bubbles: true})) })()"
    )
    page.until("Math.abs(hover - 300) < 5")
    page.until("plots.every((one) => Math.abs(one.chart.cursor.idx - 300) < 5)")
    page.open(out.as_uri() + "#lap=0&t=2.5&off=1.2&ref=3")
    page.until("document.querySelectorAll('.uplot').length >= 7")
    assert page.value("[choice.t, choice.off.size, choice.lap]") == [2.5, 2, "0"]
    assert page.errors == []


@needs_browser
def test_texts_from_outside_are_texts(tmp_path: Path, page: Page) -> None:
    evil = (
        """x" style="position:fixed;inset:0" onmouseover="window.hit=1"><img src=x onerror=hit=1>"""
    )
    path = raced(tmp_path / "run", Drive(evil, circle(TWO_LAPS, 1.0), ended=evil))
    out = tmp_path / "page.html"
    out.write_text(whole_page(all_updates(shown(path))))
    page.open(out.as_uri())
    page.until("runs.size === 1 && el('runs').rows.length === 2")
    assert evil[:20] in page.value("el('runs').innerText")
    assert page.value("document.querySelectorAll('#view img, #view [onmouseover]').length") == 0
    assert page.errors == []


@needs_browser
def test_printed_it_has_few_pages(peanut_race: Race, cli: Cli, tmp_path: Path, page: Page) -> None:
    out = tmp_path / "page.html"
    cli("view", str(peanut_race.out), "--out", str(out))
    page.open(out.as_uri())
    page.until("document.querySelectorAll('.uplot').length >= 7")
    assert len(re.findall(rb"/Type\s*/Page\b", page.printed())) <= 6


@needs_browser
@pytest.mark.check
def test_a_car_in_the_network_is_seen_while_it_drives(
    waiting: WaitingCar, tmp_path: Path, page: Page
) -> None:
    view = start("view", "--live", *waiting.track, *waiting.where, "--port", "0", cwd=tmp_path)
    waiting.ended.append(view)
    assert view.stdout is not None
    address = view.stdout.readline().split()[0]
    page.open(address)
    drive = waiting.drive(tmp_path / "drive.mcap")
    until(lambda: LogReader(tmp_path / "drive.mcap").select(STATE), "the car drives")
    page.until("[...runs.values()].at(-1).rows.t.length > 0", 3.0 + 5.0)
    before = page.value("[...runs.values()].at(-1).rows.t.length")
    page.until(f"[...runs.values()].at(-1).rows.t.length > {before} + 20")
    assert page.value("course.length") > 0
    view.send_signal(signal.SIGINT)
    assert view.wait(20) == 130
    page.until("el('state').textContent.startsWith('connection lost')")
    drive.kill()


@pytest.mark.check
def test_all_cars_on_one_track_are_shown_also_one_that_comes_later(
    course: tuple[str | Path, ...], kinematic_artefact: Path, ended: list[Any], fakes: Fakes,
    tmp_path: Path,
) -> None:  # fmt: skip
    places = {name: (free_endpoint(), free_endpoint()) for name in "ab"}
    elsewhere = fakes("c", "controller", track="oval-0123abcd").endpoints.listen
    ends = {
        name: [word for one in place for word in ("--endpoint", one)]
        for name, place in (places | {"c": elsewhere}).items()
    }
    everywhere = [word for words in ends.values() for word in words]

    def begin(name: str) -> None:
        at = "--endpoint", places[name][0], "--listen", places[name][1], "--name", name
        ended.append(start("plant", *at[:2], *at[4:]))
        ended.append(start("controller", "--artefact", kinematic_artefact, *course, *at))
        until(lambda: not any(probe(one, None) for one in places[name]), "both to listen")

    def drive(name: str) -> None:
        own = "--name", name, "--mode", "realtime", "--log", tmp_path / f"{name}.mcap"
        ended.append(start("drive", *course[:2], *LONG, *ends[name], *own))

    begin("a")
    ports = "--port", "0", "--foxglove", "0"
    view = start("view", "--live", *course[:2], *everywhere, *ports, cwd=tmp_path)
    ended.append(view)
    assert view.stdout is not None
    foxglove, address, _ = (view.stdout.readline() for _ in range(3))
    drive("a")
    runs, fault = dict[str, dict[str, Any]](), ""
    with connect(address.split()[0].replace("http", "ws") + "updates") as link:

        def told(true: Callable[[], object], what: str) -> None:
            nonlocal fault
            deadline = time.monotonic() + PATIENCE_S
            while not true():
                assert time.monotonic() < deadline, what
                for one in json.loads(link.recv(PATIENCE_S)):
                    if one["kind"] == "run":
                        runs[one["key"].split("/")[0]] = one
                    fault = one["text"] if one["kind"] == "fault" else fault

        told(lambda: runs and runs["a"]["rows"]["x"], "the first car")
        begin("b")
        drive("b")
        told(lambda: "b" in runs and runs["b"]["rows"]["x"], "the second car")
        count = runs["a"]["to"]
        told(lambda: runs["a"]["to"] > count + 50, "the first car, which goes on")
    # Who announces the controllers has no link to the view.
    assert [runs[name]["label"] for name in "ab"] == ["a", "b"]
    assert runs["a"]["colour"] != runs["b"]["colour"]
    assert fault.startswith("car 'c' is left out: it drives the track 'oval-0123abcd', not '")
    with viewer_of_foxglove(int(foxglove.rpartition(":")[2])) as seen:
        frames = {f"scene/{name}/{what}" for name in "ab" for what in ("pose", "car")}
        for topic, _, _ in seen.messages():
            frames.discard(topic)
            if not frames:
                break


def test_who_is_shown_follows_the_tracks_that_controllers_name(
    fakes: Fakes, monkeypatch: pytest.MonkeyPatch
) -> None:
    harbour, car = load_track("harbour"), get_car("orca")
    plants = [fakes(name, "plant") for name in "ab"]
    one, other = (fakes(name, "controller") for name in "ab")
    at = where(*plants, one, other)

    def until_read(true: Callable[[Source], object], what: str) -> None:
        until(lambda: (source.read(), true(source))[1], what)

    with network_source(at, "", None, car, PATIENCE_S) as source:
        assert (source.track, source.replaced, source.fault) == (None, False, "")
        other.track = harbour.identity
        until_read(lambda source: source.replaced, "a track, of which nothing was known")
    with network_source(at, "", None, car, PATIENCE_S) as source:
        assert source.track is not None
        assert (source.track.name, source.fault) == ("harbour", "")
        one.track = "oval-0123abcd"
        until_read(lambda source: source.fault, "a car that changes the track")
        assert source.fault == (
            f"car 'a' is left out: it drives the track 'oval-0123abcd', not '{harbour.identity}'"
        )
        with monkeypatch.context() as patched:
            patched.setattr("bayesrace.operation.view.network._SILENT_S", 0.0)
            until_read(lambda source: not source.fault, "one that is silent")
        until_read(lambda source: source.fault, "one that is heard again")
        one.track = harbour.identity
        until_read(lambda source: not source.fault, "its return")
        assert not source.replaced
        one.track = other.track = "oval-0123abcd"
        until_read(lambda source: source.replaced, "nobody on the track")
    with network_source(at, "b", None, car, PATIENCE_S) as source:
        assert source.course()["title"] == "b · live"
    with (
        pytest.raises(AbsentError, match=r"car 'b' is left out: .*--track"),
        network_source(at, "", harbour, car, PATIENCE_S),
    ):
        pass


@needs_browser
def test_time_lost_along_the_track_is_known(tmp_path: Path, page: Page) -> None:
    """A car that is 1 % slower everywhere loses evenly."""
    drives = [
        Drive("bayesrace", circle(TWO_LAPS / 1.01, 1.0)),
        Drive("bestcase", circle(TWO_LAPS, 1.0)),
    ]
    out = tmp_path / "page.html"
    out.write_text(whole_page(all_updates(shown(raced(tmp_path / "run", *drives)))))
    page.open(out.as_uri() + "#lap=0")
    page.until("reference() !== null")
    lost_ms = np.array(page.value("lost(shown()[0])"), float)
    expected_ms = 10 * LAP_S * np.linspace(0, 1, len(lost_ms))
    inside = np.isfinite(lost_ms)
    assert inside.mean() > 0.98
    np.testing.assert_allclose(lost_ms[inside], expected_ms[inside], atol=0.5)
