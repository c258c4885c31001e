"""Every exported FMU names the parts of other authors in it, with their licences."""

import zipfile
from pathlib import Path

import pytest

from bayesrace.codegen.fmu import car_fmu
from bayesrace.codegen.fmu.archive import licence_files, third_parties
from bayesrace.codegen.fmu.build import get_platform
from bayesrace.vehicles import get_car
from tests.car_fmu import Kind, Version, packed_car
from tests.fmu_lockstep import Exported, exported_controllers  # noqa: F401 - a fixture

NOTICES = (Path(__file__).parents[1] / "THIRD_PARTY_NOTICES.md").read_text()

FMI = ("FMI headers", "BSD-2-Clause", "Modelica Association Project")
CASADI = ("CasADi runtime", "MIT-0", "Joel Andersson, Joris Gillis, Moritz Diehl")
DAQP = ("DAQP", "MIT", "Daniel Arnström")
ZIG = ("Zig compiler runtime", "MIT", "Zig contributors")
MINGW = ("MinGW-w64 runtime", "ZPL-2.1", "the mingw-w64 project")


def named(read: dict[str, str], *parts: tuple[str, str, str]) -> None:
    """Page, licence file and repository name these parts, and there is a text of each."""
    folder = "documentation/licenses/"
    entry, page = read[f"{folder}license.txt"], read["documentation/index.html"]
    assert "BayesRace contributors" in entry
    for name, licence, holder in parts:
        line = f"{name} ("
        assert line in entry
        assert line in page
        assert f"), {licence}" in entry[entry.index(line) :]
        assert holder in read[f"{folder}{name.replace(' ', '-')}.txt"]
        assert f"| {name} |" in NOTICES
        assert holder in NOTICES
    assert sum(path.startswith(folder) for path in read) == len(parts) + 1


def documentation(fmu: Path) -> dict[str, str]:
    with zipfile.ZipFile(fmu) as archive:
        names = [name for name in archive.namelist() if name.startswith("documentation/")]
        return {name: archive.read(name).decode() for name in names}


@pytest.mark.parametrize(("version", "kind"), [(2, "cs"), (3, "cs"), (3, "me")])
def test_the_car_names_fmi_and_casadi(version: Version, kind: Kind) -> None:
    fmu = packed_car(version, kind)
    named(documentation(fmu), FMI, CASADI)
    with zipfile.ZipFile(fmu) as archive:  # nothing else is by others
        sources = {name for name in archive.namelist() if name.startswith("sources/")}
        assert all(
            b"Copyright" not in archive.read(name) or name.startswith(f"sources/fmi{version}")
            for name in sources
        )


@pytest.mark.parametrize("version", [2, 3])
def test_the_controller_names_daqp_as_well(exported: Exported, version: Version) -> None:
    named(documentation(exported.fmu(version)), FMI, CASADI, DAQP)


def test_cross_compiled_binaries_name_what_ziglang_links(ziglang: None) -> None:
    windows = get_platform("x86_64-windows")
    parts = third_parties(car_fmu(get_car("orca")), [windows])
    files = {name: content.decode() for name, content in licence_files(parts).items()}
    named(files | {"documentation/index.html": "".join(map(str, parts))}, FMI, CASADI, ZIG, MINGW)
