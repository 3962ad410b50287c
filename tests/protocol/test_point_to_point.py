"""Point-to-point networks, such as a serial radio: one path, no address, and one peer at the other end."""

from __future__ import annotations

import pytest

from tests.protocol.harness import (
    AT_A,
    AT_B,
    ELSEWHERE,
    FRAME,
    KEY_C,
    Pair,
    datagrams,
    exchange,
    of,
    only,
    payloads,
    reasons,
)
from uavlinkd.protocol import wire
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Output, Transmit
from uavlinkd.protocol.path import SERIAL_HOST, Path
from uavlinkd.protocol.settings import PeerSettings

LINE, OTHER_LINE = (Path(socket, (SERIAL_HOST, 0)) for socket in (3, 4))


def with_charlie_on_the_line(pair: Pair) -> Pair:
    """At bravo, charlie is at the other end of the line, and alpha somewhere on the Internet."""
    node = pair.b.node
    charlie = node.add_peer(PeerSettings("charlie", KEY_C.public), 0.0)
    node.set_paths(charlie, [LINE], 0.0)
    node.facts.set_point_to_point({LINE.socket: charlie})
    return pair


def is_refused(outputs: list[Output]) -> bool:
    """Whether a datagram is dropped as one of the wrong network, and nothing is sent."""
    return reasons(outputs) == [DropReason.WRONG_NETWORK] and not of(outputs, Transmit)


def test_a_session_along_a_line() -> None:
    """Handshake, frames and probes take the path like any other."""
    pair = Pair()
    pair.a.peer_at = pair.b.peer_at = LINE
    for side in (pair.a, pair.b):
        side.node.set_paths(side.peer, [LINE], 0.0)
        side.node.facts.set_point_to_point({LINE.socket: side.peer})
    pair.complete(pair.initiation(0.0), 0.0)
    assert payloads(exchange(pair.b, pair.a, pair.a.send(0.1), 0.1)) == [FRAME]
    assert payloads(exchange(pair.a, pair.b, pair.b.send(0.1), 0.1)) == [FRAME]
    assert pair.a.peer.path == pair.b.peer.path == LINE
    assert [state.is_configured for state in pair.b.peer.paths.states] == [True]


def test_an_initiation_of_another_peer_is_not_answered() -> None:
    """It is counted, and the same message along the network of its sender is answered still. So is a copy of it."""
    pair = with_charlie_on_the_line(Pair())
    initiation = pair.initiation(0.0)
    assert is_refused(pair.b.receive(initiation, 0.0, LINE))
    assert pair.b.node.drops[DropReason.WRONG_NETWORK] == 1
    assert pair.b.peer.sessions.unconfirmed == {}
    assert datagrams(pair.b.receive(initiation, 0.0), wire.RESPONSE)
    assert is_refused(pair.b.receive(initiation, 0.0, LINE))


def test_a_response_of_another_peer_is_not_read() -> None:
    """The genuine one, along the network of its sender, still makes the session."""
    pair = Pair()
    response = only(datagrams(pair.b.receive(pair.initiation(0.0), 0.0), wire.RESPONSE))
    pair.a.node.facts.set_point_to_point({LINE.socket: None})
    assert is_refused(pair.a.receive(response, 0.1, LINE))
    assert pair.a.receive(response, 0.1)
    assert pair.a.peer.sessions.current is not None


def test_an_envelope_of_another_peer_makes_no_path() -> None:
    """An attacker cannot pull the traffic of one peer to the line of another. Other networks have any peer."""
    pair = with_charlie_on_the_line(Pair().establish())
    envelope = pair.a.envelope(1.0)
    assert is_refused(pair.b.receive(envelope, 1.0, LINE))
    assert pair.b.peer.paths.find(LINE) is None
    assert payloads(pair.b.receive(envelope, 1.0, ELSEWHERE)) == [FRAME]
    assert pair.b.peer.paths.find(ELSEWHERE) is not None


def hinted(node: Node, path: Path) -> bool:
    """Whether an envelope of no session along a path causes an initiation."""
    outputs = node.receive(bytes((0x40,)) + bytes(range(1, 40)), path, 1.0)
    return any(out.path == path for out in of(outputs, Transmit))


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_each_line_is_a_place_of_its_own(order: tuple[int, int]) -> None:
    """Two lines differ in the socket alone. An unknown index on one makes the daemon initiate along that one."""
    assert LINE.place != OTHER_LINE.place
    assert (LINE.is_serial, AT_A.is_serial) == (True, False)
    assert AT_B.place == Path(9, AT_B.address).place == AT_B.address
    node = Pair().b.node
    charlie = node.add_peer(PeerSettings("charlie", KEY_C.public), 0.0)
    both = ((node.peers["alpha"], LINE), (charlie, OTHER_LINE))
    for number in order:
        node.set_paths(both[number][0], [both[number][1]], 0.0)
    node.facts.set_point_to_point({path.socket: peer for peer, path in both})
    assert [hinted(node, path) for _, path in both] == [True, True]
