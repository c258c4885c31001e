"""Track files: the communities' variants are read, broken ones are refused with row and remedy."""

import contextlib
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bayesrace.errors import InputError
from bayesrace.tracks import builtin_tracks, load_track, read_smoothed, read_track, write_track
from tests.command_line import Cli, refused
from tests.reference import reference_file

HEADER = "# x_m,y_m,w_tr_right_m,w_tr_left_m"


def rows(count: int = 12) -> list[str]:
    """Rows of a circle of radius 1, width .2 right and .3 left."""
    angle = np.arange(count) * (2 * np.pi / count)
    return [f"{np.cos(a):.6f},{np.sin(a):.6f},0.2,0.3" for a in angle]


def swapped(lines: list[str]) -> list[str]:
    """The same rows with left before right."""
    cells = [line.split(",") for line in lines]
    return [",".join([x, y, left, right]) for x, y, right, left in cells]


def scaled(factor: float, widths: float | None = None, count: int = 80) -> list[str]:
    """A circle of radius 3, .2 right and .3 left, in another unit; the widths in theirs."""
    factors = np.array([factor, factor, *[factor if widths is None else widths] * 2])
    angle = np.arange(count) * (2 * np.pi / count)
    return [
        ",".join(f"{value:.6f}" for value in factors * (3 * np.cos(a), 3 * np.sin(a), 0.2, 0.3))
        for a in angle
    ]


def written(folder: Path, lines: list[str]) -> Path:
    path = folder / "loop.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def refusal(path: Path, **options: float) -> str:
    with pytest.raises(InputError) as caught:
        read_track(path, **options)
    message = str(caught.value)
    assert str(path) in message
    assert ";" in message, "no remedy"
    return message


VARIANTS = {
    "hash": [HEADER, *rows()],
    "bare": rows(),
    "names": ["x_m,y_m,w_tr_right_m,w_tr_left_m", *rows()],
    "spaces": ["# one", "", "  # two", *[row.replace(",", " , ") for row in rows()], ""],
    "semicolon": [HEADER, *[row.replace(",", "; ") for row in rows()]],
    "tab": [HEADER, *[row.replace(",", "\t") for row in rows()]],
    "blanks": [HEADER, *[row.replace(",", "   ") for row in rows()]],
    "left first": ["# x_m,y_m,w_tr_left_m,w_tr_right_m", *swapped(rows())],
    "other names": ["x;y;width_left;width_right", *swapped(rows())],
    "repeated": [*[row + "  # note" for row in rows()], rows()[0]],
    "bom": ["\ufeff" + HEADER, *rows()],
}


@pytest.mark.parametrize("lines", VARIANTS.values(), ids=VARIANTS)
def test_every_variant_gives_the_same_track(tmp_path: Path, lines: list[str]) -> None:
    track = read_track(written(tmp_path, lines))
    assert track.name == "loop"
    assert len(track.x_m) == 12
    assert track.length_m == pytest.approx(2 * np.pi, rel=1e-2)
    np.testing.assert_allclose(track.width_right_m, 0.2)
    np.testing.assert_allclose(track.width_left_m, 0.3)


def test_windows_line_ends_count_rows_the_same(tmp_path: Path) -> None:
    path = tmp_path / "dos.csv"
    lines = [HEADER, *rows()]
    lines[4] = "1,2"
    path.write_bytes("\r\n".join(lines).encode())
    assert "row 5: 2 columns instead of 4" in refusal(path)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ("1,2,3", "row 6: 3 columns instead of 4"),
        ("1,2,3,4,5", "row 6: 5 columns instead of 4"),
        ("1", "row 6: 1 column instead of 4"),
        ("1;2", "separated by commas, semicolons, tabs or spaces"),
        ("1,2,abc,4", "row 6: 'abc' is not a number"),
        ("1,2,,4", "row 6: '' is not a number"),
        ("1,nan,.2,.3", "row 6: a value is not finite"),
        ("1,2,inf,.3", "row 6: a value is not finite"),
        ("1e300,2,.2,.3", "row 6: a value is not finite or beyond 1e+08"),
        ("1,2_0,.2,.3", "row 6: '2_0' is not a number"),
        ("-.5,.866,-.1,.3", "row 6: a width is negative"),
        ("-.5,.866,.02,.02", "row 6: the track is 0.04 m wide, the car 0.05 m"),
    ],
)
def test_a_bad_row_is_named(tmp_path: Path, bad: str, message: str) -> None:
    lines = [HEADER, *rows()]
    lines[5] = bad
    assert message in refusal(written(tmp_path, lines))


