"""The certificate authority of a system: makes, lists and revokes what its processes are known by.

Its folder holds ``authority/`` (the key that signs, and the register of all certificates) and a
folder for each certificate, to be copied to the machine of its process. Only the latter are needed
to drive; who has the former can make himself a director.
"""

import ipaddress
import os
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from pydantic import Field, ValidationError

from bayesrace.errors import InputError, faults_in
from bayesrace.files import claimed, read_text, write_whole
from bayesrace.messages import Role, is_car_name
from bayesrace.strict import StrictModel
from bayesrace.transport.credentials import (
    AUTHORITY,
    CERTIFICATE,
    EVERY_CAR,
    KEY,
    MEMBERS,
    Member,
    Members,
)
from bayesrace.transport.endpoints import address_of

__all__ = ["Entry", "add", "init", "read_register", "revoke"]

_FOLDER: Final = "authority"
_REGISTER: Final = "register.json"
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,39}")
_AUTHORITY_DAYS: Final = 3650
_CLOCKS: Final = timedelta(days=1)
"""How far clocks may be behind that of the authority."""
_LOOPBACK: Final = ("localhost", "127.0.0.1", "::1")
_LISTENERS: Final[tuple[Role, ...]] = ("plant", "controller", "shadow", "router")


class Entry(Member):
    """A certificate in the register."""

    hosts: tuple[str, ...] = Field((), description="where its process listens, beside loopback")
    ends: datetime
    revoked: bool = False


class _Register(StrictModel):
    number: int = Field(0, description="of the list of members made of it")
    entries: dict[str, Entry] = Field({}, description="by their names")


def init(folder: Path, passphrase: str = "") -> None:
    """Make an authority, whose key is encrypted with the passphrase if there is one.

    InputError if there is an authority already.
    """
    authority = folder / _FOLDER
    if authority.exists():
        raise InputError(f"{authority} exists: use it, or name another folder with --folder")
    authority.mkdir(parents=True, mode=0o700)
    key = ec.generate_private_key(ec.SECP256R1())
    name = _named(f"BayesRace {os.urandom(4).hex()}")
    ends = datetime.now(UTC) + timedelta(days=_AUTHORITY_DAYS)
    builder = (
        _begun(name, name, key.public_key(), ends)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs=True), critical=True)
    )
    _write_private(authority / KEY, key, passphrase)
    certificate = builder.sign(key, hashes.SHA256())
    write_whole(authority / AUTHORITY, certificate.public_bytes(Encoding.PEM))
    _write_register(folder, _Register(), key)


def add(
    folder: Path,
    name: str,
    role: Role | None,
    car: str | None = None,
    hosts: Sequence[str] = (),
    days: float = 365,
    renew: bool = False,
    ask: Callable[[], str] = str,
) -> Path:
    """Make a certificate, or with ``renew`` a new one of the same name; its folder.

    ``car``: the one that it is for, None: all. What is not given when renewing stays. ``ask``: for
    the passphrase, where the key of the authority has one.
    """
    with _changing(folder, ask) as (register, signs):
        before = register.entries.get(name)
        _check_name(name, before, renew)
        if before is not None:
            role, car, hosts = role or before.role, car or before.car, hosts or before.hosts
        if role is None:
            raise InputError(f"no role for certificate '{name}': give --role")
        if car not in (None, EVERY_CAR) and not is_car_name(car or ""):
            raise InputError(f"--car {car}: a name of up to 40 letters, digits, '-' or '_'")
        ends = datetime.now(UTC) + timedelta(days=days)
        target = folder / name
        target.mkdir(mode=0o700, exist_ok=True)
        key = ec.generate_private_key(ec.SECP256R1())
        certificate = _signed(folder, signs, name, role, hosts, key.public_key(), ends)
        _write_private(target / KEY, key)
        write_whole(target / CERTIFICATE, certificate)
        write_whole(target / AUTHORITY, (folder / _FOLDER / AUTHORITY).read_bytes())
        # That of the authority, if it ends before.
        ends = x509.load_pem_x509_certificate(certificate).not_valid_after_utc
        entry = Entry(role=role, car=car or EVERY_CAR, hosts=tuple(hosts), ends=ends)
        _write_register(folder, _with(register, name, entry), signs)
        return target


def revoke(folder: Path, name: str, ask: Callable[[], str] = str) -> None:
    """Take a name off the list of members, for ever; InputError if it is not on it."""
    with _changing(folder, ask) as (register, signs):
        if (entry := register.entries.get(name)) is None:
            known = ", ".join(sorted(register.entries)) or "none"
            raise InputError(f"no certificate '{name}' in {folder}; there are: {known}")
        revoked = entry.model_copy(update={"revoked": True})
        _write_register(folder, _with(register, name, revoked), signs)


def read_register(folder: Path) -> dict[str, Entry]:
    """Every certificate that was made, by name; InputError where there is no authority."""
    return dict(_read(folder).entries)


def _read(folder: Path) -> _Register:
    path = folder / _FOLDER / _REGISTER
    remedy = "make an authority with 'bayesrace certs init', or name its folder with --folder"
    text = read_text(path, "register of certificates", remedy)
    try:
        return _Register.model_validate_json(text)
    except ValidationError as error:
        raise InputError(f"{path}: {faults_in(error)}") from None


