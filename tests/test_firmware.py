"""A controller on a microcontroller: examples/firmware under QEMU, and what it takes of memory."""

import math
import platform
import re
import shutil
import subprocess
from dataclasses import replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import pytest

from bayesrace.codegen.boards import BOARDS, add_library, board_compiler, planned_memory
from bayesrace.codegen.build import build
from bayesrace.codegen.host_files import path_file
from bayesrace.codegen.settings import BuildSettings
from bayesrace.controller.assembly import path_table_for
from bayesrace.controller.driver import Level
from bayesrace.controller.native_step import NativeStep, Status
from bayesrace.errors import InputError
from bayesrace.gp.weights import pack_weights
from bayesrace.messages import STATE
from bayesrace.operation.host import HostProgram
from bayesrace.vehicles import Car
from examples.firmware.states import line
from tests.command_line import Cli, refused
from tests.conftest import CAUTIOUS, Circuit, Driven, fit_weights
from tests.instruments import odometry
from tests.test_host import at_start

FIRMWARE = Path(__file__).parents[1] / "examples" / "firmware"
SMALL = BuildSettings(gp_capacity=100, path_rows=1024, weight_buffers=1, estimator=False)
POINTS = 100


@pytest.fixture(scope="module")
def tools() -> None:
    for name in ("arm-none-eabi-gcc", "qemu-system-arm", "make"):
        if not shutil.which(name):
            pytest.skip(f"not installed: {name}")


@pytest.fixture(scope="module")
def artefact(
    tools: None,
    daqp: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, str]:
    """With the static library; and the report of its memory."""
    board, folder = BOARDS["cortex-m7"], tmp_path_factory.mktemp("firmware") / "controller"
    shutil.copytree(build(SMALL, daqp=daqp)[0], folder)
    return folder, add_library(folder, board, board_compiler(board))


@pytest.mark.check
def test_it_fits_into_a_microcontroller(artefact: tuple[Path, str]) -> None:
    flash_kb, ram_kb = map(int, re.findall(r"(\d+) kB of", artefact[1]))
    assert 60 < flash_kb <= 120
    assert 500 < ram_kb <= 700


@pytest.mark.check
@pytest.mark.timeout(900)
def test_the_firmware_answers_a_recorded_lap_as_the_program_here(
    artefact: tuple[Path, str],
    driven: Driven,
    circuit: Circuit,
    car: Car,
    tmp_path: Path,
) -> None:
    weights = fit_weights(car, ("rbf", "matern25", "matern15"), count=POINTS)
    host = HostProgram.made(
        tmp_path, artefact[0], car, circuit.track, circuit.line, weights, CAUTIOUS
    )
    states = [one for one in driven().select(STATE) if not one.final]
    (tmp_path / "drive.txt").write_text("".join(f"{line(one)}\n" for one in states))
    given = f"ARTEFACT={artefact[0]}", f"DATA={tmp_path}"
    done = subprocess.run(
        ["make", "-s", "-C", str(FIRMWARE), "run", *given], capture_output=True, text=True,
        check=False, timeout=800,
    )  # fmt: skip
    *answers, stack = done.stdout.splitlines()
    assert done.returncode == 0, done.stdout + done.stderr
    found = np.array([one.split() for one in answers], dtype=float)
    expected = [(sent.status, how.fallback, *sent.u) for sent, how in host.answers(states)]
    np.testing.assert_array_equal(found[:, :2], np.array(expected)[:, :2])
    np.testing.assert_allclose(found[:, 2:4], np.array(expected)[:, 2:4], rtol=0, atol=1e-9)
    assert len(states) > 100
    assert int(stack.removeprefix("stack ")) <= 40_000