def test_the_car_decides_how_wide_a_track_must_be(tmp_path: Path) -> None:
    path = written(tmp_path, [HEADER, *rows()])
    assert "0.5 m wide, the car 0.6 m" in refusal(path, car_width_m=0.6)
    read_track(path, car_width_m=0.4)


@pytest.mark.parametrize(
    ("factors", "car_width_m", "size", "unit"),
    [
        ((1000, None), 0.05, "500 m wide, 10000 times the car", "in millimetres; give"),
        ((100, None), 0.05, "50 m wide, 1000 times the car", "in centimetres; give"),
        ((1000, None), None, "m long and 500 m wide", "in millimetres or centimetres; give"),
        ((100, None), None, "1861 m long and 50 m wide", "in centimetres; give"),
        ((100, 1), 0.05, "0.5 m wide", "x, y and the widths probably have different units"),
        ((20000, 1), 0.05, "0.5 m wide", "x, y and the widths probably have different units"),
    ],
)
def test_a_track_in_another_unit_is_refused_with_its_likely_unit(
    tmp_path: Path,
    factors: tuple[float, float | None],
    car_width_m: float | None,
    size: str,
    unit: str,
) -> None:
    path = written(tmp_path, [HEADER, *scaled(*factors)])
    with pytest.raises(InputError, match=f"{size}; .*{unit}"):
        read_track(path, car_width_m)
    read_track(path, car_width_m=0.0)


@pytest.mark.parametrize("to_m", [(1e5, 0.0), (5e5, 5.3e6)])
def test_a_track_far_from_the_origin_is_refused_with_the_remedy(
    tmp_path: Path, cli: Cli, to_m: tuple[float, float]
) -> None:
    circle = np.array([row.split(",") for row in scaled(1.0)], dtype=float)

    def moved(*by_m: float) -> Path:
        moved = circle + np.array([*by_m, 0, 0])
        return written(tmp_path, [",".join(map(str, row)) for row in moved.tolist()])

    read_track(moved(1e3, 0.0))
    path, local = moved(*to_m), tmp_path / "local.csv"
    far = f"the track is {max(to_m):.3g} m from the origin and 0.5 m wide; make its first point the"
    assert far in refusal(path)
    done = cli("tracks", path, "--recentre", "--out", local)
    assert done.code == 0, done.err
    assert f"the origin is at x = {to_m[0] + circle[0, 0]}, y = {to_m[1]} of the file" in done.out
    nodes = np.column_stack([(found := read_track(local)).x_m, found.y_m])
    np.testing.assert_allclose(nodes, circle[:, :2] - circle[0, :2], atol=1e-8)


def noisy(noise_m: float, count: int) -> list[str]:
    """A kidney of some 8 m, measured with noise; .2 m to the right and .3 m to the left."""
    angle = np.arange(count) * (2 * np.pi / count)
    radius = 1 + 0.3 * np.cos(2 * angle)
    xy = np.column_stack([1.2 * radius * np.cos(angle), radius * np.sin(angle)])
    xy += noise_m * np.random.default_rng(3).standard_normal(xy.shape)
    return [f"{x:.6f},{y:.6f},0.2,0.3" for x, y in xy]


