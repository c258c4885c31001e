"""Mean-function weights of the GP residual as data: what learning publishes, a controller loads.

For each output the corrected model adds, to the discretised nominal model,

    mean(z) = y_mean + y_scale * signal_variance * sum_i alpha_i k(|(z - inputs_i) / length_scales|)

with the features z = [vx, vy, omega, delta, d, delta_rate] of the state and input *at the start* of
the step. The formula is evaluated by :mod:`bayesrace.gp.expression`; here it is only stored.

The encoded form is ``magic | schema (u32 LE) | sha256 | msgpack body``; the checksum covers all but
itself. Arrays are raw little-endian float64. Decoding checks every type, shape and number and never
executes anything.
"""

import hashlib
import os
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import msgpack
import numpy as np
from numpy.typing import ArrayLike, NDArray

from bayesrace.errors import InputError
from bayesrace.files import read_whole, write_whole

__all__ = [
    "FEATURES",
    "KERNELS",
    "MAX_BYTES",
    "MAX_POINTS",
    "OUTPUTS",
    "SCHEMA",
    "UNITS",
    "GpOutput",
    "GpWeights",
    "decode_weights",
    "encode_weights",
    "read_weights",
    "write_weights",
    "zero_weights",
]

Floats = NDArray[np.float64]

OUTPUTS: Final = ("vx", "vy", "omega")
"""State components that get a correction, in this order."""

UNITS: Final = {"vx": "m/s", "vy": "m/s", "omega": "rad/s"}
"""Of the correction per output, added once a step."""

FEATURES: Final = ("vx", "vy", "omega", "delta", "d", "delta_rate")
"""What the correction depends on, in this order."""

FEATURE_COUNT: Final = len(FEATURES)

KERNELS: Final = ("rbf", "matern05", "matern15", "matern25")
"""Kernel kinds by smoothness: squared exponential, Matern with nu = 0.5, 1.5, 2.5."""

MAX_POINTS: Final = 20_000
"""More training points per output than this are refused (a controller's capacity is far lower)."""

MAX_BYTES: Final = 16 * 1024 * 1024
"""Encoded weights longer than this are refused before anything is parsed."""

_MAX_PARTS: Final = 1000
"""Maps and arrays in the encoded form at most; a file has some forty. Without a limit, 16 MB of
empty arrays would take a second for every 2 MB, and 80 times their size in memory."""

SCHEMA: Final = 2
"""Version of the encoded form; any other one is refused, also an older one: train again."""

_MAGIC: Final = b"BRACEGP\n"
_HEAD: Final = struct.Struct("<8sI")
_DIGEST_BYTES: Final = 32
_MAX_TEXT: Final = 200
"""A version fits into every actuation message, whose texts have this limit."""


