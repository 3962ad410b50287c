"""What each ``[[network]]`` reaches on this machine now, for ``uavlinkd check``.

It only looks: it asks the kernel for routes (by ``ip route get`` of iproute2), sends nothing and binds no port of the
configuration.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from uavlinkd.config import Config, NetworkConfig, PeerAddress
from uavlinkd.config.network_rules import used_networks
from uavlinkd.endpoints.sockets import LINK_LOCAL, Presence, family_of, look
from uavlinkd.endpoints.url import SerialUrl
from uavlinkd.system.interfaces import find_interface, interface_of

_IP_S = 3.0
"""Limit for one call of ``ip``."""
_STRICT = 1
"""The value of rp_filter with which the kernel drops what another interface would answer (RFC 3704)."""
_CONF = Path("/proc/sys/net/ipv4/conf")
_IP = shutil.which("ip", path=f"{os.environ.get('PATH', os.defpath)}:/usr/sbin:/sbin")
"""Not in the path of every user."""


SIK_SETTINGS: Final = "MAVLINK=0, RTSCTS=1 if these wires are connected, and ECC=0"
"""What ``status`` and ``check`` advise. With another value of MAVLINK the modem cuts and mixes datagrams."""


class Reach(NamedTuple):
    """One network: its own addresses now, in words, and the peers' addresses that it reaches and does not reach."""

    network: NetworkConfig
    here: str
    reached: list[str]
    unreached: list[str]


class NetworkReport(NamedTuple):
    """All networks. ``lacks`` are sentences for a person; ``errors`` too, about addresses that no network reaches."""

    reaches: list[Reach]
    lacks: list[str]
    errors: list[str]


class _Target(NamedTuple):
    peer: str
    written: PeerAddress
    hosts: list[str]
    """Numeric; empty if the name does not resolve now."""

    def __str__(self) -> str:
        return f"{self.peer} {self.written.address}"


def look_at_networks(config: Config, answers: dict[str, list[str]]) -> NetworkReport:
    """What the networks of a configuration reach now. ``answers``: the numeric hosts of each name in it."""
    targets = [
        _Target(peer.name, written, _hosts_of(written, answers))
        for peer in config.peers
        for written in peer.addresses
    ]
    presences = {
        network.name: look(network.interface, network.address)
        for network in config.networks
        if network.serial is None
    }
    reaches, lacks = list[Reach](), list[str]()
    if presences and _IP is None:
        lacks.append("there is no `ip` here, so routes were not checked: install iproute2")
    for network in config.networks:
        if network.serial is not None:
            reaches.append(_line(network, network.serial, targets))
            continue
        presence, start = presences[network.name], f'network "{network.name}"'
        asked = [target for target in targets if any(used_networks([network], target.written))]
        if not presence.hosts:
            lacks.append(f"{start}: {presence.reason} now: the daemon uses it as soon as it is there")
            reaches.append(Reach(network, f"absent now: {presence.reason}", [], []))
            continue
        reached = [target for target in asked if _reaches(network, presence, target)]
        unreached = [target for target in asked if target.hosts and target not in reached]
        here = f"has {', '.join(presence.hosts)} now"
        reaches.append(Reach(network, here, list(map(str, reached)), list(map(str, unreached))))
        if unreached:
            lacks.append(f"{start}: it has no route to {', '.join(map(str, unreached))}: {_route_remedy(network)}")
        lacks += _rules(network, reached)
        lacks += _strict(network, presence, reached)
    return NetworkReport(reaches, lacks, list(_unreachable(config.networks, targets, reaches)))


def _line(network: NetworkConfig, line: SerialUrl, targets: Iterable[_Target]) -> Reach:
    """A serial network. What it reaches is seen only by the daemon, which has the device open."""
    here = (
        f"{'is there' if os.path.exists(line.device) else 'is absent'} now; the radio carries {network.air_bits_s:,}"
        f" bits/s, this end sends up to {network.budget_bits_s:,}; set a SiK modem to {SIK_SETTINGS}"
    )
    peers = [target.peer for target in targets if any(used_networks([network], target.written))]
    return Reach(network, here, [f"{peer} at the other end" for peer in peers], [])


def _hosts_of(written: PeerAddress, answers: dict[str, list[str]]) -> list[str]:
    if written.is_serial:
        return []
    host = written.address.host
    return answers.get(host, []) if written.address.ip is None else [host]


