"""What viewers draw of a run: right by foxglove-sdk, true to the messages, invisible to readers."""

import json
import re
from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import foxglove.layouts
import foxglove.messages
import numpy as np
import pytest
from mcap.reader import make_reader

from bayesrace.arrays import Floats
from bayesrace.log import LogReader, LogWriter
from bayesrace.log_parts import part_files
from bayesrace.log_rotation import RotatingLog
from bayesrace.messages import EVENT, STATE, TELEMETRY, TRUTH, Telemetry, Topic, encode
from bayesrace.operation.closed_loop import ClosedLoop
from bayesrace.scene import Scene
from bayesrace.sensors import get_sensors
from tests import sample_messages as messages
from tests.driven import blank
from tests.racing import Racing, racing

NS = 10**9
EMPTY = {
    "deletions", "metadata", "arrows", "cubes", "spheres", "cylinders", "texts", "models",
}  # fmt: skip
"""What no scene has one of."""
CLASSES = {
    "timestamp": "Timestamp", "lifetime": "Duration", "entities": "SceneEntity",
    "lines": "LinePrimitive", "triangles": "TriangleListPrimitive", "points": "Point3",
    "color": "Color", "colors": "Color", "pose": "Pose", "position": "Vector3",
    "translation": "Vector3", "orientation": "Quaternion", "rotation": "Quaternion",
    "transforms": "FrameTransform",
}  # fmt: skip
"""Of fields, by the definitions of the schemas."""


class Shown(NamedTuple):
    """A message of a scene in a log."""

    topic: str
    schema: Any
    log_time_ns: int
    content: dict[str, Any]


def shown_in(path: Path) -> list[Shown]:
    """As the mcap package reads it."""
    with path.open("rb") as file:
        return [
            Shown(channel.topic, schema, message.log_time, json.loads(message.data))
            for schema, channel, message in make_reader(file).iter_messages()
            if channel.topic.startswith("scene/")
        ]


@pytest.fixture(scope="module")
def raced() -> Racing:
    return racing()


