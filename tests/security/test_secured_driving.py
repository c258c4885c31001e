"""Real processes over secured links: driven, commanded, taught; and what others attempt meanwhile.

The forgers know everything but have the wrong certificate; who replays has the right one.
"""

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from bayesrace.configuration import read_configuration
from bayesrace.errors import InputError
from bayesrace.log import LogReader
from bayesrace.messages import (
    ACTUATION,
    COMMAND,
    EVENT,
    STATE,
    STOP,
    Command,
    Role,
    StopRequest,
    car_key,
    encode,
)
from bayesrace.operation.certificates import add, init
from bayesrace.transport import Endpoints, ask, free_endpoint, open_session
from tests.driven import blank
from tests.network.cars import Course, Program
from tests.network.observer import STANDING_MPS
from tests.programs import PATIENCE_S, run, until
from tests.security.authority import CAR, Bundles, bundles, written
from tests.security.intruder import bare_session
from tests.security.rig import BOTH, Rig, attacking, course, secured

__all__ = ["bundles", "course"]

pytestmark = pytest.mark.wall_clock


@pytest.mark.parametrize(
    "router", [False, pytest.param(True, marks=pytest.mark.check)], ids=["direct", "router"]
)
def test_a_secured_system_is_driven_taught_and_commanded(
    tmp_path: Path, course: Course, bundles: Bundles, router: bool
) -> None:
    """By the commands of people, each with the certificate of its role."""
    with secured(tmp_path, course, bundles, router=router) as rig:
        with_config = ("--config", rig.config)
        rig.drive(1, lockstep=True)
        assert rig.end(1).data["reason"] == "laps"
        published = run("publish", course.weights_file, *with_config)
        assert published.returncode == 0, published.stderr
        rig.drive(2, lockstep=False, laps=0)
        until(lambda: rig.phase() == "driving", "driving")
        assert run("stop", *with_config).returncode == 0
        until(lambda: rig.phase() == "stopped", "stopped")
        assert run("go", *with_config).returncode == 0
        until(lambda: rig.phase() == "driving", "driving again")
        assert run("status", "--json", *with_config).returncode == 0
        assert run("stop", "--run", *with_config).returncode == 0
        assert rig.end(2).data["reason"] == "stopped"
        director, learning = ("director", "learning")
        if router:
            director = learning = "somebody at router"
        done = (
            f"run by '{director}': run 2 started", f"stop by '{director}': run 2 stops",
            f"command by '{director}': stopped on", f"command by '{director}': driving on",
            f"weights by '{learning}': weights",
        )  # fmt: skip
        until(
            lambda: all(one in rig.plant.said() + rig.controller.said() for one in done), str(done)
        )
        journey = rig.journey()
    events = LogReader(rig.log).messages((EVENT,))
    data = {entry.message.kind: entry.message.data for entry in events}
    for kind in ("run_started", "stop", "go", "weights_accepted"):
        assert data[kind]["by"] == (learning if kind == "weights_accepted" else director)
    assert journey.off_track_m() <= 0


# Forged ------------------------------------------------------------------------------------------


@contextmanager
def forging(rig: Rig, name: str, rate: int, connections: int = 0, least: int = 0) -> Iterator[None]:
    """For the block, a program with that certificate forges messages; ``least``: so many."""
    status = rig.director.status("plant")
    words = rig.plant_at, rig.bundles.path(name), rate, connections, CAR, status.epoch, status.run
    with attacking("forger", "forging", *words) as said:
        yield
    assert int(said[0]) >= least


UNTOUCHED = {
    "plant": ("refused", "rejected", "requests_rejected", "runs"),
    "controller": ("refused", "requests_rejected"),
}


def check_untouched(rig: Rig, before: Sequence[dict[str, object]]) -> None:
    """The run goes on, and nothing has been counted as received in error."""
    assert rig.director.status("plant").phase == "running"
    assert rig.phase() in ("driving", "fallback")
    after = [rig.count(source, *names) for source, names in UNTOUCHED.items()]
    assert after == list(before)
    # States after a stall count as foreign, too, until there are several in a row.
    states = rig.count("controller", "states_received", "states_foreign", "states_stale")
    actuations = rig.count("plant", "actuations_received")
    sent = {**rig.count("plant", "states_sent"), **rig.count("controller", "actuations_sent")}
    assert sum(int(str(one)) for one in states.values()) <= int(str(sent["states_sent"]))
    received = int(str(actuations["actuations_received"]))
    assert received <= int(str(sent["actuations_sent"]))


