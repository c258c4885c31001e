"""The process that an FMU runs in: whatever the FMU does to its process, it does to this one.

Started by :class:`plant.fmu.host.FmuHost`; standard output and error are a pipe to the plant. Its
last words are written into a shared page, so that they outlive a crash. When the plant ends,
however it ends, this process ends too, and removes the unpacked FMU.
"""

import json
import mmap
import os
import shutil
import signal
import struct
import sys
import threading
from array import array
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, NoReturn

from bayesrace.clock import die_with_parent
from plant.fmu.channel import (
    DOUBLE,
    FAULT,
    LOAD,
    QUIT,
    READY,
    START,
    STEP,
    VALUES,
    Channel,
    Closed,
)
from plant.fmu.faults import CallFailed

if TYPE_CHECKING:
    from plant.fmu.instance import Instance

__all__ = ["SLOT_BYTES", "WORDS_BYTES", "main", "read_words"]

SLOT_BYTES: Final = 1024
WORDS_BYTES: Final = 2 * SLOT_BYTES
"""Two slots: the last message that reports trouble, and the last of any kind."""
_LENGTH: Final = struct.Struct("=H")

_SHOWN: Final = 200
"""Messages of one instance that are printed; all of them pass through the shared page."""

_LABELS: Final = ("info", "warning", "discard", "error", "fatal", "pending")


def read_words(page: mmap.mmap) -> str:
    """The FMU's last words, "" if it has said nothing."""
    for start in (0, SLOT_BYTES):
        (length,) = _LENGTH.unpack_from(page, start)
        if 0 < length <= SLOT_BYTES - _LENGTH.size:
            begin = start + _LENGTH.size
            return page[begin : begin + length].decode(errors="replace")
    return ""


class _Words:
    """The FMU's messages: kept in the shared page, the first of them printed."""

    def __init__(self, page: mmap.mmap) -> None:
        self._page = page
        self.clear()

    def clear(self) -> None:
        """Forget; a new instance speaks."""
        self._shown = 0
        for start in (0, SLOT_BYTES):
            _LENGTH.pack_into(self._page, start, 0)

    def log(self, status: int, category: str, message: str) -> None:
        """Takes a message; cheap, there may be millions."""
        data = message[:SLOT_BYTES].strip().encode(errors="replace")
        data = data[: SLOT_BYTES - _LENGTH.size]
        start = 0 if status else SLOT_BYTES
        _LENGTH.pack_into(self._page, start, len(data))
        self._page[start + _LENGTH.size : start + _LENGTH.size + len(data)] = data
        if self._shown <= _SHOWN:
            label = _LABELS[status] if 0 <= status < len(_LABELS) else str(status)
            line = f"[FMU {label}] {message[:SLOT_BYTES].strip()}\n"
            if self._shown == _SHOWN:
                line = "[FMU] further messages are not shown\n"
            os.write(1, line.encode(errors="replace"))
            self._shown += 1


