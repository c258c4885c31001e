"""ROS 2 without ROS: the bytes of rmw_zenoh, the car shown to it, and a car that speaks it.

No ROS is needed, and none has been tried. Tokens, keys and attachments are compared with the
examples of rmw_zenoh's design document, hashes of types with those that others have published.
"""

import json
import logging
import math
import signal
import struct
import sys
import time
import tomllib
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from typing import Any

import numpy as np
import pytest
import zenoh
import zenoh.ext
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

pytest.importorskip("rosbags", reason="the extra ros2 is not installed")

from rosbags.typesys import Stores, get_typestore

from bayesrace.messages import ACTUATION, STATE, TELEMETRY, Actuation, Telemetry
from bayesrace.operation.ros2 import Buttons
from bayesrace.plant.ros2_car import Ros2Car
from bayesrace.ros2.naming import Topic, attachment, token
from bayesrace.ros2.node import open_node
from bayesrace.ros2.settings import Joy, Ros2Settings
from bayesrace.ros2.types import TYPES, drive_fields, made, planar_pose
from bayesrace.tracks import load_track
from bayesrace.transport import Endpoints, Publisher, free_endpoint, open_session
from bayesrace.vehicles import get_car
from tests import sample_messages as messages
from tests.command_line import Cli, refused
from tests.driven import blank
from tests.fake_processes import Fakes, fakes
from tests.programs import ROOT, start, until
from tests.ros_network import Ros, network

__all__ = ["fakes"]

pytestmark = pytest.mark.wall_clock

CAR = get_car("orca")
STRING = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
CHATTER = Topic("/chatter", "std_msgs/msg/String", STRING)
PUBLISHED = {  # where a tool other than rosbags has computed it
    "std_msgs/msg/String": STRING,
    "ackermann_msgs/msg/AckermannDriveStamped":
        "RIHS01_48ca7612a08d3bb72744fd98b71b7cf2ea24c6ad50fa4e1aa0bbad963c90d8cf",
    "nav_msgs/msg/Odometry":
        "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    "sensor_msgs/msg/Imu":
        "RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b",
    "geometry_msgs/msg/PoseStamped":
        "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
}  # fmt: skip
USED = (
    *PUBLISHED, "nav_msgs/msg/Path", "sensor_msgs/msg/JointState", "sensor_msgs/msg/Joy",
    "tf2_msgs/msg/TFMessage", "visualization_msgs/msg/MarkerArray",
)  # fmt: skip
DDS = "ackermann_msgs::msg::dds_::AckermannDriveStamped_"


def test_names_are_those_of_the_design_document() -> None:
    assert CHATTER.key(0) == f"0/chatter/std_msgs::msg::dds_::String_/{STRING}"
    robot = CHATTER._replace(name="/robot1/chatter")
    assert robot.key(0) == f"0/robot1/chatter/std_msgs::msg::dds_::String_/{STRING}"
    session = "aac3178e146ba6f1fc6e6a4085e77f21"
    assert token(session, 2, "/listener") == f"@ros2_lv/2/{session}/0/0/NN/%/%/listener"
    assert token(session, 2, "/listener", "MS", 10, CHATTER) == (
        f"@ros2_lv/2/{session}/0/10/MS/%/%/listener/%chatter/"
        f"std_msgs::msg::dds_::String_/{STRING}/::,10:,:,:,,"
    )
    latched = token(session, 0, "/a/b/talker", "MP", 3, robot, True)
    assert latched == (  # reliable, transient local (1), keep last, 1
        f"@ros2_lv/0/{session}/0/3/MP/%/%a%b/talker/%robot1%chatter/"
        f"std_msgs::msg::dds_::String_/{STRING}/:1:,1:,:,:,,"
    )


def test_the_attachment_is_that_of_the_design_document() -> None:
    made_ = attachment(0x0102, -2, bytes(range(16)))
    assert made_ == b"\x02\x01" + 6 * b"\0" + b"\xfe" + 7 * b"\xff" + b"\x10" + bytes(range(16))
    of_zenoh = zenoh.ext.z_serialize(
        (zenoh.ext.Int64(0x0102), zenoh.ext.Int64(-2), bytes(range(16)))
    )
    assert made_ == of_zenoh.to_bytes()


