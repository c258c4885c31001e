"""Weights of the GP residual as data: learning publishes them, a controller loads them.

For each output the corrected model adds, to the discretised nominal model,

    mean(z) = y_mean + y_scale * signal_variance * sum_i alpha_i k(|(z - inputs_i) / length_scales|)

with the features z = [vx, vy, omega, delta, d, delta_rate] of the state and input *at the start* of
the step. :mod:`bayesrace.gp.expression` evaluates this formula.

The encoded form is ``magic | schema (u32 LE) | sha256 | msgpack body``; the checksum covers all but
itself. Arrays are raw little-endian float64. Decoding checks every type, shape and number and never
executes anything.
"""

import hashlib
import os
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, get_type_hints

import msgpack
import numpy as np
from numpy.typing import ArrayLike
from pydantic import AfterValidator, Field, InstanceOf, PlainValidator, TypeAdapter, ValidationError

from bayesrace.arrays import Floats
from bayesrace.defaults import MAX_POINTS, MAX_WEIGHTS_BYTES
from bayesrace.errors import InputError, faults_in
from bayesrace.files import read_whole, write_whole

if TYPE_CHECKING:
    from sklearn.gaussian_process import GaussianProcessRegressor

    from bayesrace.vehicles.parameters import Car

__all__ = [
    "FEATURES",
    "KERNELS",
    "OUTPUTS",
    "SCHEMA",
    "UNITS",
    "GpOutput",
    "Weights",
    "decode_weights",
    "encode_weights",
    "OUTPUT_HEAD",
    "pack_outputs",
    "pack_weights",
    "read_weights",
    "write_weights",
    "zero_weights",
]

OUTPUTS: Final = ("vx", "vy", "omega")
"""State components that get a correction, in this order."""

UNITS: Final = {"vx": "m/s", "vy": "m/s", "omega": "rad/s"}
"""Of the correction per output, added once a step."""

FEATURES: Final = ("vx", "vy", "omega", "delta", "d", "delta_rate")
"""Arguments of the correction, in this order."""

KERNELS: Final = ("rbf", "matern05", "matern15", "matern25")
"""Kernel kinds: squared exponential, Matérn with nu = 0.5, 1.5, 2.5."""

_MAX_PARTS: Final = 1000
"""Maps and arrays in the encoded form at most; a file has some forty. Without a limit, empty arrays
would take half a second for every MB, and 80 times their size in memory."""

SCHEMA: Final = 3
"""Version of the encoded form; any other version is refused, older ones included: train again."""

_MAGIC: Final = b"BRACEGP\n"
OUTPUT_HEAD: Final = struct.Struct("<II4d")
"""What :func:`pack_weights` has before the arrays of an output: kernel, points, offset, scale,
signal and noise."""
_HEAD: Final = struct.Struct("<8sI")
_BODY_START: Final = _HEAD.size + hashlib.sha256().digest_size