@pytest.mark.parametrize(("noise_m", "count"), [(0.003, 1500), (0.01, 800), (0.01, 3000)])
def test_a_measured_centreline_is_smoothed_and_its_deviation_shown(
    tmp_path: Path, cli: Cli, noise_m: float, count: int
) -> None:
    path, smooth = written(tmp_path, noisy(noise_m, count)), tmp_path / "smooth.csv"
    assert "turns back on itself; give the points in driving order; if they are" in refusal(path)
    done = cli("tracks", path, "--smooth", "--out", smooth)
    assert done.code == 0, done.err
    found = re.search(r"(\d+) points are ([\d.]+) mm \(RMS\) and at most ([\d.]+) mm", done.out)
    assert found is not None
    assert int(found[1]) == count
    assert 0.8e3 * noise_m < float(found[2]) < 1.2e3 * noise_m
    assert float(found[3]) < 6e3 * noise_m
    (tmp_path / "loop.csv").write_text("\n".join(noisy(0.0, count)))
    true = read_track(tmp_path / "loop.csv")
    measured = read_track(smooth)
    s = np.linspace(0, measured.length_m, 500)
    away = true.project_points(measured.position(s)).n_m
    assert float(np.abs(away).max()) < noise_m
    assert float(np.abs(measured.curvature(s)).max()) < 1.5 * float(np.abs(true.curvature(s)).max())
    np.testing.assert_allclose(measured.width_left_m, 0.3)


@pytest.mark.parametrize(("noise_m", "count"), [(0.003, 400), (0.004, 300), (0.003, 250)])
def test_noise_that_makes_a_centreline_zigzag_is_refused_with_the_remedy(
    tmp_path: Path, noise_m: float, count: int
) -> None:
    message = refusal(written(tmp_path, noisy(noise_m, count)))
    assert "zigzags: it turns by " in message
    assert "smooth them ('bayesrace tracks FILE --smooth" in message
    read_track(written(tmp_path, noisy(0.0, count)))


def test_what_no_smoothing_mends_is_refused(tmp_path: Path, cli: Cli) -> None:
    path = written(tmp_path, rows()[:7])
    refused(cli("tracks", path, "--smooth"), "too few points (7)")
    path = written(tmp_path, [HEADER, *scaled(1000)])
    refused(cli("tracks", path, "--smooth"), "millimetres")
    refused(cli("tracks", "--smooth"), "need the name of the track")
    path = written(tmp_path, ["1,1,0.2,0.3"] * 20)
    refused(cli("tracks", path, "--smooth"), "too few points (0)")
    path = written(tmp_path, noisy(0.01, 800)[:600])
    refused(cli("tracks", path, "--smooth"), "is not closed")
    path = written(tmp_path, [*noisy(0.01, 800)[:400], "9,9,0.2,0.3", *noisy(0.01, 800)[400:]])
    refused(cli("tracks", path, "--smooth"), "row 401: the point is", "leave it out")
    path = written(tmp_path, [*noisy(0.01, 800), *noisy(0.01, 800)])
    refused(cli("tracks", path, "--smooth"), "give the points of one lap in driving order")


@pytest.mark.parametrize("name", ["harbour", "random:3", "map.yaml"])
def test_what_was_not_measured_is_not_smoothed(tmp_path: Path, cli: Cli, name: str) -> None:
    (tmp_path / "map.yaml").touch()
    refused(cli("tracks", name, "--smooth"), "--smooth is for a CSV file of measured points, not f")


def test_a_logger_that_stood_has_measured_one_point(tmp_path: Path) -> None:
    lines = noisy(0.003, 1500)
    track, away_m = read_smoothed(written(tmp_path, lines))
    stood, all_m = read_smoothed(
        written(tmp_path, [*lines[:100], *[lines[100]] * 30, *lines[101:]])
    )
    np.testing.assert_array_equal(stood.x_m, track.x_m)
    assert len(all_m) == len(away_m) + 29


def test_tracks_of_all_scales_are_plausible(tmp_path: Path) -> None:
    for factor, car_width_m in ((1, 0.05), (4, 0.2), (24, 1.9), (24, None), (0.5, None)):
        read_track(written(tmp_path, scaled(factor)), car_width_m)


def test_a_header_in_other_units_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, ["# x_mm,y_mm,w_tr_right_mm,w_tr_left_mm", *rows()])
    assert "row 1: the header names 'x_mm' where 'x_m' is expected" in refusal(path)


@pytest.mark.parametrize("share", [0.5, 0.8])
def test_a_part_of_a_track_is_not_closed(tmp_path: Path, share: float) -> None:
    lines = scaled(1.0, count=100)
    message = refusal(written(tmp_path, lines[: round(share * 100)]))
    assert "the centreline is not closed: the last point is" in message
    assert "other neighbours at most 0.188 m" in message


