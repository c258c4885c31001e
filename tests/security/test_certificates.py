"""Making, listing and revoking certificates, and what is said of those that can't be used."""

import re
import shutil
import stat
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID

from bayesrace.errors import InputError
from bayesrace.files import claimed
from bayesrace.operation import certificates
from bayesrace.transport import Credentials
from bayesrace.transport import links as links_module
from bayesrace.transport.links import Links
from tests.command_line import Cli, refused
from tests.security.authority import Bundles, bundles

__all__ = ["bundles"]


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_from_nothing_to_certificates_that_are_read(cli: Cli, tmp_path: Path) -> None:
    """As docs/security.md does it; only the authority's folder and each own one hold a key."""
    assert cli("certs", "init").code == 0
    assert (
        cli("certs", "add", "car", "--role", "plant", "--car", "orca", "--host", "10.0.0.1").code
        == 0
    )
    assert cli("certs", "add", "boss", "--role", "director").code == 0
    car, boss = (Credentials.read(tmp_path / "certs" / name) for name in ("car", "boss"))
    assert (car.name, car.car, boss.car) == ("car", "orca", "")
    assert car.members == boss.members
    assert car.member is not None
    assert car.member.role == "plant"
    listed = cli("certs", "list").out.splitlines()
    assert len(listed) == 2
    assert all(word in listed[1] for word in ("car", "plant", "orca", "until", "10.0.0.1"))
    for key in (tmp_path / "certs").rglob("key.pem"):
        assert mode(key) == 0o600
        assert mode(key.parent) == 0o700
    refused(cli("certs", "init"), "exists")


def test_a_certificate_serves_its_purposes_alone(bundles: Bundles) -> None:
    """A viewer's can't be shown by a server; none can sign another."""
    usages = {}
    for name in ("plant", "viewer"):
        text = (bundles.path(name) / "certificate.pem").read_bytes()
        extensions = x509.load_pem_x509_certificate(text).extensions
        assert not extensions.get_extension_for_class(x509.BasicConstraints).value.ca
        assert not extensions.get_extension_for_class(x509.KeyUsage).value.key_cert_sign
        usages[name] = extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert ExtendedKeyUsageOID.SERVER_AUTH in usages["plant"]
    assert ExtendedKeyUsageOID.SERVER_AUTH not in usages["viewer"]


def test_renewed_keeps_what_is_not_given_and_revoked_never_returns(
    cli: Cli, tmp_path: Path
) -> None:
    cli("certs", "init")
    cli("certs", "add", "a", "--role", "controller", "--car", "orca", "--days", "0.2")
    cli("certs", "add", "b", "--role", "plant")
    folder = tmp_path / "certs" / "a"
    before = Credentials.read(folder)
    assert "expires in" in before.expires_soon()
    refused(cli("certs", "add", "a", "--role", "viewer"), "there is a certificate 'a'", "--renew")
    assert cli("certs", "add", "a", "--renew").code == 0
    after = Credentials.read(folder)
    assert after.member == before.member
    assert after.expires_soon() == ""
    assert cli("certs", "revoke", "a").code == 0
    assert Credentials.read(tmp_path / "certs" / "b").members.revoked == ("a",)
    with pytest.raises(InputError, match="'a' has been revoked: make another"):
        Credentials.read(folder).check("controller")
    assert "revoked" in cli("certs", "list").out
    refused(cli("certs", "add", "a", "--role", "viewer"), "revoked, for ever")
    refused(cli("certs", "add", "a", "--renew"), "revoked, for ever")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("add", "x"), ("no role", "--role")),
        (("add", "x", "--role", "king"), ("king",)),
        (("add", "authority", "--role", "plant"), ("can't name",)),
        (("add", "../x", "--role", "plant"), ("can't name",)),
        (("add", "x", "--role", "plant", "--car", "a/b"), ("--car a/b",)),
        (("add", "x", "--role", "plant", "--host", "schloß"), ("--host schloß",)),
        (("add", "x", "--role", "plant", "--host", "a..b"), ("--host a..b",)),
        (("add", "x", "--role", "plant", "--host", ""), ("--host :",)),
        (("add", "x", "--renew"), ("no certificate 'x' to renew",)),
        (("revoke", "x"), ("no certificate 'x'", "there are: none")),
    ],
)
def test_what_cannot_be_made_is_refused(
    cli: Cli, arguments: tuple[str, ...], words: tuple[str, ...]
) -> None:
    cli("certs", "init")
    refused(cli("certs", *arguments), *words)


