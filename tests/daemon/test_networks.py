"""Networks that appear, change and disappear, on sockets of loopback. What the machine has is made up here."""

from __future__ import annotations

import socket
import sys
from collections.abc import Callable, Iterator
from itertools import count

import pytest
import structlog
from structlog.testing import capture_logs

from tests.daemon.socket_states import SocketStateLog
from tests.needs import need
from uavlinkd.config.model import NetworkConfig
from uavlinkd.daemon import networks as module
from uavlinkd.daemon.networks import Networks
from uavlinkd.io.sockets import BindError, Presence, network_socket
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.ops.line_limits import LINES_BURST, LINES_PER_S
from uavlinkd.system.addresses import Address

LTE = NetworkConfig("lte", interface="lo", metered=True)
MESH = NetworkConfig("mesh", address="127.0.0.2")
V4, ALSO_V4 = 0, 2
"""The numbers of the IPv4 sockets of LTE, which has one for IPv6 too, and of MESH."""


class Scene:
    """Networks, the sockets that they put, and their reports to the core."""

    def __init__(self, *configs: NetworkConfig, port: int = 0) -> None:
        self.sockets: dict[int, socket.socket] = {}
        self.core = SocketStateLog()
        self.present = {(config.interface, config.address): Presence() for config in configs}
        listen = [Address("0.0.0.0", port)] if port else []
        self.networks = Networks(configs, listen, self.put, lambda: self.sockets, self.core, structlog.get_logger())

    def put(self, number: int, sock: socket.socket | None) -> None:
        """As the daemon's sockets."""
        before = self.sockets.pop(number, None)
        if before is not None:
            before.close()
        if sock is not None:
            self.sockets[number] = sock

    def set(self, config: NetworkConfig, presence: Presence) -> None:
        """What the machine has of a network from now on."""
        self.present[config.interface, config.address] = presence

    def port(self, number: int) -> int:
        """Where a socket is bound."""
        port: int = self.sockets[number].getsockname()[1]
        return port


@pytest.fixture(autouse=True)
def _on_linux() -> None:
    need(sys.platform == "linux", "Linux")


@pytest.fixture
def make_scene(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Scene]]:
    """Make scenes, whose sockets are closed afterwards. The machine has what the first one says."""
    scenes: list[Scene] = []

    def make(*configs: NetworkConfig, port: int = 0) -> Scene:
        scenes.append(Scene(*configs, port=port))
        return scenes[-1]

    monkeypatch.setattr(module, "look", lambda interface, address: scenes[0].present[interface, address])
    yield make
    for scene in scenes:
        for number in list(scene.sockets):
            scene.put(number, None)


@pytest.fixture
def scene(make_scene: Callable[..., Scene]) -> Scene:
    """LTE, which is absent, and MESH, which is there."""
    made = make_scene(LTE, MESH)
    made.set(MESH, Presence(0, ("127.0.0.2",)))
    return made


def test_network_that_is_absent_at_the_start_is_used_when_it_appears(scene: Scene) -> None:
    """The others are open from the start; the core learns which sockets are closed."""
    scene.set(LTE, Presence(reason="there is no interface lo"))
    scene.networks.open(0.0)
    assert set(scene.sockets) == {ALSO_V4}
    assert scene.core.metered == [0, 1]
    assert scene.core.states == [(ALSO_V4, True)]
    scene.networks.report_absent(0.0)
    assert scene.core.states[1:] == [(0, False), (1, False)]
    with capture_logs() as logs:
        scene.networks.check(0.0)
        scene.set(LTE, Presence(1, ("127.0.0.1",)))
        assert scene.networks.check(1.0)
        assert not scene.networks.check(2.0)
    assert [(line["event"], line["network"]) for line in logs] == [
        ("network_not_here_yet", "lte"),
        ("network_appeared", "mesh"),
        ("network_appeared", "lte"),
    ]
    assert logs[0]["reason"] == "there is no interface lo"
    assert (logs[2]["addresses"], logs[2]["interface_index"]) == (["127.0.0.1"], 1)
    assert set(scene.sockets) == {V4, ALSO_V4}
    assert scene.core.states[3:] == [(V4, True)]
    assert scene.sockets[V4].getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16).rstrip(b"\0") == b"lo"


