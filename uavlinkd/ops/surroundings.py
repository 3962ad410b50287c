"""What a configuration needs and this machine lacks now, for ``uavlinkd check``.

It only looks: it binds no port of the configuration, opens no device (which can reset an autopilot), and writes no
file.
"""

from __future__ import annotations

import errno
import os
import shutil
import socket
import stat
import struct
import threading
from collections.abc import Iterator
from contextlib import suppress
from ipaddress import IPv4Address, IPv6Address
from pathlib import Path
from typing import NamedTuple

from uavlinkd.config import Config
from uavlinkd.endpoints.url import EndpointKind, NetworkUrl, SerialUrl
from uavlinkd.ops.control import is_served
from uavlinkd.system.addresses import Address, numeric_host, overlaps

RESOLVE_S = 3.0
"""Limit for the look-ups of all names together."""
_TCP_LISTENS = "0A"
_MAX_SOCKET_PATH = 107
_SERIAL_DEVICES = ("serial/by-id/*", "ttyACM*", "ttyUSB*", "serial0")


Answers = dict[str, list[str]]
"""The numeric hosts of each name; none if it does not resolve."""


class _Bound(NamedTuple):
    kind: str
    address: Address
    inode: str


def lacks(config: Config, answers: Answers | None = None) -> list[str]:
    """Sentences for a person. The daemon may run in spite of them, now or later.

    ``answers``: those of :func:`look_up_names`, if it was called already.
    """
    running = config.control_socket is not None and is_served(config.control_socket)
    return [
        *_serial(config),
        *_shared_devices(config),
        *_addresses(config),
        *(() if running else _ports(config)),
        *_names(config, look_up_names(config) if answers is None else answers),
        *_recording(config),
        *_control_socket(config),
    ]


def _listening(config: Config) -> Iterator[tuple[str, str, Address]]:
    """Key, transport and address of each socket that listens."""
    for address in config.listen:
        yield "listen", "udp", address
    for endpoint in config.endpoints:
        if isinstance(endpoint.url, NetworkUrl) and endpoint.url.listens:
            kind = "udp" if endpoint.url.kind is EndpointKind.UDPIN else "tcp"
            yield f"endpoint.url ({endpoint.name})", kind, endpoint.url.address
    if config.metrics is not None:
        yield "metrics.listen", "tcp", config.metrics


def _ports(config: Config) -> Iterator[str]:
    sockets = _bound_sockets()
    for key, kind, address in _listening(config):
        for bound in sockets:
            if bound.kind == kind and overlaps(bound.address, address):
                if (owner := _owner(bound.inode, config.path)) is not None:
                    yield (
                        f"{key}: {kind.upper()} port {address.port} is in use{owner}: end that process, or write"
                        " another port; if it is this daemon, all is well"
                    )
                break


def _bound_sockets(root: Path = Path("/proc/net")) -> list[_Bound]:
    bound = []
    for name in ("udp", "udp6", "tcp", "tcp6"):
        with suppress(OSError):
            for line in (root / name).read_text().splitlines()[1:]:
                fields = line.split()
                if name.startswith("udp") or fields[3] == _TCP_LISTENS:
                    bound.append(_Bound(name[:3], _address(fields[1]), fields[9]))
    return bound


def _address(text: str) -> Address:
    """``0100007F:16A6``: the words of the address in the machine's byte order."""
    host, _, port = text.partition(":")
    words = [int(host[at : at + 8], 16) for at in range(0, len(host), 8)]
    packed = struct.pack(f"={len(words)}I", *words)
    ip = IPv4Address(packed) if len(words) == 1 else IPv6Address(packed)
    return Address(str(ip), int(port, 16))


def _owner(inode: str, config_file: Path) -> str | None:
    """`` by NAME (process 12)``; empty if unknown; None if the process is a daemon of this configuration."""
    wanted = f"socket:[{inode}]"
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if any(os.readlink(descriptor) == wanted for descriptor in (process / "fd").iterdir()):
                words = (process / "cmdline").read_bytes().decode(errors="replace").split("\0")
                folder = Path(os.readlink(process / "cwd"))
                if any(word and (folder / word).resolve() == config_file.resolve() for word in words[1:]):
                    return None
                name = (process / "comm").read_text().strip()
                return f" by {name} (process {process.name})"
    return ""


def _addresses(config: Config) -> Iterator[str]:
    for key, _, address in _listening(config):
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


def _shared_devices(config: Config) -> Iterator[str]:
    """A device that has two names in the file, as those below /dev/serial/by-id. The file itself cannot show that."""
    users: dict[str, str] = {}
    for user, url in _serial_users(config):
        other = users.setdefault(os.path.realpath(url.device), user)
        if other != user:
            yield f"{user}: {url.device} is the device of {other} too, and only one can open it: write another"


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


def _recording(config: Config) -> Iterator[str]:
    if config.recording is None:
        return
    folder = config.recording.folder
    start = f"recording.folder: {folder}"
    if folder.exists() and not folder.is_dir():
        yield f"{start} is not a folder: nothing would be recorded; write the name of a folder"
    elif not folder.exists() and not folder.parent.is_dir():
        yield f"{start} cannot be made, because {folder.parent} does not exist: run `mkdir -p {folder.parent}`"
    elif not os.access(folder if folder.exists() else folder.parent, os.W_OK | os.X_OK):
        yield f"{start} cannot be written by this user: nothing would be recorded; give it to the daemon's user"
    else:
        free = shutil.disk_usage(folder if folder.exists() else folder.parent).free
        if free < config.recording.min_free_bytes:
            yield (
                f"{start} has {free / 1e9:.1f} GB of free space, less than min_free_bytes: nothing would be recorded;"
                " make room, or write a smaller min_free_bytes"
            )


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