class _Server:
    """Does what it is asked, one thing after the other."""

    def __init__(self, channel: Channel, words: _Words) -> None:
        self._channel = channel
        self._words = words
        self._instance: Instance | None = None
        self._state = "none"  # none, made, running
        self._inputs = 0
        self._reply = array("d")
        self._time_s = 0.0
        self._excess_s = 0.0

    def serve(self) -> None:
        """Until told to quit; Closed if the plant is gone."""
        while True:
            frame = self._channel.poll()
            if frame is None:
                continue
            kind, payload = frame
            if kind == STEP:
                self._answer(self._step, payload)
            elif kind == START:
                self._answer(self._start, json.loads(bytes(payload)))
            elif kind == LOAD:
                self._answer(self._load, json.loads(bytes(payload)))
            elif kind == QUIT:
                return self._free()

    def _answer(self, do: Any, question: Any) -> None:
        try:
            kind = do(question)
        except CallFailed as failure:
            self._channel.send(FAULT, str(failure).encode(errors="replace")[:4000])
        else:
            payload = b"" if kind == READY else memoryview(self._reply).cast("B")
            self._channel.send(kind, payload)

    def _load(self, told: dict[str, Any]) -> int:
        from plant.fmu.instance import load  # brings fmpy: the leash must be on before

        inputs, outputs = told.pop("inputs"), told.pop("outputs")
        self._inputs = len(inputs)
        self._reply = array("d", bytes(DOUBLE * (1 + len(outputs))))
        self._outputs = memoryview(self._reply)[1:]
        self._instance = load(
            **told, inputs=_pairs(inputs), outputs=_pairs(outputs), logger=self._words.log
        )
        self._make()
        return READY

    def _make(self) -> None:
        assert self._instance is not None  # noqa: S101 - LOAD came first
        self._words.clear()
        self._instance.instantiate()
        self._state = "made"

    def _free(self) -> None:
        if self._instance is not None and self._state in ("made", "running"):
            self._state = "none"
            with suppress(CallFailed):  # it has served; the next one is another
                self._instance.free()

    def _start(self, told: dict[str, Any]) -> int:
        assert self._instance is not None  # noqa: S101
        if self._state == "running":
            self._free()
        if self._state == "none":
            self._make()
        structural, values = ([(tuple(variable), value) for variable, value in told[part]]
                              for part in ("structural", "values"))  # fmt: skip
        self._state = "running"
        self._instance.initialise(structural, values)
        self._time_s = self._excess_s = 0.0
        return self._values()

    def _step(self, payload: memoryview) -> int:
        instance = self._instance
        assert instance is not None  # noqa: S101
        numbers = payload.cast("d")
        step_s, count = numbers[0], int(numbers[1])
        rows, width = numbers[2:], self._inputs
        ramp = len(rows) > width
        if not ramp:
            instance.write(rows)
        for k in range(count):
            if ramp:
                instance.write(rows[k * width : (k + 1) * width])
            instance.advance(self._time_s, step_s)
            self._pass(step_s)
        return self._values()

    def _pass(self, step_s: float) -> None:
        """Adds to the time without letting rounding add up (Kahan)."""
        step_s -= self._excess_s
        time_s = self._time_s + step_s
        self._excess_s = (time_s - self._time_s) - step_s
        self._time_s = time_s

    def _values(self) -> int:
        assert self._instance is not None  # noqa: S101
        self._instance.read(self._outputs)
        self._reply[0] = self._time_s
        return VALUES


def _pairs(variables: list[list[Any]]) -> list[tuple[str, int]]:
    return [(kind, reference) for kind, reference in variables]


def _leash(folder: str, parent: int) -> None:
    """End with the plant, the FMU in the middle of a call or not, and remove what it unpacked."""
    told, tell = os.pipe()
    os.set_blocking(tell, False)

    def watch() -> None:
        os.read(told, 1)
        _end(folder)

    threading.Thread(target=watch, name="leash", daemon=True).start()
    # Python's own handler waits for the call under way; the number in the pipe does not.
    signal.signal(signal.SIGTERM, lambda *_: None)
    signal.set_wakeup_fd(tell, warn_on_full_buffer=False)
    die_with_parent(parent)


_ENDING: Final = threading.Lock()


def _end(folder: str) -> NoReturn:
    """Ends this process and asks what the FMU has started to end; removes what was unpacked.

    The signal and the closed channel come at once, to two threads: the first does it.
    """
    with _ENDING:
        shutil.rmtree(folder, ignore_errors=True)
        with suppress(ProcessLookupError):  # no session of its own; ours has been told already
            os.killpg(os.getpid(), signal.SIGTERM)
        os._exit(128 + signal.SIGTERM)


def _ordinary(cpus: list[int]) -> None:
    """An FMU that does not end must not keep the plant off the CPU: no priority, no binding."""
    if hasattr(os, "sched_setscheduler"):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.sched_setaffinity(0, cpus)


def main(arguments: list[str]) -> int:
    """Serve the plant that has started this process; returns the exit code."""
    told = json.loads(arguments[0])
    folder: str = told["folder"]
    _leash(folder, told["parent"])
    _ordinary(told["cpus"])
    os.chdir(folder)  # what an FMU writes beside itself goes when it goes
    for descriptor in (told["socket"], told["words"]):
        os.set_inheritable(descriptor, False)  # what the FMU starts has no business with them
    words = _Words(mmap.mmap(told["words"], WORDS_BYTES))
    channel = Channel(told["socket"], blocking=True)
    try:
        _Server(channel, words).serve()
    except Closed:
        _end(folder)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
