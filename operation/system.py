"""A plant and its controllers as processes of their own, and the sessions that direct and record.

In lockstep the recording has a session of its own, whose links are low-latency: plant and
controller then send what is recorded in the thread that drives, which takes a fifth of the CPU of
handing it to another. Weights are too large for such a link, so the director's are ordinary.

All meet at Unix sockets in a folder that only this user may enter, so nobody else on the machine
can join, and no certificates are needed.
"""

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

from bayesrace.configuration import Configuration, as_toml, configured
from bayesrace.errors import InputError
from bayesrace.files import write_whole
from bayesrace.messages import EVENT, Event
from bayesrace.operation.drive import execute
from bayesrace.operation.run_plan import RunPlan, announcement
from bayesrace.processes import RUN_MODULE
from bayesrace.recorder import Recorder
from bayesrace.tracks import Track
from bayesrace.transport import (
    Director,
    Publisher,
    count_processes,
    open_session,
    private_endpoints,
)

__all__ = ["Child", "System", "child", "endings", "private_network", "started_system"]

CONFIGURATION: Final = "bayesrace.toml"
"""What the processes of a system read, in its folder."""

_CLI: Final = "bayesrace.operation.cli"
_COMMAND: Final = "bayesrace.operation.command"

_START_S: Final = 60.0
"""Time for a process to start on a machine that is busy."""
_LOOK_S: Final = 0.02
_PATIENCE_S: Final = 3.0
"""Time for a process to end when it is asked to."""


