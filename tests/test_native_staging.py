"""Weights in two parts: staged by any thread while steps go on, adopted between two of them."""

import platform
import shutil
import struct
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from bayesrace.arrays import Floats
from bayesrace.controller.native_step import NativeStep
from bayesrace.errors import InputError
from bayesrace.gp.weights import Weights, pack_weights
from bayesrace.vehicles import Car
from tests.conftest import Make, Problem, fit_weights, mirrored_weights
from tests.native_programs import OPTIMISED, PROGRAMS, native_program


def staging(artefact: Path, folder: Path, *flags: str, under: Sequence[str] = ()) -> None:
    """Compiles tests/native/staging.c and runs it, under another program if there is one."""
    source, out = PROGRAMS / "staging.c", folder / "staging"
    program = native_program(artefact, source, out, *flags, also=["-pthread"])
    line: list[str | Path] = [*under, program]
    done = subprocess.run(line, capture_output=True, text=True, check=False, timeout=120)
    if "unexpected memory mapping" in done.stderr:
        pytest.skip("the thread sanitizer does not know this system's memory layout")
    assert done.returncode == 0, done.stderr[-4000:]
    assert "taken over" in done.stdout


@pytest.mark.check
def test_no_data_race_and_no_mixture(kinematic_artefact: Path, tmp_path: Path) -> None:
    flags = ("-O0", "-g", "-std=gnu11", "-fsanitize=thread")
    # some kernels spread memory farther than the sanitizer expects
    flat = shutil.which("setarch")
    under = [flat, platform.machine(), "-R"] if flat else []
    staging(kinematic_artefact, tmp_path, *flags, under=under)


def test_no_mixture_at_full_speed(kinematic_artefact: Path, tmp_path: Path) -> None:
    staging(kinematic_artefact, tmp_path, *OPTIMISED)


def drive(native: NativeStep, recorded: list[Problem], takeovers: Mapping[int, bytes]) -> Floats:
    """Inputs over a recorded drive; the sets are taken over before the steps of these numbers."""
    inputs = []
    for k, problem in enumerate(recorded[:100]):
        if k in takeovers:
            native.stage_weights(takeovers[k])
            native.adopt_weights()
        native.prepare()
        native.step(problem.x0, problem.d_previous)
        inputs.append(native.u.copy())
    return np.array(inputs)


def test_taking_over_the_same_weights_changes_no_bit(
    make: Make, weights: Weights, recorded: list[Problem]
) -> None:
    busy = drive(make(), recorded, dict.fromkeys(range(0, 100, 7), pack_weights(weights)))
    assert busy.tobytes() == drive(make(), recorded, {}).tobytes()


def test_adopted_weights_are_those_that_were_staged(
    make: Make, weights: Weights, recorded: list[Problem]
) -> None:
    """Packed as another process sends them: to the same bits as set directly."""
    other = mirrored_weights(weights)
    inputs = drive(make(), recorded, {0: pack_weights(other)})
    assert inputs.tobytes() == drive(make(other), recorded, {}).tobytes()


def test_staging_changes_nothing_before_the_adoption(
    native: NativeStep, weights: Weights, recorded: list[Problem]
) -> None:
    x, u = recorded[50].x0, np.array([0.5, 0.1])
    before = native.predict(x, u, 0.02)
    packed = pack_weights(mirrored_weights(weights))
    native.stage_weights(packed)
    assert native.predict(x, u, 0.02).tobytes() == before.tobytes()
    native.adopt_weights()
    assert native.predict(x, u, 0.02).tobytes() != before.tobytes()
    with pytest.raises(InputError, match="no weights are staged"):
        native.adopt_weights()


def test_unusable_weights_are_not_staged(native: NativeStep, weights: Weights) -> None:
    packed = pack_weights(weights)
    scale = struct.pack("<d", weights.outputs[0].amplitudes[1])
    with pytest.raises(InputError, match="unusable"):
        native.stage_weights(packed.replace(scale, struct.pack("<d", np.inf)))
    with pytest.raises(InputError, match="not the weights of the 3 outputs"):
        native.stage_weights(packed[:-8])
    with pytest.raises(InputError, match="no weights are staged"):
        native.adopt_weights()


def test_inputs_jump_only_as_far_as_the_new_model_explains(
    make: Make, car: Car, recorded: list[Problem]
) -> None:
    """The very next input is what a controller would give that had the new weights all along."""
    other = fit_weights(car, ("matern25", "matern25", "matern25"), seed=4)
    before = drive(make(iterations=20), recorded, {})
    after = drive(make(other, iterations=20), recorded, {})
    inputs = drive(make(iterations=20), recorded, {50: pack_weights(other)})
    assert inputs[:50].tobytes() == before[:50].tobytes()
    assert np.abs(inputs[50:] - after[50:]).max() < 1e-4
    assert np.abs(before[50:] - after[50:]).max() > 1e-2