def test_types_have_the_hashes_of_others_and_are_the_same_in_kilted() -> None:
    assert {kind: TYPES.hash_rihs01(kind) for kind in PUBLISHED} == PUBLISHED
    kilted = get_typestore(Stores.ROS2_KILTED)
    for kind in USED:
        if not kind.startswith("ackermann"):
            assert TYPES.hash_rihs01(kind) == kilted.hash_rihs01(kind)


def test_messages_go_through_cdr() -> None:
    """What is made of maps comes back; the first bytes are those of a header in CDR."""
    head = {"stamp": {"sec": 7, "nanosec": 8}, "frame_id": "map"}
    path = made("nav_msgs/msg/Path", header=head, poses=[{"pose": planar_pose(1, 2, 0.5)}] * 3)
    data = bytes(TYPES.serialize_cdr(path, "nav_msgs/msg/Path", little_endian=True))
    assert data[:20] == b"\0\1\0\0" + struct.pack("<iIi4s", 7, 8, 4, b"map\0")
    back: Any = TYPES.deserialize_cdr(data, "nav_msgs/msg/Path")
    assert back == path
    assert back.poses[2].pose.orientation.z == math.sin(0.25)


@pytest.mark.parametrize("name", ["orca", "f1tenth"])
def test_the_drive_message_accelerates_as_the_drive_command_does(name: str) -> None:
    """Its acceleration, put into the equation of the drive, is that command."""
    car = get_car(name)
    for vx, d in ((0.0, 0.0), (1.5, 0.8 * car.d_max), (2.0, 0.5 * car.d_min)):
        fields = drive_fields(car, "base_link", 0.1, vx, d, 0.2, 3.0)
        drive = made("ackermann_msgs/msg/AckermannDriveStamped", **fields).drive
        assert car.drive.command_at(vx, drive.acceleration, car.mass_kg) == pytest.approx(d)
        assert drive.speed == pytest.approx(max(vx + 0.1 * drive.acceleration, 0.0))
        assert (drive.steering_angle, drive.steering_angle_velocity) == (0.2, 3.0)


@pytest.fixture
def ros() -> Iterator[Ros]:
    with network(free_endpoint()) as one:
        yield one


def stamped(time_s: float, frame: str = "map") -> dict[str, Any]:
    sec, nanosec = divmod(round(time_s * 1e9), 10**9)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}


