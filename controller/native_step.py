"""The compiled control problem of one car: its limits, its path, its weights."""

from pathlib import Path

from bayesrace.gp.weights import GpWeights, pack_weights
from bayesrace.vehicles import CarParameters
from controller.native_library import StepStatus
from controller.native_problem import NativeProblem, Reference
from controller.path_table import PATH_COLUMNS, PathTable
from controller.settings import MpcSettings

__all__ = ["NativeStep", "Reference", "StepStatus"]


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
        rows = self._given("path table", table.rows, len(table.rows), PATH_COLUMNS)
        count = len(table.rows)
        error = self._library.br_mpc_set_path(self.handle, rows, count, table.spacing_m)
        self._check(error, "path")

    def set_weights(self, weights: GpWeights) -> None:
        """Uses the weights from the next step on; InputError if they are for another model."""
        weights.check_fit(self.manifest.discretisation, self.manifest.gp_capacity)
        self.load_weights(pack_weights(weights))
