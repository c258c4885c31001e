"""The decoders' promise under fire: anything is decoded to something valid or is an InputError.

400,000 damaged messages and weights files, in processes of their own, so that a crash of the
interpreter is a failure of the test; then a shorter hunt guided by coverage, where atheris is.
"""

import json
import multiprocessing
import subprocess
import sys
import tracemalloc
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from bayesrace.errors import InputError
from bayesrace.gp.weights import GpWeights, decode_weights, encode_weights
from bayesrace.messages import (
    LARGEST_BYTES,
    Message,
    decode,
    decode_json,
    encode,
    json_schema,
    to_json,
)
from tests.mutations import FRAGMENTS, KINDS, MessageMutator, WeightsMutator, bombs
from tests.programs import ROOT
from tests.test_gp_weights import BODY, make_weights, reseal
from tests.test_messages import conforms

pytestmark = pytest.mark.unmeasured

MESSAGES = 240_000
WEIGHTS = 16_000
WORKERS = 2
SCHEMAS = {kind: json_schema(kind) for kind in KINDS}


@dataclass
class Outcome:
    """What became of many inputs."""

    accepted: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)

    def add(self, name: str, data: bytes, check: Callable[[bytes], str]) -> None:
        """One input; ``check`` says what is wrong with what was accepted, if anything."""
        try:
            complaint = check(data)
        except InputError:
            self.refused[name] += 1
            return
        except Exception as error:
            complaint = f"{type(error).__name__}: {error}"
        self.accepted[name] += 1
        if complaint and len(self.wrong) < 20:
            self.wrong.append(f"{name} from {data[:200].hex()}: {complaint}")


def check_message(kind: type[Message], data: bytes) -> str:
    """Decodes; what is wrong with the result, or InputError."""
    message = decode(kind, data)
    text = to_json(message)
    if not conforms(json.loads(text), SCHEMAS[kind]):
        return f"not as its schema says: {text[:500]!r}"
    both = decode(kind, encode(message)), decode_json(kind, text)
    return "" if both == (message, message) else "another message after encoding it again"


def check_weights(data: bytes) -> str:
    """Decodes; what is wrong with the result, or InputError."""
    weights = decode_weights(data)
    for output in weights.outputs:
        numbers = np.concatenate(
            [
                output.length_scales,
                output.inputs.ravel(),
                output.alpha,
                [output.signal_variance, output.noise_variance, output.y_mean, output.y_scale],
            ]
        )
        if not np.isfinite(numbers).all() or output.inputs.shape != (output.count, 6):
            return "numbers that are not finite, or too few"
    return "" if _encoded_again(weights) == weights else "others after encoding them again"


def _encoded_again(weights: GpWeights) -> GpWeights:
    return decode_weights(encode_weights(weights))


def hunt(seed: int, messages: int, weights: int) -> Outcome:
    """Damages and decodes that many; runs in a process of its own."""
    outcome, mutate, spoil = Outcome(), MessageMutator(seed), WeightsMutator(seed)
    for i in range(messages):
        kind = KINDS[i % len(KINDS)]
        outcome.add(kind.__name__, mutate(kind), partial(check_message, kind))
    for _ in range(weights):
        outcome.add("GpWeights", spoil(), check_weights)
    return outcome


@pytest.mark.check
def test_damaged_inputs_are_valid_or_refused() -> None:
    share = (MESSAGES // WORKERS, WEIGHTS // WORKERS)
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(WORKERS, mp_context=spawn) as pool:
        outcomes = [future.result() for future in [
            pool.submit(hunt, seed, *share) for seed in range(0, 10 * WORKERS, 10)
        ]]  # fmt: skip
    accepted = sum((outcome.accepted for outcome in outcomes), Counter[str]())
    refused = sum((outcome.refused for outcome in outcomes), Counter[str]())
    assert [fault for outcome in outcomes for fault in outcome.wrong] == []
    assert accepted.total() + refused.total() == MESSAGES + WEIGHTS
    # A hunt that finds no way in, or no way to be refused, would prove nothing.
    for name in [*(kind.__name__ for kind in KINDS), "GpWeights"]:
        assert accepted[name] > 1000, name
        assert refused[name] > 1000, name


@pytest.mark.parametrize("kind", KINDS)
def test_the_undamaged_of_the_fuzzer_are_all_accepted(kind: type[Message]) -> None:
    """The other half of the argument: it starts from valid messages, at their limits too."""
    mutator = MessageMutator(1)
    for _ in range(100):
        data = mutator.valid(kind)
        assert check_message(kind, data) == ""


@pytest.mark.parametrize("kind", KINDS)
def test_every_fragment_in_every_field_is_valid_or_refused(kind: type[Message]) -> None:
    mutator, outcome = MessageMutator(2), Outcome()
    for data in mutator.with_each_fragment(kind):
        outcome.add(kind.__name__, data, partial(check_message, kind))
    assert outcome.wrong == []
    assert outcome.refused.total() > len(FRAGMENTS)


def peak_bytes(decoder: Callable[[bytes], object], data: bytes) -> int:
    """Python memory that refusing these bytes takes."""
    tracemalloc.start()
    try:
        with pytest.raises(InputError):
            decoder(data)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("name", bombs(100))
def test_what_promises_more_than_it_holds_costs_no_memory(name: str) -> None:
    """Nonsense as long as a message may be, read; and far longer, which is not read at all."""
    whole, twice = bombs(LARGEST_BYTES)[name], bombs(2 * LARGEST_BYTES)[name]
    for kind in KINDS:
        assert peak_bytes(partial(decode, kind), whole) < 2 * LARGEST_BYTES
        assert peak_bytes(partial(decode, kind), twice) < 10_000


@pytest.mark.parametrize("name", bombs(100))
def test_weights_that_promise_more_than_they_hold_cost_little_memory(name: str) -> None:
    """A checksum is no protection: an attacker who makes the bytes makes it too."""
    size = 4_000_000
    data = reseal(encode_weights(make_weights())[:BODY] + bombs(size)[name])
    assert peak_bytes(decode_weights, data) < 5 * size


@pytest.mark.check
@pytest.mark.skipif(find_spec("atheris") is None, reason="atheris has no wheel for this platform")
@pytest.mark.parametrize("target", ["messages", "weights"])
def test_coverage_guided_fuzzing_finds_nothing(target: str, tmp_path: Path) -> None:
    runs = {"messages": 200_000, "weights": 40_000}[target]
    corpus = tmp_path / "corpus"
    corpus.mkdir()
    command = [sys.executable, "-m", "tests.fuzz_decoder", target, str(corpus), f"-runs={runs}"]
    limits = ["-seed=1", "-timeout=60", "-rss_limit_mb=1024", f"-artifact_prefix={tmp_path}/"]
    done = subprocess.run(
        [*command, *limits],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert f"Done {runs} runs" in done.stderr
    # More than the seeds: it found its way to inputs that do something new.
    assert len(list(corpus.iterdir())) > 20