def test_a_car_is_shown_and_a_joystick_stops_it(ros: Ros, fakes: Fakes, tmp_path: Any) -> None:
    """Another session sees the bridge's node and topics, and gets in CDR what the car does; its
    buttons reach the controller. Malformed messages change nothing."""
    topics = tmp_path / "ros2.toml"
    topics.write_text("centre_ahead_m = 0.1\n[joy]\nstop_button = 2\n")
    controller, at = fakes("orca", "controller"), free_endpoint()
    odometry, path = "nav_msgs/msg/Odometry", "nav_msgs/msg/Path"
    ros.hear("bayesrace/odom", odometry)
    ros.hear("tf", "tf2_msgs/msg/TFMessage")
    ros.hear("bayesrace/plan", path)
    ros.hear("bayesrace/drive", "ackermann_msgs/msg/AckermannDriveStamped")
    ros.hear("bayesrace/tube", "visualization_msgs/msg/MarkerArray")
    with open_session(Endpoints(listen=(at,)), "plant") as ours:
        states, actuations = Publisher(ours, STATE, "orca"), Publisher(ours, ACTUATION, "orca")
        plans = Publisher(ours, TELEMETRY, "orca")
        bridge = start(
            "ros2", "--topics", topics, "--track", "harbour", "--joy", "--ros-endpoint",
            ros.endpoint, "--endpoint", at, "--endpoint", controller.endpoints.listen[0],
        )  # fmt: skip
        try:
            until(lambda: len(ros.tokens()) >= 8, "the bridge's tokens", 20)
            (zid,) = {one.split("/")[2] for one in ros.tokens()}
            assert f"@ros2_lv/0/{zid}/0/0/NN/%/%bayesrace/bridge" in ros.tokens()
            assert any(f"/MP/%/%bayesrace/bridge/%bayesrace%drive/{DDS}/RIHS01_48ca7612" in one
                       for one in ros.tokens())  # fmt: skip
            assert any("/MS/" in one and "/%joy/" in one for one in ros.tokens())

            plan = np.zeros((4, 7))
            plan[:, 0], plan[:, 2] = (1, 2, 3, 4), math.pi / 2
            x = (1.0, 2.0, math.pi / 2, 1.5, 0.2, 2.0, 0.05)

            def drive() -> bool:
                k = states.next_seq
                states.put(messages.state(k, time_s=9 + 0.02 * k, x=x), lockstep=False)
                actuations.put(blank(Actuation, seq=k, u=(0.5, 1.0)), lockstep=False)
                plans.put(
                    blank(Telemetry, seq=k, plan_x=tuple(plan.ravel()), tube_m=(0.1, 0.2, 0.3)),
                    lockstep=False,
                )
                time.sleep(0.02)
                return len(ros.heard["bayesrace/tube"]) > 2 and len(ros.heard["tf"]) > 9

            until(drive, "what the car does", 20)
            for pressed in ((0, 0, 0), (0, 0, 1), (0, 0, 0), (1, 0, 0)):
                ros.session.put(ros.key("joy", "sensor_msgs/msg/Joy"), b"\0\1\0\0malformed")
                ros.say("joy", "sensor_msgs/msg/Joy", buttons=pressed)
                time.sleep(0.3)
            until(lambda: len(controller.heard) == 2, "two commands", 20)
            assert [one.command for one in controller.heard] == ["stop", "go"]
            ros.hear("bayesrace/track", "visualization_msgs/msg/MarkerArray", latched=True)
            until(lambda: ros.heard["bayesrace/track"], "the track, which was sent before", 20)
        finally:
            bridge.send_signal(signal.SIGTERM)
            _, log = bridge.communicate(timeout=20)
    assert bridge.returncode == 0, log
    assert "4 messages of the ROS network refused" in log
    assert 1 <= log.count("bayesrace.ros2: refused") <= 3, log
    until(lambda: not ros.tokens(), "the tokens to be gone", 20)

    seen = ros.heard["bayesrace/odom"]
    numbers = [struct.unpack("<qqB16s", with_it) for _, with_it in seen]
    assert [one[0] for one in numbers] == list(range(1, len(seen) + 1))
    assert len({one[3] for one in numbers}) == 1
    assert abs(numbers[-1][1] * 1e-9 - time.time()) < 60
    last = seen[-1][0]
    assert (last.header.frame_id, last.child_frame_id) == ("map", "base_link")
    at_, speed = last.pose.pose.position, last.twist.twist
    assert (at_.x, at_.y) == pytest.approx((1.0, 1.9))  # the frame is 0.1 m behind the centre
    assert (speed.linear.x, speed.linear.y, speed.angular.z) == pytest.approx((1.5, 0.0, 2.0))
    (transform,) = ros.heard["tf"][-1][0].transforms
    assert transform.transform.translation.y == pytest.approx(1.9)
    assert transform.transform.rotation.z == pytest.approx(math.sin(math.pi / 4))
    command = ros.heard["bayesrace/drive"][-1][0].drive
    assert command.steering_angle == pytest.approx(0.05 + 0.02)
    assert CAR.drive.command_at(1.5, command.acceleration, CAR.mass_kg) == pytest.approx(0.5)
    assert [one.pose.position.x for one in ros.heard["bayesrace/plan"][-1][0].poses] == [1, 2, 3, 4]
    right, left = ros.heard["bayesrace/tube"][-1][0].markers
    assert [one.x for one in right.points] == pytest.approx([2.1, 3.2, 4.3])
    assert [one.x for one in left.points] == pytest.approx([1.9, 2.8, 3.7])
    edges = ros.heard["bayesrace/track"][0][0].markers
    expected = load_track("harbour").boundaries(CAR.width_m)
    for edge, points in zip(edges, expected, strict=True):
        assert np.allclose([(one.x, one.y) for one in edge.points[:-1]], points)
        assert edge.points[-1] == edge.points[0]


