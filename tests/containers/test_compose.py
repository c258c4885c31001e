"""The compose files are accepted by Podman's reader, and the unit of a bare board by systemd; both
harden every service, and leave the processes what they need."""

import ctypes
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

import pytest
import yaml

from bayesrace.configuration import read_configuration
from bayesrace.transport import free_endpoint
from bayesrace.transport.endpoints import LinkLimits
from tests.containers.confined import LIBRARY
from tests.network.cars import Program, gentle_course, start_plant
from tests.programs import ROOT, run, until
from tests.security.authority import Bundles, bundles, written

__all__ = ["bundles"]

pytestmark = pytest.mark.check

DOCKER: Final = ROOT / "docker"
BASE: Final = "python@sha256:0"
UNIT: Final = ROOT / "examples" / "systemd" / "bayesrace@.service"
WORST: Final = 25
"""Exposure as systemd counts it, in tenths."""
LINKS: Final = LinkLimits().pending + LinkLimits().sessions
"""Descriptors that links and handshakes may take."""

systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="needs systemd-analyze"
)


def config(*files: str, base: str = BASE) -> subprocess.CompletedProcess[str]:
    """What Podman makes of the files."""
    if shutil.which("podman") is None:
        pytest.skip("needs podman, see .ci/tools")
    command = Path(sys.executable).with_name("podman-compose")
    given = [word for file in files for word in ("-f", str(DOCKER / file))]
    environment = {**os.environ, "BAYESRACE_BASE": base, "BAYESRACE_HAPROXY": BASE}
    return subprocess.run(
        [command, *given, "config"], env=environment, capture_output=True, text=True
    )


def services(*files: str) -> dict[str, Any]:
    accepted = config(*files)
    assert accepted.returncode == 0, accepted.stderr
    found: dict[str, Any] = yaml.safe_load(accepted.stdout)["services"]
    return found


@pytest.mark.parametrize("files", [("compose.yaml",), ("compose.yaml", "compose.tls.yaml")])
def test_every_service_is_hardened(files: tuple[str, ...]) -> None:
    found = services(*files)
    proxy = {"proxy"} if len(files) > 1 else set()
    assert set(found) == {"prepare", "plant", "controller", "race"} | proxy
    for name, service in found.items():
        assert service["read_only"], name
        assert service["cap_drop"] == ["ALL"]
        assert set(service.get("cap_add", ())) <= {"SYS_NICE", "IPC_LOCK"}
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert "ports" not in service
        assert service["pids_limit"]
        assert service["mem_limit"]
        assert service["ulimits"]["nofile"] > LINKS
        assert service["ulimits"]["core"] == 0
    for name in ("plant", "controller"):
        file = found[name]["environment"]["BAYESRACE_HEARTBEAT"]
        assert file in found[name]["healthcheck"]["test"]
        assert found[name]["restart"] == "unless-stopped"


def test_certificates_take_the_place_of_plain_links_everywhere() -> None:
    """Each container holds the certificate of its role, and nobody the authority."""
    found = services("compose.yaml", "compose.tls.yaml")
    for name, role in (("plant", "plant"), ("controller", "controller"), ("race", "director")):
        volumes = found[name]["volumes"]
        assert any("secured.toml:/etc/bayesrace.toml:ro" in one for one in volumes)
        assert not any("plain.toml" in one for one in volumes)
        held = {one.split(":")[1] for one in volumes if "/certs/" in one}
        assert held == {f"/certs/{role}"}
        assert "tcp/" not in str(found[name])


def test_who_is_outside_reaches_plant_and_controller_through_the_proxy_alone() -> None:
    """By their names, and where the proxy's configuration looks for them."""
    found = services("compose.yaml", "compose.tls.yaml")
    assert found["proxy"]["networks"]["outside"]["aliases"] == ["plant", "controller"]
    assert not any("/certs/" in one for one in found["proxy"]["volumes"])
    proxied = (DOCKER / "haproxy.cfg").read_text()
    for name in ("plant", "controller"):
        networks = found[name]["networks"]
        assert list(networks) == ["inside"]
        assert f"{networks['inside']['aliases'][0]}:744" in proxied
    assert list(found["race"]["networks"]) == ["outside"]


def test_the_base_image_has_to_be_named() -> None:
    refused = config("compose.yaml", base="")
    assert refused.returncode != 0
    assert "name the base image by its digest" in refused.stderr


def test_the_configurations_of_the_containers_are_valid() -> None:
    plain, secured = (read_configuration(DOCKER / f"{one}.toml") for one in ("plain", "secured"))
    assert plain.network.insecure
    assert not secured.network.insecure
    assert secured.tls.folder == Path("/certs")


