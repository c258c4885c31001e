"""A certificate that ends while processes run: each says so and ends."""

import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from bayesrace.configuration import read_configuration
from bayesrace.errors import InputError
from bayesrace.messages import Role
from bayesrace.operation.certificates import add, init
from bayesrace.transport import Endpoints, free_endpoint, open_session
from tests.network.cars import Course, Program
from tests.network.observer import STANDING_MPS
from tests.programs import PATIENCE_S, until
from tests.security.authority import CAR, Bundles, bundles, written
from tests.security.rig import course, secured

__all__ = ["bundles", "course"]

pytestmark = [pytest.mark.wall_clock, pytest.mark.unmeasured]

BRIEF_DAYS = 15 / 86400
"""Long enough to start, and to drive for a while, on a machine with other work."""


def certified(folder: Path, brief: str = "") -> Bundles:
    """A certificate for each role of a drive; that of the role ``brief`` expires soon."""
    init(folder)
    for role in ("plant", "controller", "director"):
        days = BRIEF_DAYS if role == brief else 1.0
        add(folder, role, role, CAR, days=days)
    return Bundles(folder)


def check_ended(program: Program, name: str) -> None:
    """It has ended because of its certificate, and says so in one line, with the remedy."""
    assert program.process.wait(PATIENCE_S) == 2, program.said()
    last = program.said().strip().splitlines()[-1]
    assert f"bayesrace: certificate '{name}' has expired" in last
    assert f"bayesrace certs add {name} --renew" in last
    assert "Traceback" not in program.said()


def test_a_controller_ends_and_its_car_brakes(tmp_path: Path, course: Course) -> None:
    with secured(tmp_path, course, certified(tmp_path / "certs", "controller")) as rig:
        rig.drive(1, lockstep=False, laps=0)
        until(lambda: rig.phase() == "driving", "driving")
        check_ended(rig.controller, "controller")
        before = int(str(rig.count("plant", "braked")["braked"]))
        until(lambda: int(str(rig.count("plant", "braked")["braked"])) > before + 100, "braked")
        assert rig.director.status("plant").phase == "running"
        journey = rig.journey()
    assert max(state.x[3] for state in journey.states) > 0.5
    assert abs(journey.states[-1].x[3]) < STANDING_MPS


@pytest.mark.check
def test_a_plant_ends_and_its_controller_goes_on(tmp_path: Path, course: Course) -> None:
    """Though Zenoh opens the link of an expired certificate again."""
    with secured(tmp_path, course, certified(tmp_path / "certs", "plant")) as rig:
        rig.drive(1, lockstep=False, laps=0)
        until(lambda: rig.phase() == "driving", "driving")
        check_ended(rig.plant, "plant")
        assert rig.controller.process.poll() is None


@pytest.mark.check
def test_commands_end(tmp_path: Path, course: Course) -> None:
    """Whatever they are doing: looking on, learning, driving, forwarding."""
    certificates = certified(tmp_path / "certs")
    brief: tuple[Role, ...] = ("viewer", "learning", "director", "router")
    names: dict[str, str] = {role: f"brief-{role}" for role in brief}
    for one in brief:
        # 'learn' ends with the drive, so that one has to outlast it.
        days = (3 if one == "director" else 2) * BRIEF_DAYS
        add(certificates.folder, names[one], one, days=days)
    folder = tmp_path / "commands"
    folder.mkdir()
    lines: dict[str, tuple[str | Path, ...]] = {
        "viewer": ("status", "--watch"),
        "learning": ("learn", "--watch", "--out", folder / "job"),
        "director": (
            "drive", "--mode", "realtime", "--track", course.track_file, "--laps", "999",
            "--max-time", "600", "--log", folder / "run.mcap",
        ),
        "router": ("router", "--listen", free_endpoint("tls")),
    }  # fmt: skip
    with secured(tmp_path, course, certificates) as rig, ExitStack() as stack:
        network = read_configuration(rig.config).network
        config = written(folder, certificates, network.plant[0], network.controller[0], **names)
        started = {
            role: stack.enter_context(Program(folder / role, *line, "--config", config))
            for role, line in lines.items()
        }
        until(lambda: rig.phase() == "driving", "driving")
        for role, program in started.items():
            check_ended(program, names[role])


def test_a_process_is_interrupted_once(bundles: Bundles) -> None:
    """Whatever its further sessions find out while it ends because of the first one."""
    own, now_s, ended = bundles.credentials("director"), time.time(), []
    sooner, later = (
        Endpoints(
            connect=(free_endpoint("tls"),),
            credentials=own.model_copy(update={"ends_s": now_s + after_s}),
        )
        for after_s in (4.0, 4.5)
    )

    def work() -> None:
        with open_session(later, "director"):
            try:
                with open_session(sooner, "director"):
                    time.sleep(PATIENCE_S)
            finally:
                time.sleep(1.5)
                ended.append("in order")

    with pytest.raises(InputError, match="has expired"):
        work()
    assert ended == ["in order"]