def test_the_forgers_would_be_obeyed_with_the_right_certificate(
    tmp_path: Path, course: Course, bundles: Bundles
) -> None:
    """Otherwise the tests below would show nothing."""
    with secured(tmp_path, course, bundles) as rig:
        rig.drive(1, lockstep=False, laps=0)
        until(lambda: rig.phase() == "driving", "driving")
        with forging(rig, "director", rate=1000):
            assert rig.end(1).data["reason"] == "stopped"


@pytest.mark.parametrize(
    ("name", "rate", "connections", "seconds"),
    [
        ("viewer", 1000, 0, 2.0),
        ("blue-controller", 1000, 0, 2.0),
        pytest.param("blue-plant", 1000, 0, 2.0, marks=pytest.mark.check),
        pytest.param("revoked", 1000, 0, 2.0, marks=pytest.mark.check),
        pytest.param("viewer", 10_000, 500, 10.0, marks=pytest.mark.check, id="flood"),
    ],
)
def test_forged_messages_reach_nobody_and_the_car_stays_on_the_track(
    tmp_path: Path, course: Course, bundles: Bundles, name: str, rate: int, connections: int,
    seconds: float,
) -> None:  # fmt: skip
    """States, actuations, an end of the run, `stop`: nothing is received, so nothing is counted.

    A flood holds connections open, too, that never greet.
    """
    with secured(tmp_path, course, bundles) as rig:
        rig.drive(1, lockstep=False, laps=0)
        until(lambda: rig.phase() == "driving", "driving")
        before = [rig.count(source, *names) for source, names in UNTOUCHED.items()]
        with forging(rig, name, rate, connections, least=round(0.05 * rate * seconds)):
            time.sleep(seconds)
        check_untouched(rig, before)
        journey = rig.journey()
    assert journey.off_track_m() <= 0


# Asked without end -----------------------------------------------------------------------------


@contextmanager
def asking(rig: Rig, endpoint: str, source: str, rate: int) -> Iterator[None]:
    """For the block, a viewer asks for the status of a process, about so often a second."""
    with attacking("flood", "asking", endpoint, rig.bundles.path("viewer"), source, rate) as said:
        yield
    assert float(said[0]) > min(0.5 * rate, 100)  # how many more depends on the machine


@pytest.mark.check
@pytest.mark.parametrize(
    ("course", "rate"), [("Python", 30), ("Python", 1280), ("C", 1280)], indirect=["course"]
)
def test_each_stop_gets_through_while_viewers_ask_for_the_status_without_end(
    tmp_path: Path, course: Course, bundles: Bundles, rate: int
) -> None:
    with secured(tmp_path, course, bundles) as rig, ExitStack() as stack:
        rig.drive(1, lockstep=False, laps=0)
        until(lambda: rig.phase() == "driving", "driving")
        configuration = read_configuration(rig.config)
        director = stack.enter_context(
            open_session(configuration.endpoints("director"), "director")
        )
        plant, controller = configuration.network.plant[0], configuration.network.controller[0]
        for where, source in (
            (plant, "plant"),
            (controller, "controller"),
            (controller, "controller"),
        ):
            stack.enter_context(asking(rig, where, source, rate))
        time.sleep(1.0)
        took_s = []
        for _ in range(20):
            for word in ("stop", "go"):
                begin_s = time.monotonic()
                assert ask(director, COMMAND, CAR, blank(Command, command=word)).accepted
                took_s.append(time.monotonic() - begin_s)
        assert max(took_s) < 0.5
        begin_s = time.monotonic()
        assert ask(director, STOP, CAR, blank(StopRequest)).accepted
        assert time.monotonic() - begin_s < 0.5
        assert rig.end(1).data["reason"] == "stopped"


