"""A process's certificate: the files, whose it is, and what the others are.

A folder holds what one process needs, as ``bayesrace certs`` writes it: the authority's certificate
(``ca.pem``), its own (``certificate.pem``) with the private key (``key.pem``), and
``members.json``, which says what each name may do. A name that is not in it may do nothing. The
authority has signed and numbered that list; one with a lower number than the last is refused.
"""

import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

from pydantic import Field, ValidationError

from bayesrace.errors import InputError, TransientError, faults_in
from bayesrace.files import check_private, read_text, write_whole
from bayesrace.messages import Role
from bayesrace.strict import StrictModel

if TYPE_CHECKING:
    import ssl

__all__ = [
    "AUTHORITY", "CERTIFICATE", "CERTIFICATE_EXPIRED", "CERTIFICATE_NOT_YET", "COVERS", "EVERY_CAR",
    "KEY", "MEMBERS", "NEWEST_LIST", "Credentials", "Member", "Members", "calendar",
]  # fmt: skip

AUTHORITY: Final = "ca.pem"
CERTIFICATE: Final = "certificate.pem"
KEY: Final = "key.pem"
MEMBERS: Final = "members.json"
_SEEN: Final = "members.seen"
"""The highest number of a list that was read here."""

NEWEST_LIST: Final = f"give every process the newest {MEMBERS} of 'bayesrace certs'"
"""Remedy where a link stands and nothing comes over it: one end has an old list of members."""

EVERY_CAR: Final = "*"

COVERS: Final[dict[Role, tuple[Role, ...]]] = {
    "director": ("learning", "viewer"), "learning": ("viewer",),
}  # fmt: skip
"""Roles that may do all that these may."""

CERTIFICATE_EXPIRED: Final = 10
CERTIFICATE_NOT_YET: Final = 9
"""OpenSSL's numbers of what is wrong with a certificate."""

_SOON_S: Final = 14 * 86400.0

_COPYING_S: Final = 5.0
"""So long after the last change of a folder its files may still be being copied."""
_COPY: Final = "copy the folder again, as 'bayesrace certs' wrote it"


class Member(StrictModel):
    """What the bearer of a certificate may do."""

    role: Role
    car: str = Field(EVERY_CAR, description="name of the one car that it concerns; *: every car")

    def may_be(self, role: Role) -> bool:
        """Whether it can do the work of that role."""
        return role == self.role or role in COVERS.get(self.role, ())


class Members(StrictModel):
    """Everyone with a certificate that counts."""

    number: int = Field(0, description="higher than those of all lists before")
    members: dict[str, Member] = Field({}, description="by the name in the certificate")
    revoked: tuple[str, ...] = Field((), description="names that never count again")
    signature: str = Field("", description="of the authority, over all else (ECDSA), in hex")

    def content(self) -> bytes:
        """What the authority signs."""
        return self.model_dump_json(exclude={"signature"}).encode()

    def check_newer(self, seen: int, path: Path) -> None:
        """InputError if a list with a higher number has been seen; ``path``: of its file."""
        if self.number < seen:
            raise InputError(
                f"{path} has number {self.number}, and {seen} has been in use here: an old list "
                "would let in who was revoked; copy the newest one"
            )


class Credentials(StrictModel):
    """The certificate of one process, checked, with what all members may do."""

    folder: Path
    name: str = Field(description="common name in the certificate")
    ends_s: float = Field(description="calendar time of its expiry, as of time.time()")
    soon_s: float = Field(_SOON_S, description="time before the expiry that warnings begin")
    members: Members

    @classmethod
    def read(cls, folder: Path) -> Self:
        """The content of a folder; InputError naming what cannot be used.

        Expired, of another authority than that of the folder, with another key: all is noticed
        here, before there is a link. TransientError: it has expired or is not valid yet, or the
        folder has just changed, as while its files are copied one by one.
        """
        folder = folder.expanduser().absolute()
        if not folder.is_dir():
            raise InputError(f"no certificate in {folder}: make one with 'bayesrace certs add'")
        try:
            for name in (AUTHORITY, CERTIFICATE, KEY, MEMBERS):
                read_text(folder / name, "file", _COPY)
            check_private(folder / KEY)
            name, begins_s, ends_s = _verified(folder)
            members = _members(folder)
        except TransientError:
            raise
        except InputError as error:
            if _just_changed(folder):
                raise TransientError(str(error)) from None
            raise
        soon_s = min(_SOON_S, (ends_s - begins_s) / 6)
        return cls(folder=folder, name=name, ends_s=ends_s, soon_s=soon_s, members=members)

    def client(self) -> "ssl.SSLContext":
        """For a link to another end, whose certificate is checked."""
        import ssl  # 1.4 MB, which a process without certificates does not need

        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.load_verify_locations(self.folder / AUTHORITY)
        context.load_cert_chain(self.folder / CERTIFICATE, self.folder / KEY)
        return context

    @property
    def member(self) -> Member | None:
        """What its own list says about it."""
        return self.members.members.get(self.name)

    @property
    def car(self) -> str:
        """The one car that it is for; empty: every car."""
        member = self.member
        return "" if member is None or member.car == EVERY_CAR else member.car

    def check(self, role: Role) -> None:
        """InputError if the certificate is not for such a process."""
        member = self.member
        if member is None:
            revoked = self.name in self.members.revoked
            why = "has been revoked" if revoked else f"is not in {self.folder / MEMBERS}"
            raise InputError(
                f"certificate '{self.name}' {why}: make another one with 'bayesrace certs add NAME "
                f"--role {role}'"
            )
        if not member.may_be(role):
            raise InputError(
                f"certificate '{self.name}' ({self.folder}) is for the role {member.role}, and "
                f"this needs {role}: make one with 'bayesrace certs add NAME --role {role}'"
            )

    def check_car(self, car: str) -> None:
        """InputError if the certificate is for another car."""
        if self.car and car != self.car:
            raise InputError(
                f"certificate '{self.name}' is for car '{self.car}', not for '{car}': give --name "
                f"{self.car}, or make one with 'bayesrace certs add NAME --car {car}'"
            )

    def expires_soon(self) -> str:
        """A warning in the last two weeks, or the last sixth of its time; empty before."""
        left_s = self.ends_s - time.time()
        if left_s > self.soon_s:
            return ""
        left = f"{left_s / 86400:.0f} days" if left_s > 2 * 86400 else f"{left_s / 3600:.1f} hours"
        return (
            f"certificate '{self.name}' expires in {left}, and its links are closed then: renew it "
            f"with 'bayesrace certs add {self.name} --renew'"
        )

    def expired(self) -> str:
        """What to say once it has."""
        return (
            f"certificate '{self.name}' has expired, and its links are closed: renew it with "
            f"'bayesrace certs add {self.name} --renew', and start this process again with it"
        )


