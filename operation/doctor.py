"""Why the processes of a system do not meet: configuration, certificates, endpoints, access, cars.

Everything is tried as a process of this machine would try it, and each fault has its remedy. Zenoh
does not say why there is no link, so each endpoint is tried here as Zenoh tries it: a connection,
and a handshake with this machine's certificate.
"""

import itertools
import socket
import time
from collections.abc import Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final, NamedTuple

from bayesrace.configuration import Configuration, NetworkSettings, TlsSettings
from bayesrace.errors import InputError
from bayesrace.messages import STATUS, Role, Status, StatusRequest, car_key
from bayesrace.operation.lifecycle import SOURCES, find
from bayesrace.transport import Credentials, Endpoints, ask_all, open_session
from bayesrace.transport.credentials import (
    CERTIFICATE_EXPIRED,
    CERTIFICATE_NOT_YET,
    NEWEST_LIST,
    calendar,
)
from bayesrace.transport.director import apart
from bayesrace.transport.endpoints import Address, address_of, unreachable
from bayesrace.transport.session import zenoh_config

__all__ = ["Check", "check_configuration", "examine", "probe"]

_CARS_S: Final = 1.0
_ROLES: Final[tuple[Role, ...]] = (
    "director", "learning", "viewer", "controller", "plant", "router", "shadow"
)  # fmt: skip
"""In the order in which a certificate of this machine is tried."""

_CLOCK_S: Final = 3600.0
"""By so much may clocks differ."""

_CONNECT_S: Final = 1.0
_REFUSAL_S: Final = 0.2
"""How long the other end may take to refuse a certificate after the handshake."""

_NO_TLS: Final = (
    "is not encrypted, or is no process of ours: start the one that listens there with a "
    "certificate, too"
)
_OTHER_AUTHORITY: Final = (
    "of another authority than this machine's: both have to come from one 'bayesrace certs init'"
)
_WE_REFUSE: Final = {
    CERTIFICATE_EXPIRED: "has a certificate that has expired: renew it there with 'bayesrace certs "
    "add NAME --renew', or set the clock here, which says {now}",
    CERTIFICATE_NOT_YET: "has a certificate that is not valid yet: set the clock here, which says "
    "{now}, or there",
    **dict.fromkeys(
        (62, 64),
        "has a certificate for other hosts: connect by a name that is in it, or renew it with "
        "'bayesrace certs add NAME --renew --host {host}'",
    ),
}
"""OpenSSL's number of what is wrong with the other end's certificate, to what is said of it."""
_THEY_REFUSE: Final = {
    **dict.fromkeys(
        ("UNKNOWN_CA", "BAD_CERTIFICATE", "DECRYPT_ERROR"),
        f"refuses certificate '{{name}}'; its own is {_OTHER_AUTHORITY}",
    ),
    "EXPIRED": "refuses certificate '{name}' as expired or not valid yet, and by the clock here, "
    "{now}, it is valid until {ends}: set the clock there, or here",
    **dict.fromkeys(("WRONG_VERSION", "EOF"), _NO_TLS),
}
"""Part of OpenSSL's reason for the end of a handshake, to what is said of it."""


class Check(NamedTuple):
    """Something that was tried."""

    fine: bool
    text: str
    """What was found; of a fault, with its remedy."""


