"""Weights handed over from the command line: who takes them, who refuses, who is not there."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest

from bayesrace.gp.weights import GpWeights, encode_weights, read_weights, write_weights
from bayesrace.transport import free_endpoint
from bayesrace.transport.client import RefusedError
from tests.learning_rig import Rig, rigged
from tests.network.cars import gentle_course
from tests.programs import finish, run, start

pytestmark = [pytest.mark.slow, pytest.mark.alone]


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    folder = tmp_path_factory.mktemp("publish")
    with rigged(folder, gentle_course(folder)) as made:
        yield made


def named(rig: Rig, version: str) -> Path:
    """The same weights under another name."""
    path = rig.folder / f"{version}.bin"
    write_weights(path, replace(read_weights(rig.course.weights_file), version=version))
    return path


def one_line(text: str) -> str:
    lines = text.strip().splitlines()
    assert len(lines) == 1, text
    return lines[0]


def test_accepted_says_from_when_on(rig: Rig) -> None:
    done = run("publish", named(rig, "second"), *rig.endpoints)
    assert done.returncode == 0, done.stderr
    assert "second taken over at cycle" in one_line(done.stdout)
    assert "(acceptance " in done.stdout
    assert rig.version() == "second"


def test_accepted_while_driving(rig: Rig) -> None:
    process = start("publish", named(rig, "driven"), "--name", "orca", *rig.endpoints)
    end = rig.drive(1, lockstep=False)
    done = finish(process)
    assert done.returncode == 0, done.stderr
    assert end.data["reason"] == "laps"
    assert rig.version() == "driven"


def test_refused_says_why(rig: Rig) -> None:
    before = rig.version()
    damaged = bytearray(encode_weights(read_weights(rig.course.weights_file)))
    damaged[len(damaged) // 2] ^= 1
    path = rig.folder / "damaged.bin"
    path.write_bytes(bytes(damaged))
    done = run("publish", path, *rig.endpoints)
    assert done.returncode == 1
    assert "refused" in one_line(done.stderr)
    assert "checksum" in done.stderr
    assert rig.version() == before


def test_another_model_is_refused(rig: Rig) -> None:
    weights: GpWeights = read_weights(rig.course.weights_file)
    path = rig.folder / "foreign.bin"
    write_weights(path, replace(weights, discretisation="bicycle/eulerx1-pose/0.02s/abc"))
    done = run("publish", path, "--car", "orca", *rig.endpoints)
    assert done.returncode == 1
    assert "refused" in one_line(done.stderr)


def test_what_is_no_file_is_said_in_a_line(rig: Rig) -> None:
    done = run("publish", rig.folder / "nowhere.bin", *rig.endpoints)
    assert done.returncode == 2
    assert "nowhere.bin: No such file" in one_line(done.stderr)


def test_a_car_that_is_not_there_is_said_in_a_line(rig: Rig) -> None:
    weights = rig.course.weights_file
    done = run("publish", weights, "--name", "other", "--timeout", "0.5", *rig.endpoints)
    assert done.returncode == 2
    assert "no car 'other'" in one_line(done.stderr)
    assert "orca" in done.stderr
    done = run("publish", weights, "--timeout", "0.5", "--endpoint", free_endpoint())
    assert done.returncode == 2
    assert "nobody answers" in one_line(done.stderr)


def test_two_at_once_leave_one_well_defined_version(rig: Rig) -> None:
    names = ("left", "right")
    files = [named(rig, name) for name in names]
    processes = [start("publish", file, *rig.endpoints) for file in files]
    done = [finish(process) for process in processes]
    numbers = {}
    for name, one in zip(names, done, strict=True):
        assert one.returncode == 0, one.stderr
        numbers[name] = int(one.stdout.split("(acceptance ")[1].split(")")[0])
    assert len(set(numbers.values())) == 2
    assert rig.version() == max(numbers, key=lambda name: numbers[name])


def test_rollback_returns_to_those_before(rig: Rig) -> None:
    for version in ("older", "newer"):
        rig.director.send_weights(named(rig, version).read_bytes())
    done = run("rollback", "--reason", "test", *rig.endpoints)
    assert done.returncode == 0, done.stderr
    assert "older taken over at cycle" in one_line(done.stdout)
    assert "instead of newer" in done.stdout
    assert rig.version() == "older"
    with suppress(RefusedError):
        while True:
            rig.director.rollback("until there is nothing before")
    done = run("rollback", *rig.endpoints)
    assert done.returncode == 1
    assert "refused" in one_line(done.stderr)
