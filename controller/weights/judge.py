"""The process that checks one weights file, and what starts it.

Decoding and checking take some 0.1 s of the interpreter's lock, which the control thread must not
wait for; and a file that brings the checks down does not bring down the controller.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

import msgpack
import numpy as np

from bayesrace.clock import die_with_parent
from bayesrace.errors import InputError
from bayesrace.interpreter import RUN_MODULE
from bayesrace.vehicles import described_car
from controller.weights.checks import Checks
from controller.weights.prediction import Samples
from controller.weights.settings import GateSettings

__all__ = ["judged"]

_NICE: Final = 10
_POLL_S: Final = 0.02


def judged(question: Mapping[str, Any], until_s: float, follow: Callable[[], None]) -> Any:
    """The fields of a :class:`.checks.Verdict` on the question, from another process.

    ``question``: artefact and car (texts), settings (JSON), recent samples (a pair), the files and
    the time of :meth:`.checks.Checks.judge` by name. ``until_s``: deadline on the monotonic clock,
    when the process is killed. ``follow`` is called meanwhile. InputError without a verdict.
    """
    line = [*RUN_MODULE, __name__, str(os.getpid())]
    packed = msgpack.packb(question, default=_plain)
    pipes: Any = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    try:
        process = subprocess.Popen(line, **pipes)
    except OSError as error:
        raise InputError(f"no process to check them: {error.strerror}") from None
    with process, ThreadPoolExecutor(1) as pool:
        exchanged = pool.submit(process.communicate, packed)
        try:
            while not exchanged.done():
                if time.monotonic() > until_s:
                    raise InputError("the check of the weights did not end in time")
                follow()
                time.sleep(_POLL_S)
        finally:
            process.kill()
        answer, words = exchanged.result()
    if process.returncode:
        last = words.decode(errors="replace").strip().splitlines()[-1:]
        how = f"ended with code {process.returncode}"
        raise InputError(f"the check of the weights {': '.join([how, *last])}")
    return msgpack.unpackb(answer)


def _plain(array: Any) -> Any:
    return array.shape, array.tobytes()


def _array(form: Any) -> Any:
    shape, data = form
    return np.frombuffer(data).reshape(shape)


def main() -> int:
    """The program: a question on standard input, the verdict on standard output."""
    die_with_parent(int(sys.argv[1]))
    os.nice(_NICE)
    question = msgpack.unpackb(sys.stdin.buffer.read())
    settings = GateSettings.model_validate_json(question.pop("settings"))
    car, artefact = described_car(question.pop("car")), Path(question.pop("artefact"))
    recent = Samples(*map(_array, question.pop("recent")))
    verdict = Checks(settings, artefact, car).judge(recent=recent, **question)
    sys.stdout.buffer.write(msgpack.packb(verdict._asdict()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
