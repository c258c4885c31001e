"""New weights for the controller without Python, while it drives: controller/host/br_update.c."""

import subprocess
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bayesrace.codegen.build import PROGRAM
from bayesrace.codegen.host_files import weights_file
from bayesrace.controller.assembly import PredictiveController
from bayesrace.controller.cycle import Cycle
from bayesrace.controller.native_step import NativeStep
from bayesrace.controller.settings import SAMPLES, CycleSettings, GateSettings
from bayesrace.controller.weights.adoption import Adoption, Ruling, StepPort, Task
from bayesrace.gp.weights import Weights, pack_weights
from bayesrace.messages import (
    PIECE_BYTES,
    STATE,
    UPDATE,
    Message,
    Updated,
    datagrams_in,
    framed,
    from_datagram,
    to_datagram,
)
from bayesrace.messages import Update as Request
from bayesrace.operation.host import HostProgram
from bayesrace.vehicles import Car
from tests.conftest import Driven, fit_weights
from tests.exchanged import without_clocks
from tests.instruments import odometry
from tests.takeover.spoilt_weights import spoilt
from tests.test_fmu_controller_native import signed

CAPACITY = 1024


class Requests:
    """As datagrams, numbered."""

    def __init__(self) -> None:
        self._seq = 0

    def __call__(self, action: str, **given: Any) -> bytes:
        self._seq += 1
        values = {"seq": self._seq, "source_time_ns": 0, "at": 0, "reverted": 0, "watched": False}
        return to_datagram(UPDATE, Request(action=action, **(values | {"data": b""} | given)))

    def staged(self, file: bytes) -> list[bytes]:
        """The requests that bring a file there and stage it."""
        pieces = range(0, len(file), PIECE_BYTES)
        written = [self("write", at=at, data=file[at : at + PIECE_BYTES]) for at in pieces]
        return [*written, self("stage", at=len(file))]


def answers(program: HostProgram, sent: Sequence[bytes]) -> list[Message]:
    line = [str(program.folder / PROGRAM), str(program.folder), "stdio", "--telemetry"]
    given = b"".join(map(framed, sent))
    done = subprocess.run(line, input=given, capture_output=True, check=True, timeout=120)
    return [from_datagram(one)[1] for one in datagrams_in(done.stdout)]


def updates(messages: Sequence[Message]) -> list[Updated]:
    return [one for one in messages if isinstance(one, Updated)]


@pytest.mark.parametrize(
    "given", [{}, {"sensors": odometry(), "max_time_s": 6.0}], ids=["states", "readings"]
)
def test_weights_that_are_adopted_and_rolled_back_are_answered_by_to_the_bit(
    host: HostProgram, driven: Driven, native: NativeStep, car: Car, weights: Weights,
    given: dict[str, Any],
) -> None:  # fmt: skip
    """Good ones after 20 cycles, spoilt ones after 100, which the watch takes back, as in the loop
    of the controller's process in Python."""
    log = driven(**given)
    again = replace(fit_weights(car, ("rbf", "rbf", "rbf"), seed=2), version="again")
    changes = {20: again, 100: spoilt(again, "flip all")}
    native.set_weights(weights)
    identity = native.manifest.discretisation
    ask, sent = Requests(), []
    expected: list[Message] = []
    history: Any = SimpleNamespace(in_use=SimpleNamespace(proven=True))
    adoption = Adoption(StepPort(Path(), car, history, None, native), GateSettings())
    cycle = Cycle(PredictiveController(native), car, CycleSettings())
    driver = cycle.driver

    def send(state: Any, decision: Any) -> None:
        seq = len(expected) // 2
        expected.append(cycle.actuation(seq, state, decision))
        expected.append(cycle.telemetry(seq, state, decision, 0))
        adoption.between_cycles(cycle.timing.tick + 1)

    for k, state in enumerate(log.select(STATE)):
        if state.final:
            break
        if k in changes:
            file = weights_file(changes[k], identity, CAPACITY)
            sent += [*ask.staged(file), adopt := ask("adopt", watched=True)]
            native.stage_weights(pack_weights(changes[k]))
            adoption.tasks.append(Task(partial(adoption.use, changes[k].version, True), 0))
        sent.append(to_datagram(STATE, state))
        assert driver.observe(state)
        if not driver.doubted:
            adoption.observe(driver.vx_mps, driver.fallen_back)
        cycle.answer(state, send, adoption.limits(driver.vx_mps))
    found = answers(host, [*sent, adopt, ask("look")])
    driving = [one for one in found if not isinstance(one, Updated)]
    assert [without_clocks(one) for one in driving] == [without_clocks(one) for one in expected]
    ((at, ruling),) = [(at, one) for at, one in adoption.done if isinstance(one, Ruling)]
    assert ruling.action == "back"
    *_, first, again_asked, last = updates(found)
    assert again_asked == first  # without the ruling since
    assert (last.rulings, last.reverted, last.ruled_at) == (1, 1, at)
    assert (last.version, ruling.data["samples"]) == (weights.version, last.samples)
    assert last.errors[0] == ruling.data["error_new_vx"]
    assert {one.error for one in updates(found)} == {""}


