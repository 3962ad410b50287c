"""What a configuration needs and this machine lacks now, and what its networks reach, for ``uavlinkd check``.

It only looks: it binds no port of the configuration, opens no device (which can reset an autopilot), writes no file
and sends nothing. It asks the kernel for routes by ``ip route get`` of iproute2.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import socket
import stat
import subprocess
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from uavlinkd.config.model import Config, NetworkConfig, PeerAddress
from uavlinkd.config.network_rules import used_networks
from uavlinkd.endpoints.sockets import LINK_LOCAL, Presence, family_of, look
from uavlinkd.endpoints.url import NetworkUrl, SerialUrl
from uavlinkd.system.addresses import Address, numeric_host
from uavlinkd.system.interfaces import find_interface, interface_of

RESOLVE_S = 3.0  # limit for the look-ups of all names together
_MAX_SOCKET_PATH = 107
_SERIAL_DEVICES = ("serial/by-id/*", "ttyACM*", "ttyUSB*", "serial0")
_IP_S = 3.0  # limit for one call of `ip`
_IP = shutil.which("ip", path=f"{os.environ.get('PATH', os.defpath)}:/usr/sbin:/sbin")
"""Not in the path of every user."""
_CONF = Path("/proc/sys/net/ipv4/conf")
_STRICT = 1
"""The value of rp_filter with which the kernel drops what another interface would answer (RFC 3704)."""

Answers = dict[str, list[str]]  # the numeric hosts of each name; none if it does not resolve


class Reach(NamedTuple):
    """One network: its own addresses now, in words, and the peers' addresses that it reaches and does not reach."""

    network: NetworkConfig
    here: str
    reached: list[str]
    unreached: list[str]


class Surroundings(NamedTuple):
    """``reaches`` has all networks. ``lacks`` are sentences for a person: the daemon may run in spite of them, now or
    later. ``errors`` too, about addresses that no network reaches, or that are not those of one machine.
    """

    reaches: list[Reach]
    lacks: list[str]
    errors: list[str]


def look_around(config: Config) -> Surroundings:
    answers = _look_up_names(config)
    networks = look_at_networks(config, answers)
    here = _own_addresses(config, answers), _names(config, answers)
    others = _serial(config), _addresses(config), *here, _control_socket(config)
    errors = [*_broadcasts(config, answers), *networks.errors]
    return networks._replace(lacks=[*chain(*others), *networks.lacks], errors=errors)


def _addresses(config: Config) -> Iterator[str]:
    listening = [("listen", address) for address in config.listen]
    listening += [
        (f"endpoint.url ({endpoint.name})", endpoint.url.address)
        for endpoint in config.endpoints
        if isinstance(endpoint.url, NetworkUrl) and endpoint.url.listens
    ]
    peers = [(f'peer "{peer.name}"', written.address) for peer in config.peers for written in peer.addresses]
    interfaces = {text for number, name in socket.if_nameindex() for text in (str(number), name)}
    for key, address in [*listening, *peers]:
        host, _, zone = address.host.partition("%")
        if zone and zone not in interfaces:
            yield f"{key}: there is no network interface {zone} now: `ip -brief link` lists those of this machine"
        elif (key, address) not in listening or address.ip is None or address.is_wildcard:
            continue
        elif not look(None, address.host).hosts:
            wildcard = "0.0.0.0" if ":" not in host else "[::]"
            yield (
                f"{key}: {address.host} is not an address of this machine now (`ip -brief address` lists them): the"
                f' daemon uses it as soon as it is; for every address, write "{wildcard}:{address.port}"'
            )


