"""A path to a peer, as the shell names it."""

from __future__ import annotations

from typing import NamedTuple

SocketAddress = tuple[str, int] | tuple[str, int, int, int]
"""An Internet address as the kernel takes and gives it: host and port; for IPv6 also flow label and interface."""

SERIAL_HOST = "serial"
"""The host of the only path along a serial network: ``Path(socket, (SERIAL_HOST, 0))``."""


RELAY_HOST = "relay "
"""How the host of a relayed path begins; the relay's name follows. See :func:`relayed`."""


class Path(NamedTuple):
    """A local socket and a peer's address there. The core compares paths, and sends along those that it was given."""

    socket: int
    """The shell's number of the socket."""
    address: SocketAddress

    @property
    def host(self) -> str:
        """The numeric host."""
        return self.address[0]

    @property
    def is_serial(self) -> bool:
        """Whether it is a line, which has no addresses."""
        return self.address[0] == SERIAL_HOST

    @property
    def is_relayed(self) -> bool:
        """Whether it leads through a relay."""
        return self.address[0].startswith(RELAY_HOST)

    @property
    def sender(self) -> SocketAddress | str:
        """What has budgets of its own: a place, or a relay with all its handles."""
        return self.host if self.is_relayed else self.place

    @property
    def place(self) -> SocketAddress:
        """Where the peer is, whichever socket reaches it. Each line is a place of its own."""
        return (SERIAL_HOST, self.socket) if self.is_serial else self.address


def relayed(socket: int, relay: str, handle: int) -> Path:
    """The path along a relay, by its name here, with a handle that it assigned on this socket."""
    return Path(socket, (RELAY_HOST + relay, handle))
