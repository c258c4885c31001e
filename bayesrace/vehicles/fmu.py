"""A Model Exchange FMU as a vehicle model: a black box that CasADi can differentiate.

CasADi asks the FMU for directional derivatives, and takes differences of these for second ones; the
result can be discretised, simulated, and predicted with in :class:`codegen.ocp.OcpNlp`. It
cannot be turned into C: the native step takes models that are expressions.
"""

import atexit
import hashlib
import re
import zipfile
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import casadi as ca
import numpy as np

from bayesrace.errors import InputError
from bayesrace.temporary import temporary_folder
from bayesrace.vehicles.models import INPUTS, STATES, Model
from bayesrace.vehicles.parameters import CarParameters

__all__ = ["model_from_fmu"]

_REMEDY: Final = "'bayesrace fmu export --version 3 --kind me' makes one"

_DIFFERENTIABLE: Final = r"<ModelExchange\b[^>]*\bprovidesDirectionalDerivatives?\s*=\s*.(true|1)\b"


def model_from_fmu(path: Path, car: CarParameters) -> Model:
    """The dynamics of an FMU whose states and inputs have our names, as ``ode`` (an MX function).

    ``car``: whose limits hold; the FMU's parameters stay at their start values. The model is named
    after the file's content, so that weights learned with another FMU are refused. InputError if
    the FMU cannot be used so: Co-Simulation only, without directional derivatives, for another
    platform, other names, or an ode that is not finite.
    """
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
    except OSError as error:
        raise InputError(f"the FMU {path} cannot be read: {error.strerror}") from None
    _check(path)
    name = f"fmu_{digest}"
    try:
        dae = ca.DaeBuilder(name, _extracted(path))
        ode = dae.create(name, ["x", "u"], ["ode"])
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[-1]
        raise InputError(f"{path}: CasADi cannot import the FMU: {reason}") from None
    model = Model(name, car, _ordered(ode, dae.x(), dae.u()))
    at = np.array([0.0, 0, 0, 1, 0, 0, 0])
    if not np.isfinite(np.asarray(model.ode(at, np.zeros(2)))).all():
        raise InputError(f"{path}: its derivatives are not finite on a straight line at 1 m/s")
    return model


def _check(path: Path) -> None:
    """What CasADi would fail of later, or with less to say."""
    from fmpy import platform, platform_tuple, read_model_description, supported_platforms

    try:
        description = read_model_description(str(path), validate=False)
        platforms = supported_platforms(str(path))
    except Exception as error:  # fmpy raises whatever its parsers do
        raise InputError(f"{path} is not an FMU: {error}") from None
    if description.modelExchange is None:
        raise InputError(f"{path} is no Model Exchange FMU, which has no derivatives: {_REMEDY}")
    with zipfile.ZipFile(path) as archive:
        xml = archive.read("modelDescription.xml").decode("utf-8", "replace")
    if not re.search(_DIFFERENTIABLE, xml):  # fmpy 0.3 looks for FMI 2.0's spelling in both
        raise InputError(
            f"{path} has no directional derivatives, without which nothing can be optimised: "
            f"{_REMEDY}"
        )
    if not {platform, platform_tuple} & set(platforms):
        raise InputError(
            f"{path} is for {', '.join(platforms) or 'no platform'}, not for {platform_tuple}: "
            "build it for this one"
        )
    variables = description.modelVariables
    states = [v.derivative.name for v in variables if v.derivative is not None]
    _compare(path, "states", states, STATES)
    _compare(path, "inputs", [v.name for v in variables if v.causality == "input"], INPUTS)


def _compare(path: Path, what: str, found: Iterable[str], wanted: Iterable[str]) -> None:
    there, ours = set(found), set(wanted)
    if there == ours:
        return
    lacks = f"lacks {', '.join(sorted(ours - there))}" if ours - there else ""
    extra = f"has {', '.join(sorted(there - ours))} besides" if there - ours else ""
    raise InputError(
        f"{path}: the {what} must be {', '.join(wanted)}, but it "
        f"{' and '.join(part for part in (lacks, extra) if part)}; {_REMEDY}"
    )


def _extracted(path: Path) -> str:
    """A folder with the archive's files that lives as long as this process.

    CasADi would extract it next to the file, where it may not be allowed to write. The library
    stays loaded, and may look for its resources, as long as any function made of it lives.
    """
    stack = ExitStack()
    folder = str(stack.enter_context(temporary_folder()))
    atexit.register(stack.close)
    with zipfile.ZipFile(path) as archive:
        archive.extractall(folder)
    return folder


def _ordered(ode: ca.Function, states: list[str], inputs: list[str]) -> ca.Function:
    """The same with states and inputs in our order."""
    if tuple(states) == STATES and tuple(inputs) == INPUTS:
        return ode
    x, u = ca.MX.sym("x", len(STATES)), ca.MX.sym("u", len(INPUTS))
    theirs = ode(
        ca.vertcat(*(x[STATES.index(name)] for name in states)),
        ca.vertcat(*(u[INPUTS.index(name)] for name in inputs)),
    )
    ours = ca.vertcat(*(theirs[states.index(name)] for name in STATES))
    return ca.Function(ode.name(), [x, u], [ours], ["x", "u"], ["xdot"])
