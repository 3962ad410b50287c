"""What the kernel does not take towards the peers: counted under its name, and nothing else.

ENOBUFS and ENOMEM are raised by a socket of our own here: Linux keeps a full queue of an interface from senders over
UDP (udp_send_skb), so no test can have a real one say it.
"""

from __future__ import annotations

import asyncio
import errno
import socket
import sys
from types import SimpleNamespace
from typing import Any, cast

import pytest
import structlog
from structlog.testing import capture_logs

from tests.daemon.socket_states import SocketStateLog
from tests.needs import need
from tests.waiting import until
from uavlinkd.config.model import NetworkConfig, PeerAddress
from uavlinkd.daemon import networks as module
from uavlinkd.daemon.evidence import Evidence
from uavlinkd.daemon.journal import DaemonJournal
from uavlinkd.daemon.peer_names import REFRESH_S
from uavlinkd.daemon.peer_sockets import PeerSockets
from uavlinkd.io.resolver import LONGEST_WAIT_S, RELAXED_WAIT_S
from uavlinkd.io.sockets import Presence
from uavlinkd.protocol.path import Path, relayed
from uavlinkd.protocol.relay_records import wrap
from uavlinkd.relay.client_link import RelayHandles
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


def sockets_with(sock: Refusing, drops: DaemonJournal) -> PeerSockets:
    """The sockets of a daemon, of which this is the only one."""
    stall = StallWatch(0.0, lambda seconds: None)
    sockets = PeerSockets(stall, drops, Evidence({}, b""), structlog.get_logger(), SocketStateLog())
    sockets.open([Address("127.0.0.1", 0)])
    sockets.put(0, cast(socket.socket, sock))
    return sockets


@pytest.mark.parametrize("name", ["ENOBUFS", "ENOMEM", "EPERM", "ENETUNREACH", "EAGAIN"])
def test_what_is_not_taken_is_counted_and_the_next_is_sent(name: str) -> None:
    """A count for each, and datagrams go on when there is room again."""
    journal, sock = DaemonJournal(), Refusing(getattr(errno, name))
    sockets = sockets_with(sock, journal)
    for _ in range(3):
        sockets.send(b"lost", Path(0, ("127.0.0.1", 9)))
    sock.is_out = False
    sockets.send(b"there", Path(0, ("127.0.0.1", 9)))
    assert sock.sent == [b"there"]
    assert sockets.failures == {name: 3} == journal.totals


def test_relayed_path_goes_to_the_relay_or_nowhere() -> None:
    """Wrapped, along the same socket. Without its handle nothing is sent: its host is not a name to look up."""
    drops = DaemonJournal()
    sock = Refusing(errno.EPERM)
    sock.is_out = False
    sockets = sockets_with(sock, drops)
    handles = RelayHandles()
    sockets.use_relays(handles.wrap)
    handles.assign("vps", Path(0, ("127.0.0.1", 9)), [7])
    sockets.send(b"inner", relayed(0, "vps", 7))
    sockets.send(b"inner", relayed(0, "vps", 8))
    assert sock.sent == [wrap(7, b"inner")]
    assert sockets.failures == {"relay_handle_gone": 1} == drops.totals


# The paths to a peer along networks, and what failed sends cause. The networks are made up, on loopback.

LTE = NetworkConfig("lte", interface="lo")
MESH = NetworkConfig("mesh", address="127.0.0.2")
LTE_V4, LTE_V6, MESH_V4 = 0, 1, 2
HERE = {("lo", None): Presence(1, ("127.0.0.1", "::1")), (None, "127.0.0.2"): Presence(0, ("127.0.0.2",))}
V4, V6 = Address("127.0.0.9", 5790), Address("::9", 5790)


class Link:
    """A link whose paths are noted."""

    name = "drone1"

    def __init__(self, *addresses: PeerAddress) -> None:
        self.config = SimpleNamespace(addresses=addresses)
        self.states: dict[Path, Any] = {}
        self.peer = SimpleNamespace(is_up=True, paths=SimpleNamespace(find=self.states.get))
        self.paths: list[Path] = []

    def set_paths(self, paths: list[Path], now: float) -> None:
        """As a link's."""
        self.paths = list(paths)


class Scene:
    """Sockets of two networks."""

    def __init__(self) -> None:
        self.present = dict(HERE)
        self.core = SocketStateLog()
        self.drops = DaemonJournal()
        stall = StallWatch(0.0, lambda seconds: None)
        log = structlog.get_logger()
        self.sockets = PeerSockets(stall, self.drops, Evidence({}, b""), log, self.core)
        self.changes = 0

    def follow(self, link: Link) -> None:
        """Have the names of a link resolved."""
        self.sockets.follow(cast(Any, link))

    def count_change(self) -> None:
        """The networks changed."""
        self.changes += 1


