"""The compiled motion planner: projection and theta recursion (paper, section 4.3) in numpy."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bayesrace.arrays import Floats
from bayesrace.controller.assembly import PathTable, make_path_table
from bayesrace.controller.native_step import NativeStep
from bayesrace.controller.settings import MpcSettings
from bayesrace.errors import InputError
from bayesrace.vehicles import Car, default_car
from tests.conftest import Circuit

TS, HORIZON = 0.02, 20


def row_at(table: PathTable, s: float) -> Floats:
    """The table, linear between rows, periodic."""
    rows, n = table.rows, len(table.rows)
    position = s / table.spacing_m % n
    i = int(position) % n
    w = position - int(position)
    return np.asarray((1 - w) * rows[i] + w * rows[(i + 1) % n])


def nearest(table: PathTable, xy: Floats) -> tuple[float, float]:
    """Arc length and signed distance, by projecting on every segment."""
    a = table.rows[:, :2]
    t = np.roll(a, -1, axis=0) - a
    w = np.clip(np.sum((xy - a) * t, axis=1) / np.sum(t * t, axis=1), 0, 1)
    foot = a + w[:, None] * t
    i = int(np.argmin(np.linalg.norm(xy - foot, axis=1)))
    e = xy - foot[i]
    side = np.sign(t[i, 0] * (xy - a[i])[1] - t[i, 1] * (xy - a[i])[0])
    return (i + w[i]) * table.spacing_m, float(side * np.linalg.norm(e))


def references(table: PathTable, s: float) -> Floats:
    """theta_k = theta_{k-1} + Ts v(theta_{k-1}); stages 1..N."""
    stages = []
    for _ in range(HORIZON):
        s += TS * row_at(table, s)[2]
        row = row_at(table, s)
        norm = np.hypot(row[3], row[4])
        stages.append(np.r_[row[:2], row[3:7] / norm])
    return np.array(stages)


@pytest.fixture
def step(kinematic_artefact: Path, car: Car, circuit: Circuit) -> NativeStep:
    """A controller of which only the planner is looked at."""
    step = NativeStep(kinematic_artefact, car, MpcSettings(iterations=1, iterations_cold=1))
    step.set_path(circuit.table)
    return step


def place(step: NativeStep, xy: Floats, psi: float = 0.0) -> tuple[float, float, Floats]:
    """Arc length, lateral distance and reference after one step at this pose."""
    step.step(np.r_[xy, psi, 1.0, 0, 0, 0], 0.0)
    return step.info.s_ref_m, step.info.lateral_m, step.read_reference()


def test_projection_and_recursion_equal_numpy(step: NativeStep, circuit: Circuit) -> None:
    table = circuit.table
    random, s = np.random.default_rng(0), 0.0
    length = len(table.rows) * table.spacing_m
    for _ in range(400):  # several laps, so across the start line too
        s += random.uniform(0.0, 0.12)
        row, ahead = row_at(table, s), row_at(table, s + 1e-3)
        tangent = (ahead - row)[:2] / np.linalg.norm((ahead - row)[:2])
        xy = row[:2] + random.uniform(-0.1, 0.1) * np.array([-tangent[1], tangent[0]])
        s_ref, lateral, reference = place(step, xy, np.arctan2(tangent[1], tangent[0]))
        expected, distance = nearest(table, xy)
        assert abs((s_ref - expected + length / 2) % length - length / 2) < 1e-9
        assert lateral == pytest.approx(distance, abs=1e-12)
        np.testing.assert_allclose(reference, references(table, expected), rtol=0, atol=1e-9)


def test_references_carry_the_tracks_half_planes(native: NativeStep, circuit: Circuit) -> None:
    """Unit normals, bounds a track's width apart, and the edges where the track has them."""
    track = circuit.track
    for s in np.linspace(0, circuit.line.length_m, 25, endpoint=False):
        native.reset()
        native.step(circuit.start(float(s)), 0.3)
        ref = native.read_reference()
        np.testing.assert_allclose(np.hypot(ref[:, 2], ref[:, 3]), 1, atol=1e-12)
        np.testing.assert_allclose(ref[:, 5] - ref[:, 4], 0.34, atol=1e-4)
        along = ref[:, 2] * ref[:, 0] + ref[:, 3] * ref[:, 1]
        outside = np.maximum(along - ref[:, 5], ref[:, 4] - along)
        expected = track.project_points(ref[:, :2]).off_track_m
        np.testing.assert_allclose(outside, expected, atol=1e-4)


