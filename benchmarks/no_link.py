"""How soon each command says why there is no link, from its start to the line.

    python -m benchmarks.no_link
    python -m benchmarks.no_link --commands learn publish --rounds 5

Prints time and CPU time. On a machine with other work the CPU time is the fairer measure of a
command: waiting for a CPU is not in it. Neither is waiting for the network, for 1 s at most.
"""

import argparse
import json
import os
import select
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Final

from bayesrace.raceline.cached import racing_line
from bayesrace.raceline.line import write_raceline
from bayesrace.tracks import load_track
from bayesrace.transport import Credentials, Endpoints, free_endpoint, open_session
from bayesrace.transport.credentials import MEMBERS
from bayesrace.vehicles import get_car
from codegen.build import build
from codegen.settings import BuildSettings
from tests.programs import COMMAND, ROOT, environment
from tests.security.authority import Bundles, make_bundles, written
from tests.security.intruder import listening

ROLES: Final = {
    "controller": "controller", "status": "viewer", "stop": "director", "go": "director",
    "drive": "director", "latency": "director", "publish": "learning", "rollback": "learning",
    "learn": "learning", "doctor": "director",
}  # fmt: skip
"""Command to the role of its certificate."""
TICK_S: Final = 1 / os.sysconf("SC_CLK_TCK")
PATIENCE_S: Final = 60.0

There = Callable[[Bundles, str, str], AbstractContextManager[object]]
"""What listens at an endpoint, to which a command comes with the certificate of that name."""


@contextmanager
def nobody(_bundles: Bundles, _where: str, _name: str) -> Iterator[None]:
    """Nothing listens."""
    yield


@contextmanager
def silent(_bundles: Bundles, where: str, _name: str) -> Iterator[None]:
    """The queue of connections is full, so that a further one is not answered."""
    host, _, port = where.partition("/")[2].rpartition(":")
    with ExitStack() as stack:
        listener = stack.enter_context(socket.socket())
        listener.bind((host, int(port)))
        listener.listen(0)
        stack.enter_context(socket.create_connection((host, int(port))))
        yield


@contextmanager
def older(bundles: Bundles, where: str, name: str) -> Iterator[None]:
    """A plant in whose list the certificate is not."""
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(bundles.path("plant"), folder, dirs_exist_ok=True)
        content = json.loads((Path(folder) / MEMBERS).read_text())
        del content["members"][name]
        (Path(folder) / MEMBERS).write_text(json.dumps(content))
        ends = Endpoints(listen=(where,), credentials=Credentials.read(Path(folder)))
        with open_session(ends, "plant"):
            yield


def certified(bearer: str) -> There:
    """Something that listens with that certificate."""
    return lambda bundles, where, _: listening(where, bundles.path(bearer))


CAUSES: Final[dict[str, tuple[str, str, There]]] = {
    "nobody there": ("127.0.0.1", "nobody listens", nobody),
    "no answer": ("127.0.0.1", "does not answer", silent),
    "wrong CA": ("127.0.0.1", "another authority", certified("foreign-plant")),
    "expired": ("127.0.0.1", "has expired", certified("expired")),
    "other name": ("127.0.0.2", "for other hosts", certified("plant")),
    "not in the list": ("127.0.0.1", "in its list", older),
}
"""Host, words that say it, and what is there."""


def arguments(folder: Path) -> dict[str, list[str]]:
    """What each command needs besides."""
    car = get_car("orca")
    track, weights, line = load_track("paddock", car.width_m), folder / "w.bin", folder / "line.csv"
    write_raceline(line, racing_line(track, car))
    weights.write_bytes(b"")
    artefact = str(build(BuildSettings(car=car))[0])
    drives = ["--artefact", artefact, "--track", "paddock", "--raceline", str(line)]
    return {"controller": drives, "publish": [str(weights)], "latency": ["--attach"]}


def measure(line: list[str], words: str) -> tuple[float, float]:
    """Time and CPU time from the start to the line with these words."""
    begin, said = time.monotonic(), ""
    process = subprocess.Popen(
        line, cwd=ROOT, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    assert process.stdout is not None
    os.set_blocking(process.stdout.fileno(), False)
    try:
        while words not in said:
            if not select.select([process.stdout], [], [], PATIENCE_S)[0]:
                raise SystemExit(f"{line} does not say '{words}' but: {said}")
            chunk = process.stdout.read()
            if not chunk:
                raise SystemExit(f"{line} does not say '{words}' but: {said}")
            said += chunk.decode()
        took_s = time.monotonic() - begin
        fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
        return took_s, (int(fields[11]) + int(fields[12])) * TICK_S
    finally:
        process.kill()
        process.wait()


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--commands", nargs="*", default=[*ROLES], choices=[*ROLES])
    parser.add_argument("--causes", nargs="*", default=[*CAUSES], choices=[*CAUSES])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bundles = Bundles(folder / "certs")
        bundles.folder.mkdir()
        make_bundles(bundles.folder)
        further = arguments(folder)
        for cause in options.causes:
            host, words, there = CAUSES[cause]
            for command in options.commands:
                found = []
                for _ in range(options.rounds):
                    where = free_endpoint("tls").replace("127.0.0.1", host)
                    config = written(folder, bundles, where, free_endpoint("tls"))
                    line = [*COMMAND, command, *further.get(command, []), "--config", str(config)]
                    with there(bundles, where, ROLES[command]):
                        found.append(measure(line, words))
                times, cpu = zip(*found, strict=True)
                print(
                    f"{cause:16} {command:11} {min(times):.2f} to {max(times):.2f} s, "
                    f"CPU {min(cpu):.2f} to {max(cpu):.2f} s"
                )


if __name__ == "__main__":
    main()
