"""The links of the page: slow and dead ones, a viewer that is gone and comes back, IPv6, and a long
drive, whose log is written in accelerated time."""

import json
import signal
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPConnection
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

import numpy as np
import pytest
from msgspec.structs import replace
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

from bayesrace.errors import InputError
from bayesrace.log_rotation import RotatingLog
from bayesrace.messages import Event, Message, Telemetry, encode
from bayesrace.operation.view import Viewer, run_source
from bayesrace.vehicles import get_car, write_car
from benchmarks.harness import resident_bytes
from tests import sample_messages as messages
from tests.browser import Page, needs_browser, page
from tests.driven import blank
from tests.programs import start, until
from tests.synthetic_race import LINE_M, STEP_S, Drive, circle, write_race
from tests.test_analysis import TWO_LAPS
from tests.test_view import raced, shown, updates_of

__all__ = ["page"]  # a fixture

BUFFERS: Final = 4_500_000
"""More than a sender's and a small receiver's buffers hold of a link [bytes]."""
VIEW: Final = "bayesrace.operation.view"


class Car:
    """A car on the racing line at 1 m/s, recorded as it drives, which is as fast as it can."""

    def __init__(self, folder: Path, stages: int = 20, most_bytes: int | None = None) -> None:
        self.folder = write_race(folder, [])
        write_car(folder / "car.toml", get_car("orca"))
        (folder / "run.mcap").unlink()
        self._log = RotatingLog(folder / "run.mcap", None, most_bytes)
        self._stages, self._seq, self.run, self._cycle = stages, 0, 0, 0
        self._telemetry = blank(Telemetry, tube_m=(0.01,) * stages, solve_us=100.0)
        self._state = messages.state(lockstep=True)
        self.begin()

    @property
    def time_s(self) -> float:
        """Of the newest state."""
        return round(STEP_S * (self._cycle - 1), 4)

    def begin(self) -> None:
        """A run."""
        self.run, self._cycle = self.run + 1, 0
        data = {"run": self.run, "controller": "bestcase", "weights_version": "", "refused": ""}
        event = blank(Event, seq=self.run, source="race", kind="run", run=self.run, data=data)
        self._put("event/race", event)

    def drive(self, cycles: int) -> None:
        """States with telemetry, and with a plan every 0.1 s; all of it is in the file then."""
        for _ in range(cycles):
            angle = STEP_S * self._cycle / LINE_M
            x = tuple(circle(np.array([angle]), LINE_M)[0].tolist())
            time_s = STEP_S * self._cycle
            state = replace(self._state, seq=self._seq, run=self.run, time_s=time_s, x=x)
            self._put("state", state)
            known: dict[str, Any] = {"run": self.run, "state_seq": self._seq, "seq": self._seq}
            if self._cycle % 5 == 0:
                ahead = np.linspace(angle, angle + 0.03 * self._stages, self._stages + 1)
                known["plan_x"] = tuple(circle(ahead, LINE_M).ravel().tolist())
            self._put("telemetry", replace(self._telemetry, **known))
            self._seq, self._cycle = self._seq + 1, self._cycle + 1
        self._log.flush()

    def _put(self, key: str, message: Message) -> None:
        self._log.write(f"bayesrace/orca/{key}", encode(message), time.monotonic_ns())


class Told:
    """What a link has been told so far."""

    def __init__(self) -> None:
        self.bytes = self.missed = 0
        self.newest = (0, -1.0)
        """Run and time of the newest row."""
        self._rows: dict[str, int] = {}

    def take(self, text: str | bytes) -> None:
        self.bytes += len(text)
        for one in json.loads(text):
            if one["kind"] == "run" and one["rows"]["t"]:
                self.missed += one["from"] - self._rows.get(one["key"], 0)
                self._rows[one["key"]] = one["to"]
                run = int(one["key"].split("/")[2])
                self.newest = max(self.newest, (run, one["rows"]["t"][-1]))


@contextmanager
def listening(link: ClientConnection) -> Iterator[Told]:
    """Reads all that a link brings, in a thread."""
    told = Told()

    def listen() -> None:
        for text in link:
            told.take(text)

    thread = threading.Thread(target=listen, daemon=True)
    thread.start()
    yield told
    link.close()
    thread.join(10)


def small(viewer: Viewer) -> socket.socket:
    """A connection that has next to no room for what is not read."""
    where = urlsplit(viewer.address)
    link = socket.socket()
    link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    link.connect((where.hostname, where.port))
    return link