def hairpin_table() -> PathTable:
    """Two straights of 2 m, 0.16 m apart, one there and one back, joined by half circles."""
    spacing, radius, straight = 0.005, 0.08, 2.0
    turn = np.arange(0, np.pi * radius, spacing)
    out = [(x, 0.0) for x in np.arange(0, straight, spacing)]
    right = [(straight + radius * np.sin(a), radius - radius * np.cos(a)) for a in turn / radius]
    back = [(straight - x, 2 * radius) for x in np.arange(0, straight, spacing)]
    left = [(-radius * np.sin(a), radius + radius * np.cos(a)) for a in turn / radius]
    xy = np.array(out + right + back + left)
    length = np.sum(np.linalg.norm(np.roll(xy, -1, axis=0) - xy, axis=1))
    tangent = np.roll(xy, -1, axis=0) - np.roll(xy, 1, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    along = np.sum(normal * xy, axis=1)
    rows = np.column_stack([xy, np.full(len(xy), 1.5), normal, along - 0.2, along + 0.2])
    return PathTable(np.ascontiguousarray(rows), length / len(xy))


def test_a_neighbouring_piece_of_the_track_does_not_capture(step: NativeStep) -> None:
    step.set_path(hairpin_table())
    for k, x in enumerate(np.arange(0.3, 1.6, 0.04)):
        drift = min(0.13, 0.01 * k)  # beyond the middle, nearer to the way back
        s_ref, lateral, _ = place(step, np.array([x, drift]))
        assert s_ref == pytest.approx(x, abs=0.01)
        assert lateral == pytest.approx(drift, abs=1e-3)


def test_the_first_projection_prefers_the_piece_that_leads_where_the_car_points(
    step: NativeStep,
) -> None:
    """From nothing, the heading decides between two pieces that are equally near."""
    step.set_path(hairpin_table())
    for offset in (0.07, 0.08, 0.09):
        step.reset()
        assert place(step, np.array([1.0, offset]), 0.0)[0] == pytest.approx(1.0, abs=0.01)
        step.reset()
        assert place(step, np.array([1.0, offset]), np.pi)[0] > 2.0


def test_after_a_leap_the_car_is_found_again(step: NativeStep, circuit: Circuit) -> None:
    table = circuit.table
    length = len(table.rows) * table.spacing_m
    place(step, row_at(table, 0.5)[:2], circuit.start(0.5)[2])
    there = circuit.start(length / 2)
    s_ref, lateral, _ = place(step, there[:2], there[2])
    assert s_ref == pytest.approx(length / 2, abs=0.05)
    assert abs(lateral) < 1e-3


def test_the_reference_runs_on_across_the_start_line(step: NativeStep, circuit: Circuit) -> None:
    table = circuit.table
    length = len(table.rows) * table.spacing_m
    for s in (length - 0.2, length - 1e-4, length - 1e-12, 0.0, 1e-9):
        step.reset()
        row = row_at(table, s)
        psi = circuit.start(0.0)[2]
        s_ref, _, reference = place(step, row[:2], psi)
        assert abs((s_ref - s + length / 2) % length - length / 2) < 1e-9
        assert 0 <= s_ref < length + 1e-9
        gaps = np.linalg.norm(np.diff(reference[:, :2], axis=0), axis=1)
        at = np.array([nearest(table, p)[0] for p in reference[:-1, :2]])
        speeds = np.array([row_at(table, float(s))[2] for s in at])
        np.testing.assert_allclose(gaps, TS * speeds, rtol=0.01)


@pytest.mark.parametrize(
    ("row", "column", "value"),
    [(-1, 6, np.nan), (3, 2, 0.0), (3, 2, 1e3), (3, 0, 1e200), (3, 5, 10.0), (3, 3, 1.01)],
    ids=["nan", "standing", "fast", "far", "bounds", "normal"],
)
def test_an_unusable_row_is_an_input_error_and_the_old_table_stays(
    step: NativeStep, circuit: Circuit, row: int, column: int, value: float
) -> None:
    rows = circuit.table.rows.copy()
    rows[row, column] = value
    refused(step, circuit, rows, circuit.table.spacing_m)


def test_so_is_one_of_unusable_length_or_spacing_or_without_a_direction(
    step: NativeStep, circuit: Circuit
) -> None:
    rows, spacing_m = circuit.table.rows, circuit.table.spacing_m
    closed = np.vstack([rows[:-1], rows[:1]])
    for bad in (rows[:7], np.tile(rows, (8192 // len(rows) + 1, 1)), closed):
        refused(step, circuit, bad, spacing_m)
    for bad_m in (0.0, np.nan, 1e-300):
        refused(step, circuit, rows, bad_m)


def refused(step: NativeStep, circuit: Circuit, rows: Floats, spacing_m: float) -> None:
    """Tries to set the path; the one before is still in use."""
    start, seen = circuit.start(1.0), []
    for _ in range(2):
        step.reset()
        s_m, lateral_m, reference = place(step, start[:2], start[2])
        seen.append((s_m, lateral_m, reference.tobytes()))
        with pytest.raises(InputError, match="path"):
            step.set_path(PathTable(rows, spacing_m))
    assert seen[0] == seen[1]


def test_a_racing_line_of_another_track_is_refused(circuit: Circuit) -> None:
    elsewhere = replace(circuit.line, x_m=circuit.line.x_m + 3.0, track_name="elsewhere")
    with pytest.raises(InputError, match=r"'elsewhere' is far outside the track .*raceline"):
        make_path_table(circuit.track, elsewhere, default_car().tuning.path.spacing_m)