def _read_only(value: Any) -> Floats:
    """Read-only copy of finite numbers."""
    try:
        array = np.array(value, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise ValueError("not an array of numbers") from error
    if not np.isfinite(array).all():
        raise ValueError("holds a number that is not finite")
    array.setflags(write=False)
    return array


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("holds characters that cannot be printed")
    return text


_Array = Annotated[Floats, PlainValidator(_read_only)]
_Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
# Variances and scales far beyond any car's, whose products are still finite.
_Positive = Annotated[_Number, Field(gt=0, le=1e30)]
# A version must fit into an actuation message, whose texts have this limit.
_Text = Annotated[str, Field(strict=True, max_length=200), AfterValidator(_printable)]
_Name = Annotated[_Text, Field(min_length=1)]


@cache
def _adapters(kind: type) -> dict[str, TypeAdapter[Any]]:
    return {name: TypeAdapter(of) for name, of in get_type_hints(kind, include_extras=True).items()}


def _validate(item: "GpOutput | Weights") -> None:
    """Replaces each field by its validated value; InputError names the field and its fault."""
    kind: Any = type(item)
    for name, adapter in _adapters(kind).items():
        try:
            object.__setattr__(item, name, adapter.validate_python(getattr(item, name)))
        except ValidationError as error:
            fault = f"{name}: {faults_in(error, 'value')}"
            raise InputError(f"GP weights: {fault}; train again") from None


@dataclass(frozen=True, eq=False, kw_only=True)
class GpOutput:
    """One output of the residual GP; see the module text for the formula.

    ``inputs`` (n, m) are training inputs in the features' own units (m is 6 for a car), ``alpha``
    (n,) is (K + noise)^-1 y of the scaled targets y = (residual - y_mean) / y_scale,
    ``length_scales`` (m,) have the features' units. ``signal_variance`` and ``noise_variance`` are
    in units of scaled y. Where states were estimated, ``alpha`` is that of the mean that the
    readings leave, and ``noise_variance`` what leaves their variance
    (:mod:`bayesrace.learning.conditioning`).
    n = 0 means no correction beyond ``y_mean``. Raises InputError for anything inconsistent.
    """

    kernel: str
    signal_variance: _Positive
    noise_variance: Annotated[_Number, Field(ge=0)]
    y_mean: _Number = 0.0
    y_scale: _Positive = 1.0
    length_scales: _Array
    inputs: _Array
    alpha: _Array

    def __post_init__(self) -> None:
        if self.kernel not in KERNELS:
            known = ", ".join(KERNELS)
            raise InputError(f"GP weights: unknown kernel {self.kernel!r:.40}; known: {known}")
        _validate(self)
        width, shapes = self.length_scales.size, [self.length_scales.shape, self.inputs.shape]
        if self.alpha.ndim != 1 or shapes != [(width,), (self.count, width)]:
            raise InputError(
                f"GP weights: length_scales, inputs and alpha have the shapes {shapes[0]}, "
                f"{shapes[1]} and {self.alpha.shape}, expected ({width},), (n, {width}) and (n,)"
            )
        if self.count > MAX_POINTS:
            raise InputError(f"GP weights: {self.count} points are more than {MAX_POINTS}")
        if self.length_scales.min() <= 0:
            raise InputError("GP weights: every length scale must be above 0; train again")

    @property
    def count(self) -> int:
        """Number of training points, n."""
        return len(self.alpha)

    @property
    def amplitudes(self) -> tuple[float, float, float, float]:
        """What the native mean and variance are made with, SI units: offset, scale of the mean,
        variance of the function (0 without a training point: a correction that is known) and of
        the noise."""
        square = self.y_scale**2
        known = self.signal_variance * square if self.count else 0.0
        scale = self.y_scale * self.signal_variance
        return self.y_mean, scale, known, self.noise_variance * square


_Outputs = tuple[InstanceOf[GpOutput], InstanceOf[GpOutput], InstanceOf[GpOutput]]


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Weights:
    """The residual GP of one car for one discretised nominal model.

    ``discretisation`` is :meth:`bayesrace.integrators.Discretisation.identity` of the model that
    the residual was made with: a controller that predicts otherwise must refuse these weights.
    ``metrics`` maps a group to named numbers: an output's name to the scores on held-out samples
    (rmse, r2, coverage, log_density, …), "training vx" and so on to how it was learned. ``program``
    is the program and version that trained. ``sample_features`` (m, 6) and ``sample_residuals``
    (m, 3) are driven samples of the training data, by which a controller checks the weights before
    they drive. Two objects are equal if they encode to the same bytes.
    """

    version: _Name
    car: _Name
    discretisation: _Name
    dataset_digest: _Text = ""
    created_utc_ns: Annotated[int, Field(strict=True, ge=0, lt=2**63)] = 0
    metrics: Mapping[_Name, Mapping[_Name, _Number]] = field(default_factory=dict)
    program: _Text = ""
    sample_features: _Array = field(default_factory=lambda: np.zeros((0, len(FEATURES))))
    sample_residuals: _Array = field(default_factory=lambda: np.zeros((0, len(OUTPUTS))))
    outputs: _Outputs

    def __post_init__(self) -> None:
        _validate(self)
        widths = {output.inputs.shape[1] for output in self.outputs}
        if widths != {len(FEATURES)}:
            raise InputError(
                f"GP weights: inputs of {sorted(widths)} features, expected {', '.join(FEATURES)}"
            )
        features, residuals = self.sample_features, self.sample_residuals
        shapes = (len(features), len(FEATURES)), (len(features), len(OUTPUTS))
        if (features.shape, residuals.shape) != shapes:
            raise InputError(
                f"GP weights: sample_features and sample_residuals have the shapes "
                f"{features.shape} and {residuals.shape}, expected {shapes[0]} and {shapes[1]}"
            )

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Weights":
        """From a file; InputError names the file and what is wrong with it."""
        return read_weights(path)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the file that ``--weights`` and ``bayesrace publish`` take, or nothing."""
        write_weights(path, self)

    def predict(self, z: ArrayLike) -> Floats:
        """Correction (m, 3) of vx, vy [m/s] and omega [rad/s] per step, at features ``z`` (m, 6) in
        the order of :data:`FEATURES`, SI units. InputError for another shape."""
        from bayesrace.gp.expression import evaluate_mean

        return evaluate_mean(self, z)

    @classmethod
    def from_sklearn(
        cls,
        regressors: "Sequence[GaussianProcessRegressor]",
        car: "Car",
        version: str = "scikit-learn",
    ) -> "Weights":
        """Of fitted regressors for vx, vy and omega, with the same predictions.

        Each is fitted to features (n, 6) in the order of :data:`FEATURES` and to what the
        e-kinematic model of ``car`` errs by in a step (n,), as :func:`bayesrace.residuals` gives
        them. Their kernel is ConstantKernel * (RBF or Matern) + WhiteKernel, with or without any of
        these but the middle; InputError names what else there is.
        """
        from bayesrace.gp.scikit import weights_of

        return weights_of(regressors, car, version=version)

    def to_sklearn(self) -> "tuple[GaussianProcessRegressor, ...]":
        """A fitted regressor each for vx, vy and omega, with the same predictions; InputError for
        an output without training points."""
        from bayesrace.gp.scikit import regressors_of

        return regressors_of(self)

    def check_fit(self, discretisation: str, capacity: int) -> None:
        """InputError unless a controller can use them that predicts by ``discretisation`` and has
        room for ``capacity`` training points per output."""
        if self.discretisation != discretisation:
            raise InputError(
                f"weights '{self.version}' were learned for {self.discretisation}, this "
                f"controller predicts with {discretisation}: train with the same car and "
                "discretisation"
            )
        if max(self.counts) > capacity:
            raise InputError(
                f"weights '{self.version}' have {max(self.counts)} points, the controller was "
                f"built for {capacity}: train with fewer points or build with a larger capacity"
            )

    @property
    def kernels(self) -> tuple[str, ...]:
        """Kernel kind per output."""
        return tuple(output.kernel for output in self.outputs)

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of training points per output; each must fit a controller's capacity."""
        return tuple(output.count for output in self.outputs)

    def __repr__(self) -> str:
        kinds = ", ".join(f"{o.count} {o.kernel}" for o in self.outputs)
        return f"<Weights '{self.version}' of '{self.car}': {kinds} points>"

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Weights):
            return NotImplemented
        return encode_weights(self) == encode_weights(other)

    def __hash__(self) -> int:
        return hash(encode_weights(self))


