"""A UDP socket that is bound to every address of the machine answers from the address that was asked (Linux).

By itself the kernel answers from the address that it prefers for the receiver. A firewall, a NAT or a connected
socket may drop such an answer: with a second address of an interface, a VPN, or a second uplink.
"""

from __future__ import annotations

import socket
import sys
from math import inf
from typing import Any, Final

from uavlinkd.system.clock import monotonic

# linux/in.h, linux/in6.h: level, option, kind of control message, and its bytes before the own address; 4 are behind.
_PKTINFO: Final = {socket.AF_INET: (socket.IPPROTO_IP, 8, 8, 4), socket.AF_INET6: (socket.IPPROTO_IPV6, 49, 50, 0)}
_INTERFACE_NAME_BYTES: Final = 16  # IFNAMSIZ: linux/if.h
ROUTES_VALID_S: Final = 5.0
"""How long the daemon remembers which own address the kernel prefers for a receiver: routes change."""
MOST_SENDERS: Final = 4096
"""Most senders whose addresses are remembered."""


class WildcardSocket(socket.socket):
    """The address of a sender ends in the own address that it asked, if the kernel would answer from another one.

    A datagram to such an address leaves from that own address. The routes choose the interface.
    """

    __slots__ = ("_pktinfo", "_senders", "_valid_until")

    def __init__(self, family: int = -1, kind: int = -1, proto: int = -1, fileno: int | None = None) -> None:
        super().__init__(family, kind, proto, fileno)
        self._pktinfo = _PKTINFO[self.family]
        self._senders: dict[tuple[tuple[Any, ...], bytes], tuple[Any, ...]] = {}
        self._valid_until = -inf
        level, option, _, _ = self._pktinfo
        self.setsockopt(level, option, 1)

    def recvfrom_into(self, buffer: Any, nbytes: int = 0, flags: int = 0) -> tuple[int, tuple[Any, ...]]:
        """Receive a datagram and the address of its sender."""
        size, control, _, sender = self.recvmsg_into((buffer,), 64, flags)
        key = sender, control[0][2]
        now = monotonic()
        if now >= self._valid_until or len(self._senders) >= MOST_SENDERS:
            self._senders.clear()
            self._valid_until = now + ROUTES_VALID_S
        address = self._senders.get(key)
        if address is None:
            address = self._senders[key] = self._address(*key)
        return size, address

    def sendto(self, data: Any, address: Any) -> int:  # type: ignore[override]  # without flags
        """Send a datagram, from the own address in ``address`` if there is one."""
        if not isinstance(address[-1], str):
            return super().sendto(data, address)
        level, _, kind, lead = self._pktinfo
        info = bytes(lead) + socket.inet_pton(self.family, address[-1]) + bytes(4)
        return self.sendmsg((data,), ((level, kind, info),), 0, address[:-1])

    def _address(self, sender: tuple[Any, ...], info: bytes) -> tuple[Any, ...]:
        host = socket.inet_ntop(self.family, info[self._pktinfo[3] : -4])
        try:
            with sibling(self) as other:
                other.connect(sender)
                preferred = other.getsockname()[0].partition("%")[0]
        except OSError:  # no route leads there now
            return sender
        is_multicast = host.startswith(
            "ff"
        )  # of IPv6; it cannot be a source. For IPv4 the kernel names an own address
        return sender if preferred == host or is_multicast else (*sender, host)


def sibling(sock: socket.socket) -> socket.socket:
    """A new UDP socket of the same family, bound to the same interface, if any."""
    other = socket.socket(sock.family, socket.SOCK_DGRAM)
    if sys.platform == "linux":
        if interface := sock.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, _INTERFACE_NAME_BYTES):
            other.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, interface)
    return other