def test_an_estimated_state_is_the_estimate_with_its_deviations(ros: Ros) -> None:
    from bayesrace.operation.ros2 import View

    ros.hear("bayesrace/odom", "nav_msgs/msg/Odometry")
    with open_node(Ros2Settings(endpoint=ros.endpoint), "bridge") as node:
        view = View(node, Ros2Settings(), CAR, None)
        time.sleep(0.3)
        view.show(messages.state(0, estimated=True, x=(9.0,) * 7))
        view.show(
            blank(Telemetry, seq=0, estimate=(9.0,) * 9, plan_x=(0.0,) * 7, tube_m=(1.0,) * 9)
        )
        estimate, deviation = (float(i) for i in range(9)), (0.1,) * 9
        view.show(blank(Telemetry, seq=0, estimate=tuple(estimate), deviation=deviation))
        until(lambda: ros.heard["bayesrace/odom"], "odometry", 20)
    time.sleep(0.1)
    ((message, _),) = ros.heard["bayesrace/odom"]
    assert message.pose.pose.position.y == 1.0
    assert message.pose.covariance[[0, 7, 35]] == pytest.approx(0.01)
    assert np.count_nonzero(message.pose.covariance) == 3
    assert message.twist.twist.linear.x == 3.0


CALENDAR_S = 1.8e9


