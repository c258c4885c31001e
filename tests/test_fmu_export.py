"""The car as a Co-Simulation FMU is the built-in plant: trajectory, guard, parameters.

Every exported FMU names the parts of other authors in it, with their licences.
"""

import re
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu
from hypothesis import given, settings
from hypothesis import strategies as st

from bayesrace.codegen.fmu import Variable, car_fmu, pack
from bayesrace.codegen.fmu.archive import licence_files, third_parties
from bayesrace.codegen.platforms import get_platform
from bayesrace.errors import InputError
from bayesrace.plant.vehicle import PlantGuard
from bayesrace.vehicles import Car, get_car
from bayesrace.vehicles.models import STATES
from tests.car_fmu import Kind, Version, built_in, commands, driven, packed_car, slave, unpacked_car
from tests.cars import with_numbers
from tests.fmu_lockstep import Exported, exported_controllers  # noqa: F401 - a fixture
from tests.fmu_master import Slave

etree: Any = pytest.importorskip("lxml.etree")

ALL = [(2, "cs"), (3, "cs"), (3, "me")]
ORCA = get_car("orca")
START = {"x": 1.0, "y": -2.0, "psi": 0.5, "vx": 1.2, "vy": 0.1, "omega": -0.4, "delta": 0.1}


@pytest.mark.parametrize(("version", "kind"), ALL)
def test_fmpy_validates_without_a_finding(version: Version, kind: Kind) -> None:
    assert validate_fmu(str(packed_car(version, kind))) == []


def test_the_build_description_of_fmi_3_fits_its_schema() -> None:
    schema = Path(fmpy.__file__).parent / "schema" / "fmi3" / "fmi3BuildDescription.xsd"
    document = etree.parse(str(unpacked_car(3) / "sources" / "buildDescription.xml"))
    etree.XMLSchema(file=str(schema)).assertValid(document)


@pytest.mark.parametrize(("version", "kind"), ALL)
def test_the_archive_has_what_people_look_for(version: Version, kind: Kind) -> None:
    with zipfile.ZipFile(packed_car(version, kind)) as archive:
        names = set(archive.namelist())
        page = archive.read("documentation/index.html").decode()
        description = etree.fromstring(archive.read("modelDescription.xml"))
    assert {"sources/car.c", "sources/car_model.c", "sources/fmu_config.h"} <= names
    assert "cc -std=gnu11" in page
    assert "dynamic bicycle model with Pacejka tyres and DC motor" in page
    experiment = description.find("DefaultExperiment")
    assert experiment is not None
    assert float(experiment.attrib["stepSize"]) == 0.02
    variables = description.find("ModelVariables")
    assert variables is not None
    for variable in variables:
        typed = variable[0] if version == 2 else variable
        assert typed.attrib["unit"], variable.attrib["name"]
        assert variable.attrib["name"] == "time" or variable.attrib["description"]


def test_the_same_export_is_the_same_file(tmp_path: Path, car: Car) -> None:
    again = pack(car_fmu(car, 3, "cs"), tmp_path / "again.fmu")
    assert again.read_bytes() == packed_car(3).read_bytes()


def test_another_car_has_another_token(car: Car) -> None:
    tokens = set()
    for fmu in (packed_car(2), packed_car(3), packed_car(3, "me")):
        text = zipfile.ZipFile(fmu).read("modelDescription.xml").decode()
        tokens |= set(re.findall(r'(?:guid|instantiationToken)="([^"]+)"', text))
    assert len(tokens) == 3


@pytest.mark.parametrize("seed", range(3))
def test_both_versions_drive_like_the_built_in_plant(car: Car, seed: int) -> None:
    """Design: same trajectory as the built-in plant to 1e-9; FMI 2.0 and 3.0 to the last bit."""
    inputs = commands(600, seed)
    expected = built_in(car, inputs)
    rows = []
    for version in (2, 3):
        one = slave(version)
        one.initialise()
        rows.append(driven(one, inputs))
        one.close()
    np.testing.assert_array_equal(rows[0], rows[1])
    np.testing.assert_allclose(rows[0], expected, rtol=0, atol=1e-9)
    assert np.abs(expected[:, 3]).max() > 1
    assert (expected[:, 3] < 1e-3).any()  # it also stood


