"""A map to start from, guessed from the names, units and descriptions of an FMU's variables."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from bayesrace.errors import InputError
from plant.fmu.inspection import FmuDescription, Variable
from plant.fmu.units import to_si, unit_of
from plant.fmu.wiring import COMMANDS, STATES

__all__ = ["starting_map"]

_OUTPUTS: Final = {
    "x": r"x|x_m|(pos|position|p|coord|loc|location|cog|world)_?x|x_?(pos|position|coord|world|e)"
    r"|east(ing)?|pos(ition)?_e(ast)?",
    "y": r"y|y_m|(pos|position|p|coord|loc|location|cog|world)_?y|y_?(pos|position|coord|world|n)"
    r"|north(ing)?|pos(ition)?_n(orth)?",
    "psi": r"psi|yaw|heading|hdg|yaw_angle|heading_angle|orientation|azimuth|theta|compass",
    "vx": r"vx|v_x|(vel|velocity|speed|v)_(x|lon|long|longitudinal)|(lon|long|longitudinal)_"
    r"(vel|velocity|speed)|v_?lon(g)?|forward_speed|x_dot",
    "vy": r"vy|v_y|(vel|velocity|speed|v)_(y|lat|lateral)|(lat|lateral)_(vel|velocity|speed)|v_?lat"
    r"|y_dot",
    "omega": r"omega|(yaw|turn)_?rate|yaw_?(vel|velocity|speed)|psi_?(dot|p|d|rate)|d_?psi|w_?z"
    r"|gyro_?z|r|omega_z|heading_rate|angular_velocity_z",
    "delta": r"delta|steer|steering|(steer|steering|road_wheel|front_wheel)_?angle|delta_?f"
    r"|wheel_angle|steering_wheel_angle",
}
_DERIVED: Final = {
    "speed": r"speed|v|velocity|ground_speed|vel|vehicle_speed",
    "slip": r"beta|slip|side_?slip|slip_?angle|side_?slip_angle",
    "world_x": r"(world|global)_(vx|v_x|vel_x|velocity_x)|v(el)?_?e(ast)?|velocity_east"
    r"|v(el)?_?x_(world|global)|speed_east",
    "world_y": r"(world|global)_(vy|v_y|vel_y|velocity_y)|v(el)?_?n(orth)?|velocity_north"
    r"|v(el)?_?y_(world|global)|speed_north",
    "w": r"q_?w|q_?0|quat(ernion)?_?(w|0)|orientation_w",
    "qx": r"q_?x|q_?1|quat(ernion)?_?(x|1)|orientation_x",
    "qy": r"q_?y|q_?2|quat(ernion)?_?(y|2)|orientation_y",
    "qz": r"q_?z|q_?3|quat(ernion)?_?(z|3)|orientation_z",
}
_INPUTS: Final = {
    "d": r"d|duty|duty_cycle|drive|motor|pwm|motor_duty",
    "throttle": r"(throttle|gas|accelerator|acc(el)?|drive"
    r"|(gas|acc|accelerator|throttle|drive)?_?pedal)"
    r"(_(cmd|command|position|input|demand|in))?",
    "brake": r"brake|brake_?(pedal|cmd|command|input|pressure)?",
    "delta_rate": r"delta_(rate|dot)|steer(ing)?(_angle)?_(rate|velocity|speed)|d_?delta",
    "delta": r"(delta(_f)?|swa|(steer|steering|wheel|road_wheel|steering_wheel)(_?angle)?)"
    r"(_(cmd|command|input|ref|reference|target|demand|set|setpoint|in))?",
}
_UNIT_WORDS: Final = {
    "deg": "deg", "rad": "rad", "kmh": "km/h", "kph": "km/h", "mps": "m/s", "cm": "cm", "mm": "mm",
    "m": "m", "pct": "%", "percent": "%", "degps": "deg/s", "dps": "deg/s", "radps": "rad/s",
    "rpm": "rpm",
}  # fmt: skip
"""Units as names carry them at their end."""

_START_WORDS: Final = {"start", "init", "initial", "0"}
_CONTROL: Final = re.compile(r"[\x00-\x1f\x7f\x85\u2028\u2029]+")


def starting_map(description: FmuDescription) -> str:
    """TOML of a map for this FMU: guesses, and comments where somebody has to say.

    It always parses; where nothing is left to say it drives the FMU as it is.
    """
    return _Proposal(description).text()


class _Proposal:
    def __init__(self, fmu: FmuDescription) -> None:
        self._fmu = fmu
        self._lines: list[str] = []
        readable = [v for v in fmu.variables if v.causality in ("output", "local") and _real(v)]
        # An FMU's outputs come before what else it lets see.
        readable.sort(key=lambda v: v.causality != "output")
        self._readable = readable
        self._inputs = [v for v in fmu.variables if v.causality == "input"]
        self._picked: dict[str, Variable] = {}

    def text(self) -> str:
        """The map."""
        fmu = self._fmu
        self._comment(f"Map of the FMU '{fmu.model_name}' (FMI {fmu.fmi_version}) to the car.")
        self._comment("Guessed from names and units: check signs and zeros. Form: docs/fmu.md.")
        self._lines += ["", "[fmu]"]
        if fmu.default_step_s:
            self._comment(f"step_s = {fmu.default_step_s!r}  # the FMU's own step")
        self._comment("placed = true  # if it starts at an origin of its own")
        self._input_section()
        self._output_section()
        self._start_section()
        self._parameter_section()
        return "\n".join(self._lines) + "\n"

    def _comment(self, text: str) -> None:
        self._lines.append(f"# {_CONTROL.sub(' ', text)}")

    def _entry(self, key: str, value: str, remark: str = "") -> None:
        comment = f"  # {_CONTROL.sub(' ', remark)}" if remark else ""
        self._lines.append(f"{_key(key)} = {value}{comment}")

    # -- inputs -------------------------------------------------------------------------------

    def _input_section(self) -> None:
        self._lines += ["", "[inputs]"]
        reals = [variable for variable in self._inputs if _real(variable)]
        found = {name: _guess(reals, _INPUTS[name], COMMANDS[name]) for name in _INPUTS}
        if found["d"] is None and found["brake"] is None:
            found["d"] = found["throttle"]  # one pedal for both, and at its stop if it has one
        drive = ("d",) if found["d"] else ("throttle", "brake")
        steering = ("delta_rate",) if found["delta_rate"] else ("delta",)
        driven: dict[str, str] = {}
        for source in (*drive, *steering):
            variable = found[source]
            if variable is not None:
                driven.setdefault(variable.name, source)
        for name, source in driven.items():
            variable = next(one for one in reals if one.name == name)
            table = _table({"from": source} | _turned(variable, source), variable)
            self._entry(name, table, variable.description)
        if not {"d", "throttle"} & set(driven.values()):
            self._missing("one that takes the duty cycle or throttle", '{ from = "d", unit = "1" }')
        if not {"delta_rate", "delta"} & set(driven.values()):
            self._missing(
                "one that takes the steering",
                '{ from = "delta_rate", unit = "rad/s" }, or the angle: { from = "delta", unit = '
                '"rad" }',
            )
        for variable in self._inputs:
            if variable.name not in driven:
                self._constant(variable)

    def _missing(self, what: str, table: str) -> None:
        self._comment(f"TO FILL IN: {what}, as: name = {table}")

    def _constant(self, variable: Variable) -> None:
        value = _literal(variable, variable.start)
        if value is None:
            note = "TO FILL IN: an input without a start value; or say what drives it"
            self._comment(f"{_key(variable.name)} = 0  # {note}. {variable.description}")
        elif variable.kind == "boolean" and value == "false":
            self._comment(f"{_key(variable.name)} = true  # is false. {variable.description}")
        else:
            self._comment(f"{_key(variable.name)} = {value}  # stays. {variable.description}")

    # -- outputs ------------------------------------------------------------------------------

    def _output_section(self) -> None:
        derived, lines = self._derived()
        self._lines += ["", "[outputs]"]
        for quantity, unit in STATES.items():
            if quantity in derived:
                continue
            variable = _guess(self._readable, _OUTPUTS[quantity], unit)
            if variable is None:
                known = f'{quantity} = {{ variable = "…", unit = "{unit}" }}'
                needed = quantity not in ("omega", "delta")  # else derived below
                self._comment(f"TO FILL IN: {known}" if needed else f"{known}  # if there is one")
                continue
            self._picked[quantity] = variable
            table = _table({"variable": variable.name} | _turned(variable, quantity), variable)
            self._entry(quantity, table, variable.description)
        self._lines += ["", "[derive]"]
        for name, table in lines.items():
            self._entry(name, table)
        if "delta" not in self._picked:
            self._entry("delta", '"delta_rate"', "no steering output: the rate that acts, summed")
        if "omega" not in self._picked and "psi" in self._picked | derived:
            self._entry("omega", '"psi"', "no yaw rate: from the change of heading")

    def _derived(self) -> tuple[dict[str, Variable | None], dict[str, str]]:
        """What [outputs] does not find and follows from other outputs; the lines that say so."""
        derived: dict[str, Variable | None] = {}
        lines: dict[str, str] = {}

        def find(name: str, unit: str) -> Variable | None:
            return _guess(self._readable, _DERIVED[name], unit)

        def both(*names: str) -> list[str] | None:
            found = [_guess(self._readable, _OUTPUTS[name], STATES[name]) for name in names]
            return None if None in found else list(names)

        if not both("psi"):
            parts = {name: find(name, "1") for name in ("w", "qx", "qy", "qz")}
            if all(parts.values()):
                inner = {key[-1]: one.name for key, one in parts.items() if one is not None}
                lines["psi"] = f"{{ quaternion = {_inline(inner)} }}"
                derived["psi"] = None
        if not both("vx", "vy"):
            world = {name: find(name, "m/s") for name in ("world_x", "world_y")}
            speed = {"speed": find("speed", "m/s"), "slip": find("slip", "rad")}
            chosen = world if all(world.values()) else speed if speed["speed"] else {}
            tables = {k: _table({"variable": v.name}, v) for k, v in chosen.items() if v}
            if tables:
                lines["velocity"] = _raw(tables)
                derived |= {"vx": None, "vy": None}
        return derived, lines

    # -- start values and parameters ----------------------------------------------------------

    def _start_section(self) -> None:
        self._lines += ["", "[start]"]
        self._comment("Outputs whose start can be set are started without being named here.")
        settable = [
            variable
            for variable in self._fmu.variables
            if variable.settable and variable.causality != "input" and _real(variable)
        ]
        for quantity, unit in STATES.items():
            picked = self._picked.get(quantity)
            if picked is not None and picked.initial == "exact" and picked.settable:
                continue  # an output that can be set is started without being named
            starts = [v for v in settable if _START_WORDS & set(_words(v.name))]
            pattern = _OUTPUTS[quantity] + (f"|{_DERIVED['speed']}" if quantity == "vx" else "")
            variable = _guess(starts, pattern, unit, without=_START_WORDS)
            if variable is not None:
                turned = _turned(variable, quantity, outwards=True)
                table = _table({"from": quantity} | turned, variable)
                self._entry(variable.name, table, variable.description)
                self._picked.setdefault(f"start {quantity}", variable)
            elif quantity in ("x", "y", "psi"):
                self._comment(f'name = {{ from = "{quantity}", unit = "{unit}" }}')

    def _parameter_section(self) -> None:
        self._lines += ["", "[parameters]"]
        used = {variable.name for variable in self._picked.values()}
        for variable in self._fmu.variables:
            if variable.causality != "parameter" or variable.name in used or variable.array:
                continue
            value = _literal(variable, variable.start) or "0"
            unit = f"[{variable.unit_name}] " if variable.unit_name else ""
            self._comment(f"{_key(variable.name)} = {value}  # {unit}{variable.description}")


def _real(variable: Variable) -> bool:
    return variable.kind == "real" and not variable.array


def _words(name: str) -> list[str]:
    """The words of the last part of a name, in lower case: carBody.yawRate → yaw, rate."""
    last = re.split(r"[.\[\]()]", name.rstrip(".])("))[-1]
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])|(?<=[A-Za-z])(?=0$)", "_", last)
    return [word for word in re.split(r"[\W_]+", spaced.lower()) if word]


def _stated_unit(variable: Variable) -> str | None:
    """A unit that the FMU does not declare but its description or its name tells."""
    bracket = re.search(r"\[\s*([^\]\s][^\]]*?)\s*\]|\bin\s+(\S+)", variable.description)
    if bracket and unit_of(bracket[1] or bracket[2].rstrip(".,;")) is not None:
        return bracket[1] or bracket[2].rstrip(".,;")
    words = _words(variable.name)
    return _UNIT_WORDS.get(words[-1]) if len(words) > 1 else None


def _fits(variable: Variable, wanted: str) -> bool:
    unit = variable.unit or unit_of(_stated_unit(variable))
    if unit is None:
        return True
    try:
        to_si(unit, wanted)
    except InputError as error:
        return "say" in str(error)  # a frequency: the unit is the user's to choose
    return True


def _guess(
    variables: Sequence[Variable], pattern: str, wanted: str, without: Iterable[str] = ()
) -> Variable | None:
    """The first variable of a suitable unit whose name, bare of its unit, fits the pattern."""
    dropped = set(without)
    for bare in (False, True):
        for variable in variables:
            words = [word for word in _words(variable.name) if word not in dropped]
            if bare and len(words) > 1 and words[-1] in _UNIT_WORDS:
                words = words[:-1]
            if re.fullmatch(pattern, "_".join(words)) and _fits(variable, wanted):
                return variable
    return None


def _turned(variable: Variable, quantity: str, *, outwards: bool = False) -> dict[str, str | int]:
    """Sign, and a heading's zero, as far as the description tells."""
    said = variable.description.lower()
    if quantity not in ("psi", "omega", "delta", "delta_rate", "vy"):
        return {}
    clockwise = "clockwise" in said and not re.search(r"(counter|anti)[- ]?clockwise", said)
    right = re.search(r"positive (to the )?right|right (is )?positive", said)
    entry: dict[str, str | int] = {"sign": -1} if clockwise or right else {}
    north = re.search(r"(from|to|relative to|zero (is )?at|0 (is|=)) (the )?(true )?north", said)
    if north and quantity == "psi":
        # our = ±theirs + 90°, thus theirs = ±our ∓ 90°
        entry["offset"] = "-90 deg" if outwards and not clockwise else "90 deg"
    return entry


def _table(entry: Mapping[str, str | int], variable: Variable) -> str:
    """An inline table, or the name alone where nothing else is to say."""
    stated = None if variable.unit_name else _stated_unit(variable)
    full = dict(entry) | ({"unit": stated} if stated else {})
    if list(full) == ["variable"]:
        return _string(str(full["variable"]))
    return _inline(full)


def _inline(entry: Mapping[str, str | int]) -> str:
    return _raw({k: _string(v) if isinstance(v, str) else str(v) for k, v in entry.items()})


def _raw(entry: Mapping[str, str]) -> str:
    return "{ " + ", ".join(f"{key} = {value}" for key, value in entry.items()) + " }"


def _string(text: str) -> str:
    # JSON's strings are TOML's, but for the delete character.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _string(name)


def _literal(variable: Variable, start: str | None) -> str | None:
    """A start value as TOML; None if there is none that fits."""
    if start is None:
        return None
    if variable.kind == "boolean":
        return "true" if start.strip() in ("true", "1") else "false"
    if variable.kind == "string":
        return _string(start)
    try:
        number = float(start)
        if variable.kind == "real":
            return repr(number) if abs(number) < float("inf") else None
        return str(int(number))
    except (ValueError, OverflowError):
        return None
