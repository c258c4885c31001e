"""Geometry of tracks: splines, projection, start line, built-in and random circuits."""

import math
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.raceline import write_raceline
from bayesrace.tracks import (
    DEFAULT_RACE_TRACK,
    DEFAULT_TRAINING_TRACK,
    StartLine,
    Track,
    builtin_tracks,
    is_random_track,
    load_track,
    random_track,
)
from bayesrace.tracks.checks import clearance_m, find_crossing
from bayesrace.tracks.spline import fit_arc_length, rounded_polygon
from tests.reference import reference_file
from tests.test_raceline import circle, ring


def stadium(straight: float = 3.0, radius: float = 0.25, spacing: float = 0.04) -> Track:
    """Two parallel straights, 2 radius apart, joined by half circles; anticlockwise."""
    half = np.linspace(0, np.pi, max(8, round(np.pi * radius / spacing)), endpoint=False)
    run = np.arange(0, straight, spacing)
    bottom = np.column_stack([run, np.full_like(run, -radius)])
    right = np.column_stack([straight + radius * np.sin(half), -radius * np.cos(half)])
    top = np.column_stack([straight - run, np.full_like(run, radius)])
    left = np.column_stack([-radius * np.sin(half), radius * np.cos(half)])
    return Track.from_points("stadium", np.concatenate([bottom, right, top, left]), 0.2, 0.2)


def test_spline_is_smooth_and_closed_against_scipy() -> None:
    """The tridiagonal solve is right: same curve as scipy's periodic cubic spline."""
    interpolate = pytest.importorskip("scipy.interpolate")
    rng = np.random.default_rng(1)
    angle = np.sort(rng.uniform(0, 2 * np.pi, 40))
    points = np.column_stack([2 * np.cos(angle), np.sin(angle)])
    spline = fit_arc_length(points)
    theirs = interpolate.CubicSpline(
        np.append(spline.knots, spline.period),
        np.append(points, points[:1], axis=0),
        bc_type="periodic",
    )
    s = rng.uniform(-5, 20, 500)
    for order in range(3):
        np.testing.assert_allclose(
            spline(s, order), theirs(np.mod(s, spline.period), order), atol=1e-9
        )


def test_circle_has_its_analytic_length_curvature_heading_and_edges() -> None:
    track = circle(radius=0.8)
    assert track.length_m == pytest.approx(2 * np.pi * 0.8, rel=1e-5)
    s = np.linspace(-1.0, 12.0, 77)
    np.testing.assert_allclose(track.curvature(s), 1 / 0.8, rtol=2e-3)
    np.testing.assert_allclose(np.linalg.norm(track.position(s), axis=1), 0.8, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(track.centreline(s, 1), axis=1), 1.0, atol=1e-4)
    right, left = track.boundaries(0.05)
    np.testing.assert_allclose(np.linalg.norm(right, axis=1), 1.0, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(left, axis=1), 0.6, atol=1e-4)
    x, y, psi = track.start_pose()
    assert (x, y, psi) == pytest.approx((0.8, 0.0, np.pi / 2), abs=1e-9)
    np.testing.assert_allclose(track.normal(0.0), [-1.0, 0.0], atol=1e-9)


def test_projection_inverts_position_plus_offset() -> None:
    track = load_track(DEFAULT_RACE_TRACK)
    rng = np.random.default_rng(2)
    s = rng.uniform(0, track.length_m, 400)
    n = rng.uniform(-0.18, 0.18, 400)
    points = track.position(s) + n[:, None] * track.normal(s)
    found = track.project_points(points)
    np.testing.assert_allclose(found.s_m, s, atol=1e-8)
    np.testing.assert_allclose(found.n_m, n, atol=1e-9)
    np.testing.assert_allclose(found.off_track_m, np.abs(n) - 0.185, atol=1e-9)
    for i in range(5):
        one = track.project_path(points[i], s[i] + 0.1)
        assert (one.s_m[0], one.n_m[0]) == pytest.approx((s[i], n[i]), abs=1e-8)


