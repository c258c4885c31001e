"""Car and controller, connected, in one file: system structure and parameterization, SSP 1.0.

``SystemStructure.ssd`` names FMUs, connections and units; ``resources/car.ssv`` and
``controller.ssv`` hold start values, which can be edited without touching either FMU.
"""

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from bayesrace.codegen.fmu.archive import pack, rendered, units_of, write_archive
from bayesrace.codegen.fmu.build import FmuDefinition
from bayesrace.errors import InputError
from bayesrace.vehicles.models import INPUTS, STATES

__all__ = ["pack_loop"]

_CONNECTIONS: Final = (
    *(("car", "controller", name) for name in STATES),
    *(("controller", "car", name) for name in INPUTS),
)
"""From, to, name of the variable in both."""


def pack_loop(
    car: FmuDefinition, controller: FmuDefinition, out: Path, *, x0: Sequence[float],
    stop_s: float, platforms: Sequence[str] | None = None,
) -> None:  # fmt: skip
    """Writes both FMUs (FMI 2.0, Co-Simulation) and their connections to ``out``.

    ``x0`` (7,): start state of the car; ``stop_s``: end of the default experiment. The controller's
    ``delay`` is its step, for tools that step all FMUs side by side and at that step. Raises
    InputError for a controller that reads instruments, and what :func:`.pack` raises.
    """
    if not {v.name for v in controller.variables}.issuperset(STATES):
        raise InputError(
            "the car's file has instruments, but its FMU gives the state, not their readings: "
            "export the SSP for a car file without [sensors.*]"
        )
    elements = {"car": car, "controller": controller}
    step_s = controller.default_step_s
    start = {"car": dict(zip(STATES, x0, strict=True)), "controller": {"delay": step_s}}
    fed = {(end, name) for _, end, name in _CONNECTIONS}
    connectors = {  # of inputs those that are fed: some tools want each connector to be connected
        name: [v for v in fmu.variables if (name, v.name) in fed or v.causality == "output"]
        for name, fmu in elements.items()
    }
    contents = {
        "SystemStructure.ssd": rendered(
            "SystemStructure.ssd",
            name=f"{car.name} and its controller",
            description=f"communication step {step_s:g} s; FMUs are stepped side by side",
            elements=elements, connectors=connectors, connections=_CONNECTIONS, stop_s=stop_s,
            units=units_of(v for found in connectors.values() for v in found),
        )
    }  # fmt: skip
    with tempfile.TemporaryDirectory(prefix="ssp-") as folder:
        for name, fmu in elements.items():
            packed = pack(fmu, Path(folder) / f"{name}.fmu", platforms)
            contents[f"resources/{packed.name}"] = packed.read_bytes()
            contents[f"resources/{name}.ssv"] = _parameter_set(fmu, start[name])
    write_archive(out, contents)


def _parameter_set(fmu: FmuDefinition, start: Mapping[str, float]) -> bytes:
    values = [(v, repr(float(start[v.name]))) for v in fmu.variables if v.name in start]
    units = units_of(v for v, _ in values)
    # Both files' sets have one name, because ecos applies the sets of one name together.
    return rendered("parameters.ssv", name="start", values=values, units=units)