@pytest.mark.parametrize("h", [0.002, 0.005, 0.01, 0.1, 0.5])
def test_any_communication_step_is_a_period_of_that_length(car: Car, h: float) -> None:
    inputs = commands(100, 7)
    one = slave()
    one.initialise(START)
    rows = driven(one, inputs, h)
    one.close()
    expected = built_in(car, inputs, h, [START[name] for name in STATES])
    np.testing.assert_allclose(rows, expected, rtol=0, atol=1e-9)


def test_an_odd_communication_step_is_divided_into_parts_of_at_most_a_millisecond() -> None:
    one, other = slave(), slave()
    for car in (one, other):
        car.initialise(START)
        car.set({"d": 0.5, "delta_rate": -1.0})
    one.step(0.0123)  # 13 parts
    other.step(0.0123 - 0.005)
    other.step(0.005)
    np.testing.assert_allclose(one.get(*STATES), other.get(*STATES), rtol=0, atol=1e-6)
    assert one.get("time") == [pytest.approx(0.0123)]


@pytest.fixture(scope="module")
def again() -> Iterator[Slave]:
    """One instance for many runs, reset before each."""
    one = slave()
    yield one
    one.fmu.freeInstance()


numbers = st.floats(-20, 20) | st.sampled_from([np.nan, np.inf, -np.inf, 0.0, -0.0])


@settings(deadline=None, max_examples=300)
@given(
    d=numbers,
    rate=numbers,
    vx=st.floats(-1, 3),
    share=st.floats(-1, 1),
    h=st.sampled_from([0.001, 0.003, 0.02, 0.05]),
    limits=st.tuples(st.floats(-1, -0.01), st.floats(0.05, 1), st.floats(0.05, 1), st.floats(1, 9)),
)
def test_the_guard_in_c_is_the_plants(
    again: Slave,
    d: float,
    rate: float,
    vx: float,
    share: float,
    h: float,
    limits: tuple[float, float, float, float],
) -> None:
    values = dict(
        zip(("d_min", "d_max", "delta_max_rad", "delta_rate_max_radps"), limits, strict=True)
    )
    delta = share * limits[2]
    guard = PlantGuard(with_numbers(get_car("orca"), values))
    expected = guard.apply((d, rate), np.array([0, 0, 0, vx, 0, 0, delta]), h)
    again.reset()
    again.initialise({**values, "vx": vx, "delta": delta})
    again.set({"d": d, "delta_rate": rate})
    again.step(h)
    assert again.get("d_applied", "delta_rate_applied") == list(expected)
    assert again.get("delta") == [guard.angle_after(delta, expected[1], h)]


@pytest.mark.parametrize("name", sorted(ORCA.equation_numbers | ORCA.guard_numbers))
def test_every_parameter_acts_as_in_a_car_with_it(car: Car, name: str) -> None:
    inputs = [(1.3, 8.0)] * 5 + commands(150, 3)  # first beyond the limits
    value = (car.equation_numbers | car.guard_numbers)[name] * 1.25
    one = slave()
    one.initialise({name: value})
    rows = driven(one, inputs)
    one.close()
    np.testing.assert_allclose(
        rows, built_in(with_numbers(car, {name: value}), inputs), rtol=0, atol=1e-9
    )
    assert np.abs(rows - built_in(car, inputs)).max() > 1e-6


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("mass_kg", 0.0, "mass_kg"),
        ("mass_kg", -1.0, "mass_kg"),
        ("inertia_kgm2", np.nan, "inertia_kgm2"),
        ("front_d", np.inf, "front_d"),
        ("cr0", -1e-9, "cr0"),
        ("d_min", 0.1, "d_min"),
        ("delta", np.nan, "delta"),
    ],
)
@pytest.mark.parametrize("version", [2, 3])
def test_an_impossible_value_is_refused_by_name(
    version: Version, name: str, value: float, words: str
) -> None:
    one = slave(version)
    before = one.get(name)
    with pytest.raises(FMICallException):
        one.set({name: value})
    assert words in one.messages[-1]
    assert one.get(name) == before
    one.initialise()
    one.step(0.02)
    one.close()