@given(x=st.floats(-3, 3), y=st.floats(-3, 3))
@settings(max_examples=200, deadline=None)
def test_global_projection_is_nowhere_beaten(x: float, y: float) -> None:
    """Nearest over all pieces, also half-way between two of them."""
    track = load_track(DEFAULT_RACE_TRACK)
    found = track.project_points((x, y))
    everywhere = track.position(np.linspace(0, track.length_m, 4000))
    best = float(np.min(np.hypot(everywhere[:, 0] - x, everywhere[:, 1] - y)))
    foot = track.position(found.s_m[0])
    assert math.hypot(foot[0] - x, foot[1] - y) <= best + 1e-12
    assert abs(found.n_m[0]) == pytest.approx(math.hypot(foot[0] - x, foot[1] - y), abs=1e-6)


def test_local_projection_stays_on_its_piece_where_the_other_is_nearer() -> None:
    track = stadium()
    point = (1.5, 0.05)  # .30 m from the bottom straight, .20 m from the top one
    assert track.project_points(point).s_m[0] > 3.0
    local = track.project_path(point, 1.4)
    found = [*local.s_m, *local.n_m, *local.off_track_m]
    assert found == pytest.approx([1.5, 0.30, 0.10], abs=1e-3)


def test_local_projection_works_across_the_start_line() -> None:
    track = circle()
    for angle in (-0.05, 0.05):
        point = (0.9 * math.cos(angle), 0.9 * math.sin(angle))
        for guess in (0.02, track.length_m - 0.02, -0.02, 3 * track.length_m):
            (s,) = track.project_path(point, guess).s_m
            assert s == pytest.approx(angle % track.length_m, abs=1e-4)


@given(
    name=st.sampled_from([DEFAULT_TRAINING_TRACK, DEFAULT_RACE_TRACK, "random:5"]),
    start=st.floats(0, 30),
    phase=st.floats(0, 6),
    reach=st.floats(0.1, 0.24),
)
@settings(max_examples=30, deadline=None)
def test_path_projection_follows_a_weaving_car_for_laps(
    name: str, start: float, phase: float, reach: float
) -> None:
    """Off-track excursions towards a neighbouring piece don't move the car onto it."""
    track = load_track(name)
    s = np.arange(start, start + 3.4 * track.length_m, 0.06)
    n = reach * np.sin(3 * s + phase)
    path = track.project_path(track.position(s) + n[:, None] * track.normal(s), start)
    np.testing.assert_allclose(path.s_m, np.mod(s, track.length_m), atol=1e-6)
    np.testing.assert_allclose(path.n_m, n, atol=1e-6)
    np.testing.assert_allclose(np.diff(path.progress_m), np.diff(s), atol=1e-6)


@pytest.mark.parametrize("count", [3, 4, 6])
def test_a_car_inside_a_bend_tighter_than_the_track_is_wide_is_on_it(count: int) -> None:
    """Along the inner edge of a polygon: past the bisector of a corner it is beside the piece after
    it, though still near that before."""
    angle = 2 * np.pi * np.arange(count) / count
    corners = 3 * np.column_stack([np.cos(angle), np.sin(angle)])
    points = rounded_polygon([(x, y, 0.05) for x, y in corners], 0.02, 0.02)
    assert points is not None
    track = Track.from_points("polygon", points, 0.25, 0.25)
    inner = corners * (1 - 0.24 / (3 * np.cos(np.pi / count)))
    ways = zip(inner, np.roll(inner, -1, axis=0), strict=True)
    xy = np.concatenate([np.linspace(a, b, 150, endpoint=False) for a, b in ways])
    path = track.project_path(xy)
    nearest = track.project_points(xy)
    np.testing.assert_allclose(path.off_track_m, nearest.off_track_m, atol=1e-9)
    assert (path.off_track_m < 0).all()
    assert (np.diff(path.progress_m) > -1e-6).all()


def test_path_projection_finds_the_way_back_after_a_gap() -> None:
    track = stadium()
    s = np.concatenate([np.arange(0.5, 2.0, 0.1), np.arange(4.5, 6.0, 0.1)])
    np.testing.assert_allclose(track.project_path(track.position(s)).s_m, s, atol=1e-6)
    assert len(track.project_path(np.empty((0, 2))).s_m) == 0


def test_progress_starts_near_zero_just_before_the_line() -> None:
    track = circle()
    angle = np.array([-1e-6, 0.1, 0.2])
    path = track.project_path(np.column_stack([np.cos(angle), np.sin(angle)]))
    np.testing.assert_allclose(path.progress_m, angle, atol=1e-4)