def test_duplicates_name_both_rows_but_the_closing_point_is_none(tmp_path: Path) -> None:
    lines = [HEADER, *rows()]
    lines.insert(4, lines[4])
    assert "row 6: the same point as row 5" in refusal(written(tmp_path, lines))


def test_a_self_crossing_names_both_rows(tmp_path: Path) -> None:
    angle = np.arange(40) * (2 * np.pi / 40) + 0.1
    eight = [f"{np.sin(a):.5f};{np.sin(2 * a):.5f};.1;.1" for a in angle]
    message = refusal(written(tmp_path, [HEADER, *eight]))
    assert "crosses itself" in message
    assert message.count("row") == 2


def test_points_out_of_order_are_refused(tmp_path: Path) -> None:
    lines = rows(24)
    lines[7], lines[12] = lines[12], lines[7]
    assert "in driving order" in refusal(written(tmp_path, lines))


def test_a_line_there_and_back_is_refused(tmp_path: Path) -> None:
    there = [f"{0.1 * i:.2f},0,.1,.1" for i in range(10)]
    back = [f"{0.1 * i + 0.05:.2f},0,.1,.1" for i in reversed(range(9))]
    assert "turns back on itself" in refusal(written(tmp_path, there + back))


@pytest.mark.parametrize("lines", [[], [HEADER], [HEADER, *rows(4)]])
def test_too_few_points(tmp_path: Path, lines: list[str]) -> None:
    message = refusal(written(tmp_path, lines))
    assert "too few points" in message
    assert "at least 8" in message


def test_unreadable_files(tmp_path: Path) -> None:
    assert "cannot read the CSV file" in refusal(tmp_path / "absent.csv")
    assert "cannot read the CSV file" in refusal(tmp_path)
    binary = tmp_path / "binary.csv"
    binary.write_bytes(bytes(range(256)))
    assert "is not text in UTF-8" in refusal(binary)


@pytest.mark.parametrize("name", builtin_tracks())
def test_export_and_import_give_the_same_track(tmp_path: Path, name: str) -> None:
    track = load_track(name)
    path = tmp_path / f"{name}.csv"
    write_track(path, track)
    again = load_track(path)
    assert again.name == name
    for field in ("x_m", "y_m", "s_m", "width_right_m", "width_left_m"):
        np.testing.assert_array_equal(getattr(again, field), getattr(track, field))


@given(text=st.text(alphabet="0123456789.,;-+e#naif \n", max_size=300))
@settings(max_examples=200, deadline=None)
def test_any_text_is_a_track_or_an_input_error(
    tmp_path_factory: pytest.TempPathFactory, text: str
) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzz.csv"
    path.write_text(text, encoding="utf-8")
    with contextlib.suppress(InputError):
        read_track(path)


@pytest.mark.parametrize(
    ("name", "length", "width", "car_width"),
    [
        ("ethz", 17.84, 0.37, None),
        ("ethzmobil", 12.85, 0.46, None),
        ("f1tenth_monza_centerline", 446.1, 2.2, 0.3),
        ("f1tenth_spielberg_centerline", 343.4, 2.2, 0.3),
    ],
)
def test_published_tracks_are_read(
    name: str, length: float, width: float, car_width: float | None
) -> None:
    track = load_track(reference_file(f"tracks/{name}.csv"), car_width)
    assert track.length_m == pytest.approx(length, rel=1e-3)
    np.testing.assert_allclose(track.width_right_m + track.width_left_m, width)


def test_ethz_starts_south_east() -> None:
    """reference/README.md: the paper's car starts there with heading -45 degrees."""
    assert load_track(reference_file("tracks/ethz.csv")).start_pose()[2] == pytest.approx(
        np.radians(-45), abs=np.radians(0.5)
    )


def test_a_file_that_no_track_needs_is_refused_before_the_work(tmp_path: Path) -> None:
    path = tmp_path / "huge.csv"
    path.write_text("0.1,0.2,1,1\n" * 30_000)
    with pytest.raises(InputError, match=r"huge\.csv, row 20001: more than 20000 points"):
        read_track(path)
    path.write_text("0.1,0.2,1,1\n" * 400_000)
    with pytest.raises(InputError, match=r"huge\.csv is longer than 4 MB"):
        read_track(path)
