"""What the table allows to a role gets through, and nothing else: every role, key and operation,
tried by programs that forge messages and have no access control of their own."""

import json
import subprocess
import sys
from functools import partial
from typing import Any, Final, NamedTuple

import pytest

from bayesrace.messages import SERVICES, TOPICS
from bayesrace.transport import Members, free_endpoint, open_session
from bayesrace.transport import session as session_module
from bayesrace.transport.session import access_control
from tests.programs import ROOT
from tests.security.authority import CAR, OTHER, Bundles, bundles
from tests.security.intruder import ALIVE_KEYS, FORGED, KEYS, SERVICE_KEYS, TOPIC_KEYS

__all__ = ["bundles"]

ALL_TOPICS: Final = (
    "state truth actuation braking telemetry event/* status/* shadow/*/actuation shadow/*/telemetry"
)


class Rights(NamedTuple):
    """Keys behind the car's name, as docs/security.md has them; ``*``: of any source."""

    sends: str = ""
    receives: str = ""
    asks: str = ""
    answers: str = ""
    is_seen: str = ""


RIGHTS: Final[dict[str, Rights]] = {
    "plant": Rights(
        "state truth event/plant status/plant", "actuation braking hold", "*/status",
        "plant/run plant/stop plant/go_on plant/status", "alive/plant/*",
    ),
    "controller": Rights(
        "actuation braking telemetry event/controller status/controller", "state hold", "",
        "controller/status controller/weights controller/rollback controller/command",
        "alive/controller/*",
    ),
    "shadow": Rights("shadow/*/actuation shadow/*/telemetry", "state actuation"),
    "learning": Rights(
        "", "state actuation braking telemetry event/* status/*",
        "*/status controller/weights controller/rollback",
    ),
    "director": Rights(
        "event/race event/recorder hold", ALL_TOPICS,
        "*/status plant/run plant/stop plant/go_on controller/weights controller/rollback "
        "controller/command",
        "", "alive/director/*",
    ),
    "viewer": Rights("", ALL_TOPICS, "*/status"),
    "nobody": Rights(),
}  # fmt: skip
"""Written out, not generated: what is generated is under test."""


def expand(rights: str, cars: tuple[str, ...], among: tuple[str, ...]) -> set[str]:
    wanted = [f"bayesrace/{car}/{one}".split("/") for car in cars for one in rights.split()]
    return {
        key
        for key in among
        for parts in wanted
        if len(parts) == len(key.split("/"))
        and all(want in ("*", have) for want, have in zip(parts, key.split("/"), strict=True))
    }


class Witness:
    """A plant's session that notes everything that comes over its links."""

    def __init__(self, session: Any) -> None:
        self._session = session
        self.puts: set[str] = set()
        self.deletes: set[str] = set()
        self.asked: set[str] = set()
        self.tokens: set[str] = set()
        self.seen: set[str] = set()
        self._keep = [
            session.declare_subscriber("bayesrace/**", self._note),
            session.liveliness().declare_subscriber("bayesrace/**", self._token),
            *(session.declare_queryable(key, self._answer) for key in KEYS),
        ]

    def _note(self, sample: Any) -> None:
        if sample.payload.to_bytes() == FORGED:
            self.puts.add(str(sample.key_expr))
        elif str(sample.kind) == "SampleKind.DELETE":
            self.deletes.add(str(sample.key_expr))

    def _token(self, sample: Any) -> None:
        self.tokens.add(str(sample.key_expr))

    def _answer(self, query: Any) -> None:
        if query.payload is not None and query.payload.to_bytes() == FORGED:
            self.asked.add(str(query.key_expr))
            query.reply(query.key_expr, b"answer")

    def speak(self) -> set[str]:
        """Is present, sends on every key, and asks everybody; the keys that a forger answers."""
        self.seen = set(self.tokens)
        self._keep += [self._session.liveliness().declare_token(key) for key in ALIVE_KEYS]
        for key in KEYS:
            self._session.put(key, b"true")
        pending = {key: self._session.get(key, payload=b"true", timeout=0.5) for key in KEYS}
        return {
            key
            for key, replies in pending.items()
            if any(one.ok is not None and one.ok.payload.to_bytes() == FORGED for one in replies)
        }

    def close(self) -> None:
        for one in self._keep:
            one.undeclare()


def tried(endpoint: str, folder: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "tests.security.intruder", endpoint, folder]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=ROOT, stdin=pipe, stdout=pipe, text=True)


