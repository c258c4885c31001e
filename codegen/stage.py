"""The nominal model of one stage, with its derivatives and over part of it, as CasADi functions
that become C."""

import casadi as ca

from bayesrace.integrators import Discretisation
from bayesrace.vehicles.models import Model

__all__ = ["advance_function", "linearise_function", "linearised"]

_NX, _NV, _NE = 7, 9, 3
_NW = _NV + _NE


def linearised(f: ca.Function) -> ca.Function:
    """``(x, u, e, lambda) -> (F, J', H)`` of any f(x, u, e), as :func:`linearise_function`."""
    nx, nu, ne = (f.size1_in(i) for i in range(3))
    nv = nx + nu
    w = ca.SX.sym("w", nv + ne)
    return _with_arguments(*_derivatives(w, f(w[:nx], w[nx:nv], w[nv:]), ""), nx, nu, ne)


def _derivatives(v: ca.SX, x_next: ca.SX, suffix: str) -> tuple[ca.Function, ca.Function]:
    """``v -> (x_next, J)`` and ``(v, lambda) -> H``: apart, because H is often not needed."""
    lam = ca.SX.sym("lambda", x_next.numel())
    jacobian = ca.densify(ca.jacobian(x_next, v))
    hessian = ca.densify(ca.hessian(ca.dot(lam, x_next), v)[0])
    options = {"cse": True}
    return (
        ca.Function(f"br_forward{suffix}", [v], [x_next, jacobian], options),
        ca.Function(f"br_second{suffix}", [v, lam], [hessian], options),
    )


def _with_arguments(
    forward: ca.Function, second: ca.Function, nx: int, nu: int, ne: int
) -> ca.Function:
    """The same with x, u and e apart, and the Jacobian transposed."""
    x, u, e = ca.MX.sym("x", nx), ca.MX.sym("u", nu), ca.MX.sym("e", ne)
    lam, w = ca.MX.sym("lambda", nx), ca.vertcat(x, u, e)
    (x_next, jacobian), hessian = forward(w), second(w, lam)
    return ca.Function(
        "br_linearise",
        [x, u, e, lam],
        [x_next, jacobian.T, hessian],
        ["x", "u", "e", "lambda"],
        ["x_next", "jacobian_transposed", "hessian"],
    )


def _composed(model: Model, discretisation: Discretisation) -> tuple[ca.Function, ca.Function]:
    """``w -> (F, J)`` and ``(w, lambda) -> H`` for many sub-steps.

    By the chain rule, so that code grows by calls. With S_i = d [x_i; u] / d [x; u] and lambda_i
    the costate of sub-step i:

        J = d x_n / d v,    H = sum_i S_i' H_i(lambda_i) S_i,    lambda_i = A_i' lambda_{i+1}

    e enters at the end of the step: its columns of J are unit vectors, those of H zero.
    """
    n = discretisation.substeps
    one = discretisation.model_copy(update={"step_s": discretisation.step_s / n, "substeps": 1})
    v = ca.SX.sym("v", _NV)
    forward, second = _derivatives(v, one.discretise(model)(v[:_NX], v[_NX:]), "_substep")
    w, lam = ca.MX.sym("w", _NW), ca.MX.sym("lambda", _NX)
    u = w[_NX:_NV]
    states, jacobians = [w[:_NX]], []
    for _ in range(n):
        x_next, jacobian = forward(ca.vertcat(states[-1], u))
        states.append(x_next)
        jacobians.append(jacobian)
    hold_u = ca.horzcat(ca.MX.zeros(2, _NX), ca.MX.eye(2))
    sensitivities = [ca.MX.eye(_NV)]
    for jacobian in jacobians:
        sensitivities.append(ca.vertcat(jacobian @ sensitivities[-1], hold_u))
    costate = lam
    hessian = ca.MX(_NV, _NV)
    for i in reversed(range(n)):
        curvature = second(ca.vertcat(states[i], u), costate)
        hessian += sensitivities[i].T @ curvature @ sensitivities[i]
        costate = jacobians[i][:, :_NX].T @ costate
    enters = ca.vertcat(ca.DM.zeros(3, _NE), ca.DM.eye(_NE), ca.DM.zeros(1, _NE))
    jacobian = ca.horzcat(sensitivities[n][:_NX, :], enters)
    hessian = ca.diagcat(hessian, ca.DM.zeros(_NE, _NE))
    x_next = states[-1] + enters @ w[_NV:]
    options = {"cse": True}
    return (
        ca.Function("br_composed", [w], [x_next, ca.densify(jacobian)], options),
        ca.Function("br_composed_second", [w, lam], [ca.densify(hessian)], options),
    )


def linearise_function(model: Model, discretisation: Discretisation) -> ca.Function:
    """``(x, u, e, lambda) -> (F, J', H)`` of the discretised model, all dense.

    e (3) is the residual's mean, added to vx, vy, omega at the end of the step; with w = [x; u; e],
    J' (12 x 7) is the transposed Jacobian (column major, so C reads it as J row major) and H
    (12 x 12) the Hessian of lambda' F. The chain through e, which depends on x and u, is closed
    natively (controller/native/br_stage.c).
    """
    if discretisation.substeps > 1 and discretisation.pose == "integrated":
        return _with_arguments(*_composed(model, discretisation), _NX, _NV - _NX, _NE)
    return linearised(discretisation.corrected(model))


def advance_function(model: Model, discretisation: Discretisation) -> ca.Function:
    """``(x, u, e, h) -> x_next``: the model over h [s], e what the residual adds within it."""
    over = discretisation.over(model)
    x, u, e, h = (ca.SX.sym(name, n) for name, n in (("x", _NX), ("u", 2), ("e", _NE), ("h", 1)))
    x_next = ca.densify(over(x, u, e, h))
    names = ["x", "u", "e", "h"]
    return ca.Function("br_advance", [x, u, e, h], [x_next], names, ["x_next"], {"cse": True})
