"""The controller's FMU among other tools: instances, saved states, misuse, exchanged weights."""

import ctypes
import shutil
import subprocess
import zipfile
from pathlib import Path
from typing import Any, Literal

import fmpy.fmi2
import numpy as np
import pytest
from fmpy import extract, read_model_description
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import FMU2Slave
from fmpy.validation import validate_fmu

from bayesrace.codegen.fmu import exchange_weights, pack
from bayesrace.codegen.fmu.build import sources_of, write_sources
from bayesrace.codegen.host_files import WEIGHTS_FILE, path_file
from bayesrace.errors import InputError
from bayesrace.gp.weights import zero_weights
from bayesrace.manifest import read_manifest
from tests.car_fmu import packed_car
from tests.conftest import fit_weights
from tests.fmu_lockstep import (  # noqa: F401 - a fixture is used by name
    Exported,
    answers,
    exported_controllers,
    same,
    strewn,
    versions,
)
from tests.fmu_master import Slave
from tests.native_programs import PROGRAMS, SANITIZED, artefact_objects, gcc


def test_two_instances_do_not_know_each_other_and_reset_begins_the_same_run_again(
    exported: Exported,
) -> None:
    one_run = exported.lockstep().run(exported.circuit.start(v_mps=0.1), 80)
    two_run = exported.lockstep().run(exported.circuit.start(2.0, 1.5), 80)
    one, two = (exported.slave(exported.fmu(3), name=name) for name in ("one", "two"))
    for _ in range(2):
        rows = [
            np.r_[answers(one, [a]), answers(two, [b])]
            for a, b in zip(one_run.x, two_run.x, strict=True)
        ]
        same(np.array(rows)[:, 0], one_run)
        same(np.array(rows)[:, 1], two_run)
        one.set({"r_duty": 0.07})
        for slave in (one, two):
            slave.reset()
            slave.initialise()


@versions
def test_a_tool_can_roll_back(exported: Exported, version: Literal[2, 3]) -> None:
    run = exported.lockstep().run(exported.circuit.start(v_mps=1.0), 60)
    controller = exported.slave(exported.fmu(version))
    answers(controller, run.x[:30])
    get, put, free = (
        getattr(controller.fmu, f"{what}{'FMUstate' if version == 2 else 'FMUState'}")
        for what in ("get", "set", "free")
    )
    state, time = get(), controller.time
    ahead = answers(controller, run.x[30:])
    put(state)
    controller.time = time
    np.testing.assert_array_equal(answers(controller, run.x[30:]), ahead)
    free(state)


@pytest.mark.check
def test_no_sanitizer_finds_anything_and_c_sees_what_the_master_sees(
    exported: Exported, tmp_path: Path
) -> None:
    """A drive with bad states strewn in, saved and restored states, resets, missing resources."""
    run = exported.lockstep().run(exported.circuit.start(v_mps=1.0), 120, strewn)
    definition = exported.define(version=3)
    linked = write_sources(sources_of(definition)[1], tmp_path)
    own = [name for name in linked if not (exported.artefact / name).exists()]
    flags = (*SANITIZED, "-Wall", "-Wextra", "-Wno-unused-parameter", "-I.")
    objects = artefact_objects(exported.artefact, SANITIZED)
    main, archives = PROGRAMS / "fmu_controller.c", ("libdaqpstat.a", "-lm")
    said = gcc(*flags, main, *own, *objects, *archives, "-o", "drive", cwd=tmp_path)
    assert "controller" not in said
    resources = tmp_path / "resources"
    resources.mkdir()
    for name, content in definition.resources.items():
        (resources / name).write_bytes(content)
    np.array(run.x).tofile(tmp_path / "states.bin")
    done = subprocess.run(
        [tmp_path / "drive", resources, tmp_path / "states.bin", tmp_path / "results.bin"],
        capture_output=True, text=True, timeout=280,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-4000:]
    results = np.fromfile(tmp_path / "results.bin").reshape(-1, 2)
    np.testing.assert_allclose(results, np.array(run.u), rtol=0, atol=1e-6)


# Misuse ------------------------------------------------------------------------------------------


@versions
def test_wrong_parameters_are_refused_and_named(exported: Exported, version: Literal[2, 3]) -> None:
    """Discard and Warning let the simulation go on, and leave no trace in it."""
    fmu = exported.fmu(version)
    controller, other = (exported.slave(fmu, name=name) for name in ("one", "two"))
    states = [exported.circuit.start()] * 3
    np.testing.assert_array_equal(answers(controller, states), answers(other, states))
    for name, value in (("q_position", 0.0), ("r_duty", np.nan), ("iterations", 0)):
        with pytest.raises(FMICallException, match=r"\(discard\)"):
            controller.set({name: value})
        assert name in controller.messages[-1]
    with pytest.raises(FMICallException, match=r"\(error\)"):
        controller.set({"delay": 0.1})  # not tunable
    before = controller.get("d_max", "d_min", "q_position")
    controller.set({"d_max": 0.0, "d_min": 0.0, "q_position": 1.0})  # each within its own bounds
    count = len(controller.messages)
    np.testing.assert_array_equal(answers(controller, states), answers(other, states))
    assert controller.get("d_max", "d_min", "q_position") == before
    assert len(controller.messages) == count + 1
    assert "d_min must be below d_max" in controller.messages[-1]
    controller.reset()
    with pytest.raises(FMICallException):
        controller.initialise({"d_max": 0.0, "d_min": 0.0})