def _look_up_names(config: Config) -> Answers:
    """Resolve all names at the same time, as the system does for every software."""
    answers: Answers = {address.host: [] for _, address in _named(config) if address.ip is None}

    def resolve(name: str) -> None:
        with suppress(OSError, UnicodeError):
            resolved = socket.getaddrinfo(name, None, type=socket.SOCK_DGRAM)
            answers[name] = [numeric_host(sockaddr) for *_, sockaddr in resolved]

    threads = [threading.Thread(target=resolve, args=(name,), daemon=True) for name in answers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(RESOLVE_S / len(threads))
    return dict(answers)


def _named(config: Config) -> Iterator[tuple[str, Address]]:
    """The addresses that the daemon sends to, each with its section."""
    for peer in config.peers:
        yield from ((f'peer "{peer.name}"', written.address) for written in peer.addresses if not written.is_serial)
    for relay in config.relays:
        if relay.peer is None:
            yield from ((f'relay "{relay.name}"', written.address) for written in relay.addresses)
    for endpoint in config.endpoints:
        if isinstance(endpoint.url, NetworkUrl):
            yield f'endpoint "{endpoint.name}"', endpoint.url.address


def _names(config: Config, answers: Answers) -> Iterator[str]:
    for section, address in _named(config):
        if answers.get(address.host) == []:
            yield (
                f"{section}: {address.host} has no address here now: see `getent hosts {address.host}`, or"
                f' write an IP address, such as "10.13.0.2:{address.port}"'
            )


def _own_addresses(config: Config, answers: Answers) -> Iterator[str]:
    """Peers, relays and clients whose address is this daemon's."""
    ports = {address.port for address in config.listen}
    for section, address in _named(config):
        if address.port in ports and any(
            look(None, host).hosts for host in answers.get(address.host, [address.host])
        ):
            yield f"{section}: {address} is an address of this daemon itself: write that of the other machine"


def _broadcasts(config: Config, answers: Answers) -> Iterator[str]:
    """Broadcast addresses, of which the kernel knows those of the interfaces that are up. It refuses to connect."""
    for section, address in _named(config):
        for host in answers.get(address.host, [address.host]):
            with socket.socket(family_of(host), socket.SOCK_DGRAM) as probe, suppress(OSError):
                if probe.connect_ex((host, address.port)) == errno.EACCES:
                    yield f"{section}: {address} is a broadcast address: write the address of one machine"


def _serial(config: Config) -> Iterator[str]:
    users = [(f'endpoint "{one.name}"', one.url) for one in config.endpoints if isinstance(one.url, SerialUrl)]
    users += [(f'network "{one.name}"', one.serial) for one in config.networks if one.serial is not None]
    for user, url in users:
        start, path = f"{user}: {url.device}", Path(url.device)
        try:
            if not stat.S_ISCHR(path.stat().st_mode):
                yield f"{start} is not a serial device: write one, such as /dev/ttyACM0"
            elif not os.access(path, os.R_OK | os.W_OK):
                yield (
                    f"{start} may not be opened by this user: add the daemon's user to the device's group, often"
                    " dialout (`sudo usermod -aG dialout $USER`, then log in again)"
                )
        except PermissionError:
            yield f"{start} cannot be looked at: its folder does not allow it"
        except OSError:
            present = [str(other) for pattern in _SERIAL_DEVICES for other in sorted(Path("/dev").glob(pattern))]
            listed = f"this machine has {', '.join(present) or 'no serial device'}"
            yield f"{start} is not there now: plug it in, or write another device; {listed}"


def _control_socket(config: Config) -> Iterator[str]:
    path = config.control_socket
    if path is None:
        yield 'there is no control_socket: for `uavlinkd status` and `reload`, add control_socket = "NAME.sock"'
    elif len(os.fsencode(path)) > _MAX_SOCKET_PATH:
        yield (
            f"control_socket: its path has {len(os.fsencode(path))} bytes, and a socket's may have"
            f" {_MAX_SOCKET_PATH}: the daemon will not start; write a shorter one, such as"
            ' "/run/uavlinkd/control.sock"'
        )
    elif not path.parent.is_dir():
        # systemd makes the folder of a service when it starts.
        if path.parent.parent != Path("/run"):
            yield f"control_socket: the folder {path.parent} does not exist: run `mkdir -p {path.parent}`"
    elif not os.access(path.parent, os.W_OK | os.X_OK):
        yield f"control_socket: this user may not write to {path.parent}: the daemon's user needs to"


# Networks.


class _Target(NamedTuple):
    peer: str
    written: PeerAddress
    hosts: list[str]
    """Numeric; empty if the name does not resolve now, or the address is a serial line's."""

    def __str__(self) -> str:
        return f"{self.peer} {self.written.address}"


def look_at_networks(config: Config, answers: Answers) -> Surroundings:
    targets = [
        _Target(peer.name, written, _hosts_of(written, answers))
        for peer in config.peers
        for written in peer.addresses
    ]
    reaches, missing = list[Reach](), list[str]()
    if _IP is None and any(network.serial is None for network in config.networks):
        missing.append("there is no `ip` here, so routes were not checked: install iproute2")
    for network in config.networks:
        asked = [target for target in targets if any(used_networks([network], target.written))]
        if network.serial is not None:
            reaches.append(_line(network, network.serial, asked))
            continue
        presence, start = look(network.interface, network.address), f'network "{network.name}"'
        if not presence.hosts:
            missing.append(f"{start}: {presence.reason} now: the daemon uses it as soon as it is there")
            reaches.append(Reach(network, f"absent now: {presence.reason}", [], []))
            continue
        reached = [target for target in asked if _reaches(network, presence, target)]
        unreached = [str(target) for target in asked if target.hosts and target not in reached]
        here = f"has {', '.join(presence.hosts)} now"
        reaches.append(Reach(network, here, list(map(str, reached)), unreached))
        if unreached:
            missing.append(f"{start}: it has no route to {', '.join(unreached)}: {_route_remedy(network)}")
        missing += [f"{start}: {detour}" for detour in _detours(network, presence, reached)]
    return Surroundings(reaches, missing, list(_unreachable(config.networks, targets, reaches)))


def _hosts_of(written: PeerAddress, answers: Answers) -> list[str]:
    if written.is_serial:
        return []
    host = written.address.host
    return answers.get(host, []) if written.address.ip is None else [host]


def _line(network: NetworkConfig, line: SerialUrl, asked: Iterable[_Target]) -> Reach:
    """A serial network. What it reaches is seen only by the daemon, which has the device open."""
    here = (
        f"{'is there' if os.path.exists(line.device) else 'is absent'} now; the radio carries {network.air_bits_s:,}"
        f" bits/s, this end sends up to {network.budget_bits_s:,}; set a SiK modem to"
        " MAVLINK=0, RTSCTS=1 if these wires are connected, and ECC=0"  # otherwise it cuts and mixes datagrams
    )
    return Reach(network, here, [f"{target.peer} at the other end" for target in asked], [])


def _unreachable(
    networks: Sequence[NetworkConfig], targets: Iterable[_Target], reaches: Sequence[Reach]
) -> Iterator[str]:
    """Addresses whose networks are all there, and none reaches them."""
    unreached = {reach.network.name: reach.unreached for reach in reaches}
    for target in targets:
        used = [network.name for network in used_networks(networks, target.written)]
        if used and all(str(target) in unreached[name] for name in used):
            names = ", ".join(f'"{name}"' for name in used)
            yield (
                f'peer "{target.peer}": no network reaches {target.written.address}: {names}'
                f" {'has' if len(used) == 1 else 'have'} no route to it; add one, or write another address or network"
            )


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
        elif ":" not in host and (interface := find_interface(network.interface)) and interface.has_one_end:
            return True  # a modem, a tunnel: without a route, the kernel sends it along the interface
    return False


def _route(host: str, *options: str) -> dict[str, Any] | None:
    """The kernel's route to a host. None if there is no route, or no ``ip``."""
    if _IP is None:
        return None
    words = [_IP, "-j", "route", "get", *options, host.partition("%")[0]]
    try:
        answer = subprocess.run(  # noqa: S603  a fixed command
            words, capture_output=True, text=True, timeout=_IP_S, check=False
        )
        (route,) = json.loads(answer.stdout)
    except (OSError, ValueError, subprocess.TimeoutExpired):
        return None
    return route if isinstance(route, dict) else None


def _route_remedy(network: NetworkConfig) -> str:
    if network.address is not None:
        return f"see `ip route get ADDRESS from {network.address}`"
    return f"let the network manager add a default route; see `ip route get fibmatch ADDRESS oif {network.interface}`"


def _detours(network: NetworkConfig, presence: Presence, reached: Iterable[_Target]) -> Iterator[str]:
    """An ``address`` whose datagrams leave by an interface that does not have it. An ``interface`` whose answers the
    kernel drops, because its routes lead through another one.
    """
    if network.interface is not None and max(_rp_filter("all"), _rp_filter(network.interface)) != _STRICT:
        return
    own = next((host.partition("%")[0] for host in presence.hosts if network.address or ":" not in host), "")
    interface = network.interface or interface_of(own)
    for target in reached:
        for host in target.hosts:
            if _IP is None or not own or interface is None or family_of(host) != family_of(own):
                continue
            route = _route(host, "from", own)
            leaves_by = None if route is None else route.get("dev")
            if network.interface is None and leaves_by not in (None, interface, "lo"):
                yield (
                    f"datagrams from {own} to {target} leave by {leaves_by}, and {interface} has the address: add a"
                    f" rule (`ip rule add from {own} table 100`) and a route in that table, or write interface ="
                    f' "{interface}"'
                )
                return
            if network.interface is not None and leaves_by != interface:
                yield (
                    f"rp_filter = 1 on {interface}: the kernel drops what arrives there from {target}, because its"
                    " route to it leads through another interface: run"
                    f" `sysctl -w net.ipv4.conf.{interface}.rp_filter=2`"
                )
                return


def _rp_filter(interface: str) -> int:
    try:
        return int((_CONF / interface / "rp_filter").read_text())
    except (OSError, ValueError):
        return 0