def _unreachable(
    networks: Sequence[NetworkConfig], targets: Iterable[_Target], reaches: Sequence[Reach]
) -> Iterator[str]:
    """Addresses whose networks are all there, and none reaches them."""
    by_name = {reach.network.name: reach for reach in reaches}
    for target in targets:
        if target.written.is_serial:
            continue
        used = [by_name[network.name] for network in used_networks(networks, target.written)]
        if used and all(str(target) in reach.unreached for reach in used):
            names = ", ".join(f'"{reach.network.name}"' for reach in used)
            yield (
                f'peer "{target.peer}": no network reaches {target.written.address}: {names}'
                f" {'has' if len(used) == 1 else 'have'} no route to it; add one, or write another address or network"
            )


# Routes.


def _reaches(network: NetworkConfig, presence: Presence, target: _Target) -> bool:
    """Whether the network has a route to one of the hosts of a target."""
    if _IP is None:
        return True
    for host in target.hosts:
        owns = [own for own in presence.hosts if family_of(own) == family_of(host)]
        if not owns:
            continue
        if network.interface is None:
            if _route(host, "from", owns[0].partition("%")[0]):
                return True
        elif host.startswith(LINK_LOCAL) or _route(host, "fibmatch", "oif", network.interface):
            return True
        elif ":" not in host and _has_no_neighbours(network.interface):
            return True  # without a route, the kernel sends it along the interface
    return False


def _has_no_neighbours(name: str) -> bool:
    """Whether an interface has one other end, which needs no route and no ARP: a modem, a tunnel."""
    interface = find_interface(name)
    return interface is not None and interface.has_one_end


def _route(host: str, *options: str) -> dict[str, Any] | None:
    """The kernel's route to a host. None if there is no route, or no ``ip``."""
    if _IP is None:
        return None
    words = [_IP, "-j", "route", "get", *options, host.partition("%")[0]]
    try:
        answer = subprocess.run(words, capture_output=True, text=True, timeout=_IP_S, check=False)  # noqa: S603  a fixed command
        (route,) = json.loads(answer.stdout)
    except (OSError, ValueError, subprocess.TimeoutExpired):
        return None
    return route if isinstance(route, dict) else None


def _route_remedy(network: NetworkConfig) -> str:
    if network.address is not None:
        return f"see `ip route get ADDRESS from {network.address}`"
    return f"let the network manager add a default route; see `ip route get fibmatch ADDRESS oif {network.interface}`"


def _rules(network: NetworkConfig, reached: Iterable[_Target]) -> Iterator[str]:
    """An ``address`` whose datagrams leave by an interface that does not have it."""
    if network.address is None:
        return
    own = network.address.partition("%")[0]
    interface = interface_of(own)
    for target in reached:
        for host in target.hosts:
            route = _route(host, "from", own) if family_of(host) == family_of(own) else None
            if route is not None and interface is not None and route.get("dev") not in (interface, "lo"):
                yield (
                    f'network "{network.name}": datagrams from {own} to {target} leave by {route.get("dev")}, and'
                    f" {interface} has the address: add a rule (`ip rule add from {own} table 100`) and a route in"
                    f' that table, or write interface = "{interface}"'
                )
                return


def _strict(network: NetworkConfig, presence: Presence, reached: Iterable[_Target]) -> Iterator[str]:
    """An interface whose answers the kernel drops, because its routes lead through another one."""
    name = network.interface
    if name is None or max(_rp_filter("all"), _rp_filter(name)) != _STRICT:
        return
    own = next((host for host in presence.hosts if ":" not in host), None)
    for target in reached:
        for host in target.hosts:
            if ":" in host or own is None:
                continue
            route = _route(host, "from", own)
            if route is None or route.get("dev") != name:
                yield (
                    f'network "{network.name}": rp_filter = 1 on {name}: the kernel drops what arrives there from'
                    f" {target}, because its route to it leads through another interface: run"
                    f" `sysctl -w net.ipv4.conf.{name}.rp_filter=2`"
                )
                return


def _rp_filter(interface: str) -> int:
    try:
        return int((_CONF / interface / "rp_filter").read_text())
    except (OSError, ValueError):
        return 0
