"""The compiled tracking problem of one car: its limits, its path, its weights."""

from pathlib import Path

import numpy as np

from bayesrace.errors import InputError
from bayesrace.gp.weights import KERNELS, GpWeights
from bayesrace.vehicles import CarParameters
from controller.native_library import Gp, StepInfo, StepStatus
from controller.native_problem import NativeProblem, Reference
from controller.path_table import PATH_COLUMNS, PathTable
from controller.settings import MpcSettings

__all__ = ["NativeStep", "Reference", "StepInfo", "StepStatus"]


class NativeStep(NativeProblem):
    """The control step of a car that tracks a racing line."""

    def __init__(self, artefact: Path, car: CarParameters, settings: MpcSettings) -> None:
        """InputError if it was built for another car."""
        super().__init__(artefact)
        self.manifest.check_car(car, artefact)
        self.set_parameters(car, settings)

    def set_parameters(self, car: CarParameters, settings: MpcSettings) -> None:
        """Weights, limits and tolerances of the OCP; effective from the next step."""
        self.set_values(settings.parameters(car))

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
        outputs = (Gp * self.manifest.problem.outputs)()
        for target, output in zip(outputs, weights.outputs, strict=True):
            if len(output.alpha) > self.manifest.gp_capacity:
                raise InputError(
                    f"weights '{weights.version}' have {len(output.alpha)} points, the controller "
                    f"was built for {self.manifest.gp_capacity}: train with fewer points or build "
                    "with a larger capacity"
                )
            target.kernel = KERNELS.index(output.kernel)
            target.n = len(output.alpha)
            target.offset = output.y_mean
            target.scale = output.y_scale * output.signal_variance
            target.length_scales = output.length_scales.ctypes.data
            target.inputs = output.inputs.ctypes.data
            target.alpha = output.alpha.ctypes.data
        self._check(self._library.br_mpc_set_weights(self._mpc, outputs), "weights")
