"""Explicit fixed-step integrators, and the one discretisation object that all parts share.

The controller's OCP, the residual that the GP learns and every validation must step the model in
exactly the same way: a residual made with another scheme teaches the GP the difference of two
integrators. :meth:`Discretisation.identity` names the combination; weights carry it.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field

from bayesrace.vehicles.parameters import CarParameters

if TYPE_CHECKING:
    import casadi as ca

    from bayesrace.vehicles.models import Model

__all__ = ["PERFECT", "PREDICTION", "SCHEMES", "Discretisation"]

Rate = Callable[[Any], Any]


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


class Discretisation(BaseModel):
    """How a continuous-time model becomes x_{k+1} = F(x_k, u_k), input held over the step."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    scheme: Literal["euler", "heun", "rk4"] = Field("rk4", description="integration scheme")
    step_s: float = Field(0.02, gt=0, le=1, description="sampling time Ts")
    substeps: int = Field(1, ge=1, le=1000, description="integration steps within Ts")

    def discretise(self, model: "Model") -> "ca.Function":
        """F: (x, u) -> x_next for the given model, as a CasADi SX function."""
        import casadi as ca

        x = ca.SX.sym("x", len(model.states))
        u = ca.SX.sym("u", len(model.inputs))
        _, step = SCHEMES[self.scheme]
        x_next = x
        for _ in range(self.substeps):
            x_next = step(lambda s: model.ode(s, u), x_next, self.step_s / self.substeps)
        return ca.Function(f"F_{model.name}", [x, u], [x_next], ["x", "u"], ["x_next"])

    def identity(self, model_name: str, car: CarParameters) -> str:
        """Text that two discretised models share if and only if they are the same map."""
        scheme = f"{self.scheme}x{self.substeps}"
        return f"{model_name}/{scheme}/{self.step_s:.9g}s/{car.name}-{car.digest()}"


PREDICTION: Final = Discretisation(scheme="rk4", step_s=0.02, substeps=1)
"""Default for the e-kinematic model in the OCP, in residuals and in validation."""

PERFECT: Final = Discretisation(scheme="rk4", step_s=0.02, substeps=10)
"""For BestCase: the tyre forces are stiff at low speed (about 47/vx per second for the ORCA car, up
to 1250 per second at standstill), and RK4 is stable for 2.78 of these per step."""