def _array(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Floats:
    """Read-only float64 copy of ``value``, which must be finite and of the given shape."""
    try:
        array = np.array(value, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise InputError(f"GP weights: {name} is not an array of numbers") from error
    if array.shape != shape:
        raise InputError(f"GP weights: {name} has shape {array.shape}, expected {shape}")
    if not np.isfinite(array).all():
        raise InputError(f"GP weights: {name} holds a number that is not finite; train again")
    array.setflags(write=False)
    return array


def _number(name: str, value: Any, minimum: float | None = None, strict: bool = False) -> float:
    """``value`` as finite float, at least (strict: above) ``minimum``."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.floating, np.integer)):
        raise InputError(f"GP weights: {name} must be a number, not {type(value).__name__}")
    try:
        number = float(value)
    except OverflowError:
        number = float("inf")
    if not np.isfinite(number):
        raise InputError(f"GP weights: {name} is not finite; train again")
    if minimum is not None and (number < minimum or (strict and number == minimum)):
        bound = "above" if strict else "at least"
        raise InputError(f"GP weights: {name} is {number:g}, must be {bound} {minimum:g}")
    return number


def _text(name: str, value: Any, empty: bool = False) -> str:
    if not isinstance(value, str) or len(value) > _MAX_TEXT or not (value or empty):
        raise InputError(f"GP weights: {name} must be a text of 1 to {_MAX_TEXT} characters")
    if not value.isprintable():
        raise InputError(f"GP weights: {name} holds characters that cannot be printed")
    return value


@dataclass(frozen=True, eq=False)
class GpOutput:
    """One output of the residual GP; see the module text for the formula.

    ``inputs`` (n, 6) are training inputs in the features' own units, ``alpha`` (n,) is
    (K + noise)^-1 y of the scaled targets y = (residual - y_mean) / y_scale, ``length_scales`` (6,)
    have the features' units. ``signal_variance`` and ``noise_variance`` are in units of scaled y.
    n = 0 means no correction beyond ``y_mean``. Raises InputError for anything inconsistent.
    """

    kernel: str
    length_scales: Floats
    signal_variance: float
    noise_variance: float
    inputs: Floats
    alpha: Floats
    y_mean: float = 0.0
    y_scale: float = 1.0

    def __post_init__(self) -> None:
        if self.kernel not in KERNELS:
            known = ", ".join(KERNELS)
            raise InputError(f"GP weights: unknown kernel {self.kernel!r}; known: {known}")
        count = np.shape(self.alpha)[0] if np.ndim(self.alpha) == 1 else -1
        if not 0 <= count <= MAX_POINTS:
            raise InputError(f"GP weights: alpha must be one column of at most {MAX_POINTS} points")
        length_scales = _array("length_scales", self.length_scales, (FEATURE_COUNT,))
        if length_scales.min() <= 0:
            raise InputError("GP weights: every length scale must be above 0")
        checked: dict[str, Any] = {
            "length_scales": length_scales,
            "inputs": _array("inputs", self.inputs, (count, FEATURE_COUNT)),
            "alpha": _array("alpha", self.alpha, (count,)),
            "signal_variance": _number("signal_variance", self.signal_variance, 0.0, True),
            "noise_variance": _number("noise_variance", self.noise_variance, 0.0),
            "y_mean": _number("y_mean", self.y_mean),
            "y_scale": _number("y_scale", self.y_scale, 0.0, True),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    @property
    def count(self) -> int:
        """Number of training points, n."""
        return int(self.alpha.shape[0])


@dataclass(frozen=True, eq=False)
class GpWeights:
    """The residual GP of one car for one discretised nominal model.

    ``discretisation`` is :meth:`bayesrace.integrators.Discretisation.identity` of the model that
    the residual was made with: a controller that predicts otherwise must refuse these weights.
    ``metrics`` maps a group to named numbers: an output's name to what was measured on samples that
    were not learned from (rmse, r2, coverage, log_density, …), "training vx" and so on to how it
    was learned. ``program`` is the version of what made them. Two objects are equal if they encode
    to the same bytes.
    """

    version: str
    car: str
    discretisation: str
    outputs: tuple[GpOutput, GpOutput, GpOutput]
    dataset_digest: str = ""
    created_utc_ns: int = 0
    metrics: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    program: str = ""

    def __post_init__(self) -> None:
        for name in ("version", "car", "discretisation"):
            _text(name, getattr(self, name))
        for name in ("dataset_digest", "program"):
            _text(name, getattr(self, name), empty=True)
        created = self.created_utc_ns
        if isinstance(created, bool) or not isinstance(created, int) or not 0 <= created < 2**63:
            raise InputError("GP weights: created_utc_ns must be nanoseconds since 1970")
        outputs = tuple(self.outputs)
        if len(outputs) != len(OUTPUTS) or not all(isinstance(o, GpOutput) for o in outputs):
            raise InputError(f"GP weights: need one output for each of {', '.join(OUTPUTS)}")
        object.__setattr__(self, "outputs", outputs)
        object.__setattr__(self, "metrics", _metrics(self.metrics))

    @property
    def kernels(self) -> tuple[str, ...]:
        """Kernel kind per output."""
        return tuple(output.kernel for output in self.outputs)

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of training points per output; what must fit a controller's capacity."""
        return tuple(output.count for output in self.outputs)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, GpWeights):
            return NotImplemented
        return encode_weights(self) == encode_weights(other)

    def __hash__(self) -> int:
        return hash(encode_weights(self))


def _metrics(metrics: Any) -> dict[str, dict[str, float]]:
    """Checked deep copy of the metrics."""
    groups = metrics.values() if isinstance(metrics, Mapping) else [None]
    if not all(isinstance(group, Mapping) for group in groups):
        raise InputError("GP weights: metrics must map a group to named numbers")
    return {
        _text("a metrics group", group): {
            _text("a metric's name", name): _number(f"metric {group}.{name}", value)
            for name, value in values.items()
        }
        for group, values in metrics.items()
    }


def zero_weights(car: str, discretisation: str, version: str = "worstcase") -> GpWeights:
    """Weights without a training point: the correction is exactly zero (WorstCase)."""

    def nothing() -> GpOutput:
        return GpOutput(
            "rbf", np.ones(FEATURE_COUNT), 1.0, 0.0, np.zeros((0, FEATURE_COUNT)), np.zeros(0)
        )

    return GpWeights(version, car, discretisation, (nothing(), nothing(), nothing()))


def _pack_array(array: Floats) -> dict[str, Any]:
    return {"shape": list(array.shape), "f64le": array.astype("<f8", order="C").tobytes()}


_ARRAYS: Final = ("length_scales", "inputs", "alpha")
_SCALARS: Final = ("kernel", "signal_variance", "noise_variance", "y_mean", "y_scale")
_HEADERS: Final = (
    "version",
    "car",
    "discretisation",
    "dataset_digest",
    "created_utc_ns",
    "metrics",
    "program",
)


def encode_weights(weights: GpWeights) -> bytes:
    """The one byte string for these weights; :func:`decode_weights` is its inverse."""
    body: dict[str, Any] = {name: getattr(weights, name) for name in _HEADERS}
    body["features"], body["output_names"] = list(FEATURES), list(OUTPUTS)
    body["outputs"] = [
        {name: getattr(output, name) for name in _SCALARS}
        | {name: _pack_array(getattr(output, name)) for name in _ARRAYS}
        for output in weights.outputs
    ]
    packed: bytes = msgpack.packb(body, use_bin_type=True)
    head = _HEAD.pack(_MAGIC, SCHEMA)
    return head + hashlib.sha256(head + packed).digest() + packed


def _unpack_map(name: str, value: Any, keys: tuple[str, ...]) -> dict[str, Any]:
    if not isinstance(value, dict) or set(value) != set(keys):
        raise InputError(f"GP weights: {name} does not hold exactly {', '.join(keys)}")
    return value


def _unpack_array(name: str, value: Any) -> Floats:
    fields = _unpack_map(name, value, ("shape", "f64le"))
    shape, data = fields["shape"], fields["f64le"]
    sizes_ok = isinstance(shape, list) and len(shape) in (1, 2)
    if not sizes_ok or not all(type(n) is int and 0 <= n <= MAX_POINTS for n in shape):
        raise InputError(f"GP weights: {name} has an impossible shape")
    if not isinstance(data, bytes) or len(data) != 8 * int(np.prod(shape)):
        raise InputError(f"GP weights: {name} has not as many numbers as its shape says")
    return np.frombuffer(data, dtype="<f8").reshape(shape).astype(np.float64)


def _unpack_output(value: Any) -> GpOutput:
    fields = _unpack_map("an output", value, _SCALARS + _ARRAYS)
    for name in _ARRAYS:
        fields[name] = _unpack_array(name, fields[name])
    return GpOutput(**fields)


def _unpack_body(data: bytes) -> Any:
    """Checks size, magic, schema and checksum; the msgpack body as plain Python values."""
    start = _HEAD.size + _DIGEST_BYTES
    if len(data) < start or len(data) > MAX_BYTES:
        raise InputError(f"GP weights: {len(data)} bytes is not the size of a weights file")
    magic, schema = _HEAD.unpack_from(data)
    if magic != _MAGIC:
        raise InputError("GP weights: not a weights file; make one with 'bayesrace train'")
    if schema != SCHEMA:
        raise InputError(f"GP weights: schema {schema} is not {SCHEMA}; train again")
    digest = hashlib.sha256(data[: _HEAD.size] + data[start:]).digest()
    if digest != data[_HEAD.size : start]:
        raise InputError("GP weights: checksum mismatch, the data are damaged; copy them again")
    parts = iter(range(_MAX_PARTS))

    def counted(part: Any) -> Any:
        if next(parts, None) is None:
            raise ValueError("too many parts")
        return part

    try:
        return msgpack.unpackb(
            data[start:],
            object_hook=counted,
            list_hook=counted,
            max_array_len=_MAX_PARTS,
            max_map_len=_MAX_PARTS,
            max_ext_len=0,
        )
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise InputError("GP weights: the body cannot be decoded; train again") from error


def decode_weights(data: bytes) -> GpWeights:
    """Weights from :func:`encode_weights`; InputError for anything damaged, foreign or invalid."""
    keys = (*_HEADERS, "features", "output_names", "outputs")
    body = _unpack_map("the file", _unpack_body(bytes(data)), keys)
    if body["features"] != list(FEATURES) or body["output_names"] != list(OUTPUTS):
        raise InputError(f"GP weights: made for other features or outputs than {FEATURES}")
    outputs = body["outputs"]
    if not isinstance(outputs, list) or len(outputs) != len(OUTPUTS):
        raise InputError(f"GP weights: need one output for each of {', '.join(OUTPUTS)}")
    vx, vy, omega = (_unpack_output(output) for output in outputs)
    return GpWeights(outputs=(vx, vy, omega), **{name: body[name] for name in _HEADERS})


def write_weights(path: str | os.PathLike[str], weights: GpWeights) -> None:
    """Writes the encoded weights; the file appears whole or not at all."""
    try:
        write_whole(Path(path), encode_weights(weights))
    except OSError as error:
        raise InputError(f"cannot write weights file {path}: {error.strerror}") from error


def read_weights(path: str | os.PathLike[str]) -> GpWeights:
    """Weights from a file; InputError names the file and what is wrong with it."""
    data = read_whole(Path(path), "weights file", MAX_BYTES)
    try:
        return decode_weights(data)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
