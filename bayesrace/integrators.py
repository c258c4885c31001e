"""Explicit fixed-step integrators, and the one discretisation object that all parts share.

The controller's OCP, the residual that the GP learns and every validation must step the model in
exactly the same way: a residual made with another scheme teaches the GP the difference of two
integrators. :meth:`Discretisation.identity` names the combination; weights carry it.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, Literal

from pydantic import Field

from bayesrace.strict import StrictModel
from bayesrace.vehicles.parameters import Car

if TYPE_CHECKING:
    import casadi as ca

    from bayesrace.vehicles.models import Model

__all__ = [
    "PERFECT",
    "PLANT_SCHEME",
    "PLANT_SUBSTEP_HZ",
    "PREDICTION",
    "SCHEMES",
    "Discretisation",
    "pose_from_velocities",
]

Rate = Callable[[Any], Any]
Ode = Callable[[Any, Any], Any]


def _euler(f: Rate, x: Any, h: float) -> Any:
    return x + h * f(x)


def _heun(f: Rate, x: Any, h: float) -> Any:
    k1 = f(x)
    k2 = f(x + h * k1)
    return x + h / 2 * (k1 + k2)


def _rk4(f: Rate, x: Any, h: float) -> Any:
    k1 = f(x)
    k2 = f(x + h / 2 * k1)
    k3 = f(x + h / 2 * k2)
    k4 = f(x + h * k3)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


SCHEMES: Final[dict[str, tuple[int, Callable[[Rate, Any, float], Any]]]] = {
    "euler": (1, _euler),
    "heun": (2, _heun),
    "rk4": (4, _rk4),
}
"""Scheme name to (order of the global error, one step)."""

PLANT_SCHEME: Final = "rk4"
PLANT_SUBSTEP_HZ: Final = 1000
"""The simulated car, in the plant and as an FMU, integrates in steps of 1 ms by this scheme: far
inside the tyres' stability limit at low speed."""


def pose_from_velocities(x: Any, velocities: Any, h: Any) -> Any:
    """Pose after h when (vx, vy, omega) go linearly from those in x to ``velocities``.

    The heading is then a quadratic in time, and Simpson's rule gives the position to O(h^4).
    """
    import casadi as ca

    def rates(psi: Any, v: Any) -> Any:
        return ca.vertcat(
            v[0] * ca.cos(psi) - v[1] * ca.sin(psi), v[0] * ca.sin(psi) + v[1] * ca.cos(psi)
        )

    psi, start = x[2], x[3:6]
    psi_mid = psi + h / 8 * (3 * start[2] + velocities[2])
    psi_end = psi + h / 2 * (start[2] + velocities[2])
    middle = rates(psi_mid, (start + velocities) / 2)
    change = h / 6 * (rates(psi, start) + 4 * middle + rates(psi_end, velocities))
    return ca.vertcat(x[:2] + change, psi_end)


def _symbols(model: "Model") -> tuple[Any, Any, Any, Any]:
    """x, u, e and h."""
    import casadi as ca

    n, m = len(model.states), len(model.inputs)
    return ca.SX.sym("x", n), ca.SX.sym("u", m), ca.SX.sym("e", 3), ca.SX.sym("h")