@pytest.fixture
async def scene(monkeypatch: pytest.MonkeyPatch) -> Any:
    need(sys.platform == "linux", "Linux")
    made = Scene()
    monkeypatch.setattr(module, "look", lambda interface, address: made.present[interface, address])
    made.sockets.open([], [LTE, MESH])
    made.sockets.start(lambda *read: None, made.count_change)
    yield made
    made.sockets.close()


def paths(address: Address, *numbers: int) -> list[Path]:
    """The paths to an address from these sockets."""
    sockaddr: Any = (address.host, address.port, *((0, 0) if ":" in address.host else ()))
    return [Path(number, sockaddr) for number in numbers]


async def test_address_is_used_on_its_network_or_on_all_of_its_family(scene: Scene) -> None:
    """In the order of the file."""
    link = Link(PeerAddress(V6), PeerAddress(V4), PeerAddress(Address("127.0.0.8", 5790), "mesh"))
    scene.follow(link)
    assert link.paths == [
        *paths(V6, LTE_V6),
        *paths(V4, LTE_V4, MESH_V4),
        *paths(Address("127.0.0.8", 5790), MESH_V4),
    ]
    assert scene.sockets.without_socket == set()


async def test_paths_of_an_absent_network_stay(scene: Scene) -> None:
    """The core knows that they are down, and why."""
    link = Link(PeerAddress(V4))
    scene.follow(link)
    scene.changes = 0
    scene.present["lo", None] = Presence(reason="there is no interface lo")
    scene.sockets.check_networks()
    assert link.paths == paths(V4, LTE_V4, MESH_V4)
    assert scene.core.states[-2:] == [(LTE_V4, False), (LTE_V6, False)]
    assert scene.changes == 1
    scene.core.states.clear()
    scene.follow(Link(PeerAddress(V6)))  # a peer that is added later
    assert scene.core.states == [(LTE_V4, False), (LTE_V6, False)]


async def test_address_that_only_link_local_addresses_could_reach_has_no_path(scene: Scene) -> None:
    """Until the network gives the interface another address."""
    scene.present["lo", None] = Presence(1, ("127.0.0.1", "fe80::1"))
    scene.sockets.check_networks()
    link = Link(PeerAddress(V6))
    with capture_logs() as logs:
        scene.follow(link)
    assert (link.paths, scene.sockets.without_socket) == ([], {"drone1"})
    assert [(line["event"], line["reason"]) for line in logs] == [("peer_unreachable", "no network of its family")]
    scene.present["lo", None] = Presence(1, ("127.0.0.1", "2001:db8::1", "fe80::1"))
    scene.sockets.check_networks()
    assert (link.paths, scene.sockets.without_socket) == (paths(V6, LTE_V6), set())


@pytest.mark.parametrize(
    ("is_up", "works", "is_off", "interval_s"),
    [
        (False, True, False, LONGEST_WAIT_S),
        (True, True, False, REFRESH_S),
        (True, False, False, RELAXED_WAIT_S),
        (True, False, True, REFRESH_S),  # its network is absent: another address would not help
    ],
)
async def test_names_are_resolved_as_often_as_paths_need(
    scene: Scene, is_up: bool, works: bool, is_off: bool, interval_s: float
) -> None:
    """Each second while the peer is down, seldom while everything answers."""
    written = PeerAddress(V4)
    link = Link(written)
    scene.follow(link)
    link.peer.is_up = is_up
    link.states[link.paths[0]] = SimpleNamespace(works=works, is_off=is_off)
    assert scene.sockets._names["drone1"].interval_s(written) == interval_s


async def test_failed_send_has_the_networks_looked_at(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """At once, and not at the next second; and not for each datagram of a burst."""
    looks: list[int] = []
    genuine = scene.sockets.check_networks

    def check() -> None:
        looks.append(1)
        genuine()

    monkeypatch.setattr(scene.sockets, "check_networks", check)
    scene.present["lo", None] = Presence(reason="there is no interface lo")
    scene.sockets._checked_at = 0.0
    slot = scene.sockets._slots[LTE_V4]
    genuine_socket, slot.sock = slot.sock, cast(socket.socket, Refusing(errno.ENODEV))
    slot.send = slot.sock.sendto
    for _ in range(5):
        scene.sockets.send(b"lost", Path(LTE_V4, ("127.0.0.9", 9)))
    await until(lambda: scene.changes == 1)
    await asyncio.sleep(0)
    assert looks == [1]
    assert scene.core.states[-2:] == [(LTE_V4, False), (LTE_V6, False)]
    assert genuine_socket is not None
    genuine_socket.close()
