"""Access control of secured links, generated from the table of messages.

Every node checks what comes from the other end of a link, and what goes there, by the name in the
other end's certificate. What the table does not allow to that name's role and car is dropped; a
name that is not in the list of members may do nothing.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator
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
    Source,
)
from bayesrace.transport.credentials import Members

__all__ = ["access_control"]

_ANY: Final = "bayesrace/**"
"""What goes to a process is declared to it first. A declaration alone holds no data, and has the
widest key that a process of ours uses."""

_MEANS: Final[dict[str, tuple[tuple[str, str, str], ...]]] = {
    "sends": (("ingress", "put", ""), ("egress", "declare_subscriber", _ANY)),
    "receives": (("ingress", "declare_subscriber", ""), ("egress", "put", "")),
    "subscribes": (("ingress", "declare_subscriber", ""),),
    "asks": (
        ("ingress", "query", ""), ("egress", "reply", ""), ("egress", "declare_queryable", ""),
    ),
    "answers": (
        ("egress", "query", ""), ("ingress", "reply", ""), ("ingress", "declare_queryable", ""),
    ),
    "is seen": (("ingress", "liveliness_token", ""),),
    "sees": (("egress", "liveliness_token", ""),),
    "looks for": (
        ("ingress", "liveliness_query", ""), ("egress", "liveliness_query", _ANY),
        ("ingress", "declare_liveliness_subscriber", ""),
        ("egress", "declare_liveliness_subscriber", _ANY),
    ),
}  # fmt: skip
"""For each right of the process at the other end, the messages that its link may carry: direction
as seen by the node that checks ("ingress": from the other end), kind of message, and key; an empty
key is that of the topic, service or token."""


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


def _rules(subject: str, role: Role, car: str) -> list[dict[str, Any]]:
    """One rule for each direction and kind of message that such a process may exchange."""
    keys: dict[tuple[str, str], set[str]] = defaultdict(set)
    for right, key in _rights(role):
        for flow, kind, other in _MEANS[right]:
            keys[flow, kind].add(other or key.format(car=car, source="*"))
    if role == "router":  # forwards everything
        kinds = {kind for means in _MEANS.values() for _, kind, _ in means} | {"delete"}
        keys = {(flow, kind): {_ANY} for flow in ("ingress", "egress") for kind in kinds}
    return [
        {
            "id": f"{subject}-{kind}-{flow}", "permission": "allow", "flows": [flow],
            "messages": [kind], "key_exprs": sorted(some),
        }
        for (flow, kind), some in sorted(keys.items())
    ]  # fmt: skip


def _rights(role: Role) -> Iterator[tuple[str, str]]:
    """What a process of this role may do, and the key for any car."""

    def own(key: str, sources: Iterable[Source]) -> Iterator[str]:
        return (key.replace("{source}", one) for one in sources if ROLE_OF[one] == role)

    for topic in TOPICS:
        yield from (("sends", key) for key in own(topic.key, topic.sources))
        if role in topic.readers:
            yield "receives", topic.key
    if role in RECORDERS:  # they receive of it what they may read
        yield "subscribes", EVERYTHING
    for service in SERVICES:
        yield from (("answers", key) for key in own(service.key, service.servers))
        if role in service.clients:
            yield from (("asks", service.key.replace("{source}", s)) for s in service.servers)
    # Who is there is no secret among members; only that process may say so of itself.
    yield from (("is seen", key) for key in own(ALIVE, ALIVE_SOURCES))
    yield from (("sees", ALIVE.replace("{source}", one)) for one in ALIVE_SOURCES)
    yield "looks for", ALIVE
