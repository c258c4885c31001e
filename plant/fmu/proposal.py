"""A map to start from, guessed from the names, units and descriptions of an FMU's variables.

Tables say which names a quantity has in other tools; what fits best by name and unit is proposed.
"""

import json
import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import cache
from typing import Final

from bayesrace.errors import InputError
from plant.fmu.inspection import FmuDescription, Variable
from plant.fmu.units import to_si, unit_of
from plant.fmu.wiring import COMMANDS, READINGS, STATES

__all__ = ["starting_map"]

_PLACE: Final = r"(pos|position|p|coord|loc|location|cog|world)"
_READ: Final = {
    "x": rf"x|x_m|{_PLACE}_?x|x_?(pos|position|coord|world|e)|east(ing)?|pos(ition)?_e(ast)?",
    "y": rf"y|y_m|{_PLACE}_?y|y_?(pos|position|coord|world|n)|north(ing)?|pos(ition)?_n(orth)?",
    "psi": r"psi|yaw|heading|hdg|yaw_angle|heading_angle|orientation|azimuth|theta|compass",
    "vx": r"vx|v_x|(vel|velocity|speed|v)_(x|lon|long|longitudinal)|(lon|long|longitudinal)_"
    r"(vel|velocity|speed)|v_?lon(g)?|forward_speed|x_dot",
    "vy": r"vy|v_y|(vel|velocity|speed|v)_(y|lat|lateral)|(lat|lateral)_(vel|velocity|speed)|v_?lat"
    r"|y_dot",
    "omega": r"omega|(yaw|turn)_?rate|yaw_?(vel|velocity|speed)|psi_?(dot|p|d|rate)|d_?psi|w_?z"
    r"|gyro_?z|r|omega_z|heading_rate|angular_velocity_z",
    "delta": r"delta|steer|steering|(steer|steering|road_wheel|front_wheel)_?angle|delta_?f"
    r"|wheel_angle|steering_wheel_angle",
    "speed": r"speed|v|velocity|ground_speed|vel|vehicle_speed",
    "slip": r"beta|slip|side_?slip|slip_?angle|side_?slip_angle",
    "world_x": r"(world|global)_(vx|v_x|vel_x|velocity_x)|v(el)?_?e(ast)?|velocity_east"
    r"|v(el)?_?x_(world|global)|speed_east",
    "world_y": r"(world|global)_(vy|v_y|vel_y|velocity_y)|v(el)?_?n(orth)?|velocity_north"
    r"|v(el)?_?y_(world|global)|speed_north",
    "qw": r"q_?w|q_?0|quat(ernion)?_?(w|0)|orientation_w",
    "qx": r"q_?x|q_?1|quat(ernion)?_?(x|1)|orientation_x",
    "qy": r"q_?y|q_?2|quat(ernion)?_?(y|2)|orientation_y",
    "qz": r"q_?z|q_?3|quat(ernion)?_?(z|3)|orientation_z",
}
"""Names of an output that has this meaning."""

_STARTED: Final = {name: _READ[name] for name in STATES} | {"vx": f"{_READ['vx']}|{_READ['speed']}"}
"""Names of a start value, less the words for start."""

_DRIVEN: Final = {
    "d": r"d|duty|duty_cycle|drive|motor|pwm|motor_duty",
    "throttle": r"(throttle|gas|accelerator|acc(el)?|drive"
    r"|(gas|acc|accelerator|throttle|drive)?_?pedal)"
    r"(_(cmd|command|position|input|demand|in))?",
    "brake": r"brake|brake_?(pedal|cmd|command|input|pressure)?",
    "delta_rate": r"delta_(rate|dot)|steer(ing)?(_angle)?_(rate|velocity|speed)|d_?delta",
    "delta": r"(delta(_f)?|swa|(steer|steering|wheel|road_wheel|steering_wheel)(_?angle)?)"
    r"(_(cmd|command|input|ref|reference|target|demand|set|setpoint|in))?",
}
"""Names of an input that takes this command."""

_NEEDED: Final = {
    ("d", "throttle"): 'the drive command or throttle, as: name = { from = "d", unit = "1" }',
    ("delta_rate", "delta"): 'the steering, as: name = { from = "delta_rate", unit = "rad/s" }, or '
    'the angle: { from = "delta", unit = "rad" }',
}

_UNIT_WORDS: Final = {
    "deg": "deg", "rad": "rad", "kmh": "km/h", "kph": "km/h", "mps": "m/s", "cm": "cm", "mm": "mm",
    "m": "m", "pct": "%", "percent": "%", "degps": "deg/s", "dps": "deg/s", "radps": "rad/s",
    "rpm": "rpm",
}  # fmt: skip
"""Units as names carry them at their end."""

_START_WORDS: Final = frozenset({"start", "init", "initial", "0"})
_CONTROL: Final = re.compile(r"[\x00-\x1f\x7f\x85\u2028\u2029]+")


