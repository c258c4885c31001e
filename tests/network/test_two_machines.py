"""Two machines, secured, as docs/security.md sets them up: each with the folder of its certificate,
one configuration file, and addresses in the certificates that are verified."""

import shutil
from pathlib import Path

import pytest

from bayesrace.log import LogReader
from bayesrace.messages import STATE
from tests.network.cars import Program, gentle_course
from tests.network.hosts import CONTROLLER_IP, PLANT_IP, Network
from tests.programs import PATIENCE_S, run, until

pytestmark = [pytest.mark.wall_clock, pytest.mark.unmeasured, pytest.mark.check]


def test_two_machines_from_nothing(net: Network, tmp_path: Path) -> None:
    yours, folder = tmp_path / "yours", ("--folder", tmp_path / "yours" / "certs")
    yours.mkdir()
    course = gentle_course(tmp_path)
    hosts = {"plant": (net.plant, PLANT_IP), "controller": (net.controller, CONTROLLER_IP)}
    assert run("certs", "init", *folder).returncode == 0
    for role, (_, address) in hosts.items():
        of = ("--role", role, "--car", "orca", "--host", address)
        assert run("certs", "add", role, *of, *folder).returncode == 0
    assert run("certs", "add", "director", "--role", "director", *folder).returncode == 0
    config = (
        f'[network]\nplant = ["tls/{PLANT_IP}:7447"]\ncontroller = ["tls/{CONTROLLER_IP}:7448"]\n'
        '[tls]\nfolder = "certs"\n'
    )
    given = {}
    for name in ("yours", *hosts):
        given[name] = ("--config", tmp_path / name / "bayesrace.toml")
        (tmp_path / name).mkdir(exist_ok=True)
        (tmp_path / name / "bayesrace.toml").write_text(config)
    for name in hosts:  # and nothing else
        shutil.copytree(yours / "certs" / name, tmp_path / name / "certs" / name)
    out, log = tmp_path / "out", tmp_path / "run.mcap"
    lap = ("drive", "--track", course.track_file, "--laps", "1", "--mode", "realtime", "--log", log)
    drives = ("controller", *course.arguments, *given["controller"])
    with (
        Program(out, "plant", *given["plant"], host=net.plant),
        Program(out, *drives, host=net.controller) as controller,
        Program(tmp_path / "drive.txt", *lap, *given["yours"], host=net.plant) as drive,
    ):
        assert drive.process.wait(PATIENCE_S) == 0, drive.said() + controller.said()
        doctor = Program(tmp_path / "doctor.txt", "doctor", *given["yours"], host=net.plant)
        until(lambda: doctor.process.poll() is not None, "the doctor")
        assert doctor.process.returncode == 0, doctor.said()
        assert "car 'orca': controller and plant" in doctor.said()
    assert max(state.lap for state in LogReader(log).select(STATE)) == 1
