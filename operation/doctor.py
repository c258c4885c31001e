"""Why the processes of a system do not meet: configuration, certificates, endpoints, access, cars.

Everything is tried as a process of this machine would try it, and each fault has its remedy.
"""

from collections.abc import Iterator
from typing import Final, NamedTuple

from bayesrace.configuration import Configuration
from bayesrace.errors import InputError
from bayesrace.messages import Role
from bayesrace.transport import Credentials, Endpoints, open_session
from bayesrace.transport.credentials import NEWEST_LIST
from bayesrace.transport.probe import probe_all
from operation.analysis.network_status import SOURCES
from operation.lifecycle import find

__all__ = ["Check", "examine"]

_CARS_S: Final = 1.0
_ROLES: Final[tuple[Role, ...]] = (
    "director", "learning", "viewer", "controller", "plant", "router"
)  # fmt: skip
"""In the order in which a certificate of this machine is tried."""


class Check(NamedTuple):
    """Something that was tried."""

    fine: bool
    text: str
    """What was found; of a fault, with its remedy."""


def examine(configuration: Configuration) -> Iterator[Check]:
    """Tries one thing after the other; ends where the rest would only repeat a fault."""
    try:
        certificates = configuration.tls.certificates()
    except InputError as error:
        yield Check(False, str(error))
        return
    yield from map(_certificate, certificates)
    if configuration.tls.folder is None:
        yield Check(True, "no certificates: links are for loopback, or open to everyone")
    elif not certificates:
        yield Check(False, f"no certificates in {configuration.tls.folder}: 'bayesrace certs add'")
        return
    own = _chosen(certificates)
    if certificates and own is None:
        return
    endpoints = _everyone(configuration, own)
    try:
        endpoints.check()
    except InputError as error:
        yield Check(False, str(error))
        return
    faults = probe_all(endpoints.connect, own)
    for endpoint in endpoints.connect:
        yield Check(endpoint not in faults, faults.get(endpoint, f"{endpoint} answers"))
    there = tuple(one for one in endpoints.connect if one not in faults)
    if there:
        yield from _cars(endpoints.model_copy(update={"connect": there}), own)


def _certificate(one: Credentials) -> Check:
    if one.member is None:
        how = "revoked" if one.name in one.members.revoked else "not in its own members.json"
        return Check(False, f"certificate '{one.name}' is {how}: make another one, or remove it")
    if warning := one.expires_soon():
        return Check(False, warning)
    car = "every car" if not one.car else f"car '{one.car}'"
    return Check(True, f"certificate '{one.name}': {one.member.role}, {car}")


def _chosen(certificates: list[Credentials]) -> Credentials | None:
    """The one to try the links with: that which may do most."""
    by_role = {one.member.role: one for one in certificates if one.member is not None}
    return next((by_role[role] for role in _ROLES if role in by_role), None)


def _everyone(configuration: Configuration, own: Credentials | None) -> Endpoints:
    network = configuration.network
    return Endpoints(
        connect=network.everyone,
        credentials=own,
        insecure=network.insecure,
        limits=configuration.limits,
        zenoh=configuration.zenoh,
    )


def _cars(endpoints: Endpoints, own: Credentials | None) -> Iterator[Check]:
    """Whether the other ends let this machine's certificate in, and which cars there are."""
    role: Role = "viewer" if own is None or own.member is None else own.member.role
    try:
        with open_session(endpoints, role) as session:
            cars = find(session, endpoints, _CARS_S, endpoints.car_named(""))
    except InputError as error:
        yield Check(False, str(error))
        return
    remedy = "start it, or correct its endpoints"
    if own is not None:
        remedy += f"; if it runs, {NEWEST_LIST}"
    for car, present in sorted(cars.items()):
        missing = [source for source in SOURCES if source not in present]
        text = f"car '{car}': {' and '.join(sorted(present))}"
        absent = f"; no {' and no '.join(missing)}: {remedy}"
        yield Check(not missing, text + (absent if missing else ""))
