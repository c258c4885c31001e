"""Maps that do not fit say what to write instead; inspection proposes ones that do."""

import contextlib
import io
import math
from pathlib import Path

import pytest
from fmpy.model_description import BaseUnit
from hypothesis import given as those
from hypothesis import strategies as st
from rich.console import Console

from bayesrace.errors import InputError
from operation.terminal.fmu_table import FmuTable
from plant.fmu.inspection import FmuDescription, inspect
from plant.fmu.map import wire
from plant.fmu.map_file import parse_map, read_map
from plant.fmu.units import parse_quantity, to_si, unit_of
from tests.fmu_variables import OWN, description, given, own_fmu, taken, variable, write_fmu

# -- the file -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[outputs\n", "no TOML"),
        ("[fmu]\nstep_s = -1", "fmu.step_s"),
        ("[fmu]\nplace = true", "fmu.place"),
        ("[outputs]\nyaw = 'h'", "'psi'"),
        ("[outputs]\nx = 3", "give the name of a variable"),
        ("[outputs]\nx = { variable = 'a', unit = 'cm', scale = 2.0 }", "unit and scale"),
        ("[outputs]\nx = { variable = 'a', scale = 0 }", "loses the value"),
        ("[outputs]\nx = { variable = 'a', sign = 2 }", "sign is 1 or -1"),
        ("[inputs]\ngas = { form = 'd' }", "inputs.gas.from"),
        ("[inputs]\ngas = inf", "finite number"),
        ("[parameters]\nm = [1]", "parameters.m"),
        ("[derive]\nomega = 'psy'", "derive.omega"),
        ("[derive]\nvelocity = { world_x = 'a' }", "world_x and world_y"),
        ("[derive]\nvelocity = { slip = 'a' }", "or speed"),
        ("[derive]\npsi = { cos = 'a' }", "cos and sin"),
        ("[derive]\npsi = { quaternion = { w = 'a', x = 'b', y = 'c' } }", "quaternion.z"),
        ("[derive.psi]\ncos = 'a'\nsin = 'b'\nquaternion = {w='a',x='b',y='c',z='d'}", "either"),
    ],
)
def test_a_map_that_is_none_names_the_entry(text: str, said: str) -> None:
    with pytest.raises(InputError, match=r"^car\.toml") as caught:
        parse_map(text, "car.toml")
    assert said in str(caught.value)


def test_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot read the map"):
        read_map(tmp_path / "none.toml")
    (tmp_path / "latin.toml").write_bytes(b"# stra\xdfe")
    with pytest.raises(InputError, match="UTF-8"):
        read_map(tmp_path / "latin.toml")
    (tmp_path / "map.toml").write_text("[fmu]\nstep_s = 0.002")
    assert read_map(tmp_path / "map.toml").fmu.step_s == 0.002


# -- units ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "wanted", "factor"),
    [
        ("km/h", "m/s", 1 / 3.6),
        ("kmph", "m/s", 1 / 3.6),
        ("m.s-1", "m/s", 1.0),
        ("cm", "m", 0.01),
        ("deg", "rad", math.pi / 180),
        ("°/s", "rad/s", math.pi / 180),
        ("rpm", "rad/s", math.pi / 30),
        ("rev/min", "rad/s", math.pi / 30),
        ("1/s", "rad/s", 1.0),
        ("1", "rad", 1.0),
        ("%", "1", 0.01),
        ("kg.m2", "kg.m^2", 1.0),
        ("g", "kg", 1e-3),
        ("kN.s/m", "N.s/m", 1e3),
    ],
)
def test_units_as_tools_write_them(name: str, wanted: str, factor: float) -> None:
    unit = unit_of(name)
    assert unit is not None
    assert to_si(unit, wanted) == pytest.approx(factor, rel=1e-15)


@pytest.mark.parametrize(
    ("name", "wanted"),
    [("deg", "1"), ("m", "m/s"), ("rad/s", "rad"), ("kg", "m"), ("1/min", "rad/s"), ("Hz", "m")],
)
def test_units_of_another_dimension_do_not_convert(name: str, wanted: str) -> None:
    unit = unit_of(name)
    assert unit is not None
    with pytest.raises(InputError, match=name):
        to_si(unit, wanted)


@pytest.mark.parametrize(
    "name", ["", "-", "furlongs per", "9^9^9", "9**9**9", "m**99999", "m^99", "__import__('os')"]
)
def test_what_is_no_unit_is_not_computed(name: str) -> None:
    assert unit_of(name) is None


@those(st.text(max_size=80))
def test_no_text_breaks_the_reading_of_units(text: str) -> None:
    unit_of(text)
    with contextlib.suppress(InputError):
        parse_quantity(text)