EVERY = (CAR, OTHER)
MEMBERS: Final = (
    ("plant", "plant", (CAR,)),
    ("controller", "controller", (CAR,)),
    (f"{OTHER}-controller", "controller", (OTHER,)),
    ("shadow", "shadow", (CAR,)),
    ("learning", "learning", EVERY),
    ("director", "director", EVERY),
    ("viewer", "viewer", EVERY),
    ("one-viewer", "viewer", (CAR,)),
    ("revoked", "nobody", EVERY),
)


INGRESS: Final = ("sends", "deletes", "asks", "answers", "is seen")
EGRESS: Final = ("receives", "is answered")


@pytest.mark.wall_clock
@pytest.mark.parametrize(
    ("opened", "operations"),
    [
        ("", (*INGRESS, *EGRESS, "sees")),
        pytest.param("egress", INGRESS, marks=pytest.mark.check),
        pytest.param("ingress", EGRESS, marks=pytest.mark.check),
    ],
    ids=["both", "ingress", "egress"],
)
@pytest.mark.parametrize(("name", "role", "cars"), MEMBERS)
def test_exactly_what_the_table_says_gets_through(
    bundles: Bundles, name: str, role: str, cars: tuple[str, ...], opened: str,
    operations: tuple[str, ...], monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """A forger needs no declaration of the other end, so each direction has to hold alone."""
    if opened:
        monkeypatch.setattr(session_module, "access_control", partial(_opened, flow=opened))
    rights = RIGHTS[role]
    asks = expand(rights.asks, cars, SERVICE_KEYS)
    allowed = {
        "sends": expand(rights.sends, cars, TOPIC_KEYS),
        "deletes": set(),
        "receives": expand(rights.receives, cars, TOPIC_KEYS),
        "asks": asks,
        "is answered": asks,
        "answers": expand(rights.answers, cars, SERVICE_KEYS),
        "is seen": expand(rights.is_seen, cars, ALIVE_KEYS),
        "sees": expand("alive/*/*" if role != "nobody" else "", cars, ALIVE_KEYS),
    }
    got = attempt(bundles, name)
    assert {one: got[one] for one in operations} == {one: allowed[one] for one in operations}


def _opened(members: Members, flow: str) -> dict[str, Any]:
    """Access control that allows everything in that direction."""
    content = access_control(members)
    kinds = sorted({kind for rule in content["rules"] for kind in rule["messages"]})
    rule = {
        "id": "open", "permission": "allow", "flows": [flow], "messages": kinds,
        "key_exprs": ["**"],
    }  # fmt: skip
    content["rules"].append(rule)
    content["subjects"].append({"id": "anyone"})
    content["policies"].append({"rules": ["open"], "subjects": ["anyone"]})
    return content


def attempt(bundles: Bundles, name: str) -> dict[str, set[str]]:
    """What a forger with that certificate gets through to a plant, by operation."""
    where = free_endpoint("tls")
    with open_session(bundles.endpoints("plant", listen=(where,)), "plant") as session:
        witness = Witness(session)
        intruder = tried(where, str(bundles.path(name)))
        assert intruder.stdout is not None
        assert intruder.stdout.readline() == "ready\n"
        answers = witness.speak()
        out, _ = intruder.communicate("go\n", timeout=30)
        witness.close()
    found = json.loads(out)
    return {
        "sends": witness.puts, "deletes": witness.deletes, "receives": set(found["heard"]),
        "asks": witness.asked, "is answered": set(found["answered"]), "answers": answers,
        "is seen": witness.seen, "sees": set(found["present"]),
    }  # fmt: skip


@pytest.mark.wall_clock
@pytest.mark.parametrize("name", ["", "expired", "foreign-controller", "foreign-plant"])
def test_without_a_certificate_that_counts_there_is_no_link(bundles: Bundles, name: str) -> None:
    where = free_endpoint("tls")
    folder = str(bundles.path(name)) if name else ""
    with open_session(bundles.endpoints("plant", listen=(where,)), "plant") as session:
        for endpoint in (where, where.replace("tls", "tcp")):
            intruder = tried(endpoint, folder)
            assert intruder.communicate(timeout=30)[0] == "no link\n"
        assert session.info.links() == []


def test_every_row_of_the_table_has_its_rights() -> None:
    """A new topic or service is in the matrix above, or this says so."""
    granted = " ".join(rights.sends for rights in RIGHTS.values())
    served = " ".join(rights.answers for rights in RIGHTS.values())
    for topic in TOPICS:
        assert topic.key.split("/")[2] in granted, topic.name
    for service in SERVICES:
        assert service.key.split("/")[3] in served, service.name
