"""ROS maps: a track drawn into an image comes back, and what is no track is refused."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image
from scipy.spatial import cKDTree

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.tracks import Track, load_track, read_track
from bayesrace.tracks.maps import RosMap, read_map, track_of_map
from tests.command_line import Cli, refused
from tests.reference import reference_file

HALF_M = 0.6
FREE, UNKNOWN, WALL = 254, 205, 0
"""Brightness, as map_saver writes it."""
SAVED = {"negate": 0, "occupied_thresh": 0.65, "free_thresh": 0.196}


@cache
def peanut() -> Track:
    """The truth: 30 m round a waist, driven anticlockwise."""
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    radius = 4.0 + 1.2 * np.cos(2 * angle)
    xy = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    return Track.from_points("peanut", xy + np.array([1.0, 0.5]), HALF_M, HALF_M)


@cache
def drawn(resolution: float, yaw: float = 0.0, size_m: float = 14.0) -> tuple[Floats, list[float]]:
    """Distance [m] of each pixel from the true centreline, row 0 on top, and the origin."""
    count = round(size_m / resolution)
    along = (np.arange(count) + 0.5) * resolution - size_m / 2
    right, up = np.meshgrid(along, along[::-1])
    cosine, sine = np.cos(yaw), np.sin(yaw)
    x, y = cosine * right - sine * up, sine * right + cosine * up
    dense = peanut().position(np.linspace(0, peanut().length_m, 4_000))
    n, _ = cKDTree(dense).query(np.column_stack([x.ravel(), y.ravel()]))
    corner = -size_m / 2 * np.array([cosine - sine, sine + cosine])
    return n.reshape(x.shape), [*corner.tolist(), yaw]


def written(folder: Path, pixels: Any, resolution: float = 0.1, **fields: Any) -> Path:
    """A map as map_saver writes it; a field that is None is left out."""
    Image.fromarray(np.asarray(pixels, dtype=np.uint8)).save(folder / "loop.png")
    content = {"image": "loop.png", "resolution": resolution, "origin": [-7.0, -7.0, 0.0]} | SAVED
    content = {name: value for name, value in (content | fields).items() if value is not None}
    path = folder / "loop.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def loop(resolution: float = 0.1) -> Any:
    """Brightness of a map of the track in unknown space, with walls of two pixels."""
    n, _ = drawn(resolution)
    walls = np.where(n < HALF_M + 2 * resolution, WALL, UNKNOWN)
    return np.where(n < HALF_M, FREE, walls)


@pytest.mark.parametrize(
    ("resolution", "yaw", "inverted"),
    [(0.05, 0.0, False), (0.1, 0.0, True), (0.05, 0.7, False), (0.08, -2.0, False)],
)
def test_the_drawn_track_comes_back_within_a_pixel(
    tmp_path: Path, resolution: float, yaw: float, inverted: bool
) -> None:
    """Centreline and widths within one pixel; between the edges there is free space alone."""
    n, origin = drawn(resolution, yaw)
    pixels = np.where(n < HALF_M, FREE, WALL)
    pixels = 255 - pixels if inverted else pixels
    path = written(tmp_path, pixels, resolution, origin=origin, negate=int(inverted))
    truth, track = peanut(), track_of_map(read_map(path))
    found = truth.project_points(np.column_stack([track.x_m, track.y_m]))
    assert np.abs(found.n_m).max() < resolution
    assert track.length_m == pytest.approx(truth.length_m, rel=0.002)
    for width in (track.width_right_m, track.width_left_m):
        np.testing.assert_allclose(width, HALF_M, atol=resolution)
    for edge in track.boundaries():
        assert truth.project_points(edge).off_track_m.max() < 0.75 * resolution
    assert np.hypot(track.x_m, track.y_m).argmin() == 0
    (start_m,) = truth.project_points(track.position(0.0)).s_m
    assert track.heading(0.0) == pytest.approx(truth.heading(start_m), abs=0.05)


def test_walls_on_white_paper_are_the_same_track(tmp_path: Path) -> None:
    """The form of the F1TENTH community: infield and surroundings are white, too."""
    inside = track_of_map(read_map(written(tmp_path, loop())))
    n, _ = drawn(0.1)
    lines = np.where((n >= HALF_M) & (n < HALF_M + 0.2), 0, 255)
    track = track_of_map(read_map(written(tmp_path, lines, occupied_thresh=0.45)))
    np.testing.assert_array_equal(track.x_m, inside.x_m)
    np.testing.assert_array_equal(track.width_left_m, inside.width_left_m)


def test_pixels_are_what_map_server_makes_of_them(tmp_path: Path) -> None:
    """Probability (255 - mean) / 255: above occupied_thresh a wall, below free_thresh free."""
    pixels = np.zeros((1, 6, 4))
    pixels[0, :, :3] = [[255] * 3, [206] * 3, [205] * 3, [90] * 3, [89] * 3, [255, 255, 120]]
    pixels[0, :, 3] = 255
    grid = read_map(written(tmp_path, pixels))
    assert grid.free.tolist() == [[True, True, False, False, False, True]]
    assert grid.occupied.tolist() == [[False, False, False, False, True, False]]
    pixels[0, 0, 3] = 0  # nothing is known of what is transparent
    negated = read_map(written(tmp_path, pixels, negate=True))
    assert negated.free.tolist() == [[False] * 6]
    assert negated.occupied.tolist() == [[False, True, True, False, False, True]]


def test_the_grid_lies_as_its_origin_says() -> None:
    """The origin is the lower left corner of the lower left pixel, turned by the yaw."""
    free = np.zeros((3, 2), dtype=bool)
    grid = RosMap("a", free, free, 0.5, (1.0, 2.0, np.pi / 2))
    np.testing.assert_allclose(grid.metres(np.array([[0.0, 2.0], [1.0, 0.0]])),
                               [[0.75, 2.25], [-0.25, 2.75]])  # fmt: skip


def test_a_speck_of_the_mapping_is_no_obstacle(tmp_path: Path) -> None:
    pixels = loop()
    pixels[70, 130:132] = WALL
    assert read_map(written(tmp_path, pixels)).occupied[70, 130]
    track_of_map(read_map(written(tmp_path, pixels)))


def blocked(pixels: Any) -> Any:
    pixels[:, 75:80] = WALL
    return pixels


def leaking(pixels: Any) -> Any:
    pixels[:40, 78:81] = FREE
    return pixels


def with_pillar(pixels: Any) -> Any:
    pixels[68:72, 129:132] = WALL
    return pixels


def twice(pixels: Any) -> Any:
    return np.hstack([pixels, pixels])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (blocked, ("no loop", "paint infield and walls black", "% unknown")),
        (leaking, ("no loop", "close the gaps of the walls")),
        (with_pillar, ("round the infield and 1 more, at x = 6.05 m, y = 0.00 m", "paint")),
        (twice, ("several loops: 2 pieces", "paint")),
        (lambda pixels: np.minimum(pixels, UNKNOWN), ("no free pixel", "negate")),
    ],
)
def test_what_is_not_one_loop_is_refused(
    tmp_path: Path, change: Any, words: tuple[str, ...]
) -> None:
    with pytest.raises(InputError) as caught:
        track_of_map(read_map(written(tmp_path, change(loop()))))
    assert all(word in str(caught.value) for word in ("map 'loop'", *words)), caught.value


def test_a_track_too_narrow_for_the_car_is_refused_with_its_place(tmp_path: Path) -> None:
    pixels = loop()
    pixels[64:66, 120:134] = WALL  # leaves some 0.4 m
    grid = read_map(written(tmp_path, pixels))
    with pytest.raises(InputError, match=r"loop' at x = .*, y = .*: the track is .* the car 0\.5"):
        track_of_map(grid, 0.5)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"resolution": None}, ("resolution is missing",)),
        ({"resolution": -0.1}, ("resolution", "greater than 0")),
        ({"origin": [0, 0]}, ("origin",)),
        ({"image": "gone.png"}, ("gone.png", "beside the YAML file")),
        ({"image": "loop.yaml"}, ("loop.yaml", "cannot be read")),
        ({"mode": "raw"}, ("mode", "trinary")),
        ({"free_thresh": 0.9}, ("free_thresh is above",)),
        ({"occupied_thresh": float("nan")}, ("occupied_thresh",)),
    ],
)
def test_a_faulty_description_is_refused_with_its_field(
    tmp_path: Path, fields: dict[str, Any], words: tuple[str, ...]
) -> None:
    path = written(tmp_path, loop(), **fields)
    with pytest.raises(InputError) as caught:
        read_map(path)
    assert all(word in str(caught.value) for word in (str(path), *words)), caught.value


@pytest.mark.parametrize("text", ["", "a: [", "just words", "[1, 2]", "image: !!python/name:os.x"])
def test_what_is_no_description_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "loop.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"loop\.yaml"):
        read_map(path)


def test_images_beyond_all_measure_and_of_other_depth_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path, loop())
    Image.new("1", (6000, 6000)).save(tmp_path / "loop.png")
    with pytest.raises(InputError, match=r"6000 x 6000 pixels.* crop it"):
        read_map(path)
    Image.new("I;16", (10, 10)).save(tmp_path / "loop.png")
    with pytest.raises(InputError, match="8 bits a channel"):
        read_map(path)


def test_the_command_line_makes_a_track_and_a_picture(cli: Cli, tmp_path: Path) -> None:
    written(tmp_path, loop())
    done = cli("tracks", "loop.yaml", "--out", "loop.csv", "--picture", "loop.svg")
    assert done.code == 0, done.err
    assert "<svg" in (tmp_path / "loop.svg").read_text()
    there = read_track(tmp_path / "loop.csv")
    assert cli("tracks", "loop.csv").out == done.out
    back = ("tracks", "loop.yaml", "--reverse", "--start", "6.2,0.5", "--out", "back.csv")
    assert cli(*back, "--picture", "back.png").code == 0
    other = read_track(tmp_path / "back.csv")
    assert other.start_pose()[:2] == pytest.approx((6.2, 0.5), abs=0.15)
    assert sorted(other.x_m) == sorted(there.x_m)
    assert other.heading(0.0) == pytest.approx(-np.pi / 2, abs=0.1)
    refused(cli("tracks", "loop.yaml", "--start", "here"), "--start here", "1.5,-2")
    refused(cli("tracks", "loop.yaml", "--picture", "loop.gif"), "loop.gif", ".svg")
    refused(cli("tracks", "--reverse"), "--reverse", "name of the track")
    refused(cli("race", "--track", "loop.yaml"), "is a map", "bayesrace tracks loop.yaml --out")


def test_a_published_map_gives_the_published_centreline() -> None:
    """But for a hairpin, where that one keeps its distance from the outer wall alone."""
    grid = read_map(reference_file("tracks/spielberg_map/Spielberg_map.yaml"))
    published = load_track(reference_file("tracks/f1tenth_spielberg_centerline.csv"), 0.31)
    track = track_of_map(grid, 0.31).driven_from(None, reverse=True)
    off = published.project_points(np.column_stack([track.x_m, track.y_m])).n_m
    assert np.percentile(np.abs(off), 95) < grid.resolution_m
    assert np.abs(off).max() < 4 * grid.resolution_m
    assert track.length_m == pytest.approx(published.length_m, rel=0.002)
    assert track.start_pose() == pytest.approx(published.start_pose(), abs=0.2)
