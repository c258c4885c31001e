"""Members come and go while the others drive; what one does who is not a member any more."""

import json
import time
from pathlib import Path
from typing import Any

import pytest
import zenoh

from bayesrace.configuration import read_configuration
from bayesrace.errors import InputError
from bayesrace.messages import COMMAND, STOP, Command, StopRequest, car_key, encode
from bayesrace.operation.certificates import add, init, revoke
from bayesrace.operation.run_plan import RunPlan, run_request
from bayesrace.transport import free_endpoint
from tests.driven import blank
from tests.network.cars import Course, Program
from tests.programs import run, until
from tests.security.authority import CAR, Bundles, written
from tests.security.intruder import bare_session
from tests.security.rig import course, secured

__all__ = ["course"]

pytestmark = pytest.mark.wall_clock

BRIEF_S = 15.0
CLOSED_S = 2.0
"""Within so long the links of a revoked member are closed."""


def members(folder: Path) -> Bundles:
    """A certificate for each role of a drive, and one for another director."""
    init(folder)
    for role in ("plant", "controller", "director"):
        add(folder, role, role, CAR)
    add(folder, "former", "director")
    return Bundles(folder)


def answers(session: Any, named: bool = True) -> int:
    """How many processes answer when the run shall end and the car shall stop.

    ``named``: the request names its session, as those of members do.
    """
    requests = (STOP, blank(StopRequest)), (COMMAND, blank(Command, command="stop"))
    source = {"source_info": zenoh.SourceInfo(session.id, 0)} if named else {}
    replies = [
        session.get(car_key(service.key, CAR), payload=encode(one), timeout=0.1, **source)
        for service, one in requests
    ]
    return sum(reply.ok is not None for one in replies for reply in one)


def test_a_revoked_director_is_cut_off_while_a_drive_goes_on(
    tmp_path: Path, course: Course
) -> None:
    """It goes on to connect, and to ask at once each time; an older list does not help it."""
    bundles = members(tmp_path / "certs")
    with secured(tmp_path, course, bundles) as rig:
        rig.drive(1, lockstep=False, laps=0)
        until(lambda: rig.phase() == "driving", "driving")
        before = rig.count("plant", "refused", "rejected", "requests_rejected", "runs")
        with bare_session(rig.plant_at, bundles.path("former"), mode="client") as session:
            until(lambda: list(session.info.links()), "the link")
            gone: list[float] = []
            listener = session.info.declare_link_events_listener(
                lambda event: gone.append(time.monotonic())
            )
            older = (bundles.path("plant") / "members.json").read_bytes()
            revoke(bundles.folder, "former")
            begin_s = time.monotonic()
            until(lambda: gone, "its end")
            assert gone[0] - begin_s < CLOSED_S
            listener.undeclare()
            (bundles.path("plant") / "members.json").write_bytes(older)
            until(lambda: "members.json has number" in rig.plant.said(), "the older list refused")
            ends_s, tries = time.monotonic() + 2.0, 0
            while time.monotonic() < ends_s:
                assert answers(session) == 0
        while time.monotonic() < ends_s + 2.0:
            with bare_session(rig.plant_at, bundles.path("former"), mode="peer") as session:
                assert answers(session, named=tries % 2 > 0) == 0
                tries += 1
        assert tries > 3
        assert rig.count("plant", *before) == before
        # A machine that opens link after link may keep a state from the controller for a while.
        until(lambda: rig.phase() in ("driving", "fallback"), "that the drive goes on")
        assert rig.director.status("plant").phase == "running"
        said = rig.plant.said()
        assert said.count("links of 'former'") == 1
        assert all("gone" not in one.said() for one in (rig.plant, rig.controller))
        assert "vanished" not in rig.controller.said()
        journey = rig.journey()
    assert journey.off_track_m() <= 0


@pytest.mark.check
def test_a_renewed_certificate_outlasts_the_one_before(tmp_path: Path) -> None:
    bundles = Bundles(tmp_path / "certs")
    init(bundles.folder)
    add(bundles.folder, "plant", "plant", CAR, days=BRIEF_S / 86400)
    ends_s = bundles.credentials("plant").ends_s
    config = written(tmp_path, bundles, free_endpoint("tls"), free_endpoint("tls"))
    with Program(tmp_path / "plant.txt", "plant", "--config", config) as plant:
        until(lambda: "plant of car" in plant.said(), "the plant")
        add(bundles.folder, "plant", None, days=1, renew=True)
        until(lambda: time.time() > ends_s + 2.0, "the end of the first one")
        assert plant.process.poll() is None, plant.said()
        plant.end()


@pytest.mark.parametrize("router", [False, True], ids=["direct", "router"])
def test_an_added_director_and_renewed_certificates_need_no_restart(
    tmp_path: Path, course: Course, router: bool
) -> None:
    """What a controller has in use, counts and was commanded stays; the processes are the same."""
    bundles = members(tmp_path / "certs")
    if router:
        add(bundles.folder, "router", "router")
    with secured(tmp_path, course, bundles, router=router) as rig:
        rig.drive(1, lockstep=True)
        assert rig.end(1).data["reason"] == "laps"
        assert run("stop", "--config", rig.config).returncode == 0
        before = rig.count("controller", "states_received", "weights_number")
        add(bundles.folder, "new", "director")
        for name in ("plant", "controller", *(["router"] if router else [])):
            add(bundles.folder, name, None, renew=True)
        programs = [rig.plant, rig.controller, *([rig.router] if rig.router else [])]
        until(lambda: all("opened anew" in one.said() for one in programs), "new links")
        folder = tmp_path / "new"
        folder.mkdir()
        network = read_configuration(rig.config).network
        config = written(folder, bundles, network.plant[0], network.controller[0], director="new")
        if router:
            config.write_text(rig.config.read_text().replace("use = {", 'use = { director = "new"'))
        until(lambda: run("status", "--config", config).returncode == 0, "a status")
        cars = json.loads(run("status", "--json", "--config", config).stdout)["cars"]
        status = cars[CAR]["controller"]
        assert before.items() <= status["counters"].items()
        rig.drive(2, lockstep=False, laps=0)
        until(lambda: rig.phase() == "stopped", "that it is still stopped")
        assert run("go", "--config", config).returncode == 0
        until(lambda: rig.phase() == "driving", "driving")
        assert run("stop", "--run", "--config", config).returncode == 0
        assert rig.end(2).data["reason"] == "stopped"
        plan = RunPlan(3, "test", 0, 600.0, lockstep=False, held=True)
        rig.director.start(run_request(course.track, plan))
        with pytest.raises(InputError, match="did not end"):  # it is held, and then not any more
            rig.director.wait_for_end(3, 2.0)
        until(lambda: rig.director.status("plant").phase == "idle", "the end of the held run")
        for source in ("plant", "controller"):
            assert rig.count(source, "holds_lost") == {"holds_lost": 1}
        for program in programs:
            assert program.process.poll() is None
            program.end()