@contextmanager
def _changing(
    folder: Path, ask: Callable[[], str]
) -> Iterator[tuple[_Register, ec.EllipticCurvePrivateKey]]:
    """The register, which no other process changes within the block, and the key that signs."""
    _read(folder)  # there is one
    with claimed(folder / _FOLDER):
        yield _read(folder), _signing_key(folder / _FOLDER / KEY, ask)


def _signing_key(path: Path, ask: Callable[[], str]) -> ec.EllipticCurvePrivateKey:
    data = path.read_bytes()
    passphrase = ask().encode() if b"ENCRYPTED" in data else None
    try:
        key = load_pem_private_key(data, passphrase)
    except (TypeError, ValueError):
        wrong = "is not opened by this passphrase" if passphrase is not None else "is no key"
        raise InputError(f"{path} {wrong}: nothing has been changed") from None
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise InputError(f"{path} is no key of 'bayesrace certs init'")
    return key


def _with(register: _Register, name: str, entry: Entry) -> _Register:
    return register.model_copy(update={"entries": {**register.entries, name: entry}})


def _check_name(name: str, before: Entry | None, renew: bool) -> None:
    if _NAME.fullmatch(name) is None or name == _FOLDER:
        raise InputError(f"'{name}' can't name a certificate: up to 40 letters, digits, '-_.'")
    if before is None and renew:
        raise InputError(f"no certificate '{name}' to renew: leave --renew out to make it")
    if before is not None and before.revoked:
        raise InputError(f"'{name}' has been revoked, for ever: choose another name")
    if before is not None and not renew:
        raise InputError(f"there is a certificate '{name}': choose another name, or --renew it")


def _write_register(folder: Path, register: _Register, signs: ec.EllipticCurvePrivateKey) -> None:
    """The register, and the next list of members in the folder of each certificate."""
    # By the clock, so that it grows where an older copy of the authority's folder is in use, too.
    number = max(register.number + 1, int(time.time()))
    register = register.model_copy(update={"number": number})
    write_whole(folder / _FOLDER / _REGISTER, register.model_dump_json(indent=1) + "\n")
    entries = register.entries
    valid = {name: one for name, one in entries.items() if not one.revoked}
    members = Members(
        number=number,
        members={name: Member(role=one.role, car=one.car) for name, one in valid.items()},
        revoked=tuple(sorted(entries.keys() - valid.keys())),
    )
    signature = signs.sign(members.content(), ec.ECDSA(hashes.SHA256()))
    members = members.model_copy(update={"signature": signature.hex()})
    for name in entries:
        if (folder / name).is_dir():
            write_whole(folder / name / MEMBERS, members.model_dump_json(indent=1) + "\n")


def _signed(
    folder: Path,
    signs: ec.EllipticCurvePrivateKey,
    name: str,
    role: Role,
    hosts: Sequence[str],
    key: ec.EllipticCurvePublicKey,
    ends: datetime,
) -> bytes:
    issuer = x509.load_pem_x509_certificate((folder / _FOLDER / AUTHORITY).read_bytes())
    purposes = [ExtendedKeyUsageOID.CLIENT_AUTH]
    if role in _LISTENERS:
        purposes.append(ExtendedKeyUsageOID.SERVER_AUTH)
    issuer_key = x509.AuthorityKeyIdentifier.from_issuer_public_key(signs.public_key())
    certificate = (
        _begun(_named(name), issuer.subject, key, min(ends, issuer.not_valid_after_utc))
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(signs=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
        .add_extension(_alternatives((*_LOOPBACK, *hosts)), critical=False)
        .add_extension(issuer_key, critical=False)
        .sign(signs, hashes.SHA256())
    )
    return certificate.public_bytes(Encoding.PEM)


def _named(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _begun(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, ends: datetime
) -> x509.CertificateBuilder:
    """What all certificates have."""
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(min(datetime.now(UTC), ends) - _CLOCKS)
        .not_valid_after(ends)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


def _usage(signs: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs, key_cert_sign=signs, crl_sign=signs,
        content_commitment=False, key_encipherment=False, data_encipherment=False,
        key_agreement=False, encipher_only=False, decipher_only=False,
    )  # fmt: skip


def _alternatives(hosts: Sequence[str]) -> x509.SubjectAlternativeName:
    """The names and addresses by which it may be connected to."""
    names: list[x509.GeneralName] = []
    for host in dict.fromkeys(hosts):
        try:
            names.append(x509.IPAddress(ipaddress.ip_address(host)))
        except ValueError:
            try:
                address_of(f"tls/{host}:1")
                names.append(x509.DNSName(host))
            except (ValueError, InputError):
                raise InputError(
                    f"--host {host}: give a host name in ASCII, or an address"
                ) from None
    return x509.SubjectAlternativeName(names)


def _write_private(path: Path, key: ec.EllipticCurvePrivateKey, passphrase: str = "") -> None:
    how = BestAvailableEncryption(passphrase.encode()) if passphrase else NoEncryption()
    data = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, how)
    write_whole(path, data, private=True)