def test_interface_with_another_number_gets_another_socket(scene: Scene) -> None:
    """On the same port, under the same number. The socket of the other network stays."""
    scene.set(LTE, Presence(1, ("127.0.0.1",)))
    scene.networks.open(0.0)
    before, other, port = scene.sockets[V4], scene.sockets[ALSO_V4], scene.port(V4)
    scene.core.states.clear()
    scene.set(LTE, Presence(7, ("127.0.0.1",)))
    assert scene.networks.check(1.0)
    assert scene.sockets[V4] is not before
    assert before.fileno() == -1
    assert (scene.port(V4), scene.sockets[ALSO_V4]) == (port, other)
    assert scene.core.states == [(V4, False), (V4, True)]


def test_changed_address_keeps_the_socket(scene: Scene) -> None:
    """The kernel chooses the source of each datagram; the core probes the paths of that family again."""
    scene.set(LTE, Presence(1, ("127.0.0.1",)))
    scene.networks.open(0.0)
    scene.networks.check(0.0)
    before = scene.sockets[V4]
    scene.core.states.clear()
    scene.set(LTE, Presence(1, ("127.0.0.9",)))
    with capture_logs() as logs:
        assert scene.networks.check(1.0)
    assert scene.sockets[V4] is before
    assert scene.core.states == [(V4, True)]
    assert [(line["event"], line["addresses"]) for line in logs] == [("network_changed", ["127.0.0.9"])]


def test_port_of_listen_is_the_port_of_each_network(make_scene: Callable[..., Scene]) -> None:
    """Also where an interface and an address of it share it. A port that is in use is an error at the start."""
    port = free_port()
    scene = make_scene(LTE, MESH, port=port)
    scene.set(LTE, Presence(1, ("127.0.0.1",)))
    scene.set(MESH, Presence(0, ("127.0.0.2",)))
    scene.networks.open(0.0)
    assert (scene.port(V4), scene.port(ALSO_V4)) == (port, port)
    assert [sock.getsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR) for sock in scene.sockets.values()] == [0, 0]
    second = make_scene(LTE, port=port)
    with pytest.raises(BindError, match=r"^network \(lte\): cannot listen on 0\.0\.0\.0:\d+: Address already in use"):
        second.networks.open(0.0)


def test_port_of_listen_that_is_taken_meanwhile(make_scene: Callable[..., Scene]) -> None:
    """Peers know that port: the network waits for it, and the status has the reason."""
    port = free_port()
    scene = make_scene(MESH, port=port)
    scene.set(MESH, Presence(reason="gone"))
    scene.networks.open(0.0)
    with network_socket(Address("127.0.0.2", port), None, []):
        scene.set(MESH, Presence(0, ("127.0.0.2",)))
        assert not scene.networks.check(1.0)
        (network,) = scene.networks.networks
        assert "Address already in use" in network.presence.reason
        assert not network.presence.hosts
    assert scene.networks.check(2.0)
    assert scene.port(0) == port


def test_flapping_interface_cannot_fill_the_log(scene: Scene) -> None:
    """The lines are limited, and the log ends with the state of the network."""
    states = (Presence(1, ("127.0.0.1",)), Presence(reason="the interface lo is down"))
    scene.networks.open(0.0)
    with capture_logs() as logs:
        for second in range(1000):
            scene.set(LTE, states[second % 2])
            scene.networks.check(float(second))
        for second in count(1000):
            scene.networks.check(float(second))
            if logs[-1]["event"] == "network_disappeared":
                break
    assert len(logs) <= LINES_BURST + second * LINES_PER_S + 2


def test_interface_that_may_not_be_bound_to_is_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before Linux 5.7, and on other systems."""
    genuine = socket.socket.setsockopt

    def refuse(sock: socket.socket, level: int, option: int, value: int | bytes) -> None:
        if option == socket.SO_BINDTODEVICE:
            raise PermissionError(1, "Operation not permitted")
        genuine(sock, level, option, value)

    monkeypatch.setattr(socket.socket, "setsockopt", refuse)
    with pytest.raises(BindError, match="CAP_NET_RAW"):
        network_socket(Address("0.0.0.0", 0), "lo", [])
    monkeypatch.setattr(sys, "platform", "darwin")
    with pytest.raises(BindError, match="needs Linux"):
        network_socket(Address("0.0.0.0", 0), "lo", [])