class Discretisation(StrictModel):
    """How a continuous-time model becomes x_{k+1} = F(x_k, u_k), input held over the step.

    ``pose``: "integrated" takes the pose from the scheme like every other state; "interpolated"
    from the velocities at both ends of the step, the *corrected* ones where there is a residual.
    The e-kinematic model's accelerations are wrong by up to 100 rad/s^2 while steering; a residual
    that corrects the velocities alone leaves what they did to the pose during the step.
    docs/decisions/ has the measurement.
    """

    scheme: Literal["euler", "heun", "rk4"] = Field("rk4", description="integration scheme")
    step_s: float = Field(0.02, gt=0, le=1, description="sampling time Ts")
    substeps: int = Field(1, ge=1, le=1000, description="integration steps within Ts")
    pose: Literal["integrated", "interpolated"] = Field(
        "integrated", description="where x, y, psi come from"
    )

    def discretise(self, model: "Model") -> "ca.Function":
        """F: (x, u) -> x_next for the given model, as a CasADi function."""
        import casadi as ca

        corrected = self.corrected(model)
        x, u, _, _ = _symbols(model)
        x_next = corrected(x, u, 0)
        return ca.Function(f"F_{model.name}", [x, u], [x_next], ["x", "u"], ["x_next"])

    def corrected(self, model: "Model") -> "ca.Function":
        """(x, u, e) -> x_next, where e (3,) is added to vx, vy, omega at the end of the step.

        With pose "integrated" this is F(x, u) + [0, 0, 0, e, 0] to the letter (paper, eq. 7). The
        kinematic model, which lacks these states, ignores e.
        """
        import casadi as ca

        x, u, e, _ = _symbols(model)
        x_next = self._advanced(model.ode, x, u, e, self.step_s)
        return ca.Function(f"F_{model.name}", [x, u, e], [x_next], ["x", "u", "e"], ["x_next"])

    def for_any_car(self, model: "Model") -> "ca.Function":
        """(x, u, p) -> x_next of ``model.any_car``, p its car's parameters.

        Numbers that are no constants cannot be folded: the same operations in the same order as
        the C code of the car's FMU, and so the same bits. :meth:`discretise` differs by rounding.
        """
        import casadi as ca

        ode = model.any_car
        if ode is None:
            raise ValueError(f"model '{model.name}' is written for one car only")
        x, u, p = (ca.SX.sym(name, ode.size1_in(i)) for i, name in enumerate("xup"))
        x_next = self._advanced(lambda s, v: ode(s, v, p), x, u, 0, self.step_s)
        return ca.Function(f"F_{model.name}", [x, u, p], [x_next], ["x", "u", "p"], ["x_next"])

    def over(self, model: "Model") -> "ca.Function":
        """(x, u, e, h) -> x_next: :meth:`corrected` with the step h [s] instead of ``step_s``.

        e is what the residual adds within h. For predictions over part of a step: the scheme, its
        sub-steps and the pose stay as they are, only shorter.
        """
        import casadi as ca

        x, u, e, h = _symbols(model)
        x_next = self._advanced(model.ode, x, u, e, h)
        names = ["x", "u", "e", "h"]
        return ca.Function(f"F_{model.name}_over", [x, u, e, h], [x_next], names, ["x_next"])

    def _advanced(self, ode: Ode, x: Any, u: Any, e: Any, step_s: Any) -> Any:
        _, step = SCHEMES[self.scheme]
        x_next = x
        for _ in range(self.substeps):
            x_next = step(lambda s: ode(s, u), x_next, step_s / self.substeps)
        if x.size1() == 7:  # a model with velocities
            x_next[3:6] += e
            if self.pose == "interpolated":
                x_next[:3] = pose_from_velocities(x, x_next[3:6], step_s)
        return x_next

    def identity(self, model_name: str, car: Car) -> str:
        """Text that two discretised models share if and only if they are the same map."""
        scheme = f"{self.scheme}x{self.substeps}-{self.pose}"
        return f"{model_name}/{scheme}/{self.step_s:.9g}s/{car.name}-{car.digest()}"


PREDICTION: Final = Discretisation(scheme="rk4", step_s=0.02, substeps=1, pose="interpolated")
"""Default for the e-kinematic model in the OCP, in residuals and in validation."""

PERFECT: Final = Discretisation(scheme="rk4", step_s=0.02, substeps=4)
"""For BestCase: the tyre forces are stiff at low speed (about 47/vx per second for the ORCA car),
and RK4 is stable for 2.78 of these per step: four sub-steps serve down to .085 m/s."""
