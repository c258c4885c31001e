"""Maps that do not fit say what to write instead; inspection proposes ones that do."""

import io
import math
import zipfile
from pathlib import Path
from typing import Any

import pytest
from fmpy.model_description import Dimension
from hypothesis import given as those
from hypothesis import strategies as st
from rich.console import Console

from bayesrace.errors import InputError
from bayesrace.operation.terminal.fmu_table import fmu_table
from bayesrace.plant.fmu.inspection import (
    blank_map,
    inspect,
    is_settable,
    platforms,
    range_of,
    steps_s,
)
from bayesrace.plant.fmu.map import parse_map, read_map, wire
from bayesrace.units import factor_of
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
        ("[outputs]\nx = { variable = 'a', sign = 2 }", "has to be 1 or -1"),
        ("[outputs]\nx = { variable = 'a', offset = '90 deg' }", "outputs.x.offset"),
        ("[inputs]\ngas = { form = 'd' }", "inputs.gas.from"),
        ("[inputs]\ngas = inf", "finite number"),
        ("[parameters]\nm = [1]", "parameters.m"),
        ("[fmu]\nderived = ['psi']", "fmu.derived"),
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
        ("m.s-1", "m/s", 1.0),
        ("m s^-1", "m/s", 1.0),
        ("m.s-2", "m/s2", 1.0),
        ("m/s²", "m/s2", 1.0),
        ("cm", "m", 0.01),
        ("deg", "rad", math.pi / 180),
        ("°/s", "rad/s", math.pi / 180),
        ("rad.s-1", "rad/s", 1.0),
        ("rev/min", "rad/s", math.pi / 30),
        ("1/s", "rad/s", 1.0),
        ("1", "rad", 1.0),
        ("%", "1", 0.01),
        *(("deg", "1", None), ("m", "m/s", None), ("rad/s", "rad", None)),  # another dimension
        *(("1/min", "rad/s", None), ("Hz", "rad/s", None)),  # turns or radians
        *((None, "m", None), ("", "m", None), ("furlongs", "m", None)),
    ],
)
def test_units_as_tools_write_them(name: str | None, wanted: str, factor: float | None) -> None:
    assert factor_of(name, wanted) == factor


# -- maps that do not fit -------------------------------------------------------------------------

MIXED = own_fmu(
    variable("steps", "parameter", type="Int32", start="5", max="9"),
    variable("const", "parameter", variability="constant"),
    variable("calc", "calculatedParameter", variability="fixed", initial="calculated"),
    given("speed_kmh", "km/h"),
    given("count", type="Int32"),
    given("matrix", dimensions=[Dimension("3", 0)]),
    given("strange", "qwrtz"),
    given("spin", "1/min"),
    taken("gear", type="Int32", start="1", min="-1", max="6"),
    taken("on", type="Boolean", start="false"),
    variable("level", "output", initial="exact", start="1.0", max="2.0"),
)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[outputs]\nvx = 'sped_kmh'", "no variable 'sped_kmh'; near: 'speed_kmh'"),
        ("[outputs]\nvx = 'count'", "of type Int32"),
        ("[outputs]\nvx = 'matrix'", "an array"),
        ("[outputs]\nvx = 'd'", "is of causality input: give an output"),
        ("[outputs]\ndelta = 'delta_rate'", "is of causality input: give an output"),
        ("[outputs]\nx = 'speed_kmh'", "'km/h' of 'speed_kmh' does not convert to 'm'"),
        ("[outputs]\nvx = { variable = 'speed_kmh', unit = 'm/s' }", "the FMU declares 'km/h'"),
        ("[outputs]\nvx = { variable = 'vx', unit = 'qwrtz' }", "unit 'qwrtz' of"),
        ("[outputs]\nvx = 'strange'", "correct `unit`, or give `scale`"),
        ("[outputs]\nomega = 'spin'", "unit '1/min' of 'spin' does not convert to 'rad/s'"),
        ("[fmu]\nderived = ['omega']\n[outputs]\nomega = 'omega'", "omega also follows from"),
        ("[outputs]\nspeed = 'vx'\nvx = 'vx'", "vx also follows from"),
        ("[outputs]\nworld_vx = 'vx'", "give world_vx and world_vy"),
        ("[outputs]\nslip = 'psi'", "speed and slip, or speed alone"),
        ("[inputs]\nd = { from = 'gas' }", "none of d, delta_rate, delta, throttle, brake"),
        ("[inputs]\nmass_kg = 1.0", "a fixed parameter: .inputs. cannot set it"),
        ("[inputs]\nx = { from = 'd' }", "'x' is a continuous output: .inputs. cannot"),
        (
            "[inputs]\ndelta_rate = { from = 'delta' }",
            "'rad/s' of 'delta_rate' does not convert",
        ),
        ("[inputs]\non = 2", "2 does not suit 'on', which is of type Boolean"),
        ("[inputs]\ngear = 1.5", "does not suit"),
        ("[inputs]\ngear = 7", "7 is outside -1 to 6"),
        ("[inputs]\ngear = true", "does not suit"),
        ("[inputs]\ngear = { from = 'd' }", "of type Int32"),
        ("[inputs]\nd = 0.3", "takes the drive command"),
        ("[parameters]\nmas_kg = 1.0", "near: 'mass_kg'"),
        ("[parameters]\nmass_kg = 0.0", "outside 0.001 to inf"),
        ("[parameters]\nmass_kg = '41 g'", "does not suit 'mass_kg', which is of type Float64"),
        ("[parameters]\nsteps = 10", "outside"),
        ("[parameters]\nconst = 1.0", "is a constant parameter: .parameters. cannot set it"),
        ("[parameters]\ncalc = 1.0", "is a fixed calculatedParameter: .parameters. cannot"),
        ("[start]\nspeed_kmh = 'vx'", ".start. cannot set it"),
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
    assert "or [fmu] derived = ['omega']" in text
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
        wire(description(*OWN, cosimulation=False))


