"""The report: one file with the numbers of the result, from whatever a race has left."""

import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from bayesrace.operation.analysis.race import read_race
from bayesrace.operation.analysis.results import RaceResult
from bayesrace.operation.report import render, write_report
from bayesrace.operation.report.maps import lap_map
from bayesrace.operation.terminal.tables import COLUMNS
from tests.command_line import Cli, refused
from tests.synthetic_race import Drive, analyse, circle, write_race
from tests.test_analysis import TWO_LAPS, race


class _Tables(HTMLParser):
    """Texts of the cells of each table with an id, row by row; and all tag names."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: dict[str, list[list[str]]] = {}
        self.tags: set[str] = set()
        self._table = ""
        self._cell = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        if tag == "table":
            self._table = dict(attrs).get("id") or ""
            self.rows[self._table] = []
        elif tag == "tr":
            self.rows[self._table].append([])
        elif tag == "td":
            self._cell = True
            self.rows[self._table][-1].append("")

    def handle_endtag(self, tag: str) -> None:
        self._cell = self._cell and tag != "td"

    def handle_data(self, data: str) -> None:
        if self._cell:
            self.rows[self._table][-1][-1] += data


def parse(page: Path) -> _Tables:
    tables = _Tables()
    tables.feed(page.read_text(encoding="utf-8"))
    return tables


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RaceResult]:
    path = race(tmp_path_factory.mktemp("race"))
    analysis = read_race(path)
    return write_report(path, analysis), analysis.result


def test_the_page_needs_nothing_but_itself(rendered: tuple[Path, RaceResult]) -> None:
    text = rendered[0].read_text(encoding="utf-8")
    assert rendered[0].name == "report.html"
    assert len(text) < 3_000_000
    assert not re.search(r"""(src|href)\s*=\s*["'](?!#|data:)""", text)
    assert not re.search(r"@import|url\(\s*[\"']?(?!#|data:)", text)
    # Cornering, GPs, execution times; the rest is drawn by the page's own scripts.
    assert text.count("<svg ") - text.count('<svg class="mark"') == 1 + 6 + 1
    assert str(rendered[0].parent) not in text


def test_the_page_shows_the_results_numbers(rendered: tuple[Path, RaceResult]) -> None:
    page, result = rendered
    tables = parse(page).rows
    expected = [[column.cell(lap) for column in COLUMNS] for lap in result.laps]
    assert [row for row in tables["result"] if row] == expected
    gp = [row for row in tables["gp"] if row]
    assert [row[0] for row in gp] == ["vx", "vx", "vy", "vy", "omega", "omega"]
    assert gp[0][2] == f"{result.gp['vx'].rmse:.3g}"
    assert gp[0][4:6] == [f"{result.gp['vx'].r2:.4f}", f"{result.gp['vx'].coverage:.3f}"]
    for lap in result.laps:
        assert lap.trajectory_sha256 in page.read_text(encoding="utf-8")


def test_printed_it_has_few_pages_and_nothing_cut_off(
    rendered: tuple[Path, RaceResult], tmp_path: Path
) -> None:
    chromium = next(filter(None, map(shutil.which, ("chromium", "chrome", "google-chrome"))), None)
    if chromium is None or shutil.which("pdftotext") is None:
        pytest.skip("needs chromium, and pdftotext of poppler-utils")
    pdf = tmp_path / "report.pdf"
    options = ("--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path}")
    command = [chromium, *options, f"--print-to-pdf={pdf}", rendered[0].as_uri()]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    done = subprocess.run(["pdftotext", "-layout", pdf, "-"], capture_output=True, check=True)
    text = done.stdout.decode()
    assert text.count("\f") <= 6  # ends of pages, of a report with three runs
    ends = COLUMNS[0].title, COLUMNS[-1].title
    assert any(all(one in line for one in ends) for line in text.splitlines())


