"""Readings of a car's instruments as inputs of its controller's FMU, in place of its state."""

from collections.abc import Iterator, Mapping
from typing import Any, Final

from bayesrace.codegen.fmu.build import Variable
from bayesrace.codegen.fmu.car import STATE
from bayesrace.errors import InputError
from bayesrace.sensors import Sensors

__all__ = ["reading_inputs", "reading_tables"]

_BEFORE_S: Final = -1.0
"""NOT_READ in C: time of an instrument that has not measured yet."""


def _prefixes(sensors: Sensors) -> Iterator[tuple[str, str]]:
    """Each instrument with what begins the names of its variables; InputError for equal ones."""
    found = {f"sensor_{name.replace('-', '_')}_": name for name in sensors.root}
    if len(found) < len(sensors.root):
        raise InputError(
            "two of the car's sensors differ in '-' and '_' alone, which C does not tell apart: "
            "rename one of [sensors.*]"
        )
    return ((name, prefix) for prefix, name in found.items())


def reading_inputs(sensors: Sensors) -> Iterator[Variable]:
    """Of each instrument the time of its newest reading, and what that has measured; and the
    steering rate that acts. None without instruments."""
    for name, prefix in _prefixes(sensors):
        when = f"when '{name}' has measured what follows; a reading is new if this changes"
        yield Variable(f"{prefix}time", "input", when, unit="s", start=_BEFORE_S)
        for quantity in sensors.root[name].channels:
            unit, text = STATE[quantity]
            yield Variable(prefix + quantity, "input", f"measured: {text}", unit=unit, start=0.0)
    if sensors.root:
        acts = "steering rate that acts now, read with d_applied"
        yield Variable("delta_rate_applied", "input", acts, unit="rad/s", start=0.0)


def reading_tables(sensors: Sensors, estimation: Mapping[str, Any]) -> str:
    """C macros: how many instruments there are, their times, their values with standard deviations,
    and ``estimation``, the members of a br_estimation."""
    states, prefixes = list(STATE), dict(_prefixes(sensors))
    times = ", ".join(f"FMU_V_{prefix}time" for prefix in prefixes.values())
    values = ", ".join(
        f"{{{i}, FMU_V_{prefix}{key}, {states.index(key)}, {one.deviation!r}, {one.relative!r}}}"
        for i, (name, prefix) in enumerate(prefixes.items())
        for key, one in sensors.root[name].channels.items()
    )
    members = ", ".join(
        f".{name} = {{{', '.join(map(repr, value))}}}" if isinstance(value, tuple) else
        f".{name} = {value!r}"
        for name, value in estimation.items()
    )  # fmt: skip
    return (
        f"#define INSTRUMENTS {len(sensors.root)}\n#define NOT_READ {_BEFORE_S!r}\n"
        f"#define TIMES {times}\n#define CHANNELS {values}\n#define ESTIMATION {members}\n"
    )
