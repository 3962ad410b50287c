"""What the names of errors mean for an operator: one table for the status, the log and ``check``.

The names are the kernel's (``ECONNREFUSED``), and the daemon's own for failures without such a name.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping
from string import digits
from typing import Final

NAME_NOT_RESOLVED: Final = "name_not_resolved"
ADDRESS_NOT_HERE_YET: Final = "address_not_here_yet"
CONNECTED: Final = "connected"  # by TLS

_COMPARE: Final = "compare the URL with `https` in the relay's file, or try another network"
_BROKEN: Final = "not_websocket", "long_header", "text", "fragment", "long_message", "protocol", "pings"
_CUT: Final = "closed", "no_pong", "not_reading", "ECONNRESET", "EPIPE", "ETIMEDOUT"

WEB_ERRORS: Final[Mapping[str, str]] = {
    "not_resolved": "the name has no address now: see `getent hosts NAME`, or write an IP address into the URL",
    "TimeoutError": "no answer in time: open TCP port 443 at the relay; a firewall here may drop TCP too",
    "proxy_407": "the proxy wants a name and password: write HTTPS_PROXY=http://USER:PASSWORD@HOST:PORT",
    "proxy_": "the proxy refuses to connect to the relay: its owner must permit CONNECT to this host and port",
    "proxy_not_http": "HTTPS_PROXY names a proxy of another kind: write http://HOST:PORT of an HTTP proxy",
    "proxy_not_understood": "HTTPS_PROXY is wrong, or no HTTP proxy answers there: write http://HOST:PORT",
    "tls": f"no TLS at this port, or a firewall that inspects TLS ends it: {_COMPARE}",
    "slow_handshake": f"something accepts the connection and does not answer: {_COMPARE}",
    "http_404": "a web server answers there, but not for this path: correct the URL, or the server before the relay",
    "http_": "a web server, proxy or login page there refuses: log in to this network, or correct the web server",
    **dict.fromkeys(_BROKEN, f"what answers there is no relay: {_COMPARE}"),
    **dict.fromkeys(
        _CUT, "the connection ends soon: wait for the next one; a firewall may cut it: try another network"
    ),
    "silent": "it is connected, and gets no answer: compare the public_key of the [[relay]] with `uavlinkd pubkey`"
    " there, and look whether this daemon is a member there",
}
"""Why a member does not reach its relay by TLS, as in ops/README.md. ``http_`` and ``proxy_``: any other status."""

ERROR_MEANINGS: Final[Mapping[str, str]] = {
    # The network.
    "EPERM": "this machine's firewall, or the service's unit, does not permit it: see `sudo nft list ruleset` here",
    "ENETUNREACH": "this machine has no route to the address: bring the network up, and see `ip route get ADDRESS`",
    "EHOSTUNREACH": "no machine answers at the address: it is off, or its address is wrong; or a firewall rejects",
    "ENETDOWN": "the network interface is down: see `ip -brief link` here",
    "ECONNREFUSED": "no process listens there now: start it, or correct the port",
    "ECONNRESET": "the other end closed the connection",
    "EPIPE": "the other end closed the connection",
    "ETIMEDOUT": "the other end does not answer",
    "EADDRNOTAVAIL": "this machine does not have the address: see `ip -brief address` here",
    "EADDRINUSE": "another process has the port: end it (`ss -lntup` names it), or write another port",
    "EAFNOSUPPORT": "this machine cannot use addresses of this family (IPv4 or IPv6)",
    "EINVAL": "the address cannot be used from here: a link-local address (fe80::) needs its interface, as in %wlan0,"
    " and a daemon that listens on loopback reaches only this machine",
    "EMSGSIZE": "the datagram is larger than the path permits: the daemon finds out what the path carries",
    "EAGAIN": "the network card or its driver accepts no more data now: the machine sends more than it can carry",
    "ENOBUFS": "the network card or its driver accepts no more data now: the machine sends more than it can carry",
    NAME_NOT_RESOLVED: "the name has no address now: see `getent hosts NAME`, or write an IP address."
    " The daemon tries again each second",
    ADDRESS_NOT_HERE_YET: "no interface has the address: write it correctly, or wait."
    ' The socket works as soon as an interface has it. "0.0.0.0" stands for every address',
    "relay_handle_gone": "a relay no longer forwards to the peer, for example after its restart: the daemon asks it"
    " again by itself",
    # Connections to a relay by TLS.
    "too_many_connections": "this relay has as many connections by TLS as it may: run several relays",
    "displaced": "too many connections that no member has proved: a scan or an attack, or many members start at once",
    # Files and devices.
    "ENOENT": "there is no such file or device now: plug it in, or correct its name",
    "ENXIO": "the device has gone: plug it in again",
    "ENODEV": "the device has gone: plug it in again",
    "EIO": "the device does not work: it was unplugged, or is broken",
    "EACCES": "this user has no permission: for a serial device, add the user to its group, often dialout; for UDP,"
    " write the address of one machine: this is a broadcast address",
    "EBUSY": "another process has the device: end it (`fuser -v DEVICE` names it), often ModemManager",
    "ENOTTY": "it is not a serial device: name one, such as /dev/ttyUSB0",
    "EISDIR": "it is a folder: name a device, such as /dev/ttyUSB0",
    # Limits of the process.
    "EMFILE": "the daemon has no file descriptor left: raise LimitNOFILE in its unit",
    "ENFILE": "the machine has no file descriptor left",
    "ENOMEM": "the machine has no memory left",
}
"""The meaning of each name: a short statement, often with a remedy, without a full stop at the end."""


def web_problem(reason: str) -> tuple[str, str]:
    """Why a member does not reach its relay by TLS, and the remedy: of an error of the kernel that may be empty."""
    meaning = WEB_ERRORS.get(reason) or WEB_ERRORS.get(reason.rstrip(digits)) or meaning_of(reason)
    what, _, remedy = meaning.partition(": ")
    return (f"{what} ({reason})", remedy) if what else (reason, "")


def meaning_of(name: str) -> str:
    """What an error means and what an operator can do. Without a line in the table: the system's own text."""
    if name in ERROR_MEANINGS:
        return ERROR_MEANINGS[name]
    number = getattr(errno, name, None) if name in errno.errorcode.values() else None
    return "" if number is None else os.strerror(number)
