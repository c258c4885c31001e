"""Code is loaded from files only that no other user can write or exchange."""

import ctypes
import grp
import hashlib
import logging
import os
import pwd
import re
import struct
from pathlib import Path

import casadi as ca
import pytest

from bayesrace.cache import code_folder, kept
from bayesrace.codegen.compiler import compiled, find_compiler
from bayesrace.errors import InputError
from bayesrace.trusted_files import loadable, make_folder, trusted

OTHER, GROUP = 12345, 54321


@pytest.fixture
def code(tmp_path: Path) -> Path:
    """A file two folders below one of this test's own."""
    path = tmp_path / "above" / "folder" / "code"
    make_folder(path.parent)
    path.write_bytes(b"code")
    path.chmod(0o644)
    assert trusted(path) == path
    return path


def refused(path: Path, why: str) -> None:
    with pytest.raises(InputError, match=why):
        trusted(path)


@pytest.mark.parametrize("level", [0, 1, 2], ids=["file", "folder", "above"])
def test_what_everybody_may_write_is_refused_but_a_sticky_folder(code: Path, level: int) -> None:
    one = (code, *code.parents)[level]
    one.chmod(0o757)
    refused(code, f"^{re.escape(str(one))} is writable.*'chmod go-w'")
    one.chmod(0o1757)  # as /tmp, where only its owner exchanges a file
    if level:
        assert trusted(code) == code
    else:
        refused(code, "is writable")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")
@pytest.mark.parametrize("level", [0, 1, 2], ids=["file", "folder", "above"])
def test_what_belongs_to_another_user_is_refused(code: Path, level: int) -> None:
    one = (code, *code.parents)[level]
    if level:
        one.chmod(0o1777)  # its owner may exchange all that is in a sticky folder
    os.chown(one, OTHER, -1)
    refused(code, f"^{re.escape(str(one))} belongs .*{OTHER}.*run as that user.*BAYESRACE_CACHE")


def test_no_folder_is_made_where_it_would_be_refused(code: Path) -> None:
    folder = code.parent / "new" / "folder"
    code.parent.parent.chmod(0o777)
    with pytest.raises(InputError, match="is writable"):
        trusted(folder, make=True)
    assert not folder.parent.exists()
    code.parent.parent.chmod(0o755)
    before = os.umask(0)
    try:
        assert trusted(folder, make=True) == folder
    finally:
        os.umask(before)


def user(name: str, number: int, group: int) -> pwd.struct_passwd:
    return pwd.struct_passwd((name, "x", number, group, "", "/", "/bin/sh"))


ME = user("me", os.geteuid(), GROUP)


@pytest.mark.parametrize(
    ("name", "members", "users", "private"),
    [
        ("me", [], [ME], True),
        ("me", ["me"], [ME], True),
        ("me", [], [user("me", 0, GROUP)], True),  # root may write everywhere
        ("me", ["other"], [ME], False),
        ("me", [], [ME, user("other", OTHER, GROUP)], False),
        ("me", [], [user("me", os.geteuid(), 7)], False),
        ("other", [], [user("other", OTHER, GROUP)], False),
        ("staff", ["me"], [ME], False),  # not all who are in it need be known
        (None, [], [ME], False),
        ("me", [], [], False),
    ],
)
@pytest.mark.parametrize("level", [0, 1], ids=["file", "folder"])
def test_a_group_may_write_that_is_the_user_s_own(
    code: Path,
    monkeypatch: pytest.MonkeyPatch,
    level: int,
    name: str | None,
    members: list[str],
    users: list[pwd.struct_passwd],
    private: bool,
) -> None:
    one = (code, *code.parents)[level]
    one.chmod(0o775)
    number = one.stat().st_gid
    groups = {number: grp.struct_group((name, "x", number, members))} if name else {}
    users = [user(u.pw_name, u.pw_uid, number if u.pw_gid == GROUP else u.pw_gid) for u in users]
    monkeypatch.setattr("grp.getgrgid", groups.__getitem__)
    monkeypatch.setattr("pwd.getpwall", lambda: users)
    monkeypatch.setattr("pwd.getpwnam", {u.pw_name: u for u in users}.__getitem__)
    if private:
        assert trusted(code) == code
    else:
        refused(code, f"^{re.escape(str(one))} is writable for other users.*chmod go-w")


