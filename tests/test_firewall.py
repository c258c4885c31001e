"""``bayesrace config firewall``: rules of nftables for the hosts that the configuration names."""

import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from bayesrace.configuration import NetworkSettings
from bayesrace.errors import InputError
from bayesrace.operation.firewall import rules
from tests.command_line import Cli, refused

HOSTS: dict[str, Any] = {
    "plant": ("tls/192.0.2.1:7447", "tls/[2001:db8::1]:7457", "unixsock-stream/run/plant"),
    "controller": ("tls/localhost:7448",),
    "hosts": ("192.0.2.0/28", "2001:db8:0:1::/64", "192.0.2.1"),
}


def check_syntax(text: str) -> None:
    """As nft sees it; it asks for the right to load the rules, too."""
    if shutil.which("nft") is None:
        pytest.skip("needs nft, see .ci/tools")
    unshare = ["unshare", "--net", *(["--user", "--map-root-user"] if os.geteuid() else [])]
    if subprocess.run([*unshare, "true"], capture_output=True).returncode != 0:
        pytest.skip("needs network namespaces")
    command = [*unshare, "nft", "--check", "--file", "-"]
    checked = subprocess.run(command, input=text, capture_output=True, text=True)
    assert (checked.returncode, checked.stderr) == (0, "")


@pytest.mark.check
@pytest.mark.parametrize(
    "settings",
    [
        HOSTS,
        {},  # on loopback alone
        {"plant": ("tls/0.0.0.0:7447",), "hosts": ("0.0.0.0/0", "::/0")},
        {"plant": ("tls/[::]:7447", "ws/[::1]:80"), "controller": ("tcp/192.0.2.2:7448",)},
    ],
)
@pytest.mark.parametrize("role", ["plant", "controller"])
def test_nftables_accepts_the_rules(settings: dict[str, Any], role: Any) -> None:
    check_syntax(rules(NetworkSettings(**settings), role))


def test_hosts_and_ports_are_those_of_the_configuration() -> None:
    """Each with the name that it comes from; no loopback, at which no other host is."""
    text = rules(NetworkSettings(**HOSTS), "plant")
    for line in (
        "192.0.2.1/32, # 192.0.2.1",
        "2001:db8::1/128, # 2001:db8::1",
        "192.0.2.0/28, # 192.0.2.0/28",
        "2001:db8:0:1::/64, # 2001:db8:0:1::/64",
    ):
        assert text.count(f"\t{line}\n") == 1
    assert "127.0.0" not in text
    assert text.count("tcp dport { 7447, 7457 }") == 2
    overridden = rules(NetworkSettings(**HOSTS), "plant", ("tls/0.0.0.0:9",))
    assert overridden.replace("dport { 9 }", "dport { 7447, 7457 }") == text


def test_names_are_looked_up(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [(None, None, None, None, (one, 0)) for one in ("192.0.2.9", "fe80::1%eth0")]
    monkeypatch.setattr("socket.getaddrinfo", lambda *_, **__: found)
    text = rules(NetworkSettings(hosts=("laptop.lan",)), "plant")
    assert "\t192.0.2.9/32, # laptop.lan\n" in text
    assert "\tfe80::1/128, # laptop.lan\n" in text


@pytest.mark.parametrize(
    ("settings", "role", "words"),
    [
        ({}, "router", "no endpoint at which the router listens: name one"),
        ({"router": ("tls/192.0.2.1:1",)}, "plant", "make rules for the router"),
        ({"plant": ("unixsock-stream/run/plant",)}, "plant", "Unix sockets alone"),
        ({"plant": ("tcp/127.0.0.1:0",)}, "plant", "a port that changes"),
        ({"plant": ("udp/127.0.0.1:1",)}, "plant", "not for udp: listen at one of them"),
        ({"hosts": ("no-such.invalid",)}, "plant", "'no-such.invalid' in [network] is not known"),
        ({"hosts": ("192.0.2.1/33",)}, "plant", "'192.0.2.1/33' in [network] is not known"),
    ],
)
def test_what_no_rules_can_be_made_for_is_refused(
    settings: dict[str, Any], role: Any, words: str
) -> None:
    with pytest.raises(InputError) as refusal:
        rules(NetworkSettings(**settings), role)
    assert words in str(refusal.value)


def test_the_command_prints_or_writes_them(cli: Cli, tmp_path: Path) -> None:
    file, out = tmp_path / "bayesrace.toml", tmp_path / "rules.nft"
    file.write_text('[network]\nplant = ["tls/192.0.2.1:7447"]\n')
    printed = cli("config", "firewall", "plant", "--config", file)
    assert printed.out == rules(NetworkSettings(plant=("tls/192.0.2.1:7447",)), "plant")
    for _ in range(2):  # names may have other addresses by then
        assert cli("config", "firewall", "plant", "--config", file, "--out", out).code == 0
    assert out.read_text() == printed.out
    file.write_text("[network]\nhosts = ['''192.0.2.1\n} flush ruleset''']\n")
    refused(cli("config", "firewall", "plant", "--config", file), "network.hosts")
