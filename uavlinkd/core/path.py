"""A path to a peer, as the shell names it."""

from __future__ import annotations

from typing import NamedTuple

SocketAddress = tuple[str, int] | tuple[str, int, int, int]
"""An Internet address as the kernel takes and gives it: host and port; for IPv6 also flow label and interface."""


class Path(NamedTuple):
    """A local socket and a peer's address there. The core compares paths, and sends along those that it was given."""

    socket: int
    """The shell's number of the socket."""
    address: SocketAddress

    @property
    def host(self) -> str:
        """The numeric host."""
        return self.address[0]