def mute(viewer: Viewer) -> socket.socket:
    """The link of a page that reads nothing but its first bytes."""
    link, where = small(viewer), urlsplit(viewer.address)
    asked = {
        "Host": where.netloc, "Connection": "Upgrade", "Upgrade": "websocket",
        "Sec-WebSocket-Version": "13", "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
    }  # fmt: skip
    head = "".join(f"{name}: {value}\r\n" for name, value in asked.items())
    link.sendall(f"GET /updates HTTP/1.1\r\n{head}\r\n".encode())
    assert link.recv(12) == b"HTTP/1.1 101"
    return link


def test_a_page_that_stops_reading_holds_nobody_up_and_then_sees_the_newest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More is told than all buffers hold; what it misses waits nowhere."""
    monkeypatch.setattr(f"{VIEW}.runs._MOST_ROWS", 200)
    monkeypatch.setattr(f"{VIEW}.server._PATIENCE_S", 600)
    car, used = Car(tmp_path, stages=500), list[int]()
    with (
        Viewer(port=0) as viewer,
        connect(updates_of(viewer), sock=small(viewer), max_queue=1, max_size=None,
                ping_interval=None) as slow,
        connect(updates_of(viewer), max_size=None) as link, listening(link) as quick,
    ):  # fmt: skip
        viewer.show(run_source(car.folder))
        for most in (BUFFERS, 2 * BUFFERS):
            while quick.bytes < most:
                car.drive(50)
                viewer.read()
                until(lambda: quick.newest[1] > car.time_s - 0.1, "the other page goes on")
            used.append(resident_bytes("self"))
        assert quick.missed == 0
        assert used[1] - used[0] < 0.5 * BUFFERS
        late = Told()
        while late.newest[1] < car.time_s - 0.1:
            late.take(slow.recv(20))
        assert late.missed > 0
        assert late.bytes < quick.bytes - 0.5 * BUFFERS


def test_a_page_that_goes_on_reading_nothing_is_left_and_a_dead_one_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"{VIEW}.runs._MOST_ROWS", 200)
    monkeypatch.setattr(f"{VIEW}.server._PATIENCE_S", 1)
    car = Car(tmp_path, stages=500)

    def left() -> bool:
        car.drive(50)
        viewer.read()
        return threading.active_count() == threads

    with Viewer(port=0) as viewer:
        viewer.show(run_source(car.folder))
        threads = threading.active_count()
        with mute(viewer):
            until(lambda: threading.active_count() > threads, "it has a thread")
            until(left, "it is left")
        with mute(viewer) as dead:
            until(lambda: threading.active_count() > threads, "it has a thread")
            dead.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        until(lambda: threading.active_count() == threads, "the dead one has no thread")
        with connect(updates_of(viewer), max_size=None) as link, listening(link) as again:
            until(lambda: again.newest[1] > car.time_s - 0.1, "it connects again")


def test_runs_share_the_rows_that_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a page is told, piece by piece, is what is kept in the end."""
    for name, value in {"_MOST_ROWS": 500, "_MOST_IN_ALL": 1000, "_MOST_RUNS": 6}.items():
        monkeypatch.setattr(f"{VIEW}.runs.{name}", value)
    car = Car(tmp_path)
    source, known, laps = run_source(car.folder), dict[str, Any](), dict[str, list[Any]]()
    for _ in range(8):
        for _ in range(5):
            car.drive(200)
            source.read()
            for one in source.runs.updates(known):
                if one["kind"] == "gone":
                    del laps[one["key"]]
                else:
                    laps.setdefault(one["key"], []).extend(one["laps"])
        car.begin()
    kept = {one["key"]: one for one in source.runs.updates({})}
    assert list(kept) == list(known) == list(laps) == [f"orca/1/{run}" for run in range(3, 9)]
    assert {key: len(one["laps"]) for key, one in kept.items()} == dict.fromkeys(kept, 3)
    assert all(one["laps"] == laps[key] for key, one in kept.items())
    counts = [len(one["rows"]["t"]) for one in kept.values()]
    assert all(1000 // 6 <= count <= 1.5 * 1000 / 6 + 1 for count in counts)


@pytest.mark.skipif(not socket.has_ipv6, reason="needs IPv6")
def test_a_viewer_that_nobody_can_connect_to_any_more_ends() -> None:
    """As without descriptors, when its server gives up."""
    with Viewer(port=0) as viewer:
        assert viewer.read() == []
        viewer._server.shutdown()
        viewer._thread.join(10)
        with pytest.raises(InputError, match="no page can connect any more"):
            viewer.read()


def test_ipv6_is_served_with_addresses_in_brackets(tmp_path: Path) -> None:
    def asked(host: str, path: str, **headers: str) -> int:
        link = HTTPConnection(host, urlsplit(viewer.address).port, timeout=10)
        link.request("GET", path, headers=headers)
        return link.getresponse().status

    with Viewer("::1", 0) as viewer:
        viewer.show(shown(raced(tmp_path / "run")))
        assert viewer.address.startswith("http://[::1]:")
        assert [asked("::1", "/"), asked("::1", "/", Host="[::2]")] == [200, 403]
        origin = viewer.address.rstrip("/")
        with connect(updates_of(viewer), origin=origin) as link:
            assert json.loads(link.recv(10))[0]["kind"] == "course"
        with pytest.raises(InvalidStatus):
            connect(updates_of(viewer), origin="http://[::2]")
    with Viewer("::", 0) as viewer:
        where = urlsplit(viewer.address)
        assert where.netloc == f"[::]:{where.port}"
        for host in ("::1", "127.0.0.1"):
            assert [asked(host, "/"), asked(host, f"/?{where.query}")] == [403, 200]


@needs_browser
@pytest.mark.check
def test_a_page_finds_a_viewer_again_that_was_killed_or_hung(tmp_path: Path, page: Page) -> None:
    """Its runs have the same keys as those before, and are others."""
    races = [
        raced(tmp_path / name, Drive(name, circle(TWO_LAPS[:count], 1.0)))
        for name, count in (("bestcase", 90), ("bayesrace", 60))
    ]
    port, lost = "0", "el('state').textContent.startsWith('connection lost')"
    for race, count in zip(races, (90, 60), strict=True):
        view = start("view", race, "--port", port)
        try:
            assert view.stdout is not None
            address = view.stdout.readline().split()[0]
            if port == "0":
                port = str(urlsplit(address).port)
                page.open(address)
            page.until(f"el('title').textContent === '{race.name}' && runs.size === 1")
            assert page.value("[...runs.values()][0].rows.t.length") == count
            page.until("el('state').textContent === '1 run'")
            page.until("plots.length > 0 && !plots.some((one) => one.old)")
            page.value("(plots.forEach((one) => (one.old = true)), 0)")
            if count == 60:
                view.send_signal(signal.SIGSTOP)
                page.until(lost)
                view.send_signal(signal.SIGCONT)
                page.until("el('state').textContent === '1 run'")
                page.until("!plots.some((one) => one.old)")
                assert page.value("[...runs.values()][0].rows.t.length") == count
        finally:
            view.kill()
            view.communicate()
        page.until(lost)
    assert page.value("[...runs.values()].map((run) => run.label)") == ["BayesRace"]


@needs_browser
@pytest.mark.check
def test_a_long_drive_takes_no_more_memory_of_viewer_and_page(
    tmp_path: Path, page: Page, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 24 runs the viewer keeps six, and of the log not the beginning. A browser may keep charts
    of the past, with their runs, a while longer: the page has room for six more."""
    for name, value in {"_MOST_ROWS": 400, "_MOST_IN_ALL": 1200, "_MOST_RUNS": 6}.items():
        monkeypatch.setattr(f"{VIEW}.runs.{name}", value)
    car = Car(tmp_path / "race", most_bytes=400_000)
    source, used, heap = run_source(car.folder), list[int](), list[float]()
    with (
        Viewer(port=0) as viewer,
        connect(updates_of(viewer), max_size=None) as link, listening(link) as told,
    ):  # fmt: skip
        viewer.show(source)
        page.open(viewer.address, 800)
        for _ in range(24):
            for _ in range(2):
                car.drive(150)
                while viewer.read():
                    pass
                until(lambda: told.newest > (car.run, car.time_s - 0.1), "it is told")
            page.until(f"runs.get('orca/1/{car.run}').rows.t.at(-1) > {car.time_s - 0.1}")
            heap.append(page.heap_bytes())
            used.append(resident_bytes("self"))
            car.begin()
        assert told.missed == 0
        kept = {one["key"]: len(one["rows"]["t"]) for one in source.runs.all_updates()}
        assert page.value("[...runs.values()].map((run) => [run.key, run.rows.t.length])") == [
            list(one) for one in kept.items()
        ]
    assert not (car.folder / "run.mcap").exists()
    assert used[-1] < 1.1 * used[5]
    assert heap[-1] < 1.7 * heap[5]
    assert page.errors == []