def test_widths_are_interpolated_and_periodic() -> None:
    track = circle(count=10)
    right = np.arange(10) * 0.01 + 0.1
    track = Track.from_points("w", np.column_stack([track.x_m, track.y_m]), right, 0.2)
    step = track.length_m / 10
    got, left = track.widths(np.array([0.5, 9.5, 10.5, -0.5]) * step)
    np.testing.assert_allclose(got, [0.105, 0.145, 0.105, 0.145], atol=1e-6)
    np.testing.assert_allclose(left, 0.2)


def test_mirrored_track_mirrors_offsets_and_widths() -> None:
    track = Track.from_points("m", np.column_stack([circle().x_m, circle().y_m]), 0.1, 0.2)
    mirror = track.mirrored()
    here, there = track.project_points((1.05, 0.3)), mirror.project_points((1.05, -0.3))
    assert there.n_m == pytest.approx(-here.n_m)
    assert there.s_m == pytest.approx(here.s_m)
    assert there.off_track_m == pytest.approx(here.off_track_m)


def test_start_line_counts_signed_crossings_with_their_fraction() -> None:
    line = StartLine(circle())
    assert line.signed_distance(1.0, 0.25) == pytest.approx(0.25)
    forward = line.crossing((1.0, -0.03), (1.0, 0.01))
    assert forward.direction == 1
    assert forward.fraction == pytest.approx(0.75)
    assert line.crossing((1.0, 0.01), (1.0, -0.03)).direction == -1
    assert line.crossing((1.0, -0.03), (1.0, -0.01)).direction == 0
    # The other side of the circle, and far outside the track.
    assert line.crossing((-1.0, 0.03), (-1.0, -0.01)).direction == 0
    assert line.crossing((1.6, -0.03), (1.6, 0.01)).direction == 0


def test_start_line_counts_a_point_on_it_once() -> None:
    """A car that is put on the line has not crossed it; stopping on it is one crossing."""
    line = StartLine(circle())
    assert line.crossing((1.0, -1e-16), (1.0, 0.05)).direction == 0
    assert line.crossing((1.0, -0.05), (1.0, 0.0)).direction == 1
    assert line.crossing((1.0, 0.0), (1.0, 0.05)).direction == 0


def test_start_line_ends_half_way_to_the_next_piece() -> None:
    line = StartLine(stadium(radius=0.22))
    assert line.left_m == pytest.approx(0.22, abs=1e-3)
    assert line.right_m == pytest.approx(0.4, abs=1e-6)


def test_laps_of_a_trajectory_are_counted_on_every_reference_track() -> None:
    for name in ("ethz", "ethzmobil"):
        track = load_track(reference_file(f"tracks/{name}.csv"))
        line = StartLine(track)
        s = np.arange(0.0, 5.5 * track.length_m, 0.05)
        xy = track.position(s) + (0.15 * np.sin(2 * s))[:, None] * track.normal(s)
        points = [(float(x), float(y)) for x, y in xy]
        hits = [line.crossing(a, b).direction for a, b in pairwise(points)]
        assert sum(hits) == 5
        assert min(hits) == 0


def minimum_radius(track: Track) -> float:
    return float(1 / np.abs(track.curvature(np.arange(0, track.length_m, 0.01))).max())


def nodes(track: Track) -> Floats:
    return np.column_stack([track.x_m, track.y_m])


SIZES = {
    "paddock": (11, 18, 1.0),
    "harbour": (11, 18, 1.0),
    "workshop": (26, 28, 2.0),
    "airfield": (80, 250, 5.0),
}
"""Shortest and longest lap [m], and by how much it is larger than a 1:43 circuit."""


