"""The compiled control problem of one car: its limits, its path, its weights."""

import ctypes as ct
from pathlib import Path
from typing import Final

import numpy as np

from bayesrace.errors import InputError
from bayesrace.gp.weights import FEATURES, KERNELS, OUTPUTS, GpWeights
from bayesrace.vehicles import CarParameters
from controller.native_library import Gp, StepInfo, StepStatus
from controller.native_problem import NativeProblem, Reference
from controller.path_table import PATH_COLUMNS, PathTable
from controller.settings import MpcSettings

__all__ = [
    "NativeStep", "Reference", "StepInfo", "StepStatus", "pack_weights", "unpack_weights"
]  # fmt: skip


class NativeStep(NativeProblem):
    """The control step of a car that follows a racing line."""

    def __init__(self, artefact: Path, car: CarParameters, settings: MpcSettings) -> None:
        """InputError if it was built for another car."""
        super().__init__(artefact)
        self.manifest.check_car(car, artefact)
        self.set_parameters(car, settings)

    def set_parameters(self, car: CarParameters, settings: MpcSettings) -> None:
        """Weights, limits and tolerances of the OCP; effective from the next step."""
        self.set_values(settings.parameters(car, self.manifest.problem.name))

    def set_path(self, table: PathTable) -> None:
        """Racing line and track; copied."""
        rows = np.ascontiguousarray(table.rows, dtype=np.float64)
        if rows.ndim != 2 or rows.shape[1] != PATH_COLUMNS:
            raise InputError(f"path table has shape {rows.shape}, not (n, {PATH_COLUMNS})")
        error = self._library.br_mpc_set_path(
            self._mpc, rows.ctypes.data, len(rows), table.spacing_m
        )
        self._check(error, "path")

    def set_weights(self, weights: GpWeights) -> None:
        """Uses the weights from the next step on; InputError if they are for another model."""
        if weights.discretisation != self.manifest.discretisation:
            raise InputError(
                f"weights '{weights.version}' were learned for {weights.discretisation}, this "
                f"controller predicts with {self.manifest.discretisation}: train with the same car "
                "and discretisation"
            )
        if max(weights.counts) > self.manifest.gp_capacity:
            raise InputError(
                f"weights '{weights.version}' have {max(weights.counts)} points, the controller "
                f"was built for {self.manifest.gp_capacity}: train with fewer points or build "
                "with a larger capacity"
            )
        packed = pack_weights(weights)
        error = self._library.br_mpc_set_weights(self._mpc, unpack_weights(packed))
        self._check(error, "weights")


_HEAD: Final = 6
"""Numbers of an output before its arrays."""


def pack_weights(weights: GpWeights | None) -> bytes:
    """The arrays of the weights, for :func:`unpack_weights`; None: no correction."""
    packed = b""
    for output in () if weights is None else weights.outputs:
        head = np.array([KERNELS.index(output.kernel), output.count, *output.amplitudes])
        for part in (head, output.length_scales, output.inputs, output.alpha):
            packed += part.tobytes()
    return packed


def unpack_weights(packed: bytes) -> "ct.Array[Gp]":
    """The outputs for the library; they point into ``packed``, so keep it."""
    outputs = (Gp * len(OUTPUTS))()
    numbers, at = np.frombuffer(packed), 0
    for target in outputs if packed else ():
        kernel, count, *amplitudes = numbers[at : at + _HEAD]
        target.offset, target.scale, target.signal, target.noise = amplitudes
        target.kernel, target.n = int(kernel), int(count)
        target.length_scales = numbers.ctypes.data + 8 * (at + _HEAD)
        target.inputs = target.length_scales + 8 * len(FEATURES)
        target.alpha = target.inputs + 8 * len(FEATURES) * target.n
        at += _HEAD + len(FEATURES) * (1 + target.n) + target.n
    return outputs
