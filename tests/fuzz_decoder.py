"""``python -m tests.fuzz_decoder {messages|weights} FOLDER [libFuzzer options]``: atheris' hunt.

libFuzzer changes inputs so as to reach new branches of the decoders, whose Python is instrumented,
and keeps in FOLDER what did. A program of its own, because it ends the process. It runs until
stopped, or as long as ``-runs=N`` or ``-max_total_time=SECONDS`` say; an input that breaks the
promise is written to the working folder.
"""

import importlib
import random
import sys
from pathlib import Path
from typing import Any

atheris: Any = importlib.import_module("atheris")

# What is imported before is not instrumented, so nothing of the package is.
with atheris.instrument_imports(include=["bayesrace.messages", "bayesrace.gp.weights"]):
    from bayesrace.errors import InputError
    from bayesrace.gp.weights import encode_weights
    from bayesrace.messages import encode
    from tests.test_decoder_fuzz import check_message, check_weights
    from tests.test_gp_weights import BODY, make_weights, reseal
    from tests.test_messages import KINDS, values

__all__: list[str] = []


def _messages(data: bytes) -> None:
    """The first byte is the kind."""
    if data:
        _expect(check_message(KINDS[data[0] % len(KINDS)], data[1:]))


def _weights(data: bytes) -> None:
    """The body only: no fuzzer guesses a checksum."""
    _expect(check_weights(reseal(_HEAD + data)))


def _expect(complaint: str) -> None:
    if complaint:
        raise AssertionError(complaint)


def _seeds(target: str) -> list[bytes]:
    if target == "weights":
        return [encode_weights(make_weights(count))[BODY:] for count in (0, 1)]
    pick = random.Random(0)
    return [bytes([i]) + encode(kind(**values(kind, pick))) for i, kind in enumerate(KINDS)]


_HEAD = encode_weights(make_weights())[:BODY]


def main(target: str, folder: Path, *options: str) -> None:
    """Hunts; does not return."""
    one = {"messages": _messages, "weights": _weights}[target]

    def test_one_input(data: bytes) -> None:
        try:
            one(data)
        except InputError:
            return

    for i, seed in enumerate(_seeds(target)):
        (folder / f"seed-{i}").write_bytes(seed)
    atheris.Setup([sys.argv[0], *options, str(folder)], test_one_input)
    atheris.Fuzz()


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), *sys.argv[3:])