def zero_weights(car: str, discretisation: str, version: str = "worstcase") -> Weights:
    """Weights without a training point: the correction is exactly zero (WorstCase)."""
    width = len(FEATURES)
    zero = GpOutput(
        kernel="rbf",
        signal_variance=1.0,
        noise_variance=0.0,
        length_scales=np.ones(width),
        inputs=np.zeros((0, width)),
        alpha=np.zeros(0),
    )
    return Weights(
        version=version, car=car, discretisation=discretisation, outputs=(zero, zero, zero)
    )


def _packed(value: Any) -> Any:
    """The plain form of what msgpack does not know: objects as maps, arrays as shape and bytes."""
    if isinstance(value, np.ndarray):
        return {"shape": list(value.shape), "f64le": value.astype("<f8", order="C").tobytes()}
    return vars(value)


def encode_weights(weights: Weights) -> bytes:
    """The one byte string for these weights; :func:`decode_weights` is its inverse.

    InputError if it is longer than what a controller can be sent.
    """
    body = vars(weights) | {"features": FEATURES, "output_names": OUTPUTS}
    body["outputs"] = body.pop("outputs")  # the last of the map
    packed: bytes = msgpack.packb(body, default=_packed)
    head = _HEAD.pack(_MAGIC, SCHEMA)
    data = head + hashlib.sha256(head + packed).digest() + packed
    if len(data) > MAX_WEIGHTS_BYTES:
        raise InputError(
            f"GP weights: {len(data)} bytes are more than {MAX_WEIGHTS_BYTES}, the largest that a "
            "controller can be sent: train with fewer points"
        )
    return data


