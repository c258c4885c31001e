"""What the other end of a link lets a certificate do.

Access control drops what it refuses without a word to the sender. So each secured node answers one
question to whoever has a certificate of the authority: what does it let that name do?
"""

from collections.abc import Iterable, Iterator
from typing import Any, Final, NamedTuple

import zenoh
from pydantic import BaseModel, ValidationError

from bayesrace.transport.access import ACCESS
from bayesrace.transport.credentials import Credentials, Member
from bayesrace.transport.requests import in_transport_thread

__all__ = ["Refusal", "refusals", "serve_access"]

_ANSWER_S: Final = 0.5


class Refusal(NamedTuple):
    """What another end refuses to a certificate."""

    text: str
    """Why, and the remedy."""
    revoked: bool
    """The certificate never counts again."""


class _Access(BaseModel):
    """What a node says of a name."""

    node: str
    member: Member | None
    revoked: bool


def serve_access(session: Any, credentials: Credentials) -> Any:
    """Answers what a name may do here; keep what is returned."""
    members = credentials.members

    def on_query(query: Any) -> None:
        name = str(query.parameters.get("name") or "")
        answer = _Access(
            node=credentials.name, member=members.members.get(name),
            revoked=name in members.revoked,
        )  # fmt: skip
        query.reply(query.key_expr, answer.model_dump_json())

    key = ACCESS.format(node=session.info.zid())
    return session.declare_queryable(key, in_transport_thread(on_query))


def refusals(session: Any, credentials: Credentials, nodes: Iterable[str]) -> list[Refusal]:
    """What these nodes refuse to this session's certificate; all are asked at once."""
    asked = [
        session.get(
            f"{ACCESS.format(node=node)}?name={credentials.name}", timeout=_ANSWER_S,
            target=zenoh.QueryTarget.ALL, consolidation=zenoh.ConsolidationMode.NONE,
        )
        for node in nodes
    ]  # fmt: skip
    found = (_refusal(list(_answers(replies)), credentials) for replies in asked)
    return [refusal for refusal in found if refusal is not None]


def _answers(replies: Any) -> Iterator[_Access]:
    for reply in replies:
        if reply.ok is not None:
            try:
                yield _Access.model_validate_json(reply.ok.payload.to_bytes())
            except ValidationError:
                continue


def _refusal(answers: list[_Access], credentials: Credentials) -> Refusal | None:
    """None without an answer, too: it may have just gone; that it refuses us it would have said.

    Any member could answer for a node. So one answer that allows counts more than others.
    """
    if not answers or any(one.member == credentials.member for one in answers):
        return None
    known = answers[0]
    who = f"'{known.node[:60]}'"
    newest = "copy the newest members.json of 'bayesrace certs' to it and restart it"
    if known.member is not None:
        why = f"as {known.member.role} of car '{known.member.car}', not as its own list says"
        return Refusal(f"{who} knows certificate '{credentials.name}' {why}: {newest}", False)
    if known.revoked:
        another = "make another one with 'bayesrace certs add'"
        text = f"{who} refuses certificate '{credentials.name}', which is revoked: {another}"
        return Refusal(text, True)
    text = f"{who} has no certificate '{credentials.name}' in its list of members: {newest}"
    return Refusal(text, False)