def test_messages_of_a_ros_car_are_readings_and_commands_go_to_it(ros: Ros) -> None:
    """Quantities, deviations and times are those of the messages; what is none, or in another
    frame, is counted and logged, and the car drives on."""
    ros.hear("drive", "ackermann_msgs/msg/AckermannDriveStamped")
    topics = Ros2Settings.model_validate(
        {
            "endpoint": ros.endpoint, "centre_ahead_m": 0.1,
            "car": {
                "wheels": "/joint_states", "wheel_radius_m": 0.03, "wheel_joints": ["left"],
                "delays_s": {"pose": 0.01},
            },
        }
    )  # fmt: skip
    with open_node(topics, "plant") as node, Ros2Car(CAR, node, topics) as car:
        until(lambda: len(ros.tokens()) == 6, "node, four subscriptions, a publisher", 20)
        zero_ns = time.monotonic_ns()
        car.begins(zero_ns)
        pose = planar_pose(1.0, 2.0, math.pi / 2)
        covariance = np.zeros(36)
        covariance[[0, 7, 35]] = 0.04, 0.09, 0.16
        for k in range(13):
            at = stamped(CALENDAR_S + 0.02 * k if k else 0.0)  # its clock is not set yet
            ros.say("pose", "geometry_msgs/msg/PoseStamped", header=at, pose=pose)
            time.sleep(0.02)
        at = stamped(CALENDAR_S)
        twist = {"twist": {"linear": {"x": 1.25}}, "covariance": covariance}
        with_pose = {"pose": pose, "covariance": covariance}
        for frame in ("map", "odom"):  # the second one drifts: speed alone
            ros.say("odom", "nav_msgs/msg/Odometry", header=stamped(CALENDAR_S, frame),
                    pose=with_pose, twist=twist)  # fmt: skip
        spin = np.full(9, 0.25)
        ros.say("imu", "sensor_msgs/msg/Imu", header=at, angular_velocity={"z": -3.0},
                angular_velocity_covariance=spin)  # fmt: skip
        ros.say("joint_states", "sensor_msgs/msg/JointState", header=stamped(0.0),
                name=["steering", "left"], velocity=[77.0, 50.0])  # fmt: skip
        # none of these is a reading; the first one is too long to be put together
        ros.send("imu", "sensor_msgs/msg/Imu", bytes(200_000))
        ros.say("pose", "geometry_msgs/msg/PoseStamped", header=stamped(1.0, "odom"), pose=pose)
        ros.say("pose", "geometry_msgs/msg/PoseStamped", header=at)
        ros.say("imu", "sensor_msgs/msg/Imu", header=at,
                angular_velocity_covariance=np.full(9, -1.0))  # fmt: skip
        ros.say("joint_states", "sensor_msgs/msg/JointState", header=at, name=["a"])
        ros.send("imu", "sensor_msgs/msg/Imu", b"\0\1\0\0" + b"\xff" * 60)
        found: dict[str, list[Any]] = defaultdict(list)

        def taken() -> bool:
            car.steps = round((time.monotonic_ns() - zero_ns) * 1e-9 / car.step_s)
            for one in car.readings():
                found[one.instrument].append(one)
            return node.refused == 5 and "wheels" in found

        until(taken, "readings and refusals", 20)
        assert not car.silent
        assert "odometry" in car.report()
        car.reset((1.0, 2.05, math.pi / 2, 0.0, 0.0, 0.0, 0.0))
        car.actuate((0.4, 1.0))
        car.actuate(None)  # at once: the newest command is never left out
        until(lambda: len(ros.heard["drive"]) == 2, "two commands", 20)

    # 16 readings are kept at most, the newest ones
    newest = found["pose"][-1]
    assert newest.values == {
        "x": (pytest.approx(1.0), 0.01), "y": (pytest.approx(2.1), 0.01),
        "psi": (pytest.approx(math.pi / 2), 0.01),
    }  # fmt: skip
    assert newest.time_s - found["pose"][-2].time_s == pytest.approx(0.02, abs=5e-3)
    whole, drifting = found["odometry"]
    assert whole.values["vx"] == (1.25, pytest.approx(0.2))
    assert [whole.values[name][1] for name in ("x", "y", "psi")] == pytest.approx([0.2, 0.3, 0.4])
    assert set(drifting.values) == {"vx"}
    assert found["imu"][0].values == {"omega": (-3.0, 0.5)}
    assert found["wheels"][0].values == {"vx": (pytest.approx(1.5), 0.1)}
    command = ros.heard["drive"][0][0]
    assert command.header.frame_id == "base_link"
    assert command.drive.steering_angle == pytest.approx(1.0 * car.step_s)
    assert command.drive.steering_angle_velocity == pytest.approx(1.0)
    assert command.drive.acceleration > 0


def test_a_router_that_returns_is_found_again() -> None:
    at = free_endpoint()
    with network(at) as before:
        topics = Ros2Settings(endpoint=at)
        opening = open_node(topics, "bridge")
        node = opening.__enter__()
        publish = node.publisher("chat", "std_msgs/msg/String")
        until(lambda: len(before.tokens()) == 2, "the node", 20)
    with network(at) as after:
        after.hear("bayesrace/chat", "std_msgs/msg/String")

        def heard() -> bool:
            publish(lambda: {"data": "again"})
            return bool(after.heard["bayesrace/chat"])

        until(heard, "the node to be back", 20, every_s=0.2)
        assert len(after.tokens()) == 2
    opening.__exit__(None, None, None)


def test_a_topic_is_published_at_most_so_often_and_at_0_not_even_announced(ros: Ros) -> None:
    ros.hear("often", "std_msgs/msg/String")
    with open_node(Ros2Settings(endpoint=ros.endpoint), "bridge") as node:
        often = node.publisher("/often", "std_msgs/msg/String", 20.0)
        node.publisher("/never", "std_msgs/msg/String", 0.0)(lambda: {"data": 1 / 0})
        until(lambda: len(ros.tokens()) == 2, "node and one topic", 20)
        begin_s, count = time.monotonic(), 0
        while (now_s := time.monotonic() - begin_s) < 1.0:
            often(dict)
            time.sleep(0.001)
            count += 1
        time.sleep(0.2)
    assert count > 100
    assert 0.5 * 20 * now_s <= len(ros.heard["often"]) <= 20 * now_s + 2