def _array(form: Any) -> Floats:
    return np.frombuffer(form["f64le"], dtype="<f8").reshape(form["shape"])


def _output(fields: Any) -> GpOutput:
    arrays = {name: _array(fields[name]) for name in ("length_scales", "inputs", "alpha")}
    return GpOutput(**fields | arrays)


def _body(data: bytes) -> Any:
    """The msgpack body as plain values, after size, magic, schema and checksum are checked."""
    if not _BODY_START <= len(data) <= MAX_WEIGHTS_BYTES:
        raise InputError(
            f"GP weights: {len(data)} bytes is not the size of a weights file; make one with "
            "'bayesrace train'"
        )
    magic, schema = _HEAD.unpack_from(data)
    if magic != _MAGIC:
        raise InputError("GP weights: not a weights file; make one with 'bayesrace train'")
    if schema != SCHEMA:
        raise InputError(f"GP weights: schema {schema} is not {SCHEMA}; train again")
    digest = hashlib.sha256(data[: _HEAD.size] + data[_BODY_START:]).digest()
    if digest != data[_HEAD.size : _BODY_START]:
        raise InputError("GP weights: checksum mismatch, the data are damaged; copy them again")
    parts = iter(range(_MAX_PARTS))

    def counted(part: Any) -> Any:
        if next(parts, None) is None:
            raise ValueError("too many parts")
        return part

    try:
        return msgpack.unpackb(
            data[_BODY_START:],
            object_hook=counted,
            list_hook=counted,
            max_array_len=_MAX_PARTS,
            max_map_len=_MAX_PARTS,
            max_ext_len=0,
        )
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException) as error:
        raise InputError("GP weights: the body cannot be decoded; train again") from error


def decode_weights(data: bytes) -> Weights:
    """Weights from :func:`encode_weights`; InputError for any other bytes."""
    body = _body(bytes(data))
    try:
        made_for = body.pop("features"), body.pop("output_names")
        outputs: Any = tuple(map(_output, body.pop("outputs")))
        samples = {name: _array(body[name]) for name in ("sample_features", "sample_residuals")}
        weights = Weights(**body | samples, outputs=outputs)
    except InputError:
        raise
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise InputError("GP weights: the body does not describe weights; train again") from error
    if made_for != (list(FEATURES), list(OUTPUTS)):
        raise InputError(f"GP weights: made for other features or outputs than {FEATURES}")
    if encode_weights(weights) != data:  # something is missing, or has another type or shape
        raise InputError("GP weights: the body is not encoded as weights are; train again")
    return weights


def pack_weights(weights: Weights) -> bytes:
    """What the compiled step needs of them, as in the weights file of hosts in C."""
    return pack_outputs(weights.outputs)


def pack_outputs(outputs: Iterable[GpOutput]) -> bytes:
    """The same of the outputs of any problem's residual.

    For each output the members of br_mpc_gp: kernel and points as u32, offset, scale, signal, noise
    and the arrays as f64, little-endian.
    """
    parts = []
    for output in outputs:
        kernel = KERNELS.index(output.kernel)
        parts.append(OUTPUT_HEAD.pack(kernel, output.count, *output.amplitudes))
        numbers = (output.length_scales, output.inputs, output.alpha)
        parts += [np.ascontiguousarray(array, dtype="<f8").tobytes() for array in numbers]
    return b"".join(parts)


def write_weights(path: str | os.PathLike[str], weights: Weights) -> None:
    """Writes the encoded weights; the file appears whole or not at all."""
    try:
        write_whole(Path(path), encode_weights(weights))
    except OSError as error:
        raise InputError(f"cannot write weights file {path}: {error.strerror}") from error


def read_weights(path: str | os.PathLike[str]) -> Weights:
    """Weights from a file; InputError names the file and what is wrong with it."""
    data = read_whole(Path(path), "weights file", MAX_WEIGHTS_BYTES)
    try:
        return decode_weights(data)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