@pytest.mark.wall_clock
def test_a_process_that_hangs_is_unhealthy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The check needs neither a link nor a certificate."""
    file = tmp_path / "heartbeat"
    plant = yaml.safe_load((DOCKER / "compose.yaml").read_text())["services"]["plant"]
    named = plant["environment"]["BAYESRACE_HEARTBEAT"]
    check = ["sh", "-c", plant["healthcheck"]["test"].replace(named, str(file))]

    def healthy() -> bool:
        return subprocess.run(check, capture_output=True).returncode == 0

    assert not healthy()
    monkeypatch.setenv("BAYESRACE_HEARTBEAT", str(file))
    with start_plant(tmp_path, free_endpoint()) as program:
        until(healthy, "healthy")
        program.process.send_signal(signal.SIGSTOP)
        until(lambda: not healthy(), "unhealthy", every_s=0.2)
        program.process.send_signal(signal.SIGCONT)
        until(healthy, "healthy again")
    monkeypatch.setenv("BAYESRACE_HEARTBEAT", str(tmp_path / "none" / "heartbeat"))
    refused = run("plant", "--endpoint", free_endpoint())
    assert refused.returncode == 2
    assert "name a file that can be written" in refused.stderr


@systemd
@pytest.mark.parametrize("name", ["bayesrace@", "bayesrace-firewall@"])
def test_the_units_are_valid_and_hardened(tmp_path: Path, name: str) -> None:
    unit, text = tmp_path / f"{name}plant.service", (UNIT.parent / f"{name}.service").read_text()
    for program in ("/opt/bayesrace/bin/bayesrace", "/usr/sbin/nft"):
        text = text.replace(program, "/bin/true")
    unit.write_text(text)
    verified = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True)
    assert (verified.returncode, verified.stderr) == (0, "")
    judged = ["systemd-analyze", "security", "--offline=yes", f"--threshold={WORST}", str(unit)]
    assert subprocess.run(judged, capture_output=True).returncode == 0
    if name == "bayesrace@":
        assert int(text.partition("LimitNOFILE=")[2].split()[0]) > LINKS


def test_the_unit_installs_a_file_and_nothing_by_its_name() -> None:
    """Whoever takes the project's name in an index would have the board."""
    installed = re.findall(r"pip install (.*)", UNIT.read_text())
    assert installed
    assert all(one.startswith("--require-hashes ") for one in installed)


def confined() -> tuple[str, ...]:
    """A command that runs another one with the system calls of the unit alone."""
    try:
        ctypes.CDLL(LIBRARY)
    except OSError:
        pytest.skip(f"needs {LIBRARY}")
    listed = subprocess.run(
        ["systemd-analyze", "syscall-filter"], capture_output=True, text=True, check=True
    )
    groups: dict[str, list[str]] = {}
    for line in listed.stdout.splitlines():
        word = line.strip()
        if line.startswith("@"):
            members = groups.setdefault(word, [])
        elif word and not word.startswith("#"):
            members.append(word)

    def calls(name: str) -> set[str]:
        return {name}.union(*map(calls, groups.get(name, ())))

    allowed: set[str] = set()
    for denied, names in re.findall(r"^SystemCallFilter=(~?)(.*)", UNIT.read_text(), re.MULTILINE):
        some: set[str] = set().union(*map(calls, names.split()))
        allowed = allowed - some if denied else allowed | some
    return (sys.executable, "-m", "tests.containers.confined", *sorted(allowed), "--")


@systemd
def test_the_unit_allows_what_real_time_needs_and_refuses_the_rest() -> None:
    """What the system refuses to a process is the same with the filter and without it."""
    processor = min(os.sched_getaffinity(0))
    asks = (
        "from bayesrace.realtime import RealtimeSettings, prepare_thread\n"
        f"print(prepare_thread(RealtimeSettings(cpu={processor}, fifo=5, lock_memory=True)))\n"
        "import os\nos.chown('.', -1, -1)"
    )
    free, service = (
        subprocess.run(
            [*prefix, sys.executable, "-c", asks], cwd=ROOT, capture_output=True, text=True
        )
        for prefix in ((), confined())
    )
    assert service.stdout == free.stdout != ""
    assert "PermissionError" in service.stderr
    assert "PermissionError" not in free.stderr


@systemd
@pytest.mark.wall_clock
def test_a_lap_is_driven_with_the_system_calls_of_the_unit(
    tmp_path: Path, bundles: Bundles, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From compiling the car to the end of the processes, linked by TLS."""
    prefix, course = confined(), gentle_course(tmp_path)
    monkeypatch.setenv("BAYESRACE_CACHE", str(tmp_path / "cache"))  # the plant compiles its car
    given = ("--config", written(tmp_path, bundles, free_endpoint("tls"), free_endpoint("tls")))
    drives = ("controller", *course.arguments, *given)
    with (
        Program(tmp_path / "plant", "plant", *given, prefix=prefix) as plant,
        Program(tmp_path / "controller", *drives, prefix=prefix) as controller,
    ):
        lap = ("drive", "--track", course.track_file, "--laps", "1", "--mode", "realtime")
        driven = run(*lap, "--log", tmp_path / "run.mcap", *given)
        assert driven.returncode == 0, driven.stderr + plant.said() + controller.said()
        plant.end()
        controller.end()