def test_a_start_angle_beyond_the_limit_is_refused_at_the_end_of_initialisation() -> None:
    one = slave()
    with pytest.raises(FMICallException):
        one.initialise({"delta": 0.5})
    assert "delta_max_rad" in one.messages[-1]
    one.set({"delta_max_rad": 0.6})  # still in initialisation: it can be mended
    one.fmu.exitInitializationMode()
    one.step(0.02)
    assert one.get("delta") == [0.5]
    one.close()


def test_a_step_that_ends_at_infinity_is_undone_and_said() -> None:
    one = slave()
    one.initialise({"mass_kg": 1e-300, "vx": 1.0})
    before = one.get(*STATES)
    with pytest.raises(FMICallException):
        one.step(0.02)
    assert "not finite" in one.messages[-1]
    assert one.get(*STATES) == before
    with pytest.raises(FMICallException):
        one.step(0.02)
    assert "failed" in one.messages[-1]
    one.reset()
    one.initialise()
    one.step(0.02)
    one.close()


def test_model_exchange_in_fmi_2_is_refused(car: Car) -> None:
    with pytest.raises(InputError, match="--version 3"):
        car_fmu(car, 2, "me")


def test_a_definition_that_cannot_work_is_refused(car: Car, tmp_path: Path) -> None:
    definition = car_fmu(car)
    with pytest.raises(InputError, match="unknown platform 'amiga'"):
        pack(definition, tmp_path / "x.fmu", ["amiga"])
    with pytest.raises(InputError, match="cannot write"):
        pack(definition, Path("/proc/none/x.fmu"))
    strange = replace(definition, variables=(Variable("a", "local", "", unit="furlong"),))
    with pytest.raises(InputError, match="furlong"):
        pack(strange, tmp_path / "x.fmu")


NOTICES = (Path(__file__).parents[1] / "THIRD_PARTY_NOTICES.md").read_text()

FMI = ("FMI headers", "BSD-2-Clause", "Modelica Association Project")
CASADI = ("CasADi runtime", "MIT-0", "Joel Andersson, Joris Gillis, Moritz Diehl")
DAQP = ("DAQP", "MIT", "Daniel Arnström")
ZIG = ("Zig compiler runtime", "MIT", "Zig contributors")
MINGW = ("MinGW-w64 runtime", "ZPL-2.1", "the mingw-w64 project")


def named(read: dict[str, str], *parts: tuple[str, str, str]) -> None:
    """Page, licence file and repository name these parts, and there is a text of each."""
    folder = "documentation/licenses/"
    entry, page = read[f"{folder}license.txt"], read["documentation/index.html"]
    assert "BayesRace contributors" in entry
    for name, licence, holder in parts:
        line = f"{name} ("
        assert line in entry
        assert line in page
        assert f"), {licence}" in entry[entry.index(line) :]
        assert holder in read[f"{folder}{name.replace(' ', '-')}.txt"]
        assert f"| {name} |" in NOTICES
        assert holder in NOTICES
    assert sum(path.startswith(folder) for path in read) == len(parts) + 1


def documentation(fmu: Path) -> dict[str, str]:
    with zipfile.ZipFile(fmu) as archive:
        names = [name for name in archive.namelist() if name.startswith("documentation/")]
        return {name: archive.read(name).decode() for name in names}


@pytest.mark.parametrize(("version", "kind"), ALL)
def test_the_car_names_fmi_and_casadi(version: Version, kind: Kind) -> None:
    fmu = packed_car(version, kind)
    named(documentation(fmu), FMI, CASADI)
    with zipfile.ZipFile(fmu) as archive:  # nothing else is by others
        sources = {name for name in archive.namelist() if name.startswith("sources/")}
        assert all(
            b"Copyright" not in archive.read(name) or name.startswith(f"sources/fmi{version}")
            for name in sources
        )


@pytest.mark.parametrize("version", [2, 3])
def test_the_controller_names_daqp_as_well(exported: Exported, version: Version) -> None:
    named(documentation(exported.fmu(version)), FMI, CASADI, DAQP)


def test_cross_compiled_binaries_name_what_ziglang_links(ziglang: None) -> None:
    windows = get_platform("x86_64-windows")
    parts = third_parties(car_fmu(get_car("orca")), [windows])
    files = {name: content.decode() for name, content in licence_files(parts).items()}
    named(files | {"documentation/index.html": "".join(map(str, parts))}, FMI, CASADI, ZIG, MINGW)
