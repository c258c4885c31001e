"""The three vehicle models under the same inputs (paper, section 2)."""

from typing import Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.integrators import Discretisation
from bayesrace.operation.report.style import look, panel
from bayesrace.studies.paper.finding import Finding, Section
from bayesrace.vehicles import CarParameters
from bayesrace.vehicles.models import Model, dynamic, e_kinematic, kinematic
from bayesrace.vehicles.parts import AccelerationDrive

__all__ = ["model_section"]

_ACCELERATION_MPS2: Final = 1.0
_STEERING_RAD: Final = 0.2
_STEPS: Final = 1000
_APART: Final = 0.05
"""Share of the way from which a distance is a mismatch that can be seen."""
_MODELS: Final = {
    "dynamic": (dynamic, look("bestcase").colour),
    "kinematic": (kinematic, look("bayesrace").colour),
    "e-kinematic": (e_kinematic, look("worstcase").colour),
}
_DIVERGE: Final = "trajectories diverge with time; the mismatch is evident even at low speeds"
_TEXT: Final = (
    f"Acceleration {_ACCELERATION_MPS2:g} m/s² for 1 s from rest, steering held at "
    f"{_STEERING_RAD:g} rad. The dynamic model is driven so that its rear longitudinal force, "
    "resistances subtracted, is mass times that acceleration at every moment: under a constant "
    "duty cycle motor and resistances would slow it, which the kinematic models do not have."
)


def model_section(car: CarParameters) -> Section:
    """All three from rest; the drive's force over mass is the same in each."""
    # A drive whose command is F_r,x / m, resistances included.
    drive = AccelerationDrive(model="acceleration", power_speed_mps=1e3, speed_max_mps=1e3)
    same = car.model_copy(update={"drive": drive})
    figure, axes = panel(4.2)
    paths = {}
    for name, (model, colour) in _MODELS.items():
        paths[name] = path = _response(model(same))
        axes.plot(*path.T, color=colour, label=name)
        axes.plot(*path[:: _STEPS // 4].T, "o", color=colour, markersize=3)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="a dot each 0.25 s")
    axes.legend(loc="upper left")
    true = paths.pop("dynamic")
    way_m = float(np.linalg.norm(np.diff(true, axis=0), axis=1).sum())
    findings = []
    for name, path in paths.items():
        apart_m = np.linalg.norm(path - true, axis=1)
        early, half, end = (float(apart_m[_STEPS // part]) for part in (4, 2, 1))
        ours = f"{100 * early:.2g}, {100 * half:.2g}, {100 * end:.2g} cm after 0.25, 0.5, 1 s"
        criterion = f"it grows, to more than {100 * _APART:g} % of the {100 * way_m:.0f} cm driven"
        holds = early < half < end and end > _APART * way_m
        what = f"distance of the {name} from the dynamic model"
        findings.append(Finding(what, _DIVERGE, ours, criterion, holds))
    return Section("Response of the models", "section 2", _TEXT, {"models": figure}, findings)


def _response(model: Model) -> Floats:
    """Positions (n, 2) over a second."""
    step = Discretisation(scheme="rk4", step_s=1 / _STEPS).discretise(model)
    x = np.zeros(len(model.states))
    x[-1] = _STEERING_RAD
    path = [x[:2]]
    for _ in range(_STEPS):
        x = np.asarray(step(x, [_ACCELERATION_MPS2, 0.0])).ravel()
        path.append(x[:2])
    return np.array(path)