def test_what_the_car_has_shown_is_read_in_pieces(
    host: HostProgram, driven: Driven, native: NativeStep, car: Car, weights: Weights,
) -> None:  # fmt: skip
    states = driven(max_time_s=4.0).select(STATE)[:-1]
    native.set_weights(weights)
    driver = Cycle(PredictiveController(native), car, CycleSettings())
    for state in states:
        driver.driver.observe(state)
        driver.answer(state, lambda state, decision: None)
    features, residuals, noise = native.samples()
    ask, size = Requests(), 8 * SAMPLES * (6 + 3 + 3)
    sent = [to_datagram(STATE, one) for one in states]
    sent += [ask("sample"), *(ask("read", at=at) for at in range(0, size, PIECE_BYTES))]
    sampled, *read = updates(answers(host, sent))
    found = np.frombuffer(b"".join(one.data for one in read)[:size])
    count, begin = sampled.size, 0
    assert count > 100
    for array in (features, residuals, noise):
        width = array.shape[1]
        part = found[begin : begin + count * width].reshape(count, width)
        np.testing.assert_array_equal(part, array[-count:])  # those before are of the drive
        begin += SAMPLES * width


def test_what_cannot_be_used_is_refused_and_the_weights_stay(
    host: HostProgram, driven: Driven, native: NativeStep, weights: Weights
) -> None:
    """It is adopted between two cycles: behind the next state."""
    identity = native.manifest.discretisation
    states = iter(driven(max_time_s=1.0).select(STATE))
    good = weights_file(replace(weights, version="good"), identity, CAPACITY)
    other = weights_file(replace(weights, discretisation="other"), "other", CAPACITY)
    nameless = good.replace(b"good", b"go\xffd")
    ask = Requests()

    def step() -> bytes:
        return to_datagram(STATE, next(states))

    refused = {
        "damaged (checksum)": [step(), *ask.staged(good[:-1] + bytes([good[-1] ^ 1]))],
        "cut off or too long": ask.staged(good[:-1]),
        "impossible length": [ask("stage")],
        "another model": ask.staged(other),
        "more than any weights": [ask("write", at=2**31 - 1, data=bytes(10))],
        "not as long": [ask("stage", at=2**31 - 1)],
        "buffer is not": [ask("read", at=2**31 - 1)],
        "no weights are staged": [ask("adopt"), step()],
        "rolled back meanwhile": [*ask.staged(good), ask("adopt", reverted=1), step()],
        "back meanwhile; send": [ask("sample", reverted=1)],
        "version that is no text": [*ask.staged(signed(nameless))],
        # the good ones before are still staged, but what was asked for is not
        "no weights are": [ask("adopt"), step()],
    }
    end = ask.staged(good)
    again = ask("adopt")
    end += [again, step(), again]
    found = answers(host, [one for sent in refused.values() for one in sent] + end)
    said = [one for one in updates(found) if one.error]
    assert len(said) == len(refused)
    for words, one in zip(refused, said, strict=True):
        assert words in one.error
    for last in updates(found)[-2:]:  # the same answer to a request that comes again
        assert (last.error, last.version) == ("", "good")