def test_the_fmus_own_definition_stands_for_unknown_names_and_fills_no_gaps() -> None:
    ticks = unit_of("ticks", BaseUnit(m=1, factor=0.005))
    assert ticks is not None
    assert to_si(ticks, "m") == 0.005
    nothing = unit_of("km/h", BaseUnit())
    no_angle = unit_of("deg", BaseUnit(factor=0.0174533))
    assert nothing is not None
    assert no_angle is not None
    assert to_si(nothing, "m/s") == pytest.approx(1 / 3.6, rel=1e-15)
    assert to_si(no_angle, "rad") == math.pi / 180
    assert unit_of("degC", BaseUnit(K=1, offset=273.15)) is None


# -- maps that do not fit -------------------------------------------------------------------------

MIXED = own_fmu(
    variable("steps", "parameter", kind="integer", fmi_type="Int32", start="5", highest=9.0),
    variable("const", "parameter", variability="constant"),
    variable("calc", "calculatedParameter", variability="fixed", initial="calculated"),
    given("speed_kmh", "km/h"),
    given("count", kind="integer", fmi_type="Int32"),
    given("matrix", array=True),
    given("odd", "parsec/fortnight²"),
    given("strange", "qwrtz"),
    given("spin", "1/min"),
    taken("gear", kind="integer", fmi_type="Int32", start="1", lowest=-1.0, highest=6.0),
    taken("on", kind="boolean", fmi_type="Boolean", start="false"),
    variable("level", "output", initial="exact", start="1.0", highest=2.0),
)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[outputs]\nvx = 'sped_kmh'", "no variable 'sped_kmh'; near: 'speed_kmh'"),
        ("[outputs]\nvx = 'count'", "of type Int32"),
        ("[outputs]\nvx = 'matrix'", "an array"),
        ("[outputs]\nvx = 'd'", "is an input; an output is needed"),
        ("[outputs]\ndelta = 'delta_rate'", 'derive] delta = "delta_rate"'),
        ("[outputs]\nx = 'speed_kmh'", "'km/h' does not convert to 'm'"),
        ("[outputs]\nvx = { variable = 'speed_kmh', unit = 'm/s' }", "the FMU declares 'km/h'"),
        ("[outputs]\nvx = { variable = 'speed_kmh', scale = -1 }", "write sign = -1"),
        ("[outputs]\nvx = { variable = 'vx', unit = 'qwrtz' }", "unit 'qwrtz' is not known"),
        ("[outputs]\nvx = 'strange'", "give `unit`, or `scale`"),
        ("[outputs]\nvx = 'odd'", "does not convert|not known"),
        ("[outputs]\nomega = 'spin'", "turns or radians"),
        ("[outputs]\nx = { variable = 'x', offset = '9 s' }", "offset"),
        ("[outputs]\nx = { variable = 'x', offset = 'nine' }", "not a number with a unit"),
        ("[outputs]\npsi = 'psi'\n[derive]\npsi = { cos = 'x', sin = 'y' }", "give one"),
        ("[inputs]\nd = { from = 'gas' }", "none of d, delta_rate, delta, throttle, brake"),
        ("[inputs]\nmass_kg = 1.0", "goes into \\[parameters\\]"),
        ("[inputs]\nx = { from = 'd' }", "'x' is an output, not an input"),
        ("[inputs]\ndelta_rate = { from = 'delta' }", "'rad/s' does not convert to 'rad'"),
        ("[inputs]\non = 2", "2 does not suit 'on', which is of type Boolean"),
        ("[inputs]\ngear = 1.5", "does not suit"),
        ("[inputs]\ngear = 7", "7 is outside -1 to 6"),
        ("[inputs]\ngear = true", "does not suit"),
        ("[inputs]\ngear = { from = 'd' }", "of type Int32"),
        ("[inputs]\nd = 0.3", "takes the drive command"),
        ("[parameters]\nmas_kg = 1.0", "near: 'mass_kg'"),
        ("[parameters]\nmass_kg = 0.0", "outside 0.001 to inf"),
        ("[parameters]\nmass_kg = 'heavy'", "not a number with a unit"),
        ("[parameters]\nmass_kg = '1 m'", "does not convert to 'kg'"),
        ("[parameters]\nsteps = 10", "outside"),
        ("[parameters]\nconst = 1.0", "is a constant, not a parameter"),
        ("[parameters]\ncalc = 1.0", "a calculated parameter"),
        ("[parameters]\ngear = 1", "goes into \\[inputs\\]"),
        ("[parameters]\nlevel = 1.0", "goes into \\[start\\]"),
        ("[start]\ngear = 1", "goes into \\[inputs\\]"),
        ("[start]\nspeed_kmh = 'vx'", "cannot be set before initialisation"),
        ("[start]\nlevel = { from = 'velocity' }", "none of x, y, psi"),
        ("[start]\nlevel = 3.0", "outside"),
    ],
)
def test_what_does_not_fit_is_named_with_what_to_write(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        wire(MIXED, parse_map(text))


def test_all_problems_are_reported_at_once() -> None:
    fmu = description(given("speed", "km/h"), taken("pedal"), taken("wheel", start=None))
    with pytest.raises(InputError) as caught:
        wire(fmu)
    text = str(caught.value)
    for quantity in ("x", "y", "psi", "vx", "vy", "omega", "delta"):
        assert f"nothing gives our {quantity} [" in text
    assert "the drive command" in text
    assert "the steering rate" in text
    assert "'wheel' has neither a start value nor a place in the map" in text
    assert "fmu inspect" in text


def test_an_open_frequency_is_what_the_map_says_it_is() -> None:
    text = "[outputs]\nomega = { variable = 'spin', unit = 'rpm' }"
    assert "spin" in wire(MIXED, parse_map(text)).outputs


def test_a_scale_switches_the_conversion_off() -> None:
    wiring = wire(MIXED, parse_map("[outputs]\nvx = { variable = 'strange', scale = 2.5 }"))
    outputs = [4.0 if name == "strange" else 0.0 for name in wiring.outputs]
    assert wiring.begin(outputs, [0.0] * 7)[3] == 10.0


def test_model_exchange_alone_cannot_be_driven() -> None:
    with pytest.raises(InputError, match="export it for Co-Simulation"):
        wire(description(*OWN, interfaces=("Model Exchange",)))


# -- files ----------------------------------------------------------------------------------------

FMI3 = """
<Float64 name='time' valueReference='0' causality='independent'/>
<Float64 name='car.yaw' valueReference='1' causality='output' declaredType='Angle'/>
<Float32 name='u' valueReference='2' causality='input' start='0' min='-1' max='1' unit='tick'/>
<Boolean name='on' valueReference='3' causality='input' start='false'/>
<Float64 name='m' valueReference='4' causality='output'><Dimension start='3'/></Float64>
<Float64 name='x0' valueReference='5' causality='parameter' start='2' unit='cm'/>
"""


def test_inspection_reads_types_units_and_platforms(tmp_path: Path) -> None:
    units = "<Unit name='tick'><BaseUnit m='1' factor='0.5'/></Unit>"
    path = write_fmu(tmp_path / "a.fmu", FMI3.replace("declaredType='Angle'", ""), units=units)
    fmu = inspect(path)
    assert (fmu.fmi_version, fmu.platforms, fmu.default_step_s) == ("3.0", ("x86_64-linux",), 0.004)
    assert fmu.co_simulation
    by_name = {one.name: one for one in fmu.variables}
    assert "time" not in by_name
    assert by_name["m"].array
    assert by_name["on"].kind == "boolean"
    u = by_name["u"]
    assert (u.lowest, u.highest) == (-1.0, 1.0)
    assert u.unit is not None
    assert to_si(u.unit, "m") == 0.5
    assert by_name["x0"].settable
    assert not by_name["car.yaw"].settable


def test_units_and_ranges_come_from_the_declared_type_too(tmp_path: Path) -> None:
    path = write_fmu(
        tmp_path / "a.fmu",
        "<ScalarVariable name='h' valueReference='1' causality='output'>"
        "<Real declaredType='Heading'/></ScalarVariable>",
        version="2.0",
        units="</UnitDefinitions><TypeDefinitions><SimpleType name='Heading'>"
        "<Real unit='deg' min='0' max='360'/></SimpleType></TypeDefinitions><UnitDefinitions>",
    )
    (h,) = inspect(path).variables
    assert (h.unit_name, h.lowest, h.highest) == ("deg", 0.0, 360.0)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 but no archive", b"<xml/>"])
def test_a_file_that_is_no_fmu(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.fmu"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"a\.fmu"):
        inspect(path)
    with pytest.raises(InputError, match=r"none\.fmu"):
        inspect(tmp_path / "none.fmu")


def test_fmi_1_and_broken_descriptions(tmp_path: Path) -> None:
    for name, variables, version in (
        ("old", "", "1.0"),
        ("broken", "<Float64 name='a' valueReference='b'/>", "3.0"),
        ("open", "<Float64 ", "3.0"),
        ("type", FMI3, "3.0"),  # names a type that it does not define
    ):
        with pytest.raises(InputError, match=rf"{name}\.fmu"):
            inspect(write_fmu(tmp_path / f"{name}.fmu", variables, version=version))


def printed(fmu: FmuDescription, width: int = 100) -> str:
    text = io.StringIO()
    Console(width=width, file=text).print(FmuTable(fmu))
    return text.getvalue()


def test_the_table_shows_what_a_map_needs(tmp_path: Path) -> None:
    text = printed(
        description(
            *OWN,
            variable("hidden", "local"),
            given("evil", "m", description="\x1b[31m red [bold]"),
            platforms=("linux64",),
        )
    )
    for word in ("Co-Simulation", "linux64", "delta_rate", "rad/s", "mass_kg", "0.041", "≥ 0.001"):
        assert word in text
    assert "hidden" not in text
    assert "1 local variable" in text
    assert "\x1b" not in text
    assert "[bold]" in text
    assert "not this one" in printed(description(*OWN, interfaces=("Model Exchange",)))
