"""What an optimal control problem is: one object that the C code, its Python binding and the
IPOPT oracle are all made from.

    min  sum_{k=1}^N  l(x_k, u_{k-1}, u_{k-2}, p_k)  +  sum_k sum_r  w_r eps_{k,r}^2
    s.t. x_{k+1} = f(x_k, u_k) + residual,   x_0 and u_{-1} given
         u_lower <= u_k <= u_upper
         lower_r <= h_r(x_k, p_k) <= upper_r             hard rows, k = 1..N
         lower_r - eps <= h_r(x_k, p_k) <= upper_r + eps  soft rows with penalty w_r

``p_k`` are the parameters of stage k, written by a planner at each step; ``theta`` are run-time
parameters, which change seldom. All expressions are CasADi SX.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import casadi as ca

from bayesrace.errors import InputError

__all__ = [
    "NO_BOUND", "Input", "Parameter", "Problem", "Row", "State", "Symbols", "derivatives",
    "linearised", "with_arguments",
]  # fmt: skip

_TAKEN: Final = {
    "tolerance", "defect_max", "early_stop_tol", "iterations", "iterations_cold", "caution_sigmas",
    "qp_steps",
}  # fmt: skip
"""Names beside the problem's in br_mpc_parameters, controller/native/bayesrace_mpc.h."""

NO_BOUND: Final = 1e20
"""A bound of a row that is none."""


@dataclass(frozen=True)
class State:
    """One component of the state."""

    name: str
    unit: str
    scale: float = 1.0
    """Size of a defect that counts as 1 in its norm."""
    limit: float = 1e6
    """A larger absolute value is no state of this system, and refused; no bound of the problem,
    which is a :class:`Row`."""
    deviation: float = 1.0
    """What feedback about a plan weighs as much as a deviation of another component, or an
    :attr:`Input.effort`."""
    odd: bool = False
    """It changes its sign in a mirror, in which the system moves as before; the others stay."""


@dataclass(frozen=True)
class Input:
    """One component of the input."""

    name: str
    unit: str
    held: bool = True
    """What a plan is continued with at its end when it is shifted by a stage: the last value, or
    zero."""
    limit: float = 1e6
    """A larger absolute value is no input of this system, and refused; no bound of the problem."""
    effort: float = 1.0
    """What feedback about a plan weighs as much as a :attr:`State.deviation`."""
    odd: bool = False
    """As :attr:`State.odd`."""
    proximal: float = 0.0
    """Weight of half the squared change of this input in one QP, which takes as little of it as
    convexity needs: controller/native/br_qp.c. Not part of the cost: the plan that the iterations
    converge to is the same. For a cost that is linear in much of the plan."""


@dataclass(frozen=True)
class Parameter:
    """One parameter, of a stage or of the whole problem."""

    name: str
    unit: str
    text: str = ""
    low: float = -NO_BOUND
    high: float = NO_BOUND
    positive: bool = False
    """Has to be above zero."""


@dataclass(frozen=True)
class Row:
    """A constraint on the states from stage 1 on; hard without a penalty."""

    name: str
    value: ca.SX
    lower: ca.SX | float
    upper: ca.SX | float
    penalty: ca.SX | None = None
    """Weight of the squared violation, of theta alone; 0 switches the row off."""
    cautious: bool = False
    """Whether the car slows down where the residual's uncertainty takes much of the room between
    its bounds; for soft rows only."""

    @property
    def soft(self) -> bool:
        """Whether it may be violated."""
        return self.penalty is not None