@versions
def test_missing_and_damaged_resources_are_refused_and_named(
    exported: Exported, tmp_path: Path, version: Literal[2, 3]
) -> None:
    fmu = exported.fmu(version)
    damaged = tmp_path / "damaged"
    with zipfile.ZipFile(fmu) as archive:
        archive.extractall(damaged)
    weights = damaged / "resources" / WEIGHTS_FILE
    data = weights.read_bytes()

    said: list[str] = []

    class Listening(Slave):
        def _log(self, text: bytes) -> None:
            said.append(text.decode())

    for change, words in (
        (lambda: weights.write_bytes(data[:-8]), "cut off"),
        (lambda: weights.write_bytes(data[:500] + b"\xff" + data[501:]), "damaged (checksum)"),
        (weights.unlink, "missing"),
        (lambda: shutil.rmtree(damaged / "resources"), "path.bin is missing"),
    ):
        change()
        with pytest.raises(Exception, match="instantiate"):
            Listening(fmu, damaged)
        assert words in said[-1], said


def test_the_resources_are_found_by_uri_and_by_plain_path(
    exported: Exported, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """FMI 2.0 wants a URI; many importers pass a path."""
    folder = tmp_path / "an FMU, 100 %20 fine"
    extract(str(exported.fmu(2)), unzipdir=str(folder))
    description = read_model_description(str(folder), validate=False)
    identifier = description.coSimulation.modelIdentifier
    fmu: Any = FMU2Slave(
        guid=description.guid, unzipDirectory=str(folder), modelIdentifier=identifier
    )

    def instance(location: str) -> Any:
        token, callbacks = description.guid.encode(), ctypes.byref(fmpy.fmi2.defaultCallbacks)
        arguments = (location.encode(), callbacks, 0, 0)
        return fmu.fmi2Instantiate(b"one", fmpy.fmi2.fmi2CoSimulation, token, *arguments)

    monkeypatch.chdir(tmp_path)
    path = folder / "resources"
    uri = path.as_uri()
    assert "%" in uri.removeprefix("file:///")
    for location in (
        uri,
        uri + "/",
        uri.replace("file:///", "file:/"),
        uri.replace("file:///", "file://localhost/"),
        str(path),
        f"{path}/",
        str(path.relative_to(tmp_path)),
    ):
        component = instance(location)
        assert component, location
        fmu.fmi2FreeInstance(component)
    for location in ("", "http" + uri.removeprefix("file"), str(path.parent)):
        assert not instance(location), location


def test_weights_are_exchanged_without_compiling(exported: Exported, tmp_path: Path) -> None:
    other = fit_weights(exported.car, ("matern25", "rbf", "rbf"), count=90, seed=4)
    out = tmp_path / "other.fmu"
    exchange_weights(exported.fmu(3), other, out)
    assert validate_fmu(str(out)) == []
    run = exported.lockstep()
    run.native.set_weights(other)
    run.run(exported.circuit.start(v_mps=1.0), 60)
    same(answers(exported.slave(out), run.x), run)
    exchange_weights(out, None, out)  # in place
    worst = exported.lockstep()
    worst.native.load_weights(b"")
    worst.run(exported.circuit.start(v_mps=1.0), 60)
    controller = Slave(out, tmp_path / "worst")
    controller.initialise()
    same(answers(controller, worst.x), worst)
    with pytest.raises(InputError, match="learned for"):
        exchange_weights(out, zero_weights("orca", "another"), out)
    with pytest.raises(InputError, match="not a controller's FMU"):
        exchange_weights(packed_car(3), other, out)
    with pytest.raises(InputError, match="cannot be read"):
        exchange_weights(tmp_path / "none.fmu", other, out)


def test_what_does_not_fit_together_is_not_exported(exported: Exported) -> None:
    heavier = exported.car.model_copy(update={"mass_kg": 0.05})
    with pytest.raises(InputError, match="built for car"):
        exported.define(car=heavier)
    with pytest.raises(InputError, match="learned for"):
        exported.define(weights=zero_weights("orca", "another"))
    with pytest.raises(InputError, match="lack 'q_position'"):
        exported.define(settings={})
    with pytest.raises(InputError, match="path table"):
        exported.define(rows=exported.circuit.table.rows[:4])
    with pytest.raises(InputError, match="export it there"):
        pack(exported.define(), exported.folder / "no.fmu", ["x86_64-linux", "x86_64-windows"])
    table, manifest = exported.circuit.table, read_manifest(exported.artefact)
    assert len(path_file(table.rows, table.spacing_m, manifest)) % 8 == 0