def starting_map(fmu: FmuDescription) -> str:
    """TOML of a map for this FMU: guesses, and comments with ``TO FILL IN`` where there is none.

    It always parses; where nothing is left to fill in it drives the FMU as it is.
    """
    # An FMU's outputs come before what else can be read.
    readable = [v for v in fmu.variables if v.readable and v.scalar]
    readable.sort(key=lambda v: v.causality != "output")
    read = {name: _guess(readable, names, READINGS[name]) for name, names in _READ.items()}
    starts = _starts(fmu, read)
    used = {one.name for one in starts.values()}
    step_s = fmu.default_step_s
    lines = [
        _comment(f"Map of the FMU '{fmu.model_name}' (FMI {fmu.fmi_version}) to the car."),
        "# Guessed from names and units: check signs and zeros. Form: docs/fmu.md.\n\n[fmu]",
        *([f"# step_s = {step_s!r}  # the FMU's own step"] if step_s else []),
        "# placed = true  # if it starts at an origin of its own\n\n[inputs]",
        *_inputs([v for v in fmu.variables if v.causality == "input"]),
        *_outputs(read),
        "\n[start]\n# Outputs whose start can be set are started without being named here.",
        *(_entry(one.name, _table("from", name, one), one) for name, one in starts.items()),
        *(
            f'# name = {{ from = "{name}", unit = "{STATES[name]}" }}'
            for name in ("x", "y", "psi")
            if name not in starts and not _started(read[name])
        ),
        "\n[parameters]",
        *(
            _parameter(v)
            for v in fmu.variables
            if v.causality == "parameter" and v.name not in used
        ),
    ]
    return "\n".join(lines) + "\n"


def _inputs(inputs: Sequence[Variable]) -> Iterator[str]:
    scalars = [variable for variable in inputs if variable.scalar]
    found = {name: _guess(scalars, names, COMMANDS[name]) for name, names in _DRIVEN.items()}
    if not found["d"] and not found["brake"]:
        found["d"] = found["throttle"]  # one pedal for both, and at its stop if it has one
    drive = ("d",) if found["d"] else ("throttle", "brake")
    steering = ("delta_rate",) if found["delta_rate"] else ("delta",)
    driven = {one.name: (name, one) for name in (*drive, *steering) if (one := found[name])}
    for name, (source, variable) in driven.items():
        yield _entry(name, _table("from", source, variable), variable)
    sources = {source for source, _ in driven.values()}
    for quantities, what in _NEEDED.items():
        if not sources.intersection(quantities):
            yield f"# TO FILL IN: one that takes {what}"
    for variable in inputs:
        if variable.name not in driven:
            value, remark = _literal(variable), "stays"
            if value is None:
                value = "0"
                remark = "TO FILL IN: an input without a start value; or say what drives it"
            elif value == "false":
                value, remark = "true", "is false"
            yield _comment(f"{_key(variable.name)} = {value}  # {remark}. {variable.description}")


def _outputs(read: Mapping[str, Variable | None]) -> Iterator[str]:
    """[outputs] and [derive]."""
    rules: dict[str, str] = {}
    parts = {q[1]: _string(one.name) for q in ("qw", "qx", "qy", "qz") if (one := read[q])}
    if not read["psi"] and len(parts) == 4:
        rules["psi"] = _inline({"quaternion": _inline(parts)})
    if not (read["vx"] and read["vy"]):
        pairs = (("world_x", "world_y"), ("speed", "slip"), ("speed",))
        given = next((names for names in pairs if all(read[name] for name in names)), ())
        tables = {name: _table("variable", one.name, one) for name in given if (one := read[name])}
        if tables:
            rules["velocity"] = _inline(tables)
    yield "\n[outputs]"
    for quantity, unit in STATES.items():
        variable = read[quantity]
        known = f'{quantity} = {{ variable = "…", unit = "{unit}" }}'
        if ("velocity" if quantity in ("vx", "vy") else quantity) in rules:
            continue
        if variable is not None:
            yield _entry(quantity, _table("variable", variable.name, variable, quantity), variable)
        elif quantity in ("omega", "delta"):  # derived below
            yield f"# {known}  # if there is one"
        else:
            yield f"# TO FILL IN: {known}"
    yield "\n[derive]"
    yield from (f"{name} = {rule}" for name, rule in rules.items())
    if not read["delta"]:
        yield 'delta = "delta_rate"  # no steering output: the rate that acts, summed'
    if not read["omega"] and (read["psi"] or "psi" in rules):
        yield 'omega = "psi"  # no yaw rate: from the change of heading'


def _starts(fmu: FmuDescription, read: Mapping[str, Variable | None]) -> dict[str, Variable]:
    """Start values for the quantities whose output cannot be started itself."""
    settable = [one for one in fmu.variables if one.settable and one.scalar]
    starts = [
        one
        for one in settable
        if one.causality != "input" and not _START_WORDS.isdisjoint(_words(one.name))
    ]
    return {
        name: one
        for name, names in _STARTED.items()
        if not _started(read[name])
        if (one := _guess(starts, names, STATES[name], without=_START_WORDS))
    }


