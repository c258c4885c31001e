"""Weights are data: what is encoded comes back, anything else is refused with InputError."""

import hashlib
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bayesrace.defaults import MAX_POINTS, MAX_WEIGHTS_BYTES
from bayesrace.errors import InputError
from bayesrace.gp import weights as module
from bayesrace.gp.weights import (
    KERNELS,
    GpOutput,
    Weights,
    decode_weights,
    encode_weights,
    read_weights,
    write_weights,
    zero_weights,
)

HEAD = 12
BODY = HEAD + 32


def make_output(seed: int = 0, count: int = 5, kernel: str = "rbf", **changes: Any) -> GpOutput:
    random = np.random.default_rng(seed)
    values: dict[str, Any] = {
        "kernel": kernel,
        "length_scales": random.uniform(0.5, 2.0, 6),
        "signal_variance": 2.0,
        "noise_variance": 0.01,
        "inputs": random.normal(size=(count, 6)),
        "alpha": random.normal(size=count),
        "y_mean": 0.1,
        "y_scale": 0.5,
    }
    return GpOutput(**(values | changes))


def make_weights(count: int = 5, kernels: tuple[str, ...] = KERNELS[:3]) -> Weights:
    vx, vy, omega = (make_output(i, count + i, kernel) for i, kernel in enumerate(kernels))
    metrics = {"vx": {"rmse": 0.1}, "training vx": {"points": 5.0}}
    return Weights(
        version="v1",
        car="orca",
        discretisation="model/rk4",
        dataset_digest="digest",
        created_utc_ns=17,
        metrics=metrics,
        program="bayesrace 1.2.3",
        outputs=(vx, vy, omega),
    )


def reseal(data: bytes) -> bytes:
    """The same bytes with a checksum that fits: what a checksum cannot catch."""
    return data[:HEAD] + hashlib.sha256(data[:HEAD] + data[BODY:]).digest() + data[BODY:]


def rebuild(change: Any) -> bytes:
    body = msgpack.unpackb(encode_weights(make_weights())[BODY:])
    change(body)
    return reseal(encode_weights(make_weights())[:BODY] + msgpack.packb(body))


finite = st.floats(-1e6, 1e6)
positive = st.floats(1e-6, 1e6)


@st.composite
def gp_outputs(draw: st.DrawFn) -> GpOutput:
    count = draw(st.integers(0, 4))
    rows = st.lists(finite, min_size=6, max_size=6)
    inputs = draw(st.lists(rows, min_size=count, max_size=count))
    return GpOutput(
        kernel=draw(st.sampled_from(KERNELS)),
        length_scales=np.array(draw(st.lists(positive, min_size=6, max_size=6))),
        signal_variance=draw(positive),
        noise_variance=draw(st.floats(0, 10)),
        inputs=np.reshape(inputs, (count, 6)),
        alpha=np.array(draw(st.lists(finite, min_size=count, max_size=count))),
        y_mean=draw(finite),
        y_scale=draw(positive),
    )


@given(vx=gp_outputs(), vy=gp_outputs(), omega=gp_outputs(), created=st.integers(0, 2**62))
@settings(max_examples=40, deadline=None)
def test_encoding_round_trips(vx: GpOutput, vy: GpOutput, omega: GpOutput, created: int) -> None:
    weights = replace(make_weights(), created_utc_ns=created, outputs=(vx, vy, omega))
    again = decode_weights(encode_weights(weights))
    assert again == weights
    for ours, theirs in zip(weights.outputs, again.outputs, strict=True):
        assert np.array_equal(ours.inputs, theirs.inputs)
        assert np.array_equal(ours.alpha, theirs.alpha)
        assert ours.kernel == theirs.kernel


def test_the_most_points_fit_into_what_can_be_sent() -> None:
    """With samples to check them by; what does not fit is refused by whoever would write it."""
    most: Any = tuple(make_output(seed, MAX_POINTS) for seed in range(3))
    samples: Any = {"sample_features": np.ones((1000, 6)), "sample_residuals": np.ones((1000, 3))}
    largest = replace(make_weights(), outputs=most, **samples)
    assert decode_weights(encode_weights(largest)) == largest
    many: Any = {name: np.repeat(rows, 10, axis=0) for name, rows in samples.items()}
    with pytest.raises(InputError, match=f"more than {MAX_WEIGHTS_BYTES}"):
        encode_weights(replace(largest, **many))
    with pytest.raises(InputError, match=f"more than {MAX_POINTS}"):
        make_output(0, MAX_POINTS + 1)


@given(data=st.data())
@settings(max_examples=150, deadline=None)
def test_damaged_bytes_are_refused(data: st.DataObject) -> None:
    good = encode_weights(make_weights())
    position = data.draw(st.integers(0, len(good) - 1))
    bit = data.draw(st.integers(0, 7))
    flipped = bytearray(good)
    flipped[position] ^= 1 << bit
    for bad in (bytes(flipped), good[:position], good + b"\0", b""):
        with pytest.raises(InputError):
            decode_weights(bad)


