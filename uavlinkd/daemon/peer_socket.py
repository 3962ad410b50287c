"""One UDP socket for the peers, or its place while there is none: it may be replaced while the daemon runs."""

from __future__ import annotations

import errno
import socket
from collections.abc import Callable
from functools import partial
from typing import Any, Final

from uavlinkd.daemon.features import Sender
from uavlinkd.daemon.networks import Receive
from uavlinkd.io.reader import Reader
from uavlinkd.io.sockets import ErrorReports
from uavlinkd.protocol.path import SocketAddress
from uavlinkd.system.stall import StallWatch

RELAY_BUFFER_BYTES: Final = 1 << 22
"""Requested for the receive buffers of a relay: 10,000 short datagrams, a busy relay's in 0.2 s. The kernel may grant
less (net.core.rmem_max)."""


def send_nowhere(datagram: bytes, address: SocketAddress) -> int:
    """Send from a socket that is closed because its network is absent."""
    raise OSError(errno.ENODEV, "the network is absent")


class PeerSocket:
    """The socket of one number, for addresses of one family. A path of another kind has no socket."""

    def __init__(self, number: int, family: int = socket.AF_UNSPEC, send: Sender = send_nowhere) -> None:
        self.number = number
        self.family = family
        self.send = send
        self.sock: socket.socket | None = None
        self._reader: Reader | None = None
        self._reports: ErrorReports | None = None

    def put(self, sock: socket.socket | None) -> None:
        """Use this socket from now on, and close the one before. None: there is no socket."""
        if self._reader is not None:
            self._reader.stop()
        if self.sock is not None:
            self.sock.close()
        self.sock, self._reader, self._reports = sock, None, None
        self.send = send_nowhere if sock is None else sock.sendto

    def read(
        self, receive: Receive, on_failure: Callable[[OSError], None], stall: StallWatch, pause_s: float
    ) -> None:
        """Read it from now on. ``pause_s``: how long datagrams gather while it is busy; 0 at a relay."""
        if self.sock is not None:
            if not pause_s:
                self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RELAY_BUFFER_BYTES)
            self._reader = Reader(self.sock, partial(receive, self.number), on_failure, stall, pause_s)
            self._reader.start()
            self._reports = ErrorReports(self.sock)

    def renew_reports(self) -> None:
        """Have the kernel report errors again."""
        if self._reports is not None:
            self._reports.renew()

    def take_errors(self) -> list[tuple[tuple[Any, ...], int]]:
        """The ICMP errors of earlier datagrams: address and number of the error."""
        if self._reports is None or self._reader is None:  # not started
            return []
        reports = self._reports.take()
        self._reader.renew()
        return reports