@dataclass(frozen=True, eq=False)
class Symbols:
    """What the expressions of a problem are written in."""

    x: ca.SX
    u: ca.SX
    u_before: ca.SX
    """Input of the stage before."""
    p: ca.SX
    """Parameters of the stage."""
    theta: ca.SX
    """Run-time parameters, in the order of :attr:`Problem.parameters`."""
    last: ca.SX
    """1 at the last stage, else 0: a factor of the terminal cost."""
    share: ca.SX
    """Of a guess of the inputs: 0 to 1; several guesses are tried."""
    h: ca.SX
    """Duration [s] over which an input acts."""

    @classmethod
    def of(cls, states: int, inputs: int, stage_parameters: int, parameters: int) -> "Symbols":
        """Symbols of these sizes."""
        sym = ca.SX.sym
        return cls(
            sym("x", states), sym("u", inputs), sym("u_before", inputs),
            sym("p", stage_parameters), sym("theta", parameters),
            sym("last"), sym("share"), sym("h"),
        )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class Problem:
    """One optimal control problem with its prediction model."""

    name: str
    states: tuple[State, ...]
    inputs: tuple[Input, ...]
    stage_parameters: tuple[Parameter, ...]
    parameters: tuple[Parameter, ...]
    features: tuple[str, ...] = ()
    """Names of the states and inputs that the residual depends on."""
    outputs: int = 0
    """Number of the residual's outputs: of Gaussian processes that correct the model; 0: none."""
    symbols: Symbols
    f: ca.Function
    """The discretised model, (x, u, e) -> x_next; e is the residual's mean."""
    linearise: Any = None
    """(x, u, e, lambda) -> f, its transposed Jacobian, Hessian of lambda' f; :func:`linearised` of
    ``f`` without."""
    advance: ca.Function
    """(x, u, e, h) -> x_next: the model over h [s]."""
    cost: ca.SX
    """l, convex and strictly so in u; of x, u, u_before, p, theta and last."""
    rows: tuple[Row, ...]
    u_lower: ca.SX | float
    """Of theta and the measured state, which stands in x."""
    u_upper: ca.SX | float
    guess: ca.SX
    """Input to begin with where there is no plan; of x, u_before, share, theta."""
    acting: Any = None
    """What of u acts over h from x on, given the actuators' limits; u without."""
    reached: Any = None
    """The state that is then reached, given those limits; of x and theta. x without."""
    valid: Any = None
    """Above zero in all components for parameters that fit each other; of theta."""
    path: Mapping[str, str] = field(default_factory=dict)
    """For a car that follows a line: which state or input is x, y, psi, vx, vy, omega, delta, duty
    and delta_rate to the planner. Empty: there is no planner, and the stage parameters are always
    the caller's. (Constraints along a path are :attr:`rows`.)"""

    follows_plan: bool = False
    """Whether the planner takes the stage parameters from where the plan itself is on the path, and
    not from where a car on the path would be. The first parameter beyond those is ``follows``."""

    constants: Mapping[str, float] = field(default_factory=dict)
    """Numbers that C is compiled with, as ``BR_NAME``: those of the planner for a path."""

    def __post_init__(self) -> None:
        """Checks what the generated code relies on; InputError names what is wrong."""
        self._check_names()
        self._check_sizes()
        self._check_rows()
        s = self.symbols
        usual: dict[str, Any] = {"acting": s.u, "reached": s.x, "valid": ca.SX(1)}
        if self.linearise is None:
            usual["linearise"] = linearised(self.f)
        for name, value in usual.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, value)
        everything = (s.x, s.u, s.u_before, s.p, s.theta, s.last, s.share, s.h)
        allowed: tuple[tuple[str, Any, tuple[Any, ...]], ...] = (
            ("the cost", self.cost, (s.x, s.u, s.u_before, s.p, s.theta, s.last)),
            *((f"row '{r.name}'", r.value, (s.x, s.p, s.theta)) for r in self.rows),
            *((f"a bound of row '{r.name}'", r.lower, (s.p, s.theta)) for r in self.rows),
            *((f"a bound of row '{r.name}'", r.upper, (s.p, s.theta)) for r in self.rows),
            *((f"row '{r.name}'", r.penalty, (s.theta,)) for r in self.rows if r.soft),
            ("a bound of the inputs", self.u_lower, (s.x, s.theta)),
            ("a bound of the inputs", self.u_upper, (s.x, s.theta)),
        )
        for what, expression, known in allowed:
            others = [one for one in everything if not any(one is k for k in known)]
            if ca.depends_on(ca.SX(expression), ca.veccat(*others)):
                raise InputError(f"problem '{self.name}': {what} depends on what it must not")
        hessian, _ = ca.hessian(self.cost, ca.veccat(s.x, s.u, s.u_before))
        n = s.x.numel()
        if hessian[:n, n:].nnz():
            raise InputError(f"problem '{self.name}': the cost couples states with inputs")

    def _check_names(self) -> None:
        if not self.stage_parameters:
            raise InputError(f"problem '{self.name}': a stage needs at least one parameter")
        known = [*(one.name for one in self.states), *(one.name for one in self.inputs)]
        groups = {
            "state or input": known,
            "stage parameter": [one.name for one in self.stage_parameters],
            "parameter": [one.name for one in self.parameters],
        }
        for what, names in groups.items():
            for name in (self.name, *names):
                if not name.isidentifier() or names.count(name) > 1:
                    raise InputError(f"'{name}' names no {what}, or more than one")
        if taken := sorted({one.name for one in self.parameters} & _TAKEN):
            raise InputError(
                f"'{taken[0]}' is a setting of the solver: name the parameter otherwise"
            )
        if unknown := set(self.features) - set(known):
            raise InputError(f"problem '{self.name}' has no state or input {sorted(unknown)}")

    def _check_sizes(self) -> None:
        """Of the functions that C calls."""
        sizes = [len(self.states), len(self.inputs), self.outputs]
        for name, wanted in (("f", sizes), ("advance", [*sizes, 1])):
            function = getattr(self, name)
            found = [function.numel_in(i) for i in range(function.n_in())]
            if found != wanted or function.numel_out(0) != sizes[0]:
                raise InputError(
                    f"problem '{self.name}': {name} takes {found} numbers and gives "
                    f"{function.numel_out(0)}; expected {wanted} (states, inputs, outputs of the "
                    f"residual{', duration' if name == 'advance' else ''}) and {sizes[0]}"
                )

    def _check_rows(self) -> None:
        x = self.symbols.x
        constant = [ca.jacobian(row.value, x).is_constant() for row in self.rows]
        if constant != sorted(constant, reverse=True):
            raise InputError(f"problem '{self.name}': rows with constant gradients come first")
        for row, linear in zip(self.rows, constant, strict=True):
            if row.cautious and not row.soft:
                raise InputError(f"row '{row.name}' is cautious: give it a penalty")
            if not (row.soft or linear):
                # The line search weighs defects and soft rows alone.
                raise InputError(f"row '{row.name}' is not linear: give it a penalty")

    @property
    def feature_indices(self) -> tuple[int, ...]:
        """Of the features within v = [x; u]."""
        names = [*(one.name for one in self.states), *(one.name for one in self.inputs)]
        return tuple(names.index(name) for name in self.features)

    def role(self, name: str) -> int:
        """Index of the state or input that has this role for the planner."""
        states = [one.name for one in self.states]
        wanted = self.path[name]
        if wanted in states:
            return states.index(wanted)
        return [one.name for one in self.inputs].index(wanted)


