"""``bayesrace replay``: recorded drives once more, to the bit, in lockstep and in real time."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from bayesrace.api.systems import drive_system
from bayesrace.controller.settings import MpcSettings
from bayesrace.errors import InputError
from bayesrace.files import write_whole
from bayesrace.gp.weights import Weights, encode_weights, write_weights
from bayesrace.log import LogReader, LogWriter
from bayesrace.messages import COMMAND, STATE, TELEMETRY, Command, Event, encode
from bayesrace.operation.run_plan import RunPlan
from bayesrace.operation.system import started_system
from bayesrace.operation.terminal.terminal import stages_on
from bayesrace.raceline import write_raceline
from bayesrace.recorder import Recorder
from bayesrace.studies.evidence.inputs import input_bounds
from bayesrace.studies.evidence.replay.controller import Given
from bayesrace.studies.evidence.replay.recording import read_lives
from bayesrace.studies.evidence.replay.run import find_drives, replay
from bayesrace.studies.evidence.verdict import Verdict
from bayesrace.tracks import write_track
from bayesrace.transport import ask
from bayesrace.vehicles import Car, car_text, write_car
from tests.conftest import Circuit
from tests.programs import finish, start


def replayed(*logs: Path, given: Given | None = None, **options: Any) -> Verdict:
    with stages_on(Console(quiet=True)) as stages:
        return replay(logs, given or Given(), stages, **options)


@pytest.fixture(scope="module")
def lockstep(
    tmp_path_factory: pytest.TempPathFactory,
    kinematic_artefact: Path,
    circuit: Circuit,
    car: Car,
    weights: Weights,
) -> Path:
    """A drive of two processes that takes over weights after a second, stops after two, and goes on
    after four."""
    folder = tmp_path_factory.mktemp("lockstep") / "told"
    folder.mkdir()
    write_car(folder / "car.toml", car)
    write_track(folder / "track.csv", circuit.track)
    write_raceline(folder / "raceline.csv", circuit.line)
    write_weights(folder / "learned.bin", weights)
    write_whole(folder / "mpc.json", MpcSettings(iterations=4).model_dump_json())
    names = ("--car", "--track", "--raceline", "--settings")
    files = ("car.toml", "track.csv", "raceline.csv", "mpc.json")
    options = [w for n, f in zip(names, files, strict=True) for w in (n, str(folder / f))]
    pauses = 0

    def paused(_: Event) -> None:
        nonlocal pauses
        pauses += 1
        if pauses == 1:
            system.director.send_weights(encode_weights(weights))
        elif pauses in (2, 4):
            command = Command(
                seq=0, source_time_ns=0, command="stop" if pauses == 2 else "go", text="a test"
            )
            assert ask(system.recording, COMMAND, car.name, command).accepted

    about = {"drive": {"car": car_text(car)}}
    with (
        started_system(car.name, folder, ["--car", str(folder / "car.toml")]) as system,
        Recorder(system.recording, car.name, folder / "run.mcap", about) as recorder,
        system.controller(["--artefact", str(kinematic_artefact), *options]),
    ):
        system.drive(circuit.track, RunPlan(1, "", 0, 5.5, True, pause_s=1.0), recorder, paused)
    return folder


def test_a_lockstep_drive_is_answered_to_the_bit_with_weights_and_commands(lockstep: Path) -> None:
    (life,) = read_lives(lockstep / "run.mcap", ["car"])
    versions = {one.sent.weights_version for one in life.cycles}
    assert len(versions) == 2
    assert [word for one in life.cycles for word in one.commands] == ["stop", "go"]
    assert not any(one.unknown for one in life.cycles)
    verdict = replayed(lockstep)
    assert verdict.passed, verdict.text
    assert "275 of 275 cycles" in verdict.checks[0].found


@pytest.mark.wall_clock
def test_a_real_time_drive_is_answered_to_the_bit(
    tmp_path: Path, circuit: Circuit, car: Car, weights: Weights
) -> None:
    """With late states, releases passed over and steps out of time, of which there are some."""
    drive_system(
        tmp_path, car, circuit.track, laps=9, mode="realtime", line=circuit.line, weights=weights,
        delay_ms=6.0, max_time_s=8.0,
    )  # fmt: skip
    (life,) = read_lives(tmp_path / "run.mcap", ["car"])
    assert len(life.cycles) > 300
    assert any(one.how.prepared_refused for one in life.cycles)  # time always runs out there
    verdict = replayed(tmp_path)
    unknown = sum(bool(one.unknown) for one in life.cycles)
    assert unknown < len(life.cycles) / 2
    assert (
        f"{len(life.cycles) - unknown} of {len(life.cycles) - unknown} cycles"
        in verdict.checks[0].found
    )
    assert verdict.passed, verdict.text


def copied(log: Path, out: Path, left_out: Callable[[Any], bool]) -> Path:
    """The log without some messages, with the files beside it."""
    shutil.copytree(log, out)
    (out / "run.mcap").unlink()
    reader = LogReader(log / "run.mcap")
    writer = LogWriter(out / "run.mcap", reader.metadata())
    for entry in reader.messages():
        if not left_out(entry.message):
            writer.write(entry.key, encode(entry.message), entry.message.source_time_ns)
    writer.close()
    return out


@pytest.mark.parametrize("topic", [STATE, TELEMETRY], ids=["state", "telemetry"])
def test_after_a_lost_message_cycles_are_counted_and_not_judged(
    lockstep: Path, tmp_path: Path, topic: Any
) -> None:
    def lost(message: Any) -> bool:
        return isinstance(message, topic.message) and message.seq == 40

    verdict = replayed(copied(lockstep, tmp_path / "told", lost))
    assert verdict.passed
    assert "40 of 40 cycles" in verdict.checks[0].found
    assert "messages before it are not in the log" in verdict.checks[0].found


def test_another_controller_parts_where_it_is_said_and_why(lockstep: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.json"
    other.write_text(MpcSettings(iterations=4, margin_m=0.08).model_dump_json())
    given, allowed = Given(mpc=other), input_bounds("", "d=1e-9,delta_rate=1e-9")
    inputs, levels = replayed(lockstep, given=given, allowed=allowed).checks
    assert not inputs.passed
    assert "they part at state" in inputs.found
    assert "iterations" in inputs.found or "at bounds" in inputs.found
    assert "cost of the plan" in levels.found
    wide = replayed(lockstep, given=given, allowed={"d": 9, "delta_rate": 99})
    assert wide.checks[0].passed
    (alone,) = replayed(lockstep, given=given).checks  # no bound on inputs is asked for
    assert "by the fallback" in alone.name


def test_a_library_is_compared_with_a_baseline(lockstep: Path, tmp_path: Path) -> None:
    drives, base, now = (tmp_path / one for one in ("drives", "baseline", "now"))
    for name in ("one", "deeper/two"):
        shutil.copytree(lockstep, drives / name)
    assert list(find_drives([drives])) == ["deeper/two", "one"]
    assert replayed(drives, out=base).passed
    result = json.loads((base / "result.json").read_text())
    assert [one["name"] for one in result["drives"]] == ["deeper/two", "one"]
    assert result["times_real_time"] > 0
    assert (base / "one.png").stat().st_size > 10_000
    assert replayed(drives, against=base).passed
    assert replayed(drives, against=drives).passed  # recordings of the same drives
    with np.load(base / "one.npz") as kept:
        rows = kept["rows"]
    rows["u"][100, 0] += 1e-6
    np.savez(base / "one.npz", rows=rows)
    verdict = replayed(drives, against=base, out=now)
    assert [one.passed for one in verdict.checks] == [True, False]
    assert "274 of 275" in verdict.checks[1].found
    assert replayed(drives, against=base, allowed={"d": 1e-5}).passed


@pytest.mark.parametrize("host", ["c", "fmu"])
def test_hosts_without_python_answer_to_the_bit_until_weights_are_exchanged(
    lockstep: Path, host: Any
) -> None:
    (check,) = replayed(lockstep, given=Given(host=host)).checks
    assert check.passed, check.found
    assert "51 of 51 cycles" in check.found
    assert f"224 cycles (the {host} host cannot be told what comes)" in check.found


def test_the_command_exits_by_its_verdict_and_writes_junit(lockstep: Path, tmp_path: Path) -> None:
    junit = tmp_path / "replay.xml"
    done = finish(start("replay", lockstep, "--junit", junit))
    assert done.returncode == 0, done.stderr
    assert "1 of 1 checks hold" in done.stdout
    assert "<testcase" in junit.read_text()
    other = tmp_path / "other.json"
    other.write_text(MpcSettings(margin_m=0.08).model_dump_json())
    options = ("--settings", other, "--tolerance", "d=1e-9,delta_rate=1e-9")
    assert finish(start("replay", lockstep, *options)).returncode == 1
    wrong = finish(start("replay", lockstep, "--tolerance", "d=x"))
    assert wrong.returncode == 2
    assert "--tolerance d=x: give d, delta_rate or both" in wrong.stderr


def test_what_is_missing_is_named(lockstep: Path, tmp_path: Path) -> None:
    told = Path(shutil.copytree(lockstep, tmp_path / "told"))
    (told / "learned.bin").unlink()
    with pytest.raises(InputError, match="no weights of version"):
        replayed(told)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"no log \(\*\.mcap\)"):
        replayed(tmp_path / "empty")
    with pytest.raises(InputError, match=r"neither told\.npz nor a recording"):
        replayed(lockstep, against=tmp_path / "empty")
