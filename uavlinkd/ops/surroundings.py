"""What a configuration needs and this machine lacks now, for ``uavlinkd check``: ports, devices and permissions.

It only looks: it binds no port of the configuration, opens no device (which can reset an autopilot), writes no file,
resolves no name and sends nothing.
"""

from __future__ import annotations

import errno
import os
import socket
import stat
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from uavlinkd.config.model import Config
from uavlinkd.io.sockets import family_of, look
from uavlinkd.io.url import NetworkUrl, SerialUrl

_SERIAL_DEVICES = ("serial/by-id/*", "ttyACM*", "ttyUSB*", "serial0")


def look_around(config: Config) -> list[str]:
    """Sentences for a person. The daemon may run in spite of them, now or later."""
    lacks = _serial, _listening, _others, _control_socket
    return [line for look_for in lacks for line in look_for(config)]


def _others(config: Config) -> Iterator[str]:
    """Peers, relays and clients whose address is this daemon's, or not that of one machine.

    The kernel knows the broadcast addresses of the interfaces that are up, and refuses to connect.
    """
    ports = {address.port for address in config.listen}
    sent_to = [(section, one.address) for section, _, addresses in config.others() for one in addresses]
    sent_to += [
        (f'endpoint "{one.name}"', one.url.address) for one in config.endpoints if isinstance(one.url, NetworkUrl)
    ]
    for section, address in sent_to:
        if address.ip is None:
            continue
        if address.port in ports and look(None, address.host).hosts:
            yield f"{section}: {address} is an address of this daemon itself: write that of the other machine"
        with socket.socket(family_of(address.host), socket.SOCK_DGRAM) as probe, suppress(OSError):
            if probe.connect_ex((address.host, address.port)) == errno.EACCES:
                yield f"{section}: {address} is a broadcast address: write the address of one machine"


def _listening(config: Config) -> Iterator[str]:
    listening = [("listen", address) for address in config.listen]
    listening += [
        (f"endpoint.url ({endpoint.name})", endpoint.url.address)
        for endpoint in config.endpoints
        if isinstance(endpoint.url, NetworkUrl) and endpoint.url.listens
    ]
    for key, address in listening:
        if address.ip is not None and not address.is_wildcard and not look(None, address.host).hosts:
            yield (
                f"{key}: {address.host} is not an address of this machine now (`ip -brief address` lists them): the"
                f" daemon uses it as soon as it is; for every address, write {address.wildcard()}"
            )


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
    elif not path.parent.is_dir():
        # systemd makes the folder of a service when it starts.
        if path.parent.parent != Path("/run"):
            yield f"control_socket: the folder {path.parent} does not exist: run `mkdir -p {path.parent}`"
    elif not os.access(path.parent, os.W_OK | os.X_OK):
        yield f"control_socket: this user may not write to {path.parent}: the daemon's user needs to"