def _started(variable: Variable | None) -> bool:
    """Whether it is an output that can be started."""
    return variable is not None and variable.initial == "exact" and variable.settable


def _parameter(variable: Variable) -> str:
    unit = f"[{variable.unit_name}] " if variable.unit_name else ""
    value = _literal(variable) or 0
    return _comment(f"{_key(variable.name)} = {value}  # {unit}{variable.description}")


def _guess(
    variables: Sequence[Variable], names: str, unit: str, without: Collection[str] = ()
) -> Variable | None:
    """The first of the variables that fit best, if any does."""
    best = max(variables, key=lambda one: _score(one, names, unit, without), default=None)
    return best if best is not None and _score(best, names, unit, without) else None


def _score(variable: Variable, names: str, unit: str, without: Collection[str]) -> int:
    """2 for a name that fits, 1 for one that fits bare of its unit, 0 otherwise."""
    words = [word for word in _words(variable.name) if word not in without]
    bare = words[:-1] if words and words[-1] in _UNIT_WORDS else words
    fits = [bool(re.fullmatch(names, "_".join(some))) for some in (words, bare)]
    return (2 if fits[0] else 1) if any(fits) and _converts(variable, unit) else 0


@cache
def _words(name: str) -> list[str]:
    """The words of the last part of a name, in lower case: carBody.yawRate → yaw, rate."""
    last = re.split(r"[.\[\]()]", name.rstrip(".])("))[-1]
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Za-z])(?=0$)", "_", last)
    return [word for word in re.split(r"[\W_]+", spaced.lower()) if word]


def _converts(variable: Variable, wanted: str) -> bool:
    unit = variable.unit or unit_of(_stated_unit(variable))
    try:
        return unit is None or bool(to_si(unit, wanted))
    except InputError as error:
        return "say" in str(error)  # a frequency: the unit is the user's to choose


def _stated_unit(variable: Variable) -> str | None:
    """A unit that the FMU does not declare, from the variable's description or name."""
    stated = re.search(r"\[\s*([^\]\s][^\]]*?)\s*\]|\bin\s+(\S+)", variable.description)
    name = stated and (stated[1] or stated[2].rstrip(".,;"))
    if name and unit_of(name) is not None:
        return name
    words = _words(variable.name)
    return _UNIT_WORDS.get(words[-1]) if len(words) > 1 else None


def _turned(variable: Variable, quantity: str, *, outwards: bool) -> dict[str, str]:
    """Sign, and a heading's zero, as far as the description says."""
    text = variable.description.lower()
    if quantity not in ("psi", "omega", "delta", "delta_rate", "vy"):
        return {}
    clockwise = "clockwise" in text and not re.search(r"(counter|anti)[- ]?clockwise", text)
    right = re.search(r"positive (to the )?right|right (is )?positive", text)
    entry = {"sign": "-1"} if clockwise or right else {}
    north = re.search(r"(from|to|relative to|zero (is )?at|0 (is|=)) (the )?(true )?north", text)
    if north and quantity == "psi":
        # our = ±theirs + 90°, thus theirs = ±our ∓ 90°
        entry["offset"] = '"-90 deg"' if outwards and not clockwise else '"90 deg"'
    return entry


def _comment(text: str) -> str:
    return f"# {_CONTROL.sub(' ', text)}"


def _entry(key: str, value: str, variable: Variable) -> str:
    remark = f"  {_comment(variable.description)}" if variable.description else ""
    return f"{_key(key)} = {value}{remark}"


def _table(key: str, name: str, variable: Variable, quantity: str = "") -> str:
    """An inline table that says how to convert, or the FMU's name alone if it need not."""
    outwards = key == "from"
    stated = None if variable.unit_name else _stated_unit(variable)
    turned = _turned(variable, name if outwards else quantity, outwards=outwards)
    full = {key: _string(name)} | turned
    full |= {"unit": _string(stated)} if stated else {}
    return _inline(full) if outwards or len(full) > 1 else full[key]


def _inline(entry: Mapping[str, str]) -> str:
    return "{ " + ", ".join(f"{key} = {value}" for key, value in entry.items()) + " }"


def _string(text: str) -> str:
    # JSON's strings are TOML's, but for the delete character.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _string(name)


def _literal(variable: Variable) -> str | None:
    """The start value as TOML; None if there is none that fits."""
    start = variable.start
    if start is None or variable.kind == "string":
        return None if start is None else _string(start)
    if variable.kind == "boolean":
        return "true" if start.strip() in ("true", "1") else "false"
    try:
        number = float(start)
        whole = variable.kind != "real"
        return str(int(number)) if whole else repr(number) if abs(number) < math.inf else None
    except (ValueError, OverflowError):
        return None