def check_configuration(found: Configuration) -> str:
    """What there is of certificates, each of which is read; InputError if the network, or one of
    them, cannot be used."""
    found.network.check()
    folder, there = found.tls.folder, found.tls.certificates()
    if folder is not None and not there:
        raise InputError(
            f"no certificates in {folder}: make them with 'bayesrace certs', or correct "
            "[tls] folder"
        )
    roles = {one.name: "revoked" if one.member is None else one.member.role for one in there}
    for role in _ROLES:
        if folder is None or role in roles.values():
            (ends := found.endpoints(role)).check()
            zenoh_config(ends, role)
    if folder is None:
        reach = "open to everyone in the network" if found.network.insecure else "for loopback only"
        return f"fine; no certificates, so links are {reach}"
    return "fine; certificates " + ", ".join(f"'{name}' ({role})" for name, role in roles.items())


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
    else:
        yield from _director(configuration.tls.folder, certificates)
    own = _chosen(certificates)
    if certificates and own is None:
        return
    plain = configuration.model_copy(update={"tls": TlsSettings()}).endpoints("viewer")
    endpoints = plain.model_copy(update={"credentials": own})
    try:
        endpoints.check()
    except InputError as error:
        yield Check(False, str(error))
        return
    with ThreadPoolExecutor(max(len(endpoints.connect), 1)) as pool:
        found = pool.map(lambda one: probe(one, own), endpoints.connect)
    faults = {one: text for one, text in zip(endpoints.connect, found, strict=True) if text}
    for endpoint in endpoints.connect:
        yield Check(endpoint not in faults, faults.get(endpoint, f"{endpoint} answers"))
    yield from (Check(False, why) for why in filter(None, map(unreachable, faults)))
    there = tuple(one for one in endpoints.connect if one not in faults)
    if there:
        yield from _cars(endpoints.model_copy(update={"connect": there}), own, configuration)


def _certificate(one: Credentials) -> Check:
    if one.member is None:
        how = "revoked" if one.name in one.members.revoked else "not in its own members.json"
        return Check(False, f"certificate '{one.name}' is {how}: make another one, or remove it")
    if warning := one.expires_soon():
        return Check(False, warning)
    car = "every car" if not one.car else f"car '{one.car}'"
    return Check(True, f"certificate '{one.name}': {one.member.role}, {car}")


def _director(folder: Path, certificates: list[Credentials]) -> Iterator[Check]:
    """Says that there is none of a director; on the machine that makes them, that is a fault."""
    if not any(one.member and one.member.role == "director" for one in certificates):
        yield Check(
            not (folder / "authority").is_dir(),
            f"no director's certificate in {folder}: 'bayesrace drive', 'stop' and 'go' need one: "
            "'bayesrace certs add director --role director'",
        )


def _chosen(certificates: list[Credentials]) -> Credentials | None:
    """The one to try the links with: that which may do most."""
    by_role = {one.member.role: one for one in certificates if one.member is not None}
    return next((by_role[role] for role in _ROLES if role in by_role), None)


def _cars(
    endpoints: Endpoints, own: Credentials | None, configuration: Configuration
) -> Iterator[Check]:
    """Whether the other ends let this machine's certificate in, which cars there are, and what
    their processes say of themselves."""
    role: Role = "viewer" if own is None or own.member is None else own.member.role
    try:
        with open_session(endpoints, role, reports_absence=False) as session:
            cars = find(session, endpoints, _CARS_S, endpoints.car_named(""))
            known = {car: _statuses(session, car, present) for car, present in cars.items()}
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
        if role in STATUS.clients:
            for why in _trouble(car, known[car], configuration.network):
                yield Check(False, why)


def _statuses(session: Any, car: str, present: Collection[str]) -> dict[str, list[Status]]:
    """The answers of all processes of a car, by their source."""
    request = StatusRequest(seq=0, source_time_ns=time.monotonic_ns())
    keys = {source: car_key(STATUS.key, car, source) for source in sorted(present)}
    found = ask_all(session, STATUS, keys.values(), request, _CARS_S)
    return {source: found[key].valid for source, key in keys.items()}


