"""``bayesrace fmu``: what is exported is valid; contradicting options are refused."""

from pathlib import Path

import pytest
from fmpy import read_model_description
from fmpy.validation import validate_fmu

from bayesrace.gp.weights import Weights, write_weights
from bayesrace.raceline.line import write_raceline
from bayesrace.tracks import write_track
from tests.command_line import Cli, refused
from tests.conftest import Circuit


def test_the_car_is_exported(cli: Cli, tmp_path: Path) -> None:
    out = tmp_path / "car.fmu"
    done = cli("fmu", "export", "--version", "2", "--out", out)
    assert (done.code, str(out) in done.out) == (0, True), done.err
    assert read_model_description(out).fmiVersion == "2.0"
    assert validate_fmu(str(out)) == []


def test_the_controller_of_a_track_is_exported_and_given_other_weights(
    cli: Cli, tmp_path: Path, circuit: Circuit, weights: Weights
) -> None:
    names = ("track.csv", "line.csv", "weights.bin", "controller.fmu", "other.fmu")
    track, line, learned, out, other = (tmp_path / name for name in names)
    write_track(track, circuit.track)
    write_raceline(line, circuit.line)
    write_weights(learned, weights)
    files = ("--track", track, "--raceline", line)
    done = cli("fmu", "export", "--controller", *files, "--out", out)
    assert (done.code, "FMI 3.0 cs" in done.out) == (0, True), done.err
    done = cli("fmu", "weights", out, learned, "--out", other)
    assert (done.code, weights.version in done.out) == (0, True), done.err
    for fmu in (out, other):
        assert read_model_description(fmu).fmiVersion == "3.0"
        assert validate_fmu(str(fmu)) == []


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (("--track", "oval", "--artefact", "x"), "--track, --artefact: for a controller's FMU"),
        (("--controller", "--kind", "me"), "export it with --kind cs"),
    ],
)
def test_options_that_do_not_go_together_are_refused(
    cli: Cli, tmp_path: Path, options: tuple[str, ...], reason: str
) -> None:
    refused(cli("fmu", "export", *options, "--out", tmp_path / "out.fmu"), reason)
    assert not (tmp_path / "out.fmu").exists()