def test_where_drawing_fails_the_report_before_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_race(tmp_path, [Drive("bestcase", circle(TWO_LAPS, 1.0))])
    write_report(path)
    before = {file.name: file.stat().st_mtime_ns for file in path.iterdir()}

    def failing(*_: object) -> None:
        raise ArithmeticError

    monkeypatch.setattr(render, "solve_figure", failing)  # the last one
    with pytest.raises(ArithmeticError):
        write_report(path)
    assert {file.name: file.stat().st_mtime_ns for file in path.iterdir()} == before


@pytest.mark.parametrize(
    ("share", "junk", "shown"), [(1.0, b"", True), (0.5, b"", True), (0.0, b"no log", False)]
)
def test_a_damaged_log_of_the_training_drive_leaves_the_race_its_page(
    tmp_path: Path, share: float, junk: bytes, shown: bool
) -> None:
    path, training = race(tmp_path), race(tmp_path / "training")
    data = (training / "run.mcap").read_bytes()
    (path / "collect.mcap").write_bytes(junk + data[: int(share * len(data))])
    for name in ("{}.csv", "{}_raceline.csv"):
        shutil.copyfile(path / name.format("race"), path / name.format("train"))
    result = analyse(path)
    assert result.complete == (share == 1)
    assert (result.training is not None) == shown
    assert len(result.laps) == len(analyse(training).laps)
    assert write_report(path).is_file()


@pytest.mark.parametrize("states", [0, 1, 2])
def test_a_race_that_hardly_began_still_gets_its_page(tmp_path: Path, states: int) -> None:
    drive = Drive("bestcase", circle(TWO_LAPS[:states], 1.0), ended=None)
    path = write_race(tmp_path, [drive])
    assert write_report(path).is_file()
    path = write_race(tmp_path / "empty", [])
    assert write_report(path).is_file()


def test_the_command_takes_a_directory_or_its_log_but_none_without_a_run(
    cli: Cli, tmp_path: Path
) -> None:
    path = race(tmp_path / "race")
    done = cli("report", path / "run.mcap")
    assert done.code == 0, done.err
    assert done.out.splitlines()[-1] == str(path / "report.html")
    empty = write_race(tmp_path / "empty", [])
    refused(cli("report", empty), str(empty), "no run in its log", "bayesrace race")
    assert not (empty / "report.html").exists()


def test_names_from_files_are_text_not_markup(tmp_path: Path) -> None:
    drive = Drive("<script>alert(1)</script>", circle(TWO_LAPS, 1.0), ended="<b>over</b>")
    path = write_race(tmp_path, [drive])
    text = write_report(path).read_text()
    assert "<script>alert" not in text
    assert "<b>over" not in text


def test_nothing_but_tables_is_wider_than_a_telephone(rendered: tuple[Path, RaceResult]) -> None:
    text = rendered[0].read_text(encoding="utf-8")
    assert 'name="viewport" content="width=device-width' in text
    assert not re.search(r'<svg (?!class="mark")[^>]*(width|height)=', text)
    for table in re.finditer("<table", text):
        assert text[: table.start()].endswith('<div class="scroll">')
    widths = [float(box.split()[2]) for box in re.findall(r'viewBox="([^"]*)"', text)]
    assert max(widths) < 400  # points: at 400 pixels, a text of 9 points keeps 8 pixels or more


def test_a_car_that_wanders_off_does_not_shrink_the_track(tmp_path: Path) -> None:
    from bayesrace.operation.report.style import figure_style

    far = circle(TWO_LAPS[:100], np.linspace(1.0, 50.0, 100))
    analysis = read_race(write_race(tmp_path, [Drive("worstcase", far)]))
    with figure_style():
        figure = lap_map(analysis.runs[0], analysis.track, analysis.line)
    left, right = figure.axes[0].get_xlim()
    assert -1.5 < left < -1.2 < 1.2 < right < 1.5
    assert figure.axes[0].get_aspect() == 1.0