@given(data=st.data())
@settings(max_examples=150, deadline=None)
def test_a_fitting_checksum_alone_is_not_enough(data: st.DataObject) -> None:
    """Damage under a recomputed checksum gives valid weights or InputError, nothing else."""
    good = encode_weights(make_weights())
    changed = bytearray(good)
    for _ in range(data.draw(st.integers(1, 3))):
        changed[data.draw(st.integers(BODY, len(good) - 1))] = data.draw(st.integers(0, 255))
    end = data.draw(st.integers(BODY, len(good)))
    for bad in (bytes(changed), good[:end]):
        try:
            decoded = decode_weights(reseal(bad))
        except InputError:
            continue
        assert all(np.isfinite(output.alpha).all() for output in decoded.outputs)


@given(noise=st.binary(max_size=200))
def test_any_bytes_decode_or_are_refused(noise: bytes) -> None:
    head = encode_weights(make_weights())[:BODY]
    for bad in (noise, reseal(head + noise)):
        with pytest.raises(InputError):
            decode_weights(bad)


@pytest.mark.parametrize(
    "change",
    [
        lambda body: body.pop("car"),
        lambda body: body.pop("program"),
        lambda body: body.update(program="a\nb"),
        lambda body: body.update(extra=1),
        lambda body: body.update(version=""),
        lambda body: body.update(car=7),
        lambda body: body.update(created_utc_ns=-1),
        lambda body: body.update(created_utc_ns=True),
        lambda body: body.update(features=["vx"]),
        lambda body: body.update(outputs=body["outputs"][:2]),
        lambda body: body.update(outputs={}),
        lambda body: body.update(metrics=[1]),
        lambda body: body.update(metrics={"vx": {"rmse": float("nan")}}),
        lambda body: body["outputs"][0].update(kernel=["rbf"]),
        lambda body: body["outputs"][0].update(y_scale="1"),
        lambda body: body["outputs"][0].update(y_mean=float("inf")),
        lambda body: body["outputs"][0].update(y_mean=10**18 * 1.0 * 10**300),
        lambda body: body["outputs"][0]["alpha"].update(shape=[-1]),
        lambda body: body["outputs"][0]["alpha"].update(shape=[True]),
        lambda body: body["outputs"][0]["alpha"].update(shape=[4]),
        lambda body: body["outputs"][0]["alpha"].update(shape=None),
        lambda body: body["outputs"][0].update(signal_variance=2),  # encoded as an integer
        lambda body: body["outputs"][0]["alpha"].update(shape=[2**40]),
        lambda body: body["outputs"][0]["alpha"].update(f64le="text"),
        lambda body: body["outputs"][0]["inputs"].update(shape=[6, 5]),
        lambda body: body["outputs"][0]["alpha"].update(f64le=struct.pack("<5d", *[np.nan] * 5)),
    ],
)
def test_wrong_content_is_refused(change: Any) -> None:
    with pytest.raises(InputError):
        decode_weights(rebuild(change))


def test_unchanged_content_is_accepted() -> None:
    assert decode_weights(rebuild(lambda body: None)) == make_weights()


def test_other_schema_and_foreign_files_say_so() -> None:
    good = encode_weights(make_weights())
    newer = good[:8] + struct.pack("<I", module.SCHEMA + 1) + good[HEAD:]
    with pytest.raises(InputError, match=f"schema {module.SCHEMA + 1}"):
        decode_weights(newer)
    with pytest.raises(InputError, match="not a weights file"):
        decode_weights(b"PK\x03\x04" + bytes(100))


@pytest.mark.parametrize(
    "changes",
    [
        {"kernel": "cubic"},
        {"length_scales": np.zeros(6)},
        {"length_scales": np.ones(5)},
        {"signal_variance": 0.0},
        {"noise_variance": -1e-9},
        {"signal_variance": True},
        {"inputs": np.full((5, 6), np.nan)},
        {"inputs": np.zeros((4, 6))},
        {"alpha": np.zeros((5, 1))},
        {"alpha": ["a"] * 5},
        {"y_mean": np.inf},
        {"y_scale": 0.0},
    ],
)
def test_invalid_outputs_cannot_be_made(changes: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        make_output(**changes)


def test_weights_are_immutable_copies() -> None:
    inputs = np.zeros((2, 6))
    output = make_output(inputs=inputs, alpha=np.zeros(2))
    inputs[0, 0] = 7.0
    assert output.inputs[0, 0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        output.alpha[0] = 1.0


def test_zero_weights_have_no_points() -> None:
    weights = zero_weights("orca", "d")
    assert weights.counts == (0, 0, 0)
    assert decode_weights(encode_weights(weights)) == weights


def test_file_round_trip_and_errors(tmp_path: Path) -> None:
    path = tmp_path / "weights.bin"
    write_weights(path, make_weights())
    assert read_weights(path) == make_weights()
    assert [p.name for p in tmp_path.iterdir()] == ["weights.bin"]
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(InputError, match=r"weights\.bin"):
        read_weights(path)
    with pytest.raises(InputError, match=r"missing\.bin"):
        read_weights(tmp_path / "missing.bin")
    with pytest.raises(InputError, match="cannot write"):
        write_weights(tmp_path / "none" / "weights.bin", make_weights())
