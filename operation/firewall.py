"""Rules of nftables for the ports of a process: who may open links there, and how often.

A connection that never finishes its handshake holds Zenoh's TLS listener up for 100 ms once it has
timed out, so that some ten of them a second would keep everybody else out. Rules look at the
packets that open connections, and track none: links that stand are not touched.
"""

import socket
from collections.abc import Iterable, Sequence
from ipaddress import IPv4Network, IPv6Network, ip_network
from typing import Final

from bayesrace.configuration import NetworkSettings
from bayesrace.errors import InputError
from bayesrace.messages import Role
from bayesrace.transport.endpoints import address_of

__all__ = ["rules"]

_RULES: Final = """\
# Made by 'bayesrace config firewall {role}' of the names and addresses in [network].
#   nft -f FILE                          loads it, also in place of an older one
#   nft delete table inet {table}
table inet {table}
delete table inet {table}
table inet {table} {{
	set hosts4 {{
		type ipv4_addr; flags interval; auto-merge{hosts4}
	}}
	set hosts6 {{
		type ipv6_addr; flags interval; auto-merge{hosts6}
	}}
	set rates4 {{ type ipv4_addr . inet_service; flags dynamic,timeout; timeout 1m; size 65536; }}
	set rates6 {{ type ipv6_addr . inet_service; flags dynamic,timeout; timeout 1m; size 65536; }}
	set users {{ typeof meta skuid . tcp dport; flags dynamic,timeout; timeout 1m; size 65536; }}

	# From other hosts: those that [network] names. Each may open two links to a port at once, and
	# one every two seconds; beyond that, all share two a second. Whoever is refused tries again.
	chain input {{
		type filter hook input priority filter - 1
		iif lo accept
		tcp dport {{ {ports} }} tcp flags & (fin | syn | rst | ack) == syn jump opened
	}}
	chain opened {{
		ip saddr != @hosts4 counter drop
		ip6 saddr != @hosts6 counter drop
		update @rates4 {{ ip saddr . tcp dport limit rate 30/minute burst 2 packets }} accept
		update @rates6 {{ ip6 saddr . tcp dport limit rate 30/minute burst 2 packets }} accept
		limit rate 2/second burst 2 packets accept
		counter reject with tcp reset
	}}

	# From this machine, each user instead of each host.
	chain output {{
		type filter hook output priority filter - 1
		oif lo tcp dport {{ {ports} }} tcp flags & (fin | syn | rst | ack) == syn jump opened_here
	}}
	chain opened_here {{
		update @users {{ meta skuid . tcp dport limit rate 30/minute burst 2 packets }} accept
		limit rate 2/second burst 2 packets accept
		counter reject with tcp reset
	}}
}}
"""

_ANY: Final = ("0.0.0.0", "::")  # noqa: S104 (an address to listen on, and no host)


def rules(network: NetworkSettings, role: Role, listen: Sequence[str] = ()) -> str:
    """Rules for a process that listens as configured, or at ``listen``; names are looked up now.

    InputError if it listens at no port of TCP, or if a name is not known.
    """
    where = tuple(listen) or network.listens(role)
    if not where:
        remedy = "make rules for the router" if network.by_router else "name one, or give --listen"
        raise InputError(f"[network] has no endpoint at which the {role} listens: {remedy}")
    addresses = [address_of(one) for one in where]
    unruled = [one.protocol for one in addresses if one.protocol in ("udp", "quic")]
    if unruled:
        raise InputError(
            f"rules are for tcp, tls and ws, not for {unruled[0]}: listen at one of them"
        )
    ports = sorted({one.port for one in addresses if one.protocol != "unixsock-stream"})
    if 0 in ports or not ports:
        why = "a port that changes" if ports else "Unix sockets alone, which no other host reaches"
        raise InputError(f"the {role} listens at {why}: there is nothing to make rules for")
    others = (*network.plant, *network.controller, *network.shadow, *network.router)
    named = map(address_of, others)
    hosts = [one.host for one in named if one.port and one.host not in _ANY]
    found = _looked_up((*hosts, *network.hosts))
    return _RULES.format(
        role=role,
        table=f"bayesrace_{role}",
        ports=", ".join(map(str, ports)),
        hosts4=_elements(found, IPv4Network),
        hosts6=_elements(found, IPv6Network),
    )


_Network = IPv4Network | IPv6Network


def _looked_up(hosts: Iterable[str]) -> dict[_Network, str]:
    """Networks by names; loopback, at which no other host is, left out."""
    found: dict[_Network, str] = {}
    for host in hosts:
        try:
            networks = [ip_network(host, strict=False)]
        except ValueError:
            networks = [ip_network(one.partition("%")[0]) for one in _resolved(host)]
        found |= {one: host for one in networks if not one.is_loopback}
    return found


def _resolved(host: str) -> list[str]:
    try:
        found = socket.getaddrinfo(host, None, proto=socket.IPPROTO_TCP)
    except (OSError, UnicodeError):
        raise InputError(
            f"the name '{host}' in [network] is not known: correct it, or give an address"
        ) from None
    return [str(one[4][0]) for one in found]


def _elements(found: dict[_Network, str], kind: type[_Network]) -> str:
    lines = "".join(f"\t\t\t{one}, # {host}\n" for one, host in found.items() if type(one) is kind)
    return f"\n\t\telements = {{\n{lines}\t\t}}" if lines else ""
