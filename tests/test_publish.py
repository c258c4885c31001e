"""Weights sent from the command line: accepted, refused, or without an answer."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from bayesrace.defaults import MAX_WEIGHTS_BYTES
from bayesrace.gp.weights import Weights, encode_weights, read_weights, write_weights
from bayesrace.transport import free_endpoint
from tests.command_line import Cli, refused
from tests.learning_rig import Rig, rigged
from tests.network.cars import gentle_course
from tests.programs import finish, start

pytestmark = pytest.mark.wall_clock


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


def test_accepted_says_from_when_on(rig: Rig, cli: Cli) -> None:
    done = cli("publish", named(rig, "second"), *rig.endpoints)
    assert done.code == 0, done.err
    (line,) = done.out.splitlines()
    assert "second taken over at cycle" in line
    assert "(acceptance " in line
    assert rig.version() == "second"


def test_accepted_while_driving(rig: Rig) -> None:
    process = start("publish", named(rig, "driven"), "--name", "orca", *rig.endpoints)
    end = rig.drive(1, lockstep=False)
    done = finish(process)
    assert done.returncode == 0, done.stderr
    assert end.data["reason"] == "laps"
    assert rig.version() == "driven"


def test_what_are_no_weights_is_said_before_a_controller_is_looked_for(rig: Rig, cli: Cli) -> None:
    damaged = bytearray(encode_weights(read_weights(rig.course.weights_file)))
    damaged[len(damaged) // 2] ^= 1
    for content, why in ((bytes(damaged), "checksum"), (b"text" * 20, "not a weights file")):
        path = rig.folder / "damaged.bin"
        path.write_bytes(content)
        refused(cli("publish", path), "damaged.bin", why)  # nobody is at the default endpoints
    refused(cli("publish", rig.folder / "nowhere.bin"), "nowhere.bin: No such file")
    large = rig.folder / "large.bin"
    large.write_bytes(bytes(MAX_WEIGHTS_BYTES + 1))  # Zenoh would drop it silently
    refused(cli("publish", large), "large.bin is longer than 1 MB")


def test_another_model_is_refused(rig: Rig, cli: Cli) -> None:
    before = rig.version()
    weights: Weights = read_weights(rig.course.weights_file)
    path = rig.folder / "foreign.bin"
    write_weights(path, replace(weights, discretisation="bicycle/eulerx1-pose/0.02s/abc"))
    refused(cli("publish", path, "--car", "orca", *rig.endpoints), "refused", code=1)
    assert rig.version() == before


def test_a_car_that_is_not_there_is_said_in_a_line(rig: Rig, cli: Cli) -> None:
    weights = rig.course.weights_file
    done = cli("publish", weights, "--name", "other", "--timeout", "0.5", *rig.endpoints)
    refused(done, "no car 'other'", "orca")
    done = cli("publish", weights, "--timeout", "0.5", "--endpoint", free_endpoint())
    refused(done, "no connection to")


@pytest.mark.check
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


def test_rollback_returns_to_those_before(rig: Rig, cli: Cli) -> None:
    for version in ("older", "newer"):
        rig.director.send_weights(named(rig, version).read_bytes())
    done = cli("rollback", "--reason", "test", *rig.endpoints)
    assert done.code == 0, done.err
    (line,) = done.out.splitlines()
    assert "older taken over at cycle" in line
    assert "instead of newer" in line
    assert rig.version() == "older"
    while cli("rollback", *rig.endpoints).code == 0:
        pass  # until there is nothing before
    refused(cli("rollback", *rig.endpoints), "refused", code=1)