def test_a_list_of_further_users_who_may_write_is_refused(
    code: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = user("me", os.geteuid(), code.stat().st_gid)
    monkeypatch.setattr("grp.getgrgid", lambda g: grp.struct_group(("me", "x", g, [])))
    monkeypatch.setattr("pwd.getpwall", lambda: [mine])
    monkeypatch.setattr("pwd.getpwnam", lambda _: mine)
    code.chmod(0o664)
    assert trusted(code) == code
    none = 0xFFFFFFFF
    entries = [(1, 6, none), (2, 6, OTHER), (4, 4, none), (0x10, 6, none), (0x20, 4, none)]
    access = struct.pack("<I", 2) + b"".join(struct.pack("<HHI", *entry) for entry in entries)
    try:
        os.setxattr(code, "system.posix_acl_access", access)
    except OSError as error:
        pytest.skip(f"no access control lists: {error}")
    refused(code, "is writable for other users")


def test_the_folders_are_those_of_the_file_and_not_of_a_link(code: Path, tmp_path: Path) -> None:
    link = tmp_path / "link"
    link.symlink_to(code.parent)
    assert trusted(link / code.name) == code
    code.parent.parent.chmod(0o777)
    refused(link / code.name, re.escape(f"{code.parent.parent} is writable"))
    refused(link, re.escape(f"{code.parent.parent} is writable"))


def library(path: Path, number: int) -> None:
    """One whose function returns the number, in place of what is there."""
    source = path.with_suffix(".c")
    source.write_text(f"int number(void) {{ return {number}; }}\n")
    path.unlink(missing_ok=True)
    find_compiler().run("-shared", "-fPIC", source, "-o", path)


def test_libraries_that_take_each_others_place_are_each_loaded_as_opened(tmp_path: Path) -> None:
    """The loader would return the first for any that has its name, as the path or a descriptor's
    number is."""
    path, descriptors = tmp_path / "code.so", Path("/proc/self/fd")
    for number in (1, 2, 1):
        library(path, number)
        with path.open("rb") as file:
            digest = hashlib.sha256(file.read()).hexdigest()
            path.rename(tmp_path / "away.so")
            path.write_text("exchanged")
            assert ctypes.CDLL(str(loadable(file, digest))).number() == number
    before = len([*descriptors.iterdir()])
    for _ in range(10):  # equal files share one descriptor
        with (tmp_path / "away.so").open("rb") as file:
            loadable(file, digest)
    assert len([*descriptors.iterdir()]) == before


def test_what_is_kept_is_writable_for_its_owner_alone_from_its_first_byte(tmp_path: Path) -> None:
    def make(path: Path) -> None:
        assert path.parent.stat().st_mode & 0o777 == 0o700
        path.write_bytes(b"code")

    def read(path: Path) -> bytes:
        try:
            return trusted(path).read_bytes()
        except OSError as error:
            raise InputError(str(error)) from None

    before = os.umask(0)
    try:
        assert kept(tmp_path / "one" / "two" / "code", make, read) == b"code"
    finally:
        os.umask(before)


def test_a_model_from_a_cache_that_others_may_write_is_interpreted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    shared = tmp_path / "shared"
    monkeypatch.setenv("BAYESRACE_CACHE", str(shared / "cache"))
    shared.mkdir()
    shared.chmod(0o777)
    x = ca.MX.sym("x")
    twice = ca.Function("twice", [x], [2 * x])
    with caplog.at_level(logging.WARNING):
        assert compiled(twice).class_name() == twice.class_name()
    assert f"{shared} is writable" in caplog.text
    shared.chmod(0o755)
    for _ in range(2):  # made, then loaded from the cache
        external = compiled(twice)
        assert (external.class_name(), float(external(3))) == ("External", 6.0)
    (made,) = code_folder().glob("twice-*.so")
    made.chmod(0o777)
    assert compiled(twice).class_name() == "External"
    assert not made.stat().st_mode & 0o022  # made again