@pytest.fixture(scope="module")
def logs(raced: Racing, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A lap at racing speed: with and without a scene, and with an estimated state."""
    folder, found = tmp_path_factory.mktemp("scene"), {}
    scene = Scene(raced.car, raced.track, raced.line)
    for name, sensors in (("scene", "exact"), ("estimated", "odometry")):
        found[name] = folder / f"{name}.mcap"
        with closing(LogWriter(found[name], scene=scene)) as log:
            loop = ClosedLoop(
                raced.car, raced.track, raced.line, raced.controller(), log=log,
                sensors=get_sensors(sensors),
            )  # fmt: skip
            assert len(loop.drive(1).laps_s) == 1
    found["plain"] = folder / "plain.mcap"
    with closing(LogWriter(found["plain"], LogReader(found["scene"]).metadata())) as log:
        for entry in LogReader(found["scene"]).messages():
            log.write(entry.key, encode(entry.message), entry.message.source_time_ns)
    return found


def built(kind: str, content: Any) -> Any:
    """The message as the class of foxglove-sdk that has the name, which refuses wrong types."""
    of = getattr(foxglove.messages, kind)
    fields = [one.partition("=")[0].strip(" (*)") for one in of.__text_signature__.split(",")]
    assert sorted(content) == sorted(filter(None, fields))
    values = {}
    for name, value in content.items():
        if name in EMPTY:
            assert value == []
        elif isinstance(value, list) and name in CLASSES:
            value = [built(CLASSES[name], one) for one in value]
        elif name in CLASSES:
            value = built(CLASSES[name], value)
        elif name in ("type", "level"):
            enum = {"type": "LinePrimitiveLineType", "level": "LogLevel"}[name]
            known = vars(getattr(foxglove.messages, enum)).values()
            (value,) = (one for one in known if type(one).__name__ == enum and int(one) == value)
        values[name] = value
    return of(**values)


def conforms(value: Any, schema: dict[str, Any]) -> bool:
    """Whether the value has the types and all the fields of a schema, and no others."""
    if schema["type"] == "object":
        fields = schema["properties"]
        same = value.keys() == fields.keys() and set(schema["required"]) == value.keys()
        return same and all(conforms(value[name], fields[name]) for name in fields)
    if schema["type"] == "array":
        return all(conforms(one, schema["items"]) for one in value)
    kinds = {"integer": int, "number": float, "string": str, "boolean": bool}
    return type(value) is kinds[schema["type"]]


@pytest.mark.parametrize("log", ["scene", "estimated"])
def test_each_message_is_the_one_of_foxglove_that_its_schema_names(
    logs: dict[str, Path], log: str
) -> None:
    kinds = set()
    for topic, schema, log_time_ns, content in shown_in(logs[log]):
        package, kind = schema.name.split(".")
        assert (package, schema.encoding) == ("foxglove", "jsonschema")
        assert conforms(content, json.loads(schema.data)), topic
        assert built(kind, content).encode()
        (first,) = content.get("entities", [])[:1] or content.get("transforms", [content])
        stamp = first["timestamp"]
        assert stamp["sec"] * NS + stamp["nsec"] == log_time_ns
        kinds.add(kind)
    assert kinds == {"SceneUpdate", "FrameTransforms", "PoseInFrame", "Log"}


def test_times_are_times_to_viewers(logs: dict[str, Path]) -> None:
    """They tell them from other objects by the title in the schema."""
    (schema,) = {one.schema.data for one in shown_in(logs["scene"]) if "plan" in one.topic}
    entity = json.loads(schema)["properties"]["entities"]["items"]["properties"]
    assert (entity["timestamp"]["title"], entity["lifetime"]["title"]) == ("time", "duration")


def of_topic(shown: list[Shown], topic: str) -> dict[int, dict[str, Any]]:
    return {one.log_time_ns: one.content for one in shown if one.topic == topic}


def xy(points: list[dict[str, float]]) -> Floats:
    return np.array([(one["x"], one["y"]) for one in points])


def poses(shown: list[Shown], frame: str) -> dict[int, tuple[float, float, float]]:
    found = {}
    for at_ns, content in of_topic(shown, f"scene/{frame}/transform").items():
        (one,) = content["transforms"]
        assert (one["parent_frame_id"], one["child_frame_id"]) == ("world", frame)
        turn = 2 * np.arctan2(one["rotation"]["z"], one["rotation"]["w"])
        found[at_ns] = one["translation"]["x"], one["translation"]["y"], turn
    return found


def turned(angle: float) -> float:
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def test_the_car_is_where_it_was_measured_or_estimated(logs: dict[str, Path]) -> None:
    """And the truth beside it, where it differs; 25 times a second of car time at most."""
    expected: dict[str, dict[str, Topic[Any]]] = {
        "scene": {"orca": STATE}, "estimated": {"orca": TELEMETRY, "orca/truth": TRUTH},
    }  # fmt: skip
    for log, topics in expected.items():
        shown = shown_in(logs[log])
        assert {one.topic[6:-10] for one in shown if one.topic.endswith("/transform")} == {*topics}
        for frame, topic in topics.items():
            found, told = poses(shown, frame), dict[int, tuple[float, ...]]()
            for entry in LogReader(logs[log]).messages((topic,)):
                x = getattr(entry.message, "estimate" if topic is TELEMETRY else "x")
                told.setdefault(entry.log_time_ns, x)
            assert len(found) > 0.45 * len(told)
            assert np.diff(sorted(found)).min() >= 0.039 * NS
            for at_ns, (x_m, y_m, psi) in found.items():
                assert np.hypot(x_m - told[at_ns][0], y_m - told[at_ns][1]) < 1e-4
                assert abs(turned(psi - told[at_ns][2])) < 1e-3
            for at_ns, pose in of_topic(shown, f"scene/{frame}/pose").items():
                assert pose["pose"]["position"]["x"] == found[at_ns][0]


def test_the_plan_is_drawn_with_its_tube(logs: dict[str, Path]) -> None:
    plans = of_topic(shown_in(logs["scene"]), "scene/orca/plan")
    widths = []
    for entry in LogReader(logs["scene"]).messages((TELEMETRY,)):
        if (content := plans.get(entry.log_time_ns)) is None:
            continue
        (entity,) = content["entities"]
        plan = np.reshape(entry.message.plan_x, (-1, 7))
        (line,) = entity["lines"]
        assert np.abs(xy(line["points"]) - plan[:, :2]).max() < 6e-4
        for band in entity["triangles"]:
            right, left = xy(band["points"])[0::2], xy(band["points"])[1::2]
            width = np.hypot(*(left - right).T)
            assert np.abs(width / 2 - [0.0, *entry.message.tube_m]).max() < 1e-3
            across = left[-1] - right[-1]
            if np.hypot(*across) > 0.01:  # to the left of where the car will head
                heading = np.array([np.cos(plan[-1, 2]), np.sin(plan[-1, 2])])
                assert heading[0] * across[1] - heading[1] * across[0] > 0.9 * np.hypot(*across)
            assert max(band["indices"]) == len(band["points"]) - 1
            widths.append(width.max())
        assert entity["lifetime"] == {"sec": 0, "nsec": NS // 2}
    assert len(plans) > 100
    assert max(widths) > 0.005


def test_track_line_and_outline_have_the_sizes_of_the_files(
    logs: dict[str, Path], raced: Racing
) -> None:
    shown = shown_in(logs["scene"])
    track, line = next(one for one in shown if one.topic == "scene/track").content["entities"]
    *edges, start = track["lines"]
    off = [raced.track.project_points(xy(edge["points"])).off_track_m for edge in edges]
    assert np.abs(off).max() < 2e-3
    assert np.abs(xy(start["points"]).mean(axis=0) - raced.track.position(0.0)).max() < 2e-3
    (path,) = line["lines"]
    distance = xy(path["points"])[:, None] - raced.line.xy_m
    assert np.hypot(*distance.T).min(axis=0).max() < 1e-3
    assert len(path["colors"]) == len(path["points"]) > 100
    (car,) = next(one for one in shown if one.topic == "scene/orca/car").content["entities"]
    outline = xy(car["triangles"][0]["points"])
    assert np.ptp(outline, axis=0).tolist() == [raced.car.length_m, raced.car.width_m]
    assert (car["frame_id"], car["frame_locked"]) == ("orca", True)


def test_readers_find_the_messages_alone(logs: dict[str, Path]) -> None:
    def read(log: str) -> tuple[Any, ...]:
        reader = LogReader(logs[log])
        found = [(one.key, one.message) for one in reader.messages()]
        newer = [one.message for one in LogReader(logs[log]).newer()]
        return found, newer, reader.contents(), reader.refused, reader.truncated

    assert read("scene") == read("plain")


def test_a_scene_costs_a_third_of_the_log_at_most(logs: dict[str, Path]) -> None:
    assert 1.0 < logs["scene"].stat().st_size / logs["plain"].stat().st_size < 1.35


def test_each_part_of_a_recording_has_scene_and_layout(raced: Racing, tmp_path: Path) -> None:
    """And its announcements, which each part repeats, are read once."""
    path, seqs, kinds = tmp_path / "run.mcap", list[int](), list[str]()
    scene = Scene(raced.car, raced.track, raced.line)
    entries = list(enumerate(raced.driven.states))
    with closing(RotatingLog(path, None, 400_000, scene)) as log:
        for kind in ("weights_accepted", "run"):
            event = messages.event(kind=kind)
            log.write("bayesrace/orca/event/plant", encode(event), 0)
        log.flush()
        reader = LogReader(path)

        def follow() -> None:
            for entry in reader.newer((STATE, EVENT)):
                if entry.key.endswith("state"):
                    seqs.append(entry.message.seq)
                else:
                    kinds.append(entry.message.kind)

        for seq, state in entries:
            report = blank(Telemetry, plan_x=(*state.x, *state.x), state_seq=state.seq)
            log.write("bayesrace/orca/state", encode(state), seq)
            log.write("bayesrace/orca/telemetry", encode(report), seq)
            if seq % 20 == 0:
                log.flush()
                follow()
    follow()
    assert seqs == [state.seq for _, state in entries]
    assert kinds == ["weights_accepted", "run"]
    parts = part_files(path)
    assert len(parts) > 2
    for file in parts.values():
        first, *_ = shown_in(file)
        assert first.topic == "scene/track"
        assert {"scene/orca/car", "scene/orca/log"} <= {one.topic for one in shown_in(file)}
        with file.open("rb") as stream:
            (layout,) = make_reader(stream).iter_attachments()
        assert layout.name == "foxglove-layout.json"
        assert layout.data == scene.layout


def test_several_cars_and_shadows_have_frames_and_colours_of_their_own(raced: Racing) -> None:
    scene, at_ns = Scene(raced.car), 5 * NS
    report = blank(Telemetry, plan_x=(0.5,) * 14, tube_m=(0.1,), estimate=(0.5,) * 9)
    told = {
        "red/state": messages.state(), "blue/state": messages.state(),
        "red/telemetry": report, "red/shadow/new/telemetry": report,
    }  # fmt: skip
    drawn = [one for key, sent in told.items() for one in scene.of(f"bayesrace/{key}", sent, at_ns)]
    found = defaultdict[str, list[Any]](list)
    for one in drawn:
        found[one.topic].append(json.loads(one.json))
    assert {"red", "blue", "red/new"} == {topic[6:-4] for topic in found if topic[-4:] == "/car"}
    assert {"scene/red/plan", "scene/red/new/plan"} <= found.keys()
    bodies = [found[f"scene/{one}/car"][0]["entities"][0] for one in ("red", "blue", "red/new")]
    assert len({json.dumps(body["triangles"][0]["color"]) for body in bodies}) == 3
    (transform,) = found["scene/red/new/transform"][0]["transforms"]
    assert (transform["child_frame_id"], transform["translation"]["x"]) == ("red/new", 0.5)


def test_what_happens_is_a_log_by_severity(raced: Racing) -> None:
    scene = Scene(raced.car)

    def lines(key: str, message: Any) -> Iterator[tuple[int, str, str]]:
        for one in scene.of(f"bayesrace/orca/{key}", message, NS):
            if one.topic == "scene/orca/log":
                content = json.loads(one.json)
                yield content["level"], content["name"], content["message"]

    def event(kind: str, **data: Any) -> list[tuple[int, str, str]]:
        return list(lines("event/plant", messages.event(kind=kind, text="why", data=data)))

    info, warning, error = 2, 3, 4
    assert event("run_started") == [(info, "plant", "run_started: why")]
    assert event("run_ended", reason="laps") == [(info, "plant", "run_ended: why")]
    assert event("run_ended", reason="plant_fault") == [(error, "plant", "run_ended: why")]
    assert event("sensor_fault")[0][0] == warning
    beats = [
        list(lines("status/controller", messages.status(source="controller", phase=phase)))
        for phase in ("driving", "driving", "fallback", "driving")
    ]
    assert [[level for level, *_ in one] for one in beats] == [[info], [], [warning], [info]]


def test_another_viewer_gets_what_is_constant(raced: Racing) -> None:
    scene = Scene(raced.car, raced.track)

    def topics() -> set[str]:
        return {one.topic for one in scene.of("bayesrace/orca/state", messages.state(), NS)}

    assert {"scene/track", "scene/orca/car"} <= topics()
    assert not topics()
    scene.begin()
    assert {"scene/track", "scene/orca/car"} == topics()


def test_the_layout_has_settings_that_foxglove_knows_and_topics_of_the_log(
    logs: dict[str, Path], raced: Racing
) -> None:
    """What it plots is a number in the messages."""
    layout = json.loads(Scene(raced.car).layout)
    kinds = {
        "3D": foxglove.layouts.ThreeDeeConfig(), "Plot": foxglove.layouts.PlotConfig(),
        "RosOut": foxglove.layouts.LogConfig(),
    }  # fmt: skip
    with logs["estimated"].open("rb") as file:
        told = {c.topic: json.loads(m.data) for _, c, m in make_reader(file).iter_messages()}
    for panel, config in layout["configById"].items():
        assert config.keys() <= kinds[panel.partition("!")[0]]._to_dict().keys()
        for path in config.get("paths", []):
            assert path.keys() <= foxglove.layouts.PlotSeries()._to_dict().keys()
            topic, *fields = re.split(r"\.|\[|\]\.?", path["value"].removesuffix("[0]"))
            value = told[topic]
            for field in fields:
                value = value[field]
            value = value[0] if path["value"].endswith("[0]") else value
            assert type(value) in (int, float), path
    scene = layout["configById"]["3D!scene"]
    camera = foxglove.layouts.ThreeDeeCameraState()._to_dict()
    assert scene["cameraState"].keys() <= camera.keys()
    assert scene["topics"].keys() | {layout["configById"]["RosOut!log"]["topicToRender"]} <= {*told}
    assert f'"{raced.car.name}"' == json.dumps(scene["followTf"])
    moved = {one[6:-10] for one in told if one.endswith("/transform")}
    assert scene["transforms"].keys() == {f"frame:{one}" for one in ("world", *moved)}
    tiles = re.findall(r'"([^"]+!\w+)"', json.dumps(layout["layout"]))
    assert sorted(tiles) == sorted(layout["configById"])
