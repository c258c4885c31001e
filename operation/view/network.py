"""The cars of a network, as a source of a view: those that are there, and those that come later."""

import math
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from itertools import count
from pathlib import Path
from shutil import rmtree
from tempfile import TemporaryDirectory
from typing import Any, Final

from bayesrace.errors import InputError
from bayesrace.log import Entry, LogReader
from bayesrace.messages import HEARTBEAT, is_car_name
from bayesrace.operation.lifecycle import ask_statuses, find, pick
from bayesrace.operation.view.sources import Source
from bayesrace.raceline import same_track
from bayesrace.recorder import Recorder
from bayesrace.tracks import Track, builtin_tracks, load_track
from bayesrace.transport import Endpoints, Inbox, open_session
from bayesrace.vehicles import Car

__all__ = ["AbsentError", "NetworkSource", "network_source"]

_MOST_BYTES: Final = 200_000_000
"""Of the log of what is seen of a car."""
_MOST_CARS: Final = 16
"""That are shown, and that are said to be left out."""
_SILENT_S: Final = 5.0
"""After that a car is not there any more."""


class AbsentError(InputError):
    """There is no car in the network, yet."""


class NetworkSource(Source):
    """What the cars on one track do from now on, each recorded in a log of its own by this process,
    which only listens."""

    def __init__(
        self, stack: ExitStack, session: Any, folder: Path, name: str, driven: str,
        track: Track | None, car: Car,
    ) -> None:  # fmt: skip
        """``stack``: its end is that of the recording. ``name``: of the only car that is meant;
        empty: all. ``driven``: identity of the track, empty while it is not known; ``track``: the
        same, if it is at hand."""
        shown = name or (track.name if track else "network")
        super().__init__(None, track, None, car, f"{shown} · live")
        self._session, self._folder = session, folder
        self._recorders: dict[str, Recorder] = {}
        stack.callback(self._close)
        self._numbers, self._heard_s = count(), dict[str, float]()
        self._driven, self._named = driven, False
        self._inbox = Inbox(session, name or None)
        self._inbox.subscribe(HEARTBEAT)

    @property
    def replaced(self) -> bool:
        """Whether a track has become known, or no car drives this one any more."""
        return self._named or not self._recorders

    def read(self) -> list[Entry[Any]]:
        """The same; cars that have come join before."""
        while (item := self._inbox.get()) is not None:
            _, car, _, source = item.key.split("/")
            self._heard_s[car] = time.monotonic()
            if item.value is not None and is_car_name(car) and source == "controller":
                self.notice(car, item.value.track)
        silent_s = time.monotonic() - _SILENT_S
        for car in [one for one in self.faults if self._heard_s.get(one, math.inf) < silent_s]:
            del self.faults[car]
        shown = self._recorders.keys() | self.faults.keys()
        self._heard_s = {car: at_s for car, at_s in self._heard_s.items() if car in shown}
        return super().read()

    def notice(self, car: str, driven: str) -> None:
        """A car that is there is shown from now on, or left out if its controller drives another
        track; ``driven``: the identity of that, empty if it names none."""
        self._heard_s[car] = time.monotonic()
        if driven and not self._driven:
            self._named = True
        elif driven and not same_track(driven, self._driven):
            self._leave_out(car, f"it drives the track '{driven}', not '{self._driven}'")
            if car in self._recorders:
                self._leave(car)
        elif car in self._recorders:
            return
        elif len(self._recorders) >= _MOST_CARS and not self._leave_silent():
            self._leave_out(car, f"no more than {_MOST_CARS} are shown")
        else:
            self.faults.pop(car, None)
            log = self._folder / str(next(self._numbers)) / "car.mcap"
            log.parent.mkdir()
            recorder = Recorder(self._session, car, log, most_bytes=_MOST_BYTES)
            self._recorders[car], self._readers[car] = recorder, LogReader(log)

    def _leave_silent(self) -> bool:
        """Whether a car that is not heard any more has left its place to another one."""
        silent = min(self._recorders, key=lambda car: self._heard_s[car])
        if time.monotonic() - self._heard_s[silent] < _SILENT_S:
            return False
        self._leave(silent)
        return True

    def _leave(self, car: str) -> None:
        # A car that drives goes on sending; nobody waits for its last messages.
        with suppress(InputError):  # of a full disk
            self._recorders.pop(car).close(patience_s=0)
        rmtree(self._readers.pop(car).path.parent)

    def _close(self) -> None:
        for car in [*self._recorders]:
            self._leave(car)

    def _leave_out(self, car: str, why: str) -> None:
        if car in self.faults or len(self.faults) < _MOST_CARS:
            self.faults[car] = f"car '{car}' is left out: {why}"


@contextmanager
def network_source(
    endpoints: Endpoints, name: str, track: Track | None, car: Car, timeout_s: float
) -> Iterator[NetworkSource]:
    """The cars in the network, or that of this name, on ``track``, or else on that which the first
    controller that names one drives.

    AbsentError if there is no such car within the timeout.
    """
    name = endpoints.car_named(name)
    with (
        TemporaryDirectory() as folder,
        open_session(endpoints, "viewer", reports_absence=False) as session,
        ExitStack() as stack,
    ):
        try:
            found = find(session, endpoints, timeout_s, name, ("plant",))
            cars = pick(found, name, True, "plant")
        except InputError as error:
            raise AbsentError(str(error)) from None
        known, tracks = ask_statuses(session, found, timeout_s).cars, dict[str, str]()
        for one in cars:
            controller = known[one].get("controller")
            tracks[one] = controller.status.track if controller and controller.status else ""
        driven = track.identity if track else next(filter(None, tracks.values()), "")
        if driven and track is None:
            built_in = map(load_track, builtin_tracks())
            track = next((one for one in built_in if same_track(driven, one.identity)), None)
        source = NetworkSource(stack, session, Path(folder), name, driven, track, car)
        for one in cars:
            source.notice(one, tracks[one])
        if source.replaced:
            raise AbsentError(f"{source.fault}; name that with --track")
        yield source