# Replayed ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("course", "source"),
    [
        ("Python", "plant"),
        ("Python", "controller"),
        pytest.param("C", "plant", marks=pytest.mark.check),
    ],
    indirect=["course"],
)
def test_what_was_recorded_has_no_effect_when_it_is_sent_again(
    tmp_path: Path, course: Course, bundles: Bundles, source: str
) -> None:
    """By the one who had sent it: of another run, so it is counted, and not acted on."""
    topic, port = (STATE, 1) if source == "plant" else (ACTUATION, 0)
    with secured(tmp_path, course, bundles) as rig:
        rig.drive(1, lockstep=False)
        assert rig.end(1).data["reason"] == "laps"
        time.sleep(0.5)  # the recorder flushes five times a second
        messages = LogReader(rig.log).messages((topic,))
        old = [encode(entry.message) for entry in messages]
        assert len(old) > 100
        rig.drive(2, lockstep=False, laps=0)
        until(lambda: rig.phase() == "driving", "driving")
        other, counter = (
            ("controller", "states_foreign") if source == "plant" else ("plant", "stale")
        )
        before = rig.count(other, counter)[counter]
        network = read_configuration(rig.config).network
        where = (network.plant, network.controller)[port][0]
        with bare_session(where, bundles.path(source)) as session:
            publisher = session.declare_publisher(car_key(topic.key, CAR))
            until(lambda: publisher.matching_status.matching, "a subscriber")
            for payload in old[:200]:
                publisher.put(payload)
                time.sleep(0.005)
        until(lambda: int(str(rig.count(other, counter)[counter])) > int(str(before)), "counted")
        assert rig.director.status("plant").phase == "running"
        journey = rig.journey()
    assert journey.off_track_m() <= 0


# Certificates that end ---------------------------------------------------------------------------

BRIEF_DAYS = 15 / 86400
"""Long enough to start, and to drive for a while, on a machine with other work."""


def certified(folder: Path, brief: str = "") -> Bundles:
    """A certificate for each role of a drive; that of the role ``brief`` expires soon."""
    init(folder)
    for role in ("plant", "controller", "director"):
        days = BRIEF_DAYS if role == brief else 1.0
        add(folder, role, role, CAR, days=days)
    return Bundles(folder)


def check_ended(program: Program, name: str, code: int = 75, *others: Program) -> None:
    """It has ended because of its certificate, and says so in one line, with the remedy.

    ``code``: 75, a failure that passes, where it would wait for another one at its next start.
    ``others``: what these say helps to understand a failure.
    """
    assert program.process.wait(PATIENCE_S) == code, program.said()
    last = program.said().strip().splitlines()[-1]
    said = [one.said() for one in others]
    assert f"bayesrace: certificate '{name}' has expired" in last, (program.said(), *said)
    assert f"bayesrace certs add {name} --renew" in last
    assert "Traceback" not in program.said()


@BOTH
def test_a_controller_whose_certificate_ends_does_so_and_its_car_brakes(
    tmp_path: Path, course: Course
) -> None:
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
def test_a_plant_whose_certificate_ends_does_so_and_its_controller_goes_on(
    tmp_path: Path, course: Course
) -> None:
    """Though Zenoh opens the link of an expired certificate again."""
    with secured(tmp_path, course, certified(tmp_path / "certs", "plant")) as rig:
        rig.drive(1, lockstep=False, laps=0)
        until(lambda: rig.phase() == "driving", "driving")
        check_ended(rig.plant, "plant")
        assert rig.controller.process.poll() is None


@pytest.mark.check
def test_commands_whose_certificate_ends_do_so(tmp_path: Path, course: Course) -> None:
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
            check_ended(program, names[role], 75 if role == "router" else 2, rig.controller)


@pytest.mark.usefixtures("interruptible")
def test_a_process_whose_certificate_ends_is_interrupted_once(bundles: Bundles) -> None:
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
        with open_session(later, "director", peers_follow=True):
            try:
                with open_session(sooner, "director", peers_follow=True):
                    time.sleep(60)
                    ended.append("not interrupted")
            finally:
                time.sleep(1.5)
                ended.append("in order")

    with pytest.raises(InputError, match="has expired"):
        work()
    assert ended == ["in order"]