def test_without_its_compiler_one_line_says_which_packages_bring_it(
    cli: Cli, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("CC", "no-such-arm-gcc")
    build_it = ("build", "--platform", "cortex-m7")
    refused(cli(*build_it, "--out", tmp_path / "m7"), "--daqp daqp-")
    file = tmp_path / "daqp.tar.gz"
    refused(cli(*build_it, "--daqp", file), "--out")
    whole = (*build_it, "--daqp", file, "--out", tmp_path / "m7")
    refused(cli(*whole), "cortex-m7 (no-such-arm-gcc): install gcc-arm-none-eabi and libnewlib")
    monkeypatch.setenv("CC", "cc")
    if "arm" not in platform.machine():
        refused(cli(*whole), "cc does not compile for cortex-m7")


@pytest.fixture(scope="module")
def small(car: Car) -> NativeStep:
    """The step of such a controller, here."""
    return NativeStep(build(SMALL)[0], car, CAUTIOUS)


def test_lines_that_do_not_fit_are_refused_and_longer_ones_sampled_as_finely_as_they_do(
    small: NativeStep, circuit: Circuit, car: Car
) -> None:
    with pytest.raises(InputError, match=f"build one with --path-rows {len(circuit.table.rows)}"):
        small.set_path(circuit.table)
    with pytest.raises(InputError, match="--path-rows"):
        path_file(circuit.table.rows, circuit.table.spacing_m, small.manifest)
    table = path_table_for(small.manifest, car, circuit.track, circuit.line)
    assert len(table.rows) == SMALL.path_rows
    small.set_path(table)
    shortest = small.manifest.model_copy(update={"path_rows": 8})
    least = math.ceil(circuit.line.length_m / car.tuning.path.spacing_max_m)
    with pytest.raises(InputError, match=f"build one with --path-rows {least}"):
        path_table_for(shortest, car, circuit.track, circuit.line)


def test_with_one_buffer_weights_are_set_before_driving_alone(
    small: NativeStep, circuit: Circuit, car: Car
) -> None:
    """And these count: steps are those of a controller with three, to the bit."""
    weights = fit_weights(car, ("rbf", "matern25", "matern15"), count=POINTS)
    whole = NativeStep(build(SMALL.model_copy(update={"weight_buffers": 3}))[0], car, CAUTIOUS)
    for step in (small, whole):
        step.set_path(path_table_for(step.manifest, car, circuit.track, circuit.line))
        step.set_weights(weights)
        assert step.step(circuit.start(), (0.0, 0.0)).usable
    np.testing.assert_array_equal(small.u, whole.u)
    for refused_here in (
        partial(small.stage_weights, pack_weights(weights)), small.adopt_weights,
        small.revert_weights,
    ):  # fmt: skip
        with pytest.raises(InputError, match="--weight-buffers"):
            refused_here()
    assert len(small.samples()[0]) == 0
    broken = replace(weights.outputs[0], length_scales=np.full(6, 1e-320))
    with pytest.raises(InputError, match="unusable"):
        small.load_weights(pack_weights(replace(weights, outputs=(broken, *weights.outputs[1:]))))
    small.step(circuit.start(), (0.0, 0.0))
    whole.load_weights(b"")
    whole.reset()
    small.reset()
    for step in (small, whole):  # no correction is left
        assert step.step(circuit.start(), (0.0, 0.0)).usable
    np.testing.assert_array_equal(small.u, whole.u)


def test_without_estimator_cars_with_sensors_are_refused_and_readings_are_no_state(
    car: Car, circuit: Circuit, tmp_path: Path
) -> None:
    artefact, manifest = build(SMALL)
    with pytest.raises(InputError, match="without --no-estimator"):
        manifest.check_car(car.model_copy(update={"sensors": odometry()}), artefact)
    host = HostProgram.made(tmp_path, artefact, car, circuit.track, circuit.line, None, CAUTIOUS)
    whole = at_start(circuit, lockstep=True)
    for estimated in (False, True):
        [(sent, how)] = host.answers([msgspec.structs.replace(whole, estimated=estimated)])
        assert (sent.status == Status.NO_STATE) == estimated
        assert (how.fallback == Level.SOLUTION) != estimated


def test_memory_is_foretold_as_the_library_has_it(small: NativeStep) -> None:
    memory, library = planned_memory(SMALL), small.artefact.library
    assert memory["controller"] == library.br_mpc_memory_size()
    assert memory["cycle"] == library.br_cycle_memory_size()
    parts = ("path", "weights", "qp", "stages", "watch")
    assert 0.8 < sum(memory[part] for part in parts) / memory["controller"] < 1
    assert memory["estimator"] < planned_memory(BuildSettings())["estimator"] / 10


def test_two_weight_buffers_are_none_that_it_can_be_built_with() -> None:
    with pytest.raises(ValueError, match="1 or 3"):
        BuildSettings(weight_buffers=2)
