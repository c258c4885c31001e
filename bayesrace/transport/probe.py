"""Why there is no link to an endpoint: what Zenoh does not say.

Zenoh tries again for ever, whatever is wrong. So the endpoint is tried here as Zenoh tries it: a
connection, and a handshake with this process's certificate.
"""

import socket
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Final

from bayesrace.transport.credentials import AUTHORITY, CERTIFICATE, KEY, Credentials
from bayesrace.transport.endpoints import Address, address_of

if TYPE_CHECKING:
    import ssl

__all__ = ["probe", "probe_all"]

_CONNECT_S: Final = 1.0
_REFUSAL_S: Final = 0.2
"""How long the other end may take to refuse a certificate after the handshake."""

_EXPIRED: Final = 10
_NOT_YET: Final = 9
_OTHER_NAME: Final = (62, 64)
"""OpenSSL's numbers of what is wrong with a certificate."""


def probe_all(endpoints: Sequence[str], credentials: Credentials | None) -> dict[str, str]:
    """What is wrong with each endpoint, and the remedy; those that are fine are left out.

    All are tried at once, within some 1.5 s.
    """
    if not endpoints:
        return {}
    with ThreadPoolExecutor(len(endpoints)) as pool:
        found = pool.map(lambda one: probe(one, credentials), endpoints)
        return {one: text for one, text in zip(endpoints, found, strict=True) if text}


def probe(endpoint: str, credentials: Credentials | None) -> str:
    """What is wrong with an endpoint, and the remedy; empty if nothing is found."""
    address = address_of(endpoint)
    if address.protocol not in ("tcp", "tls", "ws", "unixsock-stream"):
        return ""
    try:
        connection = _connected(endpoint, address)
    except OSError as error:
        return _unreached(endpoint, address, error)
    with connection:
        if address.protocol in ("ws", "unixsock-stream"):
            return ""
        if credentials is None:
            text = _asks_for_certificates(connection)
        else:
            text = _refused(connection, address, credentials)
    return f"{endpoint} {text}" if text else ""


def _connected(endpoint: str, address: Address) -> socket.socket:
    if address.protocol != "unixsock-stream":
        return socket.create_connection((address.host, address.port), _CONNECT_S)
    connection = socket.socket(socket.AF_UNIX)
    try:
        connection.settimeout(_CONNECT_S)
        connection.connect(endpoint.partition("/")[2].partition("?")[0].partition("#")[0])
    except OSError:
        connection.close()
        raise
    return connection


def _unreached(endpoint: str, address: Address, error: OSError) -> str:
    if isinstance(error, ConnectionRefusedError | FileNotFoundError):
        return (
            f"nobody listens at {endpoint}: start the process that should, or correct the endpoint"
        )
    if isinstance(error, socket.gaierror):
        return f"{endpoint}: the name '{address.host}' is not known: correct it, or give an address"
    if isinstance(error, TimeoutError):
        return f"{endpoint} does not answer: check address, network and firewall"
    return f"{endpoint} cannot be reached: {error.strerror or error}; check address and network"


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

    folder = credentials.folder
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        context.load_verify_locations(folder / AUTHORITY)
        context.load_cert_chain(folder / CERTIFICATE, folder / KEY)
    except OSError as error:  # the folder is gone, or half of a renewed one, while we run
        why = f"certificate '{credentials.name}' in {folder} cannot be read ({error.strerror})"
        return f"cannot be tried, since {why}: copy the folder again, as 'bayesrace certs' wrote it"
    try:
        with context.wrap_socket(connection, server_hostname=address.host) as link:
            # The other end judges our certificate when the handshake is over for this one.
            link.settimeout(_REFUSAL_S)
            link.recv(1)
    except TimeoutError as error:
        # It waits for our greeting; or, in the handshake, for something that is no TLS.
        return "" if "handshake" not in str(error) else _NO_TLS
    except ssl.SSLCertVerificationError as error:
        return _we_refuse(error, address, folder.name)
    except ssl.SSLError as error:
        return _they_refuse(error, credentials)
    except OSError:  # it closes the connection
        return _NO_TLS
    return ""


_NO_TLS: Final = (
    "is not encrypted, or is no process of ours: start the one that listens there with a "
    "certificate, too"
)


def _we_refuse(error: "ssl.SSLCertVerificationError", address: Address, name: str) -> str:
    if error.verify_code == _EXPIRED:
        return (
            "has a certificate that has expired: renew it there with 'bayesrace certs add NAME "
            "--renew'"
        )
    if error.verify_code == _NOT_YET:
        return "has a certificate that is not valid yet: set the clocks of both machines"
    if error.verify_code in _OTHER_NAME:
        return (
            f"has a certificate for other hosts: connect by a name that is in it, or renew it with "
            f"'bayesrace certs add NAME --renew --host {address.host}'"
        )
    return (
        f"has a certificate of another authority than certificate '{name}' here: both have to come "
        f"from one 'bayesrace certs init' ({error.verify_message})"
    )


def _they_refuse(error: "ssl.SSLError", credentials: Credentials) -> str:
    reason = error.reason or str(error)
    if "UNKNOWN_CA" in reason or "BAD_CERTIFICATE" in reason or "DECRYPT_ERROR" in reason:
        return (
            f"refuses certificate '{credentials.name}', which is of another authority: both have "
            "to come from one 'bayesrace certs init'"
        )
    if "EXPIRED" in reason:
        return (
            f"refuses certificate '{credentials.name}' as expired: renew it with 'bayesrace certs "
            f"add {credentials.name} --renew', or set the clocks of both machines"
        )
    if "WRONG_VERSION" in reason or "EOF" in reason:
        return _NO_TLS
    return f"refuses the link ({reason.replace('_', ' ').lower()}): see 'bayesrace doctor' there"
