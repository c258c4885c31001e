"""The compose files are accepted by Podman's reader, and the unit of a bare board by systemd; both
harden every service."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

import pytest
import yaml

from bayesrace.configuration import read_configuration
from tests.programs import ROOT

pytestmark = pytest.mark.check

DOCKER: Final = ROOT / "docker"
BASE: Final = "python@sha256:0"
WORST: Final = 50
"""Exposure that systemd would call medium, in tenths."""


def config(*files: str, base: str = BASE) -> subprocess.CompletedProcess[str]:
    """What Podman makes of the files."""
    if shutil.which("podman") is None:
        pytest.skip("needs podman, see .ci/tools")
    command = Path(sys.executable).with_name("podman-compose")
    given = [word for file in files for word in ("-f", str(DOCKER / file))]
    environment = {**os.environ, "BAYESRACE_BASE": base}
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
    assert set(found) == {"prepare", "plant", "controller", "race"}
    for name, service in found.items():
        assert service["read_only"], name
        assert service["cap_drop"] == ["ALL"]
        assert set(service.get("cap_add", ())) <= {"SYS_NICE", "IPC_LOCK"}
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert "ports" not in service
    for name in ("plant", "controller"):
        assert "bayesrace status" in found[name]["healthcheck"]["test"]
        assert found[name]["restart"] == "unless-stopped"


def test_certificates_take_the_place_of_plain_links_everywhere() -> None:
    """Each container holds the certificate of its role, and nobody the authority."""
    found = services("compose.yaml", "compose.tls.yaml")
    for name, role in (("plant", "plant"), ("controller", "controller"), ("race", "director")):
        volumes = found[name]["volumes"]
        assert any("secured.toml:/etc/bayesrace.toml:ro" in one for one in volumes)
        assert not any("plain.toml" in one for one in volumes)
        held = {one.split(":")[1] for one in volumes if "/certs/" in one}
        assert held - {"/certs/viewer"} == {f"/certs/{role}"}
        assert "tcp/" not in str(found[name])


def test_the_base_image_has_to_be_named() -> None:
    refused = config("compose.yaml", base="")
    assert refused.returncode != 0
    assert "name the base image by its digest" in refused.stderr


def test_the_configurations_of_the_containers_are_valid() -> None:
    plain, secured = (read_configuration(DOCKER / f"{one}.toml") for one in ("plain", "secured"))
    assert plain.network.insecure
    assert not secured.network.insecure
    assert secured.tls.folder == Path("/certs")


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_the_unit_is_valid_and_hardened(tmp_path: Path) -> None:
    unit = tmp_path / "bayesrace@plant.service"
    text = (ROOT / "examples" / "systemd" / "bayesrace@.service").read_text()
    unit.write_text(text.replace("/opt/bayesrace/bin/bayesrace", "/bin/true"))
    verified = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True)
    assert (verified.returncode, verified.stderr) == (0, "")
    judged = ["systemd-analyze", "security", "--offline=yes", f"--threshold={WORST}", str(unit)]
    assert subprocess.run(judged, capture_output=True).returncode == 0
