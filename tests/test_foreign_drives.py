"""Drives of others teach what the same drives teach as logs of ours; what is wrong is named."""

import math
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from bayesrace.arrays import Floats
from bayesrace.codegen.build import build
from bayesrace.codegen.settings import BuildSettings
from bayesrace.columns import LogColumns
from bayesrace.controller.pure_pursuit import PurePursuitSettings
from bayesrace.errors import InputError
from bayesrace.learning.foreign import DriveMap, read_drive, write_drive
from bayesrace.learning.recordings import _number
from bayesrace.learning.sources import read_samples
from bayesrace.learning.training import fit
from bayesrace.messages import QUANTITIES, STATE
from bayesrace.operation.collect import collect
from bayesrace.ros2.types import TYPES, made
from bayesrace.tracks import load_track
from bayesrace.vehicles import get_car
from tests.command_line import Cli, refused
from tests.conftest import offset_line
from tests.driven import QUICK

CAR = get_car("orca")
STEP_S = 0.02
START_NS = 1_700_000_000_000_000_000

MAP = """
time = { from = "t", unit = "ms" }
[signals]
x = { from = "east", unit = "mm" }
y = { from = "south", sign = -1 }
psi = { from = "compass", unit = "deg", sign = -1, offset = 1.5707963267948966 }
vx = { from = "speed", unit = "km/h" }
vy = "vy"
omega = { from = "yaw rate", unit = "deg/s" }
delta = { from = "wheel", scale = 0.1 }
d = { from = "pedal", unit = "%" }
"""


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A closed-loop drive of ours, in which the tyres slide."""
    track, log = load_track("paddock"), tmp_path_factory.mktemp("own") / "own.mcap"
    line, artefact = offset_line(track, 0.0, 6.0, 3.0), build(BuildSettings(car=CAR))[0]
    collect(track, line, CAR, artefact, log, 8.0, PurePursuitSettings())
    return log


@pytest.fixture(scope="module")
def driven(own: Path) -> tuple[Floats, Floats, Floats]:
    """Its times (n,), states (n, 7) and inputs (n, 2) from each state on."""
    states = LogColumns(own, {STATE: "time_s x u_applied"}, CAR.name).read()[STATE]
    u = states["u_applied"]
    return states["time_s"], states["x"], np.vstack((u[1:], u[-1:]))


def write_csv(path: Path, columns: dict[str, Any], separator: str = ",") -> Path:
    rows = np.column_stack(list(columns.values()))
    head = separator.join(columns)
    np.savetxt(path, rows, "%.12g", separator, header=head, comments="", encoding="utf-8")
    return path


def theirs(time: Floats, x: Floats, u: Floats) -> dict[str, Any]:
    """As a program with other names, units and axes writes it."""
    compass = np.remainder(np.degrees(math.pi / 2 - x[:, 2]), 360)
    return {
        "t": 1.7e9 + 1e3 * time, "east": 1e3 * x[:, 0], "south": -x[:, 1], "compass": compass,
        "speed": 3.6 * x[:, 3], "vy": x[:, 4], "yaw rate": np.degrees(x[:, 5]),
        "wheel": 10 * x[:, 6], "pedal": 100 * u[:, 0],
    }  # fmt: skip


def ours(time: Floats, x: Floats, u: Floats) -> dict[str, Any]:
    return {"time_s": time} | dict(zip(QUANTITIES, x.T, strict=True)) | {"d": u[:, 0]}


def write_bag(
    folder: Path, storage: StoragePlugin, time: Floats, x: Floats, u: Floats, **topics: str
) -> Path:
    """As an F1TENTH car records it: odometry of the rear axle, commands of speed and angle."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    added = ("ackermann_msgs/msg/AckermannDrive", "ackermann_msgs/msg/AckermannDriveStamped")
    store.register({kind: TYPES.fielddefs[kind] for kind in added})
    t: Any = store.types
    duty: Any = CAR.drive
    forces = u[:, 0] * (duty.cm1 - duty.cm2 * x[:, 3]) - duty.cr0 - duty.cr2 * x[:, 3] ** 2
    speeds = x[:, 3] + 0.21 * forces / CAR.mass_kg
    angles = x[:, 6] + STEP_S * u[:, 1]
    with Writer(folder, version=9, storage_plugin=storage) as bag:
        channels = {
            kind: bag.add_connection(topics.get(kind, f"/{kind}"), name, typestore=store)
            for kind, name in (("odom", "nav_msgs/msg/Odometry"),
                               ("drive", "ackermann_msgs/msg/AckermannDriveStamped"))
        }  # fmt: skip
        for at_s, state, speed, angle in zip(time, x, speeds, angles, strict=True):
            ns = START_NS + round(1e9 * at_s)
            stamp = t["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
            header = t["std_msgs/msg/Header"](stamp=stamp, frame_id="map")
            point, vector = t["geometry_msgs/msg/Point"], t["geometry_msgs/msg/Vector3"]
            c, s = math.cos(state[2]), math.sin(state[2])
            at = point(x=state[0] - CAR.lr_m * c, y=state[1] - CAR.lr_m * s, z=0.0)
            half = state[2] / 2
            facing = t["geometry_msgs/msg/Quaternion"](0.0, 0.0, math.sin(half), math.cos(half))
            moving = t["geometry_msgs/msg/Twist"](
                linear=vector(x=state[3], y=state[4] - CAR.lr_m * state[5], z=0.0),
                angular=vector(x=0.0, y=0.0, z=state[5]),
            )
            none = np.zeros(36)
            odometry = t["nav_msgs/msg/Odometry"](
                header=header, child_frame_id="base_link",
                pose=t["geometry_msgs/msg/PoseWithCovariance"](
                    t["geometry_msgs/msg/Pose"](at, facing), none
                ),
                twist=t["geometry_msgs/msg/TwistWithCovariance"](moving, none),
            )  # fmt: skip
            command = t["ackermann_msgs/msg/AckermannDriveStamped"](
                header=header,
                drive=t["ackermann_msgs/msg/AckermannDrive"](angle, 0.0, speed, 0.0, 0.0),
            )
            for kind, message in (("odom", odometry), ("drive", command)):
                data = store.serialize_cdr(message, message.__msgtype__)
                bag.write(channels[kind], ns + 3_000_000, data)  # recorded 3 ms late
    return folder


@pytest.mark.parametrize("form", ["theirs", "our names", "mcap", "sqlite3", "humble"])
def test_a_drive_teaches_the_same_in_every_form(
    form: str, own: Path, driven: tuple[Floats, Floats, Floats], tmp_path: Path, cli: Cli
) -> None:
    """What is learned differs by less than 0.2 % where commands are in single precision and the
    wheels' first angle is not known, as in a bag, and else by 1e-6."""
    options: list[Any] = ["--track", "paddock", "--out", "imported.mcap"]
    if form == "our names":
        file = write_csv(tmp_path / "drive.csv", ours(*driven), ";")
    elif form in ("mcap", "sqlite3", "humble"):
        storage = StoragePlugin.MCAP if form == "mcap" else StoragePlugin.SQLITE3
        file = write_bag(tmp_path / "bag", storage, *driven)
        if form == "humble":  # whose recordings have no definitions of their messages
            with sqlite3.connect(next(file.glob("*.db3"))) as tables:
                tables.execute("UPDATE schema SET schema_version = 3")
                tables.execute("DROP TABLE message_definitions")
    else:
        file = write_csv(tmp_path / "drive.csv", theirs(*driven))
        (tmp_path / "map.toml").write_text(MAP)
        options += ["--map", "map.toml"]
    done = cli("import-drive", file, *options)
    assert done.code == 0, done.err
    count = len(driven[0])
    assert f"{count} states at 50 Hz in 1 unbroken parts (left out: 0 gap, 0 jump, 0 " in done.out
    same, given = read_samples([tmp_path / "imported.mcap"]), read_samples([own])
    assert len(same.dataset) == len(given.dataset) > 300
    # No bag says how the wheels stand at first.
    assert np.abs(same.dataset.x - given.dataset.x)[1:].max() < 1e-5
    assert np.abs(same.dataset.u - given.dataset.u)[1:].max() < 1e-4
    learned = [fit(one.dataset, one.discretisation, QUICK).weights for one in (same, given)]
    one, other = (weights.predict(given.dataset.features) for weights in learned)
    most = 2e-3 if file.is_dir() else 1e-6
    assert (np.abs(one - other).max(axis=0) < most * other.std(axis=0)).all()


def test_states_between_their_times_are_interpolated_and_inputs_held(tmp_path: Path) -> None:
    """A circle at constant speed, recorded at 80 Hz from an odd time on, across whole turns."""
    t = 0.0037 + np.arange(0, 4, 1 / 80)
    speed, omega = 2.0, 4.0
    columns = {
        "time_s": t, "x": 0.5 * np.sin(omega * t), "y": -0.5 * np.cos(omega * t),
        "psi": np.remainder(omega * t + np.pi, 2 * np.pi) - np.pi, "vx": 0 * t + speed,
        "vy": 0 * t, "omega": 0 * t + omega, "delta": 0.1 * np.sin(3 * t),
        "d": np.floor(4 * t) / 20,
    }  # fmt: skip
    found = read_drive(write_csv(tmp_path / "a.csv", columns), DriveMap(), CAR, STEP_S)
    at = 0.0037 + STEP_S * np.arange(len(found.x))
    assert len(found.x) == 200
    assert not any(found.dropped.values())
    exact = np.column_stack((0.5 * np.sin(omega * at), -0.5 * np.cos(omega * at), omega * at))
    assert np.abs(found.x[:, :3] - exact).max() < 0.5 * (omega / 80) ** 2 / 8 + 1e-9
    assert np.abs(found.u[1:, 1] - 0.3 * np.cos(3 * (at[1:] - STEP_S / 2))).max() < 0.01
    assert found.u[1:, 0] == pytest.approx(np.interp(at[:-1], t, columns["d"]), abs=0.05)
    assert set(found.u[:, 0]) <= set(np.round(columns["d"], 12))  # never between two of them


def test_what_has_gaps_or_jumps_is_left_out_and_counted(
    driven: tuple[Floats, Floats, Floats], tmp_path: Path
) -> None:
    time, x, u = driven
    moved = x.copy()
    moved[300:, :2] += 0.1  # the localisation has changed its mind
    kept = np.ones(len(time), dtype=bool)
    kept[100:110] = False
    file = write_csv(tmp_path / "a.csv", ours(time[kept], moved[kept], u[kept]))
    found = read_drive(file, DriveMap(), CAR, STEP_S)
    assert found.dropped == {"gap": 10, "jump": 1, "single": 0}
    assert np.unique(found.run, return_counts=True)[1].tolist() == [100, 190, len(time) - 300]
    write_drive(tmp_path / "log.mcap", found, CAR)
    samples = read_samples([tmp_path / "log.mcap"]).dataset
    assert len(samples) == len(found.x) - 3
    assert not samples.dropped["gap"]
    bridged = read_drive(file, DriveMap(gap_s=0.25), CAR, STEP_S)
    assert bridged.dropped["gap"] == 0


def test_the_cars_limits_decide_how_fast_a_command_is_followed(tmp_path: Path) -> None:
    """A step of the command, and a speed that cannot be reached at once."""
    t = np.arange(0, 2, STEP_S)
    columns = dict.fromkeys(("x", "y", "psi", "vy", "omega"), 0 * t) | {
        "x": t, "vx": 0 * t + 1, "time_s": t, "delta_command": np.where(t < 1, -0.3, 9.0),
        "speed_command": 0 * t + 100,
    }  # fmt: skip
    found = read_drive(write_csv(tmp_path / "a.csv", columns), DriveMap(), CAR, STEP_S)
    turned = np.clip(-0.3 + CAR.delta_rate_max_radps * (t - 1), -0.3, CAR.delta_max_rad)
    assert found.x[:, 6] == pytest.approx(turned, abs=1e-9)
    assert (found.u[1:, 0] == CAR.d_max).all()


SPOILT: dict[str, tuple[dict[str, Any], str, tuple[str, ...]]] = {
    "no column": ({"psi": None}, "", ("has no psi: say in [signals] of --map",)),
    "no mapped column": ({}, "[signals]\npsi = 'yaw'", ("has no column 'yaw'", "time_s, x, y")),
    "no time": ({"time_s": None}, "", ("has no column 'time_s'",)),
    "no drive": ({"d": None}, "", ("has no d or speed_command",)),
    "two of one": ({}, "[signals]\nd='d'\nspeed_command='vx'", ("d and speed_command: give one",)),
    "unit": ({}, "[signals]\npsi = { from = 'psi', unit = 'grad' }", ("'grad' of 'psi'", "'rad'")),
    "unit of time": ({}, "time = { from = 'time_s', unit = 'h' }", ("'h' of 'time'",)),
    "far": ({}, "[signals]\nx = { from = 'x', offset = 5e6 }", ("beyond 1e+06", "an offset")),
    "unknown": ({}, "[signals]\nyaw = 'psi'", ("signals.yaw", "psi")),
    "not finite": ({"vx": (7, math.nan)}, "", ("'vx': row 8 is not finite",)),
    "unsorted": ({"time_s": (9, 0.0)}, "", ("the time of row 10 is no later", "sort the rows")),
    "twice": ({"time_s": (9, 0.16)}, "", ("the time of row 10 is no later",)),
    "short": (
        {},
        "gap_s = 0.001",
        ("only 0 of 403 states at 50 Hz", "400 gap", "50 are needed"),
    ),
}


@pytest.mark.parametrize("name", SPOILT)
def test_a_drive_that_cannot_be_used_says_why(
    name: str, driven: tuple[Floats, Floats, Floats], tmp_path: Path, cli: Cli
) -> None:
    changes, text, words = SPOILT[name]
    columns = ours(*driven)
    if name == "short":  # odd times, so that nothing can be taken without interpolation
        columns["time_s"] = 1.005 * columns["time_s"]
    for column, change in changes.items():
        if change is None:
            del columns[column]
        else:
            columns[column] = np.array(columns[column])
            columns[column][change[0]] = change[1]
    (tmp_path / "map.toml").write_text(text)
    file = write_csv(tmp_path / "drive.csv", columns)
    refused(cli("import-drive", file, "--map", "map.toml", "--out", "a.mcap"), *words)
    assert not (tmp_path / "a.mcap").exists()


def test_what_is_no_drive_says_why(
    driven: tuple[Floats, Floats, Floats], own: Path, tmp_path: Path, cli: Cli
) -> None:
    few = [column[:60] for column in driven]
    bag = write_bag(tmp_path / "bag", StoragePlugin.MCAP, *few, drive="/teleop")
    refused(cli("import-drive", bag), "no messages on '/drive'", "it has /odom, /teleop")
    (tmp_path / "map.toml").write_text(
        'time = "recorded"\n[signals]\nd = "/teleop:drive.acceleration"\n'
        'delta_command = "/teleop:drive.steering_angle"\n'
    )
    assert cli("import-drive", bag, "--map", "map.toml", "--out", "a.mcap").code == 0
    one = next(bag.glob("*.mcap"))  # the file of a bag will do
    assert cli("import-drive", one, "--map", "map.toml", "--out", "b.mcap").code == 0
    for wrong, said in (("drive.yaw", "no field 'drive.yaw'"), ("drive", "'drive' is no number")):
        (tmp_path / "map.toml").write_text(
            f'[signals]\nd = "/teleop:{wrong}"\ndelta_command = "/teleop:drive.steering_angle"\n'
        )
        refused(cli("import-drive", bag, "--map", "map.toml"), "/teleop", said)
    with pytest.raises(InputError, match="/odom: 'facing' is an orientation that is no quaternion"):
        _number(made("geometry_msgs/msg/Quaternion"), "/odom", "facing")
    refused(cli("import-drive", own), "own.mcap is no rosbag2 recording")
    (tmp_path / "text.db3").write_text("no database")
    refused(cli("import-drive", tmp_path / "text.db3"), "is no rosbag2 recording")
    refused(cli("import-drive", tmp_path / "none"), "is no rosbag2 recording")
    (tmp_path / "text.csv").write_text("time_s,x,y,psi,vx,vy,omega,delta,d\n1,2,3,4,five,6,7,8,9\n")
    refused(cli("import-drive", tmp_path / "text.csv"), "five", "give numbers alone")
    (tmp_path / "head.csv").write_text("time_s,x,y,psi,vx,vy,omega,delta,d\n")
    refused(cli("import-drive", tmp_path / "head.csv"), "has no rows")
    (tmp_path / "one.csv").write_text("time_s,x,y,psi,vx,vy,omega,delta,d\n1,2,3,4,5,6,7,8,9\n")
    refused(cli("import-drive", tmp_path / "one.csv"), "only 0 of 1 states")
    refused(cli("train", one), "import-drive")
    refused(cli("train", tmp_path / "text.csv"), "import-drive")
