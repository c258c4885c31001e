"""Access control of secured links, generated from the table of messages.

Every node checks what comes from the other end of a link, and what goes there, by the name in the
other end's certificate. What the table does not allow to that name's role and car is dropped; a
name that is not in the list of members may do nothing.
"""

from collections import defaultdict
from collections.abc import Iterator
from typing import Any, Final

from bayesrace.messages import (
    ALIVE,
    ALIVE_SOURCES,
    EVERYTHING,
    RECORDERS,
    ROLE_OF,
    SERVICES,
    TOPICS,
    Role,
)
from bayesrace.transport.credentials import Members

__all__ = ["access_control"]

_Right = tuple[str, str, str]
"""Direction as seen by the node that checks ("ingress": from the other end), kind, key."""

_EVERY_KIND: Final = (
    "put", "delete", "declare_subscriber", "query", "reply", "declare_queryable",
    "liveliness_token", "liveliness_query", "declare_liveliness_subscriber",
)  # fmt: skip
_ANY: Final = "bayesrace/**"


def access_control(members: Members) -> dict[str, Any]:
    """Zenoh's setting ``access_control``: deny by default, in both directions."""
    names: dict[tuple[Role, str], list[str]] = defaultdict(list)
    for name, member in members.members.items():
        names[member.role, member.car].append(name)
    rules: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for number, ((role, car), bearers) in enumerate(sorted(names.items())):
        subject = f"{role}-{number}"
        granted = _rules(subject, role, car)
        rules += granted
        subjects.append({"id": subject, "cert_common_names": sorted(bearers)})
        policies.append({"rules": [rule["id"] for rule in granted], "subjects": [subject]})
    return {
        "enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects,
        "policies": policies,
    }  # fmt: skip


_FLOWS: Final = ("ingress", "egress")


def _rules(subject: str, role: Role, car: str) -> list[dict[str, Any]]:
    """One rule for each direction and kind of message that such a process may exchange."""
    keys: dict[tuple[str, str], set[str]] = defaultdict(set)
    for flow, kind, key in _rights(role):
        keys[flow, kind].add(key.format(car=car, source="*"))
    return [
        {
            "id": f"{subject}-{kind}-{flow}", "permission": "allow", "flows": [flow],
            "messages": [kind], "key_exprs": sorted(some),
        }
        for (flow, kind), some in sorted(keys.items())
    ]  # fmt: skip


def _rights(role: Role) -> Iterator[_Right]:
    """Everything that a link to a process of this role may carry.

    What goes to it is declared to it first: a declaration alone holds no data, and has the widest
    key that a process of ours uses.
    """
    if role == "router":
        yield from ((flow, kind, _ANY) for flow in _FLOWS for kind in _EVERY_KIND)
        return
    yield from _topic_rights(role)
    yield from _service_rights(role)
    yield from _liveliness_rights(role)


def _topic_rights(role: Role) -> Iterator[_Right]:
    for topic in TOPICS:
        for source in topic.sources:
            if ROLE_OF[source] == role:
                yield "ingress", "put", _from(topic.key, source)
                yield "egress", "declare_subscriber", _ANY
        if role in topic.readers:
            yield "ingress", "declare_subscriber", topic.key
            yield "egress", "put", topic.key
    if role in RECORDERS:
        yield "ingress", "declare_subscriber", EVERYTHING


def _service_rights(role: Role) -> Iterator[_Right]:
    for service in SERVICES:
        for source in service.servers:
            key = _from(service.key, source)
            if role in service.clients:
                yield "ingress", "query", key
                yield "egress", "reply", key
                yield "egress", "declare_queryable", key
            if ROLE_OF[source] == role:
                yield "egress", "query", key
                yield "ingress", "reply", key
                yield "ingress", "declare_queryable", key


def _liveliness_rights(role: Role) -> Iterator[_Right]:
    """Who is there is no secret among members; only he may say so of himself."""
    for source in ALIVE_SOURCES:
        if ROLE_OF[source] == role:
            yield "ingress", "liveliness_token", _from(ALIVE, source)
        yield "egress", "liveliness_token", _from(ALIVE, source)
    for kind in ("liveliness_query", "declare_liveliness_subscriber"):
        yield "ingress", kind, ALIVE
        yield "egress", kind, _ANY


def _from(key: str, source: str) -> str:
    """The key of one source, still for any car."""
    return key.replace("{source}", source)
