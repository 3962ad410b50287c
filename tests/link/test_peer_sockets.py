"""What the kernel does not take towards the peers: counted under its name, and nothing else.

ENOBUFS and ENOMEM are raised by a socket of our own here: Linux keeps a full queue of an interface from senders over
UDP (udp_send_skb), so no test can have a real one say it.
"""

from __future__ import annotations

import errno
import socket
from typing import Any, cast

import pytest
import structlog

from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic
from uavlinkd.endpoints.sockets import Reader
from uavlinkd.ops.log import DropSummary
from uavlinkd.link.peer_sockets import PeerSockets
from uavlinkd.system.stall import StallWatch


class Refusing:
    """A socket that takes nothing while it is out of something."""

    def __init__(self, error: int) -> None:
        self.error = error
        self.is_out = True
        self.sent: list[bytes] = []

    def fileno(self) -> int:
        """As that of a closed socket."""
        return -1

    def sendto(self, datagram: bytes, address: object) -> None:
        """As a socket's."""
        if self.is_out:
            raise OSError(self.error, "out of it")
        self.sent.append(datagram)

    def recvfrom_into(self, buffer: memoryview) -> tuple[int, tuple[str, int]]:
        """As a socket's."""
        if self.is_out:
            self.is_out = False
            raise OSError(self.error, "out of it")
        raise BlockingIOError


@pytest.mark.parametrize("name", ["ENOBUFS", "ENOMEM", "EPERM", "ENETUNREACH", "EAGAIN"])
def test_what_is_not_taken_is_counted_and_the_next_is_sent(name: str) -> None:
    """A line when it begins, a count for each, and datagrams go on when there is room again."""
    lines: list[tuple[str, dict[str, Any]]] = []

    class Log:
        def warning(self, event: str, **fields: Any) -> None:
            lines.append((event, fields))

    log = cast(Any, Log())
    stall = StallWatch(0.0, lambda seconds: None)
    sockets = PeerSockets(lambda arrived, now, epoch: None, stall, DropSummary(log), structlog.get_logger())
    sockets.open([Address("127.0.0.1", 0)])
    sock = Refusing(getattr(errno, name))
    sockets._sockets[0].close()
    sockets._sockets[0] = cast(socket.socket, sock)
    for _ in range(3):
        sockets.send(b"lost", (0, "127.0.0.1", 9))
    sock.is_out = False
    sockets.send(b"there", (0, "127.0.0.1", 9))
    assert sock.sent == [b"there"]
    assert sockets.failures == {name: 3}
    assert [(event, fields["reason"]) for event, fields in lines] == [("sends_failed", name)]


def test_a_read_that_fails_for_want_of_memory_is_told_and_the_next_tried() -> None:
    """Nothing is raised into the loop."""
    failures: list[OSError] = []
    stall = StallWatch(monotonic(), lambda seconds: None)
    reader = Reader(cast(socket.socket, Refusing(errno.ENOBUFS)), failures.append, stall)
    assert reader.read()[0] == []
    assert [each.errno for each in failures] == [errno.ENOBUFS]