def test_an_encrypted_key_signs_with_its_passphrase_alone(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refused(cli("certs", "init", "--passphrase"), "BAYESRACE_PASSPHRASE", "terminal")
    monkeypatch.setenv("BAYESRACE_PASSPHRASE", "correct horse")
    assert cli("certs", "init", "--passphrase").code == 0
    authority, folder = tmp_path / "certs" / "authority", tmp_path / "certs" / "a"
    assert "BEGIN ENCRYPTED PRIVATE KEY" in (authority / "key.pem").read_text()
    assert cli("certs", "add", "a", "--role", "viewer", "--days", "0.5").code == 0
    before = Credentials.read(folder)
    monkeypatch.setenv("BAYESRACE_PASSPHRASE", "wrong")
    for command in (("add", "b", "--role", "viewer"), ("add", "a", "--renew"), ("revoke", "a")):
        refused(cli("certs", *command), "authority/key.pem is not opened by this passphrase")
    monkeypatch.delenv("BAYESRACE_PASSPHRASE")
    refused(cli("certs", "revoke", "a"), "BAYESRACE_PASSPHRASE", "terminal")
    assert Credentials.read(folder) == before
    assert not (tmp_path / "certs" / "b").exists()
    assert cli("certs", "list").code == 0


def test_only_one_process_at_a_time_changes_the_register(cli: Cli, tmp_path: Path) -> None:
    """Of four at once, three were in no list of members afterwards."""
    cli("certs", "init")
    with claimed(tmp_path / "certs" / "authority"):
        refused(cli("certs", "add", "x", "--role", "viewer"), "another process", "wait for its end")
    assert not (tmp_path / "certs" / "x").exists()


def test_without_an_authority_there_is_a_remedy(cli: Cli) -> None:
    refused(cli("certs", "list"), "bayesrace certs init")


def _readable(folder: Path) -> None:
    (folder / "key.pem").chmod(0o644)


def _without_list(folder: Path) -> None:
    (folder / "members.json").unlink()


def _spoilt_list(folder: Path) -> None:
    (folder / "members.json").write_text('{"members": {"plant": {"role": "king"}}}')


def _another_role(folder: Path) -> None:
    text = (folder / "members.json").read_text()
    assert '"role":"viewer"' in text.replace(" ", "")
    (folder / "members.json").write_text(text.replace('"viewer"', '"director"'))


def _unsigned(folder: Path) -> None:
    text = (folder / "members.json").read_text()
    (folder / "members.json").write_text(re.sub(r',\s*"signature": "\w+"', "", text))


def _of(name: str, *files: str) -> Callable[[Path, Bundles], None]:
    def take(folder: Path, bundles: Bundles) -> None:
        for file in files:
            shutil.copy(bundles.path(name) / file, folder / file)

    return take


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda folder, _: _readable(folder), "others can read .*chmod 600"),
        (lambda folder, _: _without_list(folder), "members.json.*copy the folder again"),
        (lambda folder, _: _spoilt_list(folder), "members.plant.role"),
        (lambda folder, _: _another_role(folder), "not signed by the authority.*copy it"),
        (lambda folder, _: _unsigned(folder), "not signed by the authority.*add NAME --renew"),
        (_of("foreign-plant", "members.json"), "not signed by the authority"),
        (_of("controller", "key.pem"), "do not fit"),
        (_of("foreign-plant", "certificate.pem", "key.pem"), "not of the authority"),
        (_of("expired", "certificate.pem", "key.pem"), "has expired: it counts from"),
    ],
)
def test_a_folder_that_cannot_be_used_is_refused_with_the_remedy(
    bundles: Bundles, tmp_path: Path, spoil: Callable[[Path, Bundles], None], words: str
) -> None:
    folder = tmp_path / "plant"
    shutil.copytree(bundles.path("plant"), folder)
    assert Credentials.read(folder).name == "plant"
    spoil(folder, bundles)
    with pytest.raises(InputError, match=words):
        Credentials.read(folder)


def test_a_folder_that_stays_unusable_is_read_again_when_it_changes_or_much_later(
    bundles: Bundles, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A clock that is set, so that its certificate counts, does not change it."""
    folder, clock, reads = tmp_path / "plant", SimpleNamespace(monotonic=lambda: 0.0), list[Path]()
    shutil.copytree(bundles.path("plant"), folder)
    links, read = Links(Credentials.read(folder), "plant"), Credentials.read
    monkeypatch.setattr(links_module, "time", clock)

    def reading(folder: Path) -> Credentials:
        reads.append(folder)
        return read(folder)

    monkeypatch.setattr(Credentials, "read", reading)

    def looked(times: int) -> int:
        before = len(reads)
        for _ in range(times):
            links.look()
        return len(reads) - before

    assert looked(5) == 1
    shutil.copy(bundles.path("controller") / "key.pem", folder / "key.pem")
    assert looked(5) == 1
    _spoilt_list(folder)
    assert looked(5) == 1
    clock.monotonic = lambda: 11.0
    assert looked(5) == 1
    shutil.copytree(bundles.path("plant"), folder, dirs_exist_ok=True)
    assert looked(5) == 1
    assert links.newest == links.used


def test_a_list_with_a_lower_number_than_the_last_one_is_refused(tmp_path: Path) -> None:
    """Who was revoked could bring back the list that he was in. Read-only folders forget it."""
    certificates.init(tmp_path)
    folder = certificates.add(tmp_path, "plant", "plant")
    certificates.add(tmp_path, "boss", "director")
    older = (folder / "members.json").read_bytes()
    certificates.revoke(tmp_path, "boss")
    newest = Credentials.read(folder).members
    (folder / "members.json").write_bytes(older)
    with pytest.raises(InputError, match=f"members.json has number .*and {newest.number} has been"):
        Credentials.read(folder)
    (folder / "members.seen").unlink()
    (folder / "members.seen").mkdir()
    assert Credentials.read(folder).members.number < newest.number


def test_a_directors_certificate_serves_those_who_may_do_less(bundles: Bundles) -> None:
    for role in ("director", "learning", "viewer"):
        bundles.credentials("director").check(role)


def test_the_register_says_when_a_certificate_really_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the authority's own, at the latest."""
    monkeypatch.setattr(certificates, "_AUTHORITY_DAYS", 10)
    certificates.init(tmp_path)
    folder = certificates.add(tmp_path, "plant", "plant", days=365)
    ends = certificates.read_register(tmp_path)["plant"].ends
    assert ends.timestamp() == Credentials.read(folder).ends_s
    assert ends < datetime.now(UTC) + timedelta(days=11)
