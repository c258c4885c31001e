"""The images hold what they should, and drive a race between them, secured.

Each process runs as the image's user in the image's files. What a container engine adds (read-only
root, dropped capabilities, a network for each) is in the compose files, and not tried here: that
takes a daemon, or namespaces that sandboxes refuse.
"""

import json
import os
import shutil
import signal
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from bayesrace.log import LogReader
from bayesrace.messages import STATE, Role
from bayesrace.operation.certificates import add, init
from bayesrace.transport import free_endpoint
from tests.containers.images import Store, missing_tools
from tests.network.cars import gentle_course
from tests.programs import PATIENCE_S

pytestmark = [
    pytest.mark.check,
    pytest.mark.timeout(1800),
    pytest.mark.skipif(missing_tools() != "", reason=missing_tools()),
]

USER = 1000


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """All images, gone after the tests: they take gigabytes."""
    folder = tmp_path_factory.mktemp("images")
    store = Store(folder)
    store.build(("controller", "router", "plant", "learning"))
    yield store
    shutil.rmtree(folder)


def test_the_controller_holds_no_more_than_it_needs(store: Store) -> None:
    for target in ("controller", "router"):
        with store.container(target) as container:
            listed = json.loads(container.run("pip", "list", "--format", "json"))
            installed = {one["name"].lower() for one in listed}
            assert not installed & {"casadi", "scikit-learn", "matplotlib", "scipy"}
            assert container.run("id", "--user") == str(USER)
            assert container.run("sh", "-c", "command -v gcc || echo none") == "none"
            container.run("test", "!", "-w", "/opt/bayesrace")


def test_a_build_without_a_base_fails(store: Store) -> None:
    with pytest.raises(AssertionError, match="BASE"):
        store.buildah("bud", "--file", "docker/Dockerfile", ".")


@contextmanager
def running(line: list[str], output: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A container's process for the block, ended with all that it has started."""
    with output.open("wb") as file:
        process = subprocess.Popen(line, stdout=file, stderr=file, start_new_session=True)
    try:
        yield process
    finally:
        os.killpg(process.pid, signal.SIGTERM)
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def test_containers_drive_a_race_with_certificates(store: Store, tmp_path: Path) -> None:
    """The artefact is built in one, driven in another; the third records it.

    As in ``compose.tls.yaml``, each holds the certificate of its role alone.
    """
    data, certs, config = tmp_path / "data", tmp_path / "certs", tmp_path / "bayesrace.toml"
    data.mkdir()
    course = gentle_course(data)
    init(certs)
    images: dict[str, Role] = {
        "plant": "plant", "controller": "controller", "learning": "director",
    }  # fmt: skip
    for role in images.values():
        add(certs, role, role)
    plant_at, controller_at = free_endpoint("tls"), free_endpoint("tls")
    config.write_text(
        f'[network]\nplant = ["{plant_at}"]\ncontroller = ["{controller_at}"]\n'
        '[tls]\nfolder = "/certs"\n'
    )
    subprocess.run(["chown", "-R", str(USER), data, certs], check=True)
    tmp_path.chmod(0o755)
    shared = (f"{data}:/data", f"{config}:/etc/bayesrace.toml:ro")
    given = ("--config", "/etc/bayesrace.toml")
    files = [f"--track={course.track_file.name}", f"--raceline={course.line_file.name}",
             f"--weights={course.weights_file.name}"]  # fmt: skip
    with ExitStack() as stack:
        held = {name: f"{certs / role}:/certs/{role}:ro" for name, role in images.items()}
        plant_in, controller_in, director_in = (
            stack.enter_context(store.container(name, *shared, held[name])) for name in images
        )
        director_in.run("bayesrace", "build", "--out", "controller-orca")
        plant = plant_in.line("plant", *given)
        stack.enter_context(running(plant, tmp_path / "plant.txt"))
        drives = ("controller", "--artefact=controller-orca", *files, *given)
        controller = controller_in.line(*drives)
        stack.enter_context(running(controller, tmp_path / "controller.txt"))
        lap = ("drive", files[0], "--laps=1", "--mode=realtime", "--log=run.mcap", *given)
        line = director_in.line(*lap)
        driven = subprocess.run(line, capture_output=True, text=True, timeout=PATIENCE_S)
        said = "".join((tmp_path / f"{one}.txt").read_text() for one in ("plant", "controller"))
        assert driven.returncode == 0, driven.stderr + said
        status = director_in.run("bayesrace", "status", "--endpoint", controller_at, *given)
        assert "controller" in status
    assert sum(1 for _ in LogReader(data / "run.mcap").messages((STATE,))) > 100