def _trouble(car: str, known: dict[str, list[Status]], network: NetworkSettings) -> Iterator[str]:
    """What the processes of a car contradict: each other, the configuration, the clock here."""
    for source, found in known.items():
        if not found:
            yield f"the {source} of car '{car}' does not answer within {_CARS_S:g} s: it hangs"
        for one in found:
            for where in one.listens:
                if where in network.everyone and where not in getattr(network, source):
                    yield (
                        f"the {source} of car '{car}' listens at {where}, which the configuration "
                        "has for the other of the two: exchange plant and controller in it"
                    )
            yield from filter(None, map(unreachable, one.listens))
            ahead_s = one.calendar_s - time.time()
            if abs(ahead_s) > _CLOCK_S:
                yield (
                    f"the clock of the {source}'s machine says {calendar(one.calendar_s)}, this "
                    f"one's {calendar()}: set the wrong one; certificates begin and end by it"
                )
    for pair in itertools.product(*(known.get(source, ()) for source in SOURCES)):
        if why := apart(*pair):
            yield f"car '{car}': {why}"


def probe(endpoint: str, credentials: Credentials | None) -> str:
    """What is wrong with an endpoint, and the remedy; empty if nothing is found within some 1.5 s.

    Others than tcp, tls and Unix sockets are not tried.
    """
    address = address_of(endpoint)
    if address.protocol not in ("tcp", "tls", "unixsock-stream"):
        return ""
    try:
        connection = _connected(address)
    except (ConnectionRefusedError, FileNotFoundError):
        return f"nothing listens at {endpoint}: start its process, or correct the endpoint"
    except socket.gaierror:
        return f"{endpoint}: the name '{address.host}' is not known: correct it, or give an address"
    except TimeoutError:
        return f"{endpoint} does not answer: check address, network and firewall"
    except OSError as error:
        return f"{endpoint} cannot be reached: {error.strerror or error}; check address and network"
    with connection:
        if address.protocol == "unixsock-stream":
            return ""
        if credentials is None:
            text = _asks_for_certificates(connection)
        else:
            text = _refused(connection, address, credentials)
    return f"{endpoint} {text}" if text else ""


def _connected(address: Address) -> socket.socket:
    if address.protocol != "unixsock-stream":
        return socket.create_connection((address.host, address.port), _CONNECT_S)
    connection = socket.socket(socket.AF_UNIX)
    try:
        connection.settimeout(_CONNECT_S)
        connection.connect(address.host)
    except OSError:
        connection.close()
        raise
    return connection


def _asks_for_certificates(connection: socket.socket) -> str:
    """Whether TLS is spoken where plain links were asked for."""
    import ssl  # 1.4 MB, which a process without certificates does not need

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    connection.settimeout(_REFUSAL_S)
    try:
        context.wrap_socket(connection).close()
    except OSError:
        return ""
    return (
        "asks for a certificate: name the folder of this process's in [tls] of bayesrace.toml, and "
        "write tls/ in place of tcp/"
    )


def _refused(connection: socket.socket, address: Address, credentials: Credentials) -> str:
    """Why the handshake fails at one of its ends; empty if it does not."""
    import ssl  # as above

    context = credentials.client()
    try:
        with context.wrap_socket(connection, server_hostname=address.host) as link:
            # The other end judges our certificate when the handshake is over for this one.
            link.settimeout(_REFUSAL_S)
            link.recv(1)
    except TimeoutError as error:
        # It waits for our greeting; or, in the handshake, for something that is no TLS.
        return "" if "handshake" not in str(error) else _NO_TLS
    except ssl.SSLCertVerificationError as error:
        if text := _WE_REFUSE.get(error.verify_code):
            return text.format(host=address.host, now=calendar())
        return f"has a certificate {_OTHER_AUTHORITY} ({error.verify_message})"
    except ssl.SSLError as error:
        reason = error.reason or str(error)
        known = next((text for part, text in _THEY_REFUSE.items() if part in reason), "")
        unknown = f"refuses the link ({reason.replace('_', ' ').lower()})"
        ends = calendar(credentials.ends_s)
        return known.format(name=credentials.name, now=calendar(), ends=ends) or unknown
    except OSError:  # it closes the connection
        return _NO_TLS
    return ""