@given(data=st.one_of(st.binary(max_size=200), st.binary(max_size=200).map(b"\0\1\0\0".__add__)))
@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_bytes_are_a_message_or_refused(data: bytes, caplog: pytest.LogCaptureFixture) -> None:
    from bayesrace.ros2.node import _Reader

    caplog.set_level(logging.CRITICAL)
    for kind in ("sensor_msgs/msg/Joy", "sensor_msgs/msg/JointState", "nav_msgs/msg/Odometry"):
        reader = _Reader(Topic("/a", kind, ""), lambda _: None)
        reader(data)
        assert reader.accepted + reader.refused == 1


def test_the_page_has_every_setting_with_its_default() -> None:
    text = (ROOT / "docs" / "ros2.md").read_text().split("```toml\n")[1].split("```")[0]
    given_ = tomllib.loads(text)
    assert Ros2Settings.model_validate(given_) == Ros2Settings()
    assert given_ == json.loads(Ros2Settings().model_dump_json())


class _AtOnce(Executor):
    """A pool whose work is done where it is given."""

    def submit(self, do: Callable[..., Any], /, *given: Any, **named: Any) -> Future[Any]:
        done: Future[Any] = Future()
        done.set_result(do(*given, **named))
        return done


def test_buttons_count_when_they_are_pressed_and_stop_wins() -> None:
    sent: list[str] = []
    buttons = Buttons(Joy(stop_button=1, go_button=0), _AtOnce(), sent.append)
    for go, stop in ((1, 0), (0, 0), (1, 0), (1, 0), (1, 1), (1, 1), (1, 0), (0, 0)):
        buttons(made("sensor_msgs/msg/Joy", buttons=[go, stop]))
    # A go that is held at first, or since the stop began, is let go and pressed anew.
    assert sent == ["go", "stop", "go"]


def test_a_stop_while_a_go_is_not_answered_is_sent_at_once_and_after_it() -> None:
    """Which of them the car has heard last is not known."""
    sent: list[str] = []

    def command(action: str) -> None:
        sent.append(action)
        if action == "go":
            buttons(made("sensor_msgs/msg/Joy", buttons=[0, 1]))

    buttons = Buttons(Joy(stop_button=1, go_button=0), _AtOnce(), command)
    for go in (0, 1):
        buttons(made("sensor_msgs/msg/Joy", buttons=[go, 0]))
    assert sent == ["go", "stop", "stop"]
    with pytest.raises(IndexError):
        buttons(made("sensor_msgs/msg/Joy", buttons=[1]))


def test_what_cannot_be_used_is_one_line(
    cli: Cli, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "ros2.toml"
    file.write_text('domain_id = 300\n[publish]\nplan = "no spaces"\n')
    refused(cli("ros2", "--topics", file), "domain_id", "300", "plan")
    refused(cli("plant", "--hardware", "absent.toml"), "absent.toml", "docs/ros2.md")
    refused(cli("ros2", "--ros-endpoint", "tcp/10.0.0.9:7447"), "rmw_zenohd", "--insecure")
    refused(cli("plant", "--hardware", "ros2", "--fmu", "a.fmu"), "leave out --fmu")
    refused(cli("plant", "--ros-endpoint", "tcp/localhost:1"), "--hardware ros2")
    nobody = free_endpoint()
    refused(cli("plant", "--hardware", "ros2", "--ros-endpoint", nobody), nobody, "rmw_zenohd")
    with open_session(Endpoints(listen=(nobody,)), "plant"):
        refused(cli("plant", "--hardware", "ros2", "--ros-endpoint", nobody), "is no router")
    for module in ("types", "node"):
        monkeypatch.delitem(sys.modules, f"bayesrace.ros2.{module}")
    monkeypatch.delitem(sys.modules, "bayesrace.plant.ros2_car")
    monkeypatch.setitem(sys.modules, "rosbags", None)
    monkeypatch.setitem(sys.modules, "rosbags.interfaces", None)
    refused(cli("plant", "--hardware", "ros2"), "rosbags", "pip install 'bayesrace[ros2]'")