class Child:
    """A running ``bayesrace`` subcommand, or other module, whose output goes to a file."""

    def __init__(self, arguments: list[str], output: Path, module: str = _CLI) -> None:
        self.output = output
        self._file = output.open("ab")
        self._process = subprocess.Popen(
            [*RUN_MODULE, module, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=self._file,
            stderr=subprocess.STDOUT,
            # Ctrl-C at the terminal is for the starter, which ends its children in order
            start_new_session=True,
        )

    @property
    def pid(self) -> int:
        """Process number."""
        return self._process.pid

    def ended(self) -> str:
        """Why the process is not running any more, with its last message; "" while it runs."""
        code = self._process.poll()
        if code is None:
            return ""
        words = self.output.read_text(errors="replace").strip().splitlines()
        # A killed process had no time for a last message: that of its start would mislead.
        said = f": {words[-1]}" if words and code != -signal.SIGKILL else ""
        how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
        return f"{how}{said}"

    def wait(self, timeout_s: float) -> bool:
        """Whether it ends by itself in that time."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return False
        return True

    def stop(self) -> None:
        """SIGTERM, and SIGKILL if it does not end."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(_PATIENCE_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
        self._process.wait()
        self._file.close()


@contextmanager
def child(arguments: list[str], output: Path, module: str = _CLI) -> Iterator[Child]:
    """A child process that does not outlive the block, however the block ends.

    With ``--parent-pid`` among the arguments it does not outlive this process either.
    """
    process = Child(arguments, output, module)
    try:
        yield process
    finally:
        process.stop()


def _part(
    name: str, options: Sequence[str], output: Path, own: Mapping[str, Sequence[str]]
) -> AbstractContextManager[Child]:
    """A plant or a controller for a block: ours with these options, or the user's own command."""
    if command := own.get(name):
        return child([str(os.getpid()), *command], output, _COMMAND)
    return child([name, *options], output)


def endings(children: Iterable[Child]) -> list[str]:
    """Of those that have ended, how."""
    return [f"{one.output.stem} {why}" for one in children if (why := one.ended())]


class System:
    """One plant, one controller at a time, and the sessions that direct and record them."""

    def __init__(
        self,
        session: Any,
        recording: Any,
        car: str,
        folder: Path,
        options: Sequence[str],
        own: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        """``folder`` receives the output of the processes; ``options`` are those of both, and
        ``own`` as in :func:`started_system`."""
        self.session = session
        """Directs; for requests of any size."""
        self.recording = recording
        """For a :class:`Recorder`, which hears the race's own events on this session alone."""
        self.director = Director(session, car)
        self.children: dict[str, Child] = {}
        """The processes by what they are, plant and controller."""
        self._folder, self._options, self._own = folder, list(options), own or {}
        self._car = car
        self._events: Publisher[Event] = Publisher(recording, EVENT, car, "race")

    @contextmanager
    def controller(self, options: Sequence[str], log: str = "controller.log") -> Iterator[None]:
        """A controller process for the block; it and the plant are ready for a run.

        ``options`` are those of ``bayesrace controller`` beside the configuration.
        InputError, with the last message of a process that has ended, if they do not get ready.
        """
        line = [*options, *self._options]
        with _part("controller", line, self._folder / log, self._own) as process:
            self.children["controller"] = process
            with self.explained():
                self._wait_for_both()
                yield
            del self.children["controller"]
        self.director.wait_until_gone("controller", _START_S)

    @contextmanager
    def explained(self) -> Iterator[None]:
        """Adds to an InputError of the block how processes of the system have ended."""
        try:
            yield
        except InputError as error:
            time.sleep(0.2)  # the system reports an end a moment after the network does
            words = [str(error), *endings(self.children.values())]
            raise InputError("; ".join(words)) from error

    def drive(
        self,
        track: Track,
        plan: RunPlan,
        recorder: Recorder | None = None,
        paused: Callable[[Event], None] = lambda _: None,
    ) -> Event:
        """Drives one run to its end; see :func:`bayesrace.operation.drive.execute`."""
        self._wait_for_recording()
        return execute(self.director, self._events, track, plan, recorder, paused)

    def refused(self, plan: RunPlan, reason: str) -> None:
        """Records that a run is not driven, because the controller refuses its weights."""
        event = announcement(plan, self._events.next_seq, "", reason)
        self._events.put(event, lockstep=True)

    def _wait_for_recording(self) -> None:
        """Waits until plant and controller know what the recorder has subscribed to, as a process
        does that answers on its session. InputError if they do not in time."""
        deadline = time.monotonic() + _START_S
        for source in self.children:
            while not count_processes(self.recording, self._car, source):
                if time.monotonic() > deadline:
                    raise InputError(
                        f"the {source} of car '{self._car}' cannot be recorded: it does not answer "
                        f"within {_START_S:g} s"
                    )
                time.sleep(_LOOK_S)

    def _wait_for_both(self) -> None:
        """Waits as long as the processes live; InputError if they are not there in time."""
        deadline = time.monotonic() + _START_S
        while True:
            try:
                return self.director.wait_for(("plant", "controller"), 0.5)
            except InputError:
                if endings(self.children.values()) or time.monotonic() > deadline:
                    raise


@contextmanager
def started_system(
    car: str,
    folder: Path,
    plant: Sequence[str] = (),
    both: Sequence[str] = (),
    configuration: Configuration | None = None,
    *,
    lockstep: bool = False,
    own: Mapping[str, Sequence[str]] | None = None,
) -> Iterator[System]:
    """A running plant for the block, and the sessions that direct and record it.

    ``car`` is its name in message keys, ``plant`` are options of ``bayesrace plant``, ``both``
    those of plant and controllers. ``configuration`` is that of all three; without it they meet at
    sockets in a folder of this user's own, without certificates, and all else is as configured. It
    is left in ``folder``.
    ``lockstep``: all runs are in lockstep, and their links without priorities. ``own``: commands to
    start in place of ``bayesrace plant`` and ``bayesrace controller``, by those names; they get no
    options beside their own. No process outlives the block, however it ends.
    """
    file = folder / CONFIGURATION
    options = ["--config", str(file), "--parent-pid", str(os.getpid()), *both]
    if lockstep:
        options.append("--low-latency")
    with ExitStack() as stack:
        used = configuration or stack.enter_context(private_network())
        write_whole(file, as_toml(used))
        endpoints = used.endpoints("director")
        process = stack.enter_context(
            _part("plant", [*plant, *options], folder / "plant.log", own or {})
        )
        recording = session = stack.enter_context(
            open_session(endpoints, "director", peers_follow=True)
        )
        if lockstep:
            fast = endpoints.model_copy(update={"low_latency": True})
            recording = stack.enter_context(open_session(fast, "director", peers_follow=True))
        stack.callback(process.stop)  # before the sessions, so that its end is seen
        system = System(session, recording, car, folder, options, own)
        system.children["plant"] = process
        yield system


@contextmanager
def private_network() -> Iterator[Configuration]:
    """The configuration of processes that meet at sockets which only this user can reach."""
    with private_endpoints("plant", "controller") as (plant, controller):
        yield configured().plain(plant, controller)
