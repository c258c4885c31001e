"""What the page is told of the model's errors: those that the weights are validated by."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.gp.weights import read_weights
from bayesrace.learning.dataset import dataset_from_arrays
from bayesrace.learning.validation import residual, validate
from bayesrace.log import Entry, LogReader
from bayesrace.messages import Event
from bayesrace.operation.analysis.race import read_race
from bayesrace.operation.view import Source, run_source, whole_page
from bayesrace.operation.view.sources import all_updates
from bayesrace.vehicles import get_car, write_car
from tests.browser import Page, needs_browser, page
from tests.programs import Race
from tests.synthetic_race import Drive, circle, write_race
from tests.test_analysis import TWO_LAPS
from tests.test_view import raced, shown

__all__ = ["page"]  # a fixture

ROUNDED = 0.51e-5


def errors_in(source: Source) -> list[tuple[Floats, Floats]]:
    """Error and band of each run that has been read, nan where there is none."""
    return [
        (np.array(run["rows"]["omega_error"], float), np.array(run["rows"]["omega_band"], float))
        for run in source.runs.all_updates()
    ]


def read(path: Path, car: str = "") -> list[tuple[Floats, Floats]]:
    return errors_in(shown(path, car))


def test_they_are_those_of_the_weights_that_drove(peanut_race: Race) -> None:
    race = read_race(peanut_race.out)
    settings = race.recording.settings
    weights = {w.version: w for w in map(read_weights, peanut_race.out.glob("weights-*.bin"))}
    driven = set()
    for run, (error, band) in zip(race.runs, read(peanut_race.out), strict=True):
        x, u = run.record.truth["x"], run.record.truth["u_applied"][1:]
        data = dataset_from_arrays(settings.car, settings.discretisation.step_s, x, u)
        assert np.isnan([error[0], band[0]]).all()
        if run.controller == "bestcase":  # whose model is the car's
            assert np.isnan(error).all()
            continue
        if version := run.record.weights_version:
            expected = validate(weights[version], data, settings.discretisation)
            np.testing.assert_allclose(error[1:], expected.error[:, 2], atol=ROUNDED)
            np.testing.assert_allclose(band[1:], expected.band[:, 2], atol=ROUNDED)
            driven.add(version)
        else:
            nominal = residual(data, settings.discretisation)[:, 2]
            np.testing.assert_allclose(error[1:], nominal, atol=ROUNDED)
            assert np.isnan(band).all()
    assert driven == set(weights)


def test_they_come_with_the_weights_while_it_is_driven(peanut_race: Race, tmp_path: Path) -> None:
    """A race writes weights before they drive, and a viewer reads its log piece by piece."""
    expected = read(peanut_race.out)
    files = {read_weights(path).version: path for path in peanut_race.out.glob("weights-*.bin")}
    first = shutil.ignore_patterns("weights-updated.bin", "weights-limit-*.bin")
    out = shutil.copytree(peanut_race.out, tmp_path / "run", ignore=first)
    live = run_source(out)
    piece: list[Entry[Any]] = []
    for entry in LogReader(out / "run.mcap").messages():
        about = entry.message.data if isinstance(entry.message, Event) else {}
        if path := files.get(str(about.get("weights_version"))):
            shutil.copy(path, out)
        piece.append(entry)
        if len(piece) == 50:
            live.runs.take(piece)
            piece.clear()
    live.runs.take(piece, whole=True)
    for own, other in zip(errors_in(live), expected, strict=True):
        np.testing.assert_allclose(own, other, atol=2 * ROUNDED)


def test_a_row_after_a_gap_has_none(tmp_path: Path) -> None:
    drive = Drive("bayesrace", circle(TWO_LAPS, 1.05), weights="bayesrace", drop=(5, 8, 9))
    ((error, band),) = read(raced(tmp_path / "run", drive))
    expected = np.ones(len(error), bool)
    expected[[0, 5, 7]] = False  # the rows 6 and 10 of the run follow on gaps
    np.testing.assert_array_equal(np.isfinite(error), expected)
    np.testing.assert_array_equal(np.isfinite(band), expected)


def test_there_are_none_without_weights_that_are_known(tmp_path: Path) -> None:
    drives = [Drive(name, circle(TWO_LAPS, 1.05), weights=name) for name in ("bayesrace", "other")]
    path = raced(tmp_path / "run", *drives)

    def known() -> list[bool]:
        return [bool(np.isfinite(error).any()) for error, _ in read(path)]

    assert known() == [True, False]
    shutil.copy(path / "run.mcap", alone := tmp_path / "run.mcap")
    for log in (alone, path / "run.mcap"):
        assert all(np.isnan(error).all() for error, _ in read(log, "orca"))
    (path / "weights-bayesrace.bin").write_bytes(b"damaged")
    assert known() == [False, False]
    write_race(path, drives)
    write_car(path / "car.toml", get_car("f1tenth"))  # not the one that the weights are of
    assert known() == [False, False]


def test_where_nothing_is_true_they_are_of_what_was_measured(tmp_path: Path) -> None:
    x = circle(TWO_LAPS, 1.05)
    seen = x + np.eye(7)[5] * np.random.default_rng(1).normal(0, 0.1, (len(x), 1))
    drive = Drive("worstcase", x, measured=seen)
    (true, _), (measured, band) = (
        read(raced(tmp_path / str(known), drive, truth=known))[0] for known in (True, False)
    )
    assert np.nanstd(true) < 0.01 < 0.1 < np.nanstd(measured)
    assert np.isnan(band).all()


@needs_browser
def test_a_chart_shows_them(peanut_race: Race, tmp_path: Path, page: Page) -> None:
    out = tmp_path / "page.html"
    out.write_text(whole_page(all_updates(shown(peanut_race.out))))
    page.open(out.as_uri() + "#lap=0")
    page.until("plots.length >= 7")
    chart = "plots.find((one) => one.kind.of === 'omega_error').chart"
    low, high = page.value(f"[{chart}.scales.y.min, {chart}.scales.y.max]")
    most = page.value("Math.max(...shown().flatMap((run) => series(run, 'omega_error')))")
    assert -low == high > most > 0
    assert page.errors == []
