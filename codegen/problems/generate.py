"""From a problem to C: its functions (br_model.c) and its sizes, structures and sparsity
(br_problem.h). The runtime in controller/native knows a problem by these alone."""

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from bayesrace.codegen.problems.problem import Parameter, Problem

__all__ = ["c_header", "functions"]


def functions(problem: Problem) -> list[ca.Function]:
    """Everything that the runtime calls, named ``br_...``."""
    return [
        *_derivatives(problem.linearise),
        _named("br_advance", problem.advance),
        _transition(problem.advance),
        *_parts(problem),
    ]


def _named(name: str, function: ca.Function) -> ca.Function:
    """The function under the name that the runtime calls; as it is, if it has that already."""
    if function.name() == name:
        return function
    names = function.name_in(), function.name_out()
    return ca.Function(name, function.sx_in(), function.call(function.sx_in(), True, False), *names)


def _transition(advance: ca.Function) -> ca.Function:
    """(x, u, e, h) -> x_next, and its transposed Jacobian in x and e."""
    kind: Any = ca.SX if advance.is_a("SXFunction") else ca.MX
    names = ["x", "u", "e", "h"]
    x, u, e, h = (kind.sym(name, advance.size1_in(i)) for i, name in enumerate(names))
    x_next = advance(x, u, e, h)
    jacobian = ca.densify(ca.jacobian(x_next, ca.vertcat(x, e)).T)
    made = [ca.densify(x_next), jacobian]
    return ca.Function(
        "br_transit", [x, u, e, h], made, names, ["x_next", "jacobian"], {"cse": True}
    )


def _derivatives(linearise: ca.Function) -> list[ca.Function]:
    """Value with Jacobian, and the Hessian alone, which the runtime makes later."""
    kind: Any = ca.SX if linearise.is_a("SXFunction") else ca.MX
    names = ["x", "u", "e", "lambda"]
    x, u, e, lam = (kind.sym(name, linearise.size1_in(i)) for i, name in enumerate(names))
    f, jacobian, _ = linearise.call([x, u, e, kind(ca.DM.zeros(lam.shape))], True, False)
    hessian = linearise.call([x, u, e, lam], True, False)[2]
    return [
        ca.Function("br_linearise", [x, u, e], [f, jacobian], names[:3], ["f", "jacobian"]),
        ca.Function("br_hessian", [x, u, e, lam], [hessian], names, ["hessian"]),
    ]


def _parts(problem: Problem) -> list[ca.Function]:
    s, rows = problem.symbols, problem.rows
    stage = [s.x, s.u, s.u_before, s.last, s.p, s.theta]
    names = ["x", "u", "u_before", "last", "p", "theta"]
    values, lower, upper = (_of_rows(problem, name) for name in ("value", "lower", "upper"))
    gradient = ca.gradient(problem.cost, ca.veccat(s.x, s.u, s.u_before))
    terms = [problem.cost, ca.densify(gradient), *map(ca.densify, (values, lower, upper))]
    terms.append(_nonzeros(_row_jacobian(problem).T))
    multiplier = ca.SX.sym("multiplier", len(rows))
    cost_xx, rows_xx = _hessians_in_x(problem, multiplier)
    v = ca.veccat(s.u, s.u_before)
    in_u = ca.densify(ca.hessian(problem.cost, v)[0])
    options = {"cse": True}
    penalties = ca.vertcat(*(0 if r.penalty is None else r.penalty for r in rows))
    return [
        ca.Function("br_terms", stage, [ca.vertcat(*terms)], names, ["terms"], options),
        ca.Function(
            "br_curvature",
            [*stage, multiplier],
            [_nonzeros(cost_xx), _nonzeros(rows_xx), in_u],
            [*names, "multiplier"],
            ["cost_xx", "rows_xx", "cost_uu"],
            options,
        ),
        ca.Function("br_bounds", [s.x, s.theta], [ca.densify(problem.u_lower),
                    ca.densify(problem.u_upper)], ["x", "theta"], ["lower", "upper"]),
        ca.Function("br_penalties", [s.theta], [ca.densify(ca.SX(penalties))]),
        ca.Function("br_guess", [s.x, s.u_before, s.share, s.theta], [ca.densify(problem.guess)]),
        ca.Function("br_acting", [s.x, s.u, s.h, s.theta], [ca.densify(problem.acting)]),
        ca.Function("br_reached", [s.x, s.theta], [ca.densify(problem.reached)]),
        ca.Function("br_valid", [s.theta], [ca.mmin(ca.densify(ca.SX(problem.valid)))]),
    ]  # fmt: skip


def _of_rows(problem: Problem, name: str) -> ca.SX:
    """One field of all rows, such as their values."""
    return ca.vertcat(ca.SX(0, 1), *(getattr(row, name) for row in problem.rows))