def linearised(f: ca.Function) -> ca.Function:
    """``(x, u, e, lambda) -> (F, J', H)`` of any f(x, u, e), all dense.

    With w = [x; u; e], J' is the transposed Jacobian (column major, so C reads it as J row major)
    and H the Hessian of lambda' F. The chain through e, which depends on x and u, is closed
    natively (controller/native/br_stage.c).
    """
    nx, nu, ne = (f.size1_in(i) for i in range(3))
    nv = nx + nu
    w = ca.SX.sym("w", nv + ne)
    return with_arguments(*derivatives(w, f(w[:nx], w[nx:nv], w[nv:]), ""), nx, nu, ne)


def derivatives(v: ca.SX, x_next: ca.SX, suffix: str) -> tuple[ca.Function, ca.Function]:
    """``v -> (x_next, J)`` and ``(v, lambda) -> H``: apart, because H is often not needed."""
    lam = ca.SX.sym("lambda", x_next.numel())
    jacobian = ca.densify(ca.jacobian(x_next, v))
    hessian = ca.densify(ca.hessian(ca.dot(lam, x_next), v)[0])
    options = {"cse": True}
    return (
        ca.Function(f"br_forward{suffix}", [v], [x_next, jacobian], options),
        ca.Function(f"br_second{suffix}", [v, lam], [hessian], options),
    )


def with_arguments(
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