def _just_changed(folder: Path) -> bool:
    try:
        changed_s = max(path.stat().st_ctime for path in (folder, *folder.iterdir()))
    except OSError:  # while we look
        return True
    return abs(time.time() - changed_s) < _COPYING_S


def _members(folder: Path) -> Members:
    """The list of members, signed and as new as any before; InputError if it cannot be used."""
    path, seen_path = folder / MEMBERS, folder / _SEEN
    text = read_text(path, "list of members", "copy it from where 'bayesrace certs' wrote it")
    try:
        members = Members.model_validate_json(text)
    except ValidationError as error:
        raise InputError(f"{path}: {faults_in(error)}; copy it again") from None
    _check_signature(members, folder)
    seen = 0
    with suppress(OSError, ValueError):
        seen = int(seen_path.read_bytes())
    members.check_newer(seen, path)
    if members.number > seen:
        with suppress(OSError):  # read-only: then a running process alone remembers
            write_whole(seen_path, str(members.number))
    return members


def _check_signature(members: Members, folder: Path) -> None:
    # 19 MB, which a process without certificates does not need.
    from cryptography import x509
    from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec

    try:
        key = x509.load_pem_x509_certificate((folder / AUTHORITY).read_bytes()).public_key()
        if not isinstance(key, ec.EllipticCurvePublicKey):
            raise InvalidSignature
        signature = bytes.fromhex(members.signature)
        key.verify(signature, members.content(), ec.ECDSA(hashes.SHA256()))
    except (InvalidSignature, ValueError, UnsupportedAlgorithm):
        raise InputError(
            f"{folder / MEMBERS} is not signed by the authority in {AUTHORITY}: copy it from where "
            "'bayesrace certs' wrote it; if that is from before lists were signed, 'bayesrace "
            "certs add NAME --renew' for any name writes it again"
        ) from None


def calendar(time_s: float | None = None) -> str:
    """A calendar time in words; None: now, by this machine's clock."""
    return time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(time_s))


def _verified(folder: Path) -> tuple[str, float, float]:
    """Name, begin and end of the certificate; InputError if it cannot be used."""
    from cryptography import x509  # as above
    from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    try:
        authority, one = (
            x509.load_pem_x509_certificate((folder / name).read_bytes())
            for name in (AUTHORITY, CERTIFICATE)
        )
        key = load_pem_private_key((folder / KEY).read_bytes(), None)
        if key.public_key() != one.public_key():
            raise ValueError("another key")
    except (TypeError, ValueError, UnsupportedAlgorithm) as error:
        raise InputError(
            f"{folder}: certificate, key and authority do not fit ({error}): {_COPY}"
        ) from None
    try:
        one.verify_directly_issued_by(authority)
    except (InvalidSignature, TypeError, ValueError, UnsupportedAlgorithm):
        why = f"is not of the authority in {AUTHORITY}: {_COPY}"
        raise InputError(f"certificate in {folder} {why}") from None
    begins_s, ends_s = (
        at.timestamp() for at in (one.not_valid_before_utc, one.not_valid_after_utc)
    )
    if not begins_s <= (now_s := time.time()) < ends_s:
        raise TransientError(
            f"certificate in {folder} {'has expired' if now_s > begins_s else 'is not valid yet'}: "
            f"it counts from {calendar(begins_s)} to {calendar(ends_s)}, and the clock of this "
            f"machine says {calendar(now_s)}: set the clock if that is wrong, or renew it with "
            "'bayesrace certs add NAME --renew'"
        )
    (name,) = one.subject.get_attributes_for_oid(x509.NameOID.COMMON_NAME)
    return str(name.value), begins_s, ends_s
