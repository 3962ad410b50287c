"""What a configuration needs and this machine lacks now, for ``uavlinkd check``.

It only looks: it binds no port of the configuration, opens no device (which can reset an autopilot), and writes no
file.
"""

from __future__ import annotations

import errno
import os
import socket
import stat
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from uavlinkd.config import Config
from uavlinkd.endpoints.url import NetworkUrl, SerialUrl
from uavlinkd.system.addresses import Address, numeric_host

RESOLVE_S = 3.0
"""Limit for the look-ups of all names together."""
_MAX_SOCKET_PATH = 107
_SERIAL_DEVICES = ("serial/by-id/*", "ttyACM*", "ttyUSB*", "serial0")


Answers = dict[str, list[str]]
"""The numeric hosts of each name; none if it does not resolve."""


def lacks(config: Config, answers: Answers | None = None) -> list[str]:
    """Sentences for a person. The daemon may run in spite of them, now or later.

    ``answers``: those of :func:`look_up_names`, if it was called already.
    """
    return [
        *_serial(config),
        *_addresses(config),
        *_names(config, look_up_names(config) if answers is None else answers),
        *_control_socket(config),
    ]


def _listening(config: Config) -> Iterator[tuple[str, Address]]:
    """Key and address of each socket that listens."""
    yield from (("listen", address) for address in config.listen)
    for endpoint in config.endpoints:
        if isinstance(endpoint.url, NetworkUrl) and endpoint.url.listens:
            yield f"endpoint.url ({endpoint.name})", endpoint.url.address
    if config.metrics is not None:
        yield "metrics.listen", config.metrics


def _addresses(config: Config) -> Iterator[str]:
    for key, address in _listening(config):
        host, _, zone = address.host.partition("%")
        if zone and not _has_interface(zone):
            yield f"{key}: there is no network interface {zone} now: `ip -brief link` lists those of this machine"
        elif address.ip is not None and not address.is_wildcard and not _is_here(address):
            wildcard = "0.0.0.0" if ":" not in host else "[::]"
            yield (
                f"{key}: {address.host} is not an address of this machine now (`ip -brief address` lists them): the"
                f' daemon uses it as soon as it is; for every address, write "{wildcard}:{address.port}"'
            )
    for peer in config.peers:
        for written in peer.addresses:
            zone = written.address.host.partition("%")[2]
            if zone and not _has_interface(zone):
                yield (
                    f'peer "{peer.name}": there is no network interface {zone} now: `ip -brief link` lists those of'
                    " this machine"
                )


def _has_interface(zone: str) -> bool:
    if zone.isdigit():
        return any(number == int(zone) for number, _ in socket.if_nameindex())
    return any(name == zone for _, name in socket.if_nameindex())


def _is_here(address: Address) -> bool:
    """Whether a socket can be bound to the address. The kernel chooses the port."""
    with suppress(OSError):
        family, *_, sockaddr = socket.getaddrinfo(
            address.host, 0, type=socket.SOCK_DGRAM, flags=socket.AI_NUMERICHOST
        )[0]
        with socket.socket(family, socket.SOCK_DGRAM) as sock:
            try:
                sock.bind(sockaddr)
            except OSError as error:
                return error.errno != errno.EADDRNOTAVAIL
    return True


def look_up_names(config: Config) -> Answers:
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


def _named(config: Config) -> list[tuple[str, Address]]:
    """The addresses that the daemon sends to, each with its section."""
    wanted = [
        (f'peer "{peer.name}"', written.address)
        for peer in config.peers
        for written in peer.addresses
        if not written.is_serial
    ]
    wanted += [
        (f'relay "{relay.name}"', written.address)
        for relay in config.relays
        if relay.peer is None
        for written in relay.addresses
    ]
    wanted += [
        (f'endpoint "{endpoint.name}"', endpoint.url.address)
        for endpoint in config.endpoints
        if isinstance(endpoint.url, NetworkUrl)
    ]
    return wanted


def _names(config: Config, answers: Answers) -> Iterator[str]:
    for section, address in _named(config):
        if answers.get(address.host) == []:
            yield (
                f"{section}: {address.host} has no address here now: see `getent hosts {address.host}`, or"
                f' write an IP address, such as "10.13.0.2:{address.port}"'
            )


def _serial(config: Config) -> Iterator[str]:
    for user, url in _serial_users(config):
        if why := _serial_problem(Path(url.device)):
            yield f"{user}: {url.device} {why}"


def _serial_users(config: Config) -> Iterator[tuple[str, SerialUrl]]:
    for endpoint in config.endpoints:
        if isinstance(endpoint.url, SerialUrl):
            yield f'endpoint "{endpoint.name}"', endpoint.url
    for network in config.networks:
        if network.serial is not None:
            yield f'network "{network.name}"', network.serial


def _serial_problem(path: Path) -> str | None:
    try:
        is_device = stat.S_ISCHR(path.stat().st_mode)
    except PermissionError:
        return "cannot be looked at: its folder does not allow it"
    except OSError:
        present = [str(other) for pattern in _SERIAL_DEVICES for other in sorted(Path("/dev").glob(pattern))]
        listed = f"this machine has {', '.join(present)}" if present else "this machine has no serial device"
        return f"is not there now: plug it in, or write another device; {listed}"
    if not is_device:
        return "is not a serial device: write one, such as /dev/ttyACM0"
    if not os.access(path, os.R_OK | os.W_OK):
        return (
            "may not be opened by this user: add the daemon's user to the device's group, often dialout"
            " (`sudo usermod -aG dialout $USER`, then log in again)"
        )
    return None


def _control_socket(config: Config) -> Iterator[str]:
    path = config.control_socket
    if path is None:
        yield 'there is no control_socket: for `uavlinkd status` and `reload`, add control_socket = "NAME.sock"'
        return
    if len(os.fsencode(path)) > _MAX_SOCKET_PATH:
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
