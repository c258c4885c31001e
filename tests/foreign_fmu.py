"""An FMU that another tool made, with names, units and signs of its own, and the map for it."""

import subprocess
import sys
from pathlib import Path
from typing import Final

__all__ = ["FOREIGN_MAP", "build_foreign_fmu"]

FOREIGN_MAP: Final = """\
[fmu]
derived = ["delta"]

[inputs]
PedalPercent = { from = "d", unit = "%" }
SteerAngleCmd = { from = "delta", unit = "deg", sign = -1 }

[outputs]
x = { variable = "posEast", unit = "cm" }
y = { variable = "posNorth", unit = "cm" }
psi = { variable = "compass", unit = "deg", sign = -1, offset = 1.5707963267948966 }
omega = { variable = "turnRate", unit = "deg/s", sign = -1 }

world_vx = { variable = "velEast", unit = "km/h" }
world_vy = { variable = "velNorth", unit = "km/h" }

[start]
startEast = { from = "x", unit = "cm" }
startNorth = { from = "y", unit = "cm" }
startCompass = { from = "psi", unit = "deg", sign = -1, offset = 90 }
startSpeed = { from = "vx", unit = "km/h" }
"""


def build_foreign_fmu(folder: Path) -> Path:
    """Has `pythonfmu` make the FMU (FMI 2.0, Co-Simulation) in ``folder``."""
    script = Path(__file__).with_name("foreign_vehicle.py")
    command = [sys.executable, "-m", "pythonfmu", "build", "-f", str(script), "-d", str(folder)]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    return folder / "ForeignCar.fmu"