# -- files ----------------------------------------------------------------------------------------

FMI3 = """
<Float64 name='time' valueReference='0' causality='independent'/>
<Float64 name='car.yaw' valueReference='1' causality='output' declaredType='Angle'/>
<Float32 name='u' valueReference='2' causality='input' start='0' min='-1' max='1' unit='tick'/>
<Float64 name='m' valueReference='4' causality='output'><Dimension start='3'/></Float64>
<Float64 name='x0' valueReference='5' causality='parameter' start='2' unit='cm'/>
"""


def test_inspection_reads_variables_and_platforms(tmp_path: Path) -> None:
    path = write_fmu(tmp_path / "a.fmu", FMI3.replace("declaredType='Angle'", ""))
    fmu = inspect(path)
    assert (fmu.fmiVersion, platforms(path), steps_s(fmu)) == ("3.0", "x86_64-linux", [0, 0.004])
    variables = {one.name: one for one in fmu.modelVariables}
    assert variables["m"].dimensions
    assert range_of(variables["u"]) == (-1.0, 1.0)
    assert [name for name, one in variables.items() if is_settable(one)] == ["u", "x0"]


def test_units_and_ranges_come_from_the_declared_type_too(tmp_path: Path) -> None:
    path = write_fmu(
        tmp_path / "a.fmu",
        "<ScalarVariable name='h' valueReference='1' causality='output'>"
        "<Real declaredType='Heading'/></ScalarVariable>",
        version="2.0",
        types="<SimpleType name='Heading'><Real unit='deg' min='0' max='360'/></SimpleType>",
    )
    [h] = inspect(path).modelVariables
    assert (h.unit, *range_of(h)) == ("deg", 0.0, 360.0)


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


def test_a_description_beyond_measure_is_refused_before_it_is_read(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "huge.fmu", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", " " * 20_000_000)
    with pytest.raises(InputError, match=r"huge\.fmu: its modelDescription\.xml has 20 MB"):
        inspect(tmp_path / "huge.fmu")


# -- the table, and the map to fill in ------------------------------------------------------------


def printed(fmu: Any) -> str:
    text = io.StringIO()
    Console(width=100, file=text).print(fmu_table(fmu, "linux64"))
    return text.getvalue()


def test_the_table_shows_what_a_map_needs() -> None:
    text = printed(
        description(
            *OWN,
            variable("hidden", "local"),
            given("evil", "m", description="\x1b[31m red [bold]"),
        )
    )
    for word in ("Co-Simulation", "linux64", "delta_rate", "rad/s", "mass_kg", "0.041", "≥ 0.001"):
        assert word in text
    assert "hidden" not in text
    assert "1 local variable" in text
    assert "\x1b" not in text
    assert "[bold]" in text
    assert "not this one" in printed(description(*OWN, cosimulation=False))


def test_a_map_to_fill_in_has_the_names_and_units_that_agree() -> None:
    """Our own FMU needs nothing more; of another, what does not agree is left blank."""
    text = blank_map(own_fmu())
    wiring, plain = wire(own_fmu(), parse_map(text)), wire(own_fmu())
    assert (wiring.inputs, wiring.outputs) == (plain.inputs, plain.outputs)
    assert '# "mass_kg" = 0.041  # [kg] mass' in text.splitlines()
    others = given("x", "cm"), given("psi", "deg"), taken("gas", "%"), taken("on", type="Boolean")
    text = blank_map(own_fmu(*others, without=("x", "psi", "d")))
    lines = text.splitlines()
    for blank in (
        '# x = { variable = "", unit = "m" }',
        '# psi = { variable = "", unit = "rad" }',
        '# "gas" = { from = "", unit = "%" }  # [%]',
        '# "on" = 0',
    ):
        assert blank in lines
    assert parse_map(text).outputs.keys() == {"y", "vx", "vy", "omega", "delta"}
    assert parse_map(text).inputs.keys() == {"delta_rate"}


names = st.text(st.characters(codec="utf-8"), min_size=1, max_size=30)


@those(
    name=names | st.sampled_from(["x", "d"]),
    text=names,
    start=st.none() | names,
    kind=st.sampled_from(["Float64", "Int32", "Boolean", "String", "Enumeration", "Binary"]),
    causality=st.sampled_from(["input", "output", "parameter", "local"]),
    unit=st.none() | names,
)
def test_a_map_to_fill_in_always_parses(
    name: str, text: str, start: str | None, kind: str, causality: str, unit: str | None
) -> None:
    one = variable(name, causality, unit, type=kind, start=start, description=text)
    parse_map(blank_map(description(one, name=text)))
