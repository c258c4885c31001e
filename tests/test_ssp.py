"""Car and controller in one SSP: valid by the standard's schemas, and driven by tools of others.

ecos and fmpy are two independent masters; the oracle is a loop of both FMUs of our own.
"""

import shutil
import subprocess
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from fmpy import read_model_description
from fmpy.ssp.simulation import simulate_ssp
from fmpy.ssp.ssd import Parameter, ParameterSet, get_connections, read_ssd
from fmpy.validation import validate_fmu

from bayesrace.arrays import Floats
from bayesrace.codegen.fmu import car_fmu, pack_loop
from bayesrace.errors import InputError
from bayesrace.gp.weights import Weights, write_weights
from bayesrace.operation.analysis.laps import time_laps
from bayesrace.tracks import Track
from bayesrace.vehicles.models import STATES
from tests.command_line import Cli, course_files, refused
from tests.conftest import Circuit, offset_line
from tests.fmu_lockstep import Exported, exported_controllers  # noqa: F401 - a fixture
from tests.fmu_master import Slave, drive
from tests.instruments import odometry
from tests.shared import session_folder

STEP_S = 0.02
STEPS = 250
"""A lap from the start, and half of another."""

NAMESPACES = {
    "ssd": "http://ssp-standard.org/SSP1/SystemStructureDescription",
    "ssc": "http://ssp-standard.org/SSP1/SystemStructureCommon",
}


@dataclass(frozen=True)
class Loop:
    """An SSP of the synthetic track."""

    file: Path
    unpacked: Path
    own: Path
    """Where FMUs are extracted to."""
    track: Track

    @property
    def start(self) -> tuple[float, ...]:
        """State at the start line, at 0.1 m/s."""
        return (*self.track.start_pose(), 0.1, 0.0, 0.0, 0.0)

    def driven(self) -> tuple[Floats, Floats]:
        """States (n, 7) and inputs (n, 2) of a loop of our own that steps both side by side."""
        car = dict(zip(STATES, self.start, strict=True))
        values = {"car": car, "controller": {"delay": STEP_S}}
        slaves = []
        for name, given in values.items():
            fmu = self.unpacked / "resources" / f"{name}.fmu"
            slaves.append(Slave(fmu, self.own / name))
            slaves[-1].initialise(given)
        states, inputs = drive(slaves[0], slaves[1], STEPS, STEP_S, parallel=True)
        for slave in slaves:
            slave.close()
        return states, inputs

    def lap_s(self, x: Floats) -> float:
        """Time of the first lap, which is driven on the track."""
        projected = self.track.project_path(x[:, :2])
        time_s: Floats = STEP_S * np.arange(len(x), dtype=np.float64)
        laps = time_laps(self.track, time_s, x[:, :2], projected.s_m)
        assert projected.off_track_m[: laps.after[0]].max() < 0
        return laps.times_s[0]


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory, circuit: Circuit, weights: Weights) -> Loop:
    """As the command line exports it, which compiles two FMUs."""
    track = circuit.track
    line = offset_line(track, offset_m=0.0, lateral_mps2=6.0, v_max=2.6)

    def make(folder: Path) -> None:
        write_weights(folder / "weights.bin", weights)
        given = ("--weights", folder / "weights.bin", "--out", folder / "loop.ssp")
        program = (sys.executable, "-m", "bayesrace.operation.cli", "fmu", "export", "--ssp")
        subprocess.run([*program, *course_files(folder, track, line), *given], check=True)
        with zipfile.ZipFile(folder / "loop.ssp") as archive:
            archive.extractall(folder / "unpacked")

    folder = session_folder(tmp_path_factory, "ssp", make)
    return Loop(folder / "loop.ssp", folder / "unpacked", tmp_path_factory.mktemp("ssp"), track)


def start_values(file: Path) -> dict[str, dict[str, Any]]:
    """Of each component, as fmpy reads its parameter file, which it validates."""
    return {
        one.name: {
            value.name: float(value.value)
            for binding in one.parameterBindings
            for values in binding.parameterValues
            for value in values.parameters
        }
        for one in read_ssd(file).system.elements
    }


