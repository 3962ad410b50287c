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

from tests.link.socket_states import SocketStateLog
from tests.link.test_drop_summary import Recorder
from uavlinkd.core.path import Path, relayed
from uavlinkd.core.relay_records import wrap
from uavlinkd.link.drop_summary import EVERYDAY_ERRORS, DropSummary
from uavlinkd.link.evidence import Evidence
from uavlinkd.link.peer_sockets import PeerSockets
from uavlinkd.system.addresses import Address
from uavlinkd.system.stall import StallWatch


class Refusing:
    """A socket that takes nothing while it is out of something."""

    family = socket.AF_INET

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

    def close(self) -> None:
        """As a socket's."""


def sockets_with(sock: Refusing, drops: DropSummary) -> PeerSockets:
    """The sockets of a daemon, of which this is the only one."""
    stall = StallWatch(0.0, lambda seconds: None)
    sockets = PeerSockets(stall, drops, Evidence({}, b""), structlog.get_logger(), SocketStateLog())
    sockets.open([Address("127.0.0.1", 0)])
    sockets.put(0, cast(socket.socket, sock))
    return sockets


@pytest.mark.parametrize("name", ["ENOBUFS", "ENOMEM", "EPERM", "ENETUNREACH", "EAGAIN"])
def test_what_is_not_taken_is_counted_and_the_next_is_sent(name: str) -> None:
    """A line for a rare error, a count for each, and datagrams go on when there is room again."""
    log, sock = Recorder(), Refusing(getattr(errno, name))
    sockets = sockets_with(sock, DropSummary(cast(Any, log)))
    for _ in range(3):
        sockets.send(b"lost", Path(0, ("127.0.0.1", 9)))
    sock.is_out = False
    sockets.send(b"there", Path(0, ("127.0.0.1", 9)))
    assert sock.sent == [b"there"]
    assert sockets.failures == {name: 3}
    logged = [] if name in EVERYDAY_ERRORS else [("sends_failed", name)]
    assert [(event, fields["reason"]) for event, fields in log.lines] == logged


def test_relayed_path_goes_to_the_relay_or_nowhere() -> None:
    """Wrapped, along the same socket. Without its handle nothing is sent: its host is not a name to look up."""
    drops = DropSummary(structlog.get_logger())
    sock = Refusing(errno.EPERM)
    sock.is_out = False
    sockets = sockets_with(sock, drops)
    sockets.use_relays()
    sockets.handles.assign("vps", Path(0, ("127.0.0.1", 9)), [7])
    sockets.send(b"inner", relayed(0, "vps", 7))
    sockets.send(b"inner", relayed(0, "vps", 8))
    assert sock.sent == [wrap(7, b"inner")]
    assert sockets.failures == {"relay_handle_gone": 1} == drops.totals