def _nonzeros(matrix: ca.SX) -> ca.SX:
    """Column by column."""
    entries: ca.SX = matrix.nz[:]
    return entries


def _row_jacobian(problem: Problem) -> ca.SX:
    return ca.jacobian(_of_rows(problem, "value"), problem.symbols.x)


def _hessians_in_x(problem: Problem, multiplier: ca.SX) -> tuple[ca.SX, ca.SX]:
    x = problem.symbols.x
    weighted = ca.SX(0)
    for i, row in enumerate(problem.rows):
        weighted += multiplier[i] * row.value
    return ca.hessian(problem.cost, x)[0], ca.hessian(weighted, x)[0]


def _most_changed(problem: Problem) -> list[int]:
    """The state that each output of the residual changes most, from a state and input of zeros."""
    e = ca.MX.sym("e", problem.outputs)
    ahead = problem.f(np.zeros(len(problem.states)), np.zeros(len(problem.inputs)), e)
    effect = ca.Function("effect", [e], [ca.jacobian(ahead, e)])
    found = np.asarray(ca.densify(effect(np.zeros(problem.outputs))))
    return [int(one) for one in np.abs(found).argmax(axis=0)]


def _model_sparsity(problem: Problem) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Where Jacobian (nx, nv) and Hessian (nv, nv) of the corrected model may be nonzero."""
    nx, nv = len(problem.states), len(problem.states) + len(problem.inputs)
    w = ca.MX.sym("w", nv + problem.outputs)
    f = problem.f(w[:nx], w[nx:nv], w[nv:])
    lam = ca.MX.sym("lambda", nx)
    expand = ca.Function("f", [w, lam], [f, ca.dot(lam, f)])
    jacobian = _pattern(ca.jacobian(f, w))
    sw, sl = ca.SX.sym("w", nv + problem.outputs), ca.SX.sym("lambda", nx)
    hessian = _pattern(ca.hessian(expand(sw, sl)[1], sw)[0])
    features = np.array(problem.feature_indices)
    j, h = jacobian[:, :nv].copy(), hessian[:nv, :nv].copy()
    if problem.outputs:
        corrected = np.flatnonzero(jacobian[:, nv:].any(axis=1))
        j[np.ix_(corrected, features)] = True
        changed = np.array(_most_changed(problem))  # the mismatch has terms in what changes these
        j[np.ix_(corrected, changed)] = True
        j[np.ix_(corrected, np.flatnonzero(j[changed].any(axis=0)))] = True
        crossed = np.flatnonzero(hessian[:nv, nv:].any(axis=1))
        h[np.ix_(crossed, features)] = True
        h[np.ix_(features, crossed)] = True
        h[np.ix_(features, features)] = True
    return j, h | h.T


def _pattern(matrix: ca.SX | ca.MX) -> np.ndarray[Any, Any]:
    return np.asarray(ca.DM(matrix.sparsity(), 1.0).full(), dtype=bool)


def _array(name: str, values: Sequence[Any], kind: str = "unsigned char") -> str:
    content = ", ".join(repr(v) if isinstance(v, float) else str(int(v)) for v in values) or "0"
    return f"static const {kind} {name}[] = {{{content}}};"


def _lists(name: str, pattern: np.ndarray[Any, Any]) -> list[str]:
    """Of each row of a pattern, the columns that may be nonzero: starts and indices."""
    found = [np.flatnonzero(row) for row in pattern]
    starts = np.concatenate([[0], np.cumsum([len(one) for one in found])])
    indices = np.concatenate([*found, []]).astype(int)
    return [
        _array(f"{name}_START", starts.tolist(), "unsigned short"),
        _array(f"{name}_INDEX", indices.tolist()),
    ]


def _pairs(name: str, matrix: ca.SX) -> list[str]:
    rows, columns = matrix.sparsity().get_triplet()
    return [
        f"#define {name}_NNZ {len(rows)}",
        _array(f"{name}_ROW", rows),
        _array(f"{name}_COLUMN", columns),
    ]


def _meaning(parameter: Parameter) -> str:
    return f"{parameter.text} [{parameter.unit}]".lstrip()


def _struct(name: str, parameters: Sequence[Parameter]) -> list[str]:
    lines = [f"    double {one.name}; /* {_meaning(one)} */" for one in parameters]
    return ["typedef struct {", *lines, f"}} {name};"]


def _groups(features: int, most: int = 11) -> str:
    """Rows of the lower triangle of the features' second moments, in groups of at most so many
    entries: what has room in the registers of one pass over the training points."""
    groups, first, count = [], 0, 0
    for row in range(features):
        if count and count + row + 1 > most:
            groups.append((first, row))
            first, count = row, 0
        count += row + 1
    groups.append((first, features))
    return " ".join(f"GROUP({a}, {b})" for a, b in groups if b > a)


def c_header(problem: Problem) -> str:
    """Sizes, structures and sparsity: the content of br_problem.h."""
    states, inputs, rows = problem.states, problem.inputs, problem.rows
    s = problem.symbols
    jacobian, hessian = _model_sparsity(problem)
    nx = len(states)
    row_jacobian = _row_jacobian(problem)
    cost_xx, rows_xx = _hessians_in_x(problem, ca.SX.sym("multiplier", len(rows)))
    in_u = ca.hessian(problem.cost, ca.veccat(s.u, s.u_before))[0]
    second = ca.veccat(_nonzeros(cost_xx), _nonzeros(rows_xx), _nonzeros(in_u))
    late = ca.depends_on(second, ca.veccat(s.p, s.u_before))
    early = [row_jacobian[i, :].is_constant() for i in range(len(rows))]
    constant = [
        [float(row_jacobian[i, j]) if early[i] else 0.0 for j in range(nx)]
        for i in range(len(rows))
    ]
    lines = [
        f"/* generated from the problem '{problem.name}' */",
        "#ifndef BR_PROBLEM_H",
        "#define BR_PROBLEM_H",
        f"#define BR_NX {nx} /* {', '.join(one.name for one in states)} */",
        f"#define BR_NU {len(inputs)} /* {', '.join(one.name for one in inputs)} */",
        f"#define BR_NPARAMETERS {len(problem.parameters)} /* run-time parameters */",
        f"#define BR_NZ {len(problem.features)} /* features: {', '.join(problem.features)} */",
        f"#define BR_NE {problem.outputs} /* outputs of the residual */",
        f"#define BR_NR {len(rows)} /* rows a stage: {', '.join(r.name for r in rows)} */",
        f"#define BR_NR_SOFT {sum(row.soft for row in rows)} /* of them, soft */",
        f"#define BR_NR_EARLY {sum(early)} /* of them, with constant gradients */",
        f"#define BR_CURVATURE_LATE {int(late)} /* second derivatives depend on p or u_before */",
        f"#define BR_HAS_PATH {int(bool(problem.path))}",
        f"#define BR_FOLLOWS_PLAN {int(problem.follows_plan)}",
        f"#define BR_PROXIMAL {int(any(one.proximal for one in inputs))}",
        *(f"#define BR_INDEX_{role.upper()} {problem.role(role)}" for role in problem.path),
        *(f"#define BR_{n.upper()} {float(v)!r}" for n, v in problem.constants.items()),
        *_struct("br_mpc_reference", problem.stage_parameters),
        "#define BR_PARAMETERS(X) \\",
        *(f"    X({one.name}) /* {_meaning(one)} */ \\" for one in problem.parameters),
        "",
        "#ifdef BR_TABLES /* for the runtime */",
        _array("BR_FEATURE", problem.feature_indices),
        _array("BR_STATE_SCALE", [float(one.scale) for one in states], "double"),
        _array("BR_STATE_LIMIT", [float(one.limit) for one in states], "double"),
        _array("BR_INPUT_LIMIT", [float(one.limit) for one in inputs], "double"),
        _array("BR_INPUT_PROXIMAL", [float(one.proximal) for one in inputs], "double"),
        _array("BR_STATE_DEVIATION", [float(one.deviation) for one in states], "double"),
        _array("BR_INPUT_EFFORT", [float(one.effort) for one in inputs], "double"),
        _array("BR_CHANGED", _most_changed(problem)),
        _array("BR_STATE_ODD", [one.odd for one in states]),
        _array("BR_INPUT_ODD", [one.odd for one in inputs]),
        _array("BR_INPUT_HELD", [one.held for one in inputs]),
        _array("BR_PARAMETER_LOW", [float(one.low) for one in problem.parameters], "double"),
        _array("BR_PARAMETER_HIGH", [float(one.high) for one in problem.parameters], "double"),
        _array("BR_PARAMETER_POSITIVE", [one.positive for one in problem.parameters]),
        *_lists("BR_A", jacobian[:, :nx]),
        *_lists("BR_AT", jacobian[:, :nx].T),
        *_lists("BR_BT", jacobian[:, nx:].T),
        *_lists("BR_WXX", hessian[:nx, :nx]),
        *_lists("BR_WUX", hessian[nx:, :nx]),
        *_pairs("BR_CXX", cost_xx),
        *_pairs("BR_RXX", rows_xx),
        f"#define BR_ROW_NNZ {row_jacobian.nnz()}",
        *_lists("BR_ROW", _pattern(row_jacobian)),
        _array("BR_ROW_SOFT", [row.soft for row in rows]),
        _array("BR_ROW_CAUTIOUS", [row.cautious for row in rows]),
        _array("BR_ROW_CONSTANT", [v for row in constant for v in row], "double"),
        f"#define BR_MOMENT_GROUPS {_groups(len(problem.features))}",
        "#endif",
        "#endif",
        "",
    ]  # fmt: skip
    return "\n".join(lines)