@pytest.mark.check
def test_it_is_valid_and_says_of_the_fmus_what_they_say_of_themselves(loop: Loop) -> None:
    structure = read_ssd(loop.file)  # raises where the schemas of SSP 1.0 find a fault
    described = ElementTree.parse(loop.unpacked / "SystemStructure.ssd")  # noqa: S314 - our own
    for component in structure.system.elements:
        fmu = loop.unpacked / component.source
        assert validate_fmu(str(fmu)) == []
        known = {v.name: v for v in read_model_description(fmu).modelVariables}
        path = f".//ssd:Component[@name='{component.name}']//ssd:Connector"
        connectors = {one.attrib["name"]: one for one in described.findall(path, NAMESPACES)}
        assert connectors.keys() >= {*STATES, "d", "delta_rate"}
        for name, one in connectors.items():
            [kind] = one
            assert one.get("kind") == known[name].causality
            assert kind.tag == f"{{{NAMESPACES['ssc']}}}{known[name].type}"
            assert kind.get("unit") == known[name].unit
        for value in component.parameterBindings[0].parameterValues[0].parameters:
            assert value.unit == known[value.name].unit
    ends = get_connections(structure.system)
    assert {(a.parent.name, a.name, b.parent.name, b.name) for a, b in ends} == {
        *(("car", name, "controller", name) for name in STATES),
        *(("controller", name, "car", name) for name in ("d", "delta_rate")),
    }
    used = {one.get("unit") for one in described.iterfind(".//ssc:Real", NAMESPACES)}
    assert {unit.name for unit in structure.units} == used
    start = zip(STATES, loop.start, strict=True)
    assert start_values(loop.file) == {"car": dict(start), "controller": {"delay": STEP_S}}


def ecos() -> Any:
    """ecos, a co-simulation of others; skips where it does not run."""
    if shutil.which("unzip") is None:
        pytest.skip("ecos needs unzip")
    try:
        import ecospy
    except (ImportError, OSError) as error:  # no such package, or no libtbb12 of the system
        pytest.skip(f"ecos does not run here: {error}")
    return ecospy


@pytest.mark.check
def test_ecos_drives_the_lap_of_a_loop_of_our_own_to_the_bit(loop: Loop) -> None:
    """It steps both side by side, and has one parameter set for both, by its name."""
    ecospy = ecos()
    ecospy.EcosLib.set_log_level("warn")
    simulation = ecospy.EcosSimulation(STEP_S, ssp_path=str(loop.file))
    simulation.init(parameter_set="start")
    names = [*(f"car::{name}" for name in STATES), "controller::d", "controller::delta_rate"]
    rows = []
    for _ in range(STEPS):
        rows.append([simulation.get_real(name) for name in names])
        simulation.step()
    simulation.terminate()
    table = np.array(rows)
    states, inputs = loop.driven()
    np.testing.assert_array_equal(table[:, :7], states)
    np.testing.assert_array_equal(table[1:, 7:], inputs[:-1])  # outputs of the step before
    assert loop.lap_s(table) == loop.lap_s(states)


@pytest.mark.check
def test_fmpy_drives_a_lap_too(loop: Loop) -> None:
    """It gives all inputs 0 at first, which a controller that believes each state gets over."""
    values = start_values(loop.file)
    values["controller"]["sensor_tolerance"] = 0.0
    given = ParameterSet(
        name="start",
        parameters=[Parameter(name=f"{element}.{name}", value=value)
                    for element, those in values.items() for name, value in those.items()],
    )  # fmt: skip
    rows = simulate_ssp(loop.file, 0.0, STEPS * STEP_S, STEP_S, given)
    after = np.column_stack([rows[f"car.{name}"] for name in STATES])
    states = np.vstack([loop.start, after])
    ours, _ = loop.driven()
    assert loop.lap_s(states) == pytest.approx(loop.lap_s(ours), abs=0.1)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (("--controller",), "leave out --controller"),
        (("--version", "3"), "in FMI 2.0"),
        (("--kind", "me"), "export it with --kind cs"),
    ],
)
def test_options_that_do_not_go_together_are_refused(
    cli: Cli, tmp_path: Path, options: tuple[str, ...], reason: str
) -> None:
    refused(cli("fmu", "export", "--ssp", *options, "--out", tmp_path / "out.ssp"), reason)


def test_a_controller_that_reads_instruments_is_refused(exported: Exported, tmp_path: Path) -> None:
    car = exported.car.model_copy(update={"sensors": odometry()})
    controller = exported.define(car=car, version=2)
    with pytest.raises(InputError, match=r"without \[sensors"):
        pack_loop(car_fmu(car, 2), controller, tmp_path / "x.ssp", x0=[0.0] * 7, stop_s=1)
    assert not (tmp_path / "x.ssp").exists()
