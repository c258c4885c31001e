"""Members come and go while the others drive; what one does who is not a member any more."""

import time
from pathlib import Path

import pytest

from bayesrace.messages import COMMAND, STOP, Command, StopRequest, car_key, encode
from bayesrace.operation.certificates import add, init, revoke
from tests.driven import blank
from tests.network.cars import Course
from tests.programs import until
from tests.security.authority import CAR, Bundles
from tests.security.intruder import bare_session
from tests.security.rig import course, secured

__all__ = ["course"]

pytestmark = [pytest.mark.wall_clock, pytest.mark.unmeasured]

CLOSED_S = 2.0
"""Within so long the links of a revoked member are closed."""


def members(folder: Path) -> Bundles:
    """A certificate for each role of a drive, and one for another director."""
    init(folder)
    for role in ("plant", "controller", "director"):
        add(folder, role, role, CAR)
    add(folder, "former", "director")
    return Bundles(folder)


def answers(session: object) -> int:
    """How many processes answer when the run shall end and the car shall stop."""
    requests = (STOP, blank(StopRequest)), (COMMAND, blank(Command, command="stop"))
    replies = [
        session.get(car_key(service.key, CAR), payload=encode(one), timeout=0.1)  # type: ignore[attr-defined]
        for service, one in requests
    ]
    return sum(reply.ok is not None for one in replies for reply in one)


def test_a_revoked_director_is_cut_off_while_a_drive_goes_on(
    tmp_path: Path, course: Course
) -> None:
    """It goes on to connect, and to ask at once each time."""
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
            revoke(bundles.folder, "former")
            begin_s = time.monotonic()
            until(lambda: gone, "its end")
            assert gone[0] - begin_s < CLOSED_S
            listener.undeclare()
            ends_s, tries = time.monotonic() + 2.0, 0
            while time.monotonic() < ends_s:
                assert answers(session) == 0
        while time.monotonic() < ends_s + 2.0:
            with bare_session(rig.plant_at, bundles.path("former"), mode="peer") as session:
                assert answers(session) == 0
                tries += 1
        assert tries > 3
        assert rig.count("plant", *before) == before
        assert rig.phase() in ("driving", "fallback")
        assert rig.director.status("plant").phase == "running"
        said = rig.plant.said()
        assert said.count("links of 'former'") == 1
        assert all("gone" not in one.said() for one in (rig.plant, rig.controller))
        assert "vanished" not in rig.controller.said()
        journey = rig.journey()
    assert journey.off_track_m() <= 0