@pytest.mark.parametrize("name", builtin_tracks())
def test_builtin_tracks_are_real_circuits(name: str) -> None:
    """Length, width, hairpins both sharp and clear of the neighbouring piece, bends both ways."""
    track = load_track(name)
    width = track.width_left_m + track.width_right_m
    shortest, longest, size = SIZES[name]
    assert shortest <= track.length_m <= longest
    assert width.min() >= 0.37 * size - 1e-9
    assert width.max() <= 0.5 * size + 1e-9
    apart = 0.1 * size
    assert clearance_m(nodes(track), skip_m=np.pi / 2 * (width[0] + apart)) > width[0] + apart
    assert minimum_radius(track) > width[0] / 2 + 0.02
    for edge in track.boundaries(0.02):
        assert find_crossing(edge) is None
    s = np.arange(0, track.length_m, 0.01)
    kappa = track.curvature(s)
    assert kappa.min() < -2 / size
    assert kappa.max() > 2 / size
    bends = s[np.abs(kappa) > 0.4 / size]
    straight = np.diff(np.append(bends, bends[0] + track.length_m)).max()
    assert straight > 2.0 * size, "no straight"
    turned = np.array([np.sum(np.clip(kappa, 0, None)), np.sum(np.clip(-kappa, 0, None))]) * 0.01
    assert abs(turned[0] - turned[1]) == pytest.approx(2 * np.pi, abs=1e-2)
    assert turned.min() > np.pi / 2


def test_default_tracks_are_built_in_and_the_race_track_is_longer_and_narrower() -> None:
    training, race = load_track(DEFAULT_TRAINING_TRACK), load_track(DEFAULT_RACE_TRACK)
    assert race.length_m > training.length_m
    assert race.width_left_m[0] < training.width_left_m[0]


@given(seed=st.integers(0, 2**63))
@settings(max_examples=60, deadline=None)
def test_any_seed_gives_a_valid_circuit(seed: int) -> None:
    track = random_track(seed)
    width = float(track.width_left_m[0] + track.width_right_m[0])
    assert 11 <= track.length_m <= 18.1
    assert 0.37 <= width <= 0.46
    assert minimum_radius(track) > width / 2
    assert clearance_m(nodes(track), skip_m=np.pi / 2 * (width + 0.05)) >= width + 0.049
    for edge in track.boundaries(0.02):
        assert find_crossing(edge) is None


def test_a_seed_gives_the_same_circuit_again_and_others_differ() -> None:
    np.testing.assert_array_equal(random_track(7).x_m, load_track("random:7").x_m)
    assert random_track(7).length_m != random_track(8).length_m


def test_circuits_for_larger_cars_have_the_same_shape() -> None:
    track, larger = load_track("random:7"), load_track("random10:7")
    assert (track.name, larger.name) == ("random:7", "random10:7")
    np.testing.assert_allclose(larger.x_m, 4.3 * track.x_m, rtol=1e-12)
    np.testing.assert_allclose(larger.width_left_m, 4.3 * track.width_left_m, rtol=1e-12)
    assert larger.length_m == pytest.approx(4.3 * track.length_m, rel=1e-9)


@pytest.mark.parametrize("name", ["random:", "random:-1", "random:x", "random:1.5", "random10:x"])
def test_bad_seeds_are_refused(name: str) -> None:
    assert not is_random_track(name)
    with pytest.raises(InputError, match="seed must be a whole number"):
        load_track(name)
    with pytest.raises(InputError, match="negative"):
        random_track(-1)


def test_unknown_names_list_what_there_is() -> None:
    with pytest.raises(InputError, match=rf"'nowhere'.*{DEFAULT_RACE_TRACK}.*random:SEED"):
        load_track("nowhere")


def test_a_track_narrower_than_the_car_is_refused_whatever_its_source() -> None:
    for name in (DEFAULT_RACE_TRACK, "random:3"):
        with pytest.raises(InputError, match=r"wide, the car 0\.6 m"):
            load_track(name, car_width_m=0.6)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((3, 3)), r"shape \(n, 2\)"),
        (np.eye(2)[np.zeros(9, dtype=int)], "same point as point 0"),
        (np.eye(2), "too few points"),
    ],
)
def test_from_points_names_the_point_that_is_wrong(points: Floats, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Track.from_points("t", points, 0.2, 0.2)


def test_tracks_and_lines_are_read_without_slow_imports(tmp_path: Path) -> None:
    """The controller process starts without CasADi, scipy or matplotlib."""
    path = tmp_path / "ring.csv"
    write_raceline(path, ring())
    code = (
        "import sys, bayesrace.tracks as t; t.load_track('random:1').project_points((0, 0)); "
        f"from bayesrace.raceline import read_raceline; read_raceline({str(path)!r}); "
        "print([m for m in ('casadi', 'scipy', 'matplotlib', 'sklearn') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
