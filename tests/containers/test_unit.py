"""The service of a bare board is accepted by systemd, and is as hardened as it says."""

import shutil
import subprocess
from pathlib import Path

import pytest

from tests.programs import ROOT

pytestmark = [
    pytest.mark.check,
    pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze"),
]

WORST: int = 50
"""Exposure that systemd would call medium, in tenths."""


def test_the_unit_is_valid_and_hardened(tmp_path: Path) -> None:
    unit = tmp_path / "bayesrace@plant.service"
    text = (ROOT / "examples" / "systemd" / "bayesrace@.service").read_text()
    unit.write_text(text.replace("/opt/bayesrace/bin/bayesrace", "/bin/true"))
    verified = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True)
    assert (verified.returncode, verified.stderr) == (0, "")
    judged = ["systemd-analyze", "security", "--offline=yes", f"--threshold={WORST}", str(unit)]
    assert subprocess.run(judged, capture_output=True).returncode == 0
