"""Point-to-point networks, such as a serial radio: one path, no address, and one peer at the other end."""

from __future__ import annotations

import pytest

from tests.core.harness import AT_A, AT_B, FRAME, KEY_C, Pair, Side, datagrams, exchange, of, only, payloads, reasons
from uavlinkd.core import wire
from uavlinkd.core.drops import DropReason
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Transmit
from uavlinkd.core.path import SERIAL_HOST, Path
from uavlinkd.core.settings import PeerSettings

LINE, OTHER_LINE = (Path(socket, (SERIAL_HOST, 0)) for socket in (3, 4))


def on_a_line() -> Pair:
    """Alpha and bravo at the ends of a line, before the first handshake."""
    pair = Pair()
    pair.a.peer_at = pair.b.peer_at = LINE
    for side in (pair.a, pair.b):
        side.node.set_paths(side.peer, [LINE], 0.0)
        side.node.set_point_to_point({LINE.socket: [side.peer]})
    return pair


def with_charlie_on_the_line(pair: Pair) -> None:
    """At bravo, charlie is at the other end of the line, and alpha somewhere on the Internet."""
    node = pair.b.node
    charlie = node.add_peer(PeerSettings("charlie", KEY_C.public), 0.0)
    node.set_paths(charlie, [LINE], 0.0)
    node.set_point_to_point({LINE.socket: [charlie]})


def test_a_session_along_a_line() -> None:
    """Handshake, frames and probes take the path like any other."""
    pair = on_a_line()
    initiation = pair.initiation(0.0)
    pair.complete(initiation, 0.0)
    assert payloads(exchange(pair.b, pair.a, pair.a.send(0.1), 0.1)) == [FRAME]
    assert payloads(exchange(pair.a, pair.b, pair.b.send(0.1), 0.1)) == [FRAME]
    assert pair.a.peer.path == pair.b.peer.path == LINE
    assert [state.is_configured for state in pair.b.peer.paths.states] == [True]


def test_an_initiation_of_another_peer_is_not_answered() -> None:
    """It is counted, and the same message along the network of its sender is answered still."""
    pair = Pair()
    with_charlie_on_the_line(pair)
    initiation = pair.initiation(0.0)
    outputs = pair.b.receive(initiation, 0.0, LINE)
    assert (reasons(outputs), of(outputs, Transmit)) == ([DropReason.WRONG_NETWORK], [])
    assert pair.b.node.drops[DropReason.WRONG_NETWORK] == 1
    assert pair.b.peer.sessions.unconfirmed == {}
    assert datagrams(pair.b.receive(initiation, 0.0), wire.RESPONSE)


def test_a_copy_of_an_answered_initiation_is_not_answered_along_the_line() -> None:
    """Otherwise the line would carry the response of another peer."""
    pair = Pair()
    with_charlie_on_the_line(pair)
    initiation = pair.initiation(0.0)
    assert datagrams(pair.b.receive(initiation, 0.0), wire.RESPONSE)
    outputs = pair.b.receive(initiation, 0.0, LINE)
    assert (reasons(outputs), of(outputs, Transmit)) == ([DropReason.WRONG_NETWORK], [])


def test_a_response_of_another_peer_is_not_read() -> None:
    """The genuine one, along the network of its sender, still makes the session."""
    pair = Pair()
    response = only(datagrams(pair.b.receive(pair.initiation(0.0), 0.0), wire.RESPONSE))
    pair.a.node.set_point_to_point({LINE.socket: []})
    assert reasons(pair.a.receive(response, 0.1, LINE)) == [DropReason.WRONG_NETWORK]
    assert pair.a.receive(response, 0.1)
    assert pair.a.peer.sessions.current is not None


def test_an_envelope_of_another_peer_makes_no_path() -> None:
    """An attacker cannot pull the traffic of one peer to the line of another by repeating its envelopes there."""
    pair = Pair().establish()
    with_charlie_on_the_line(pair)
    envelope = pair.a.envelope(1.0)
    outputs = pair.b.receive(envelope, 1.0, LINE)
    assert (reasons(outputs), of(outputs, Transmit)) == ([DropReason.WRONG_NETWORK], [])
    assert pair.b.peer.paths.find(LINE) is None
    assert payloads(pair.b.receive(envelope, 1.0)) == [FRAME]


def test_other_networks_have_any_peer() -> None:
    """Roaming goes on."""
    pair = Pair().establish()
    with_charlie_on_the_line(pair)
    elsewhere = Path(0, ("198.51.100.9", 4000))
    assert payloads(pair.b.receive(pair.a.envelope(1.0), 1.0, elsewhere)) == [FRAME]
    assert pair.b.peer.paths.find(elsewhere) is not None


def test_the_network_leads_to_every_key_of_the_peer() -> None:
    """While keys change, one daemon is several peers of the core."""
    pair = on_a_line()
    other = pair.b.node.add_peer(PeerSettings("alpha (previous key)", KEY_C.public), 0.0)
    pair.b.node.set_point_to_point({LINE.socket: [other, pair.b.peer]})
    assert datagrams(pair.b.receive(pair.initiation(0.0), 0.0), wire.RESPONSE)


def test_each_line_is_a_place_of_its_own() -> None:
    """The paths of two lines differ in the socket alone, and two peers are not where the other is."""
    assert LINE.place != OTHER_LINE.place
    assert (LINE.is_serial, AT_A.is_serial) == (True, False)
    assert AT_B.place == AT_B.address
    assert Path(9, AT_B.address).place == AT_B.place


def hinted(node: Node, path: Path) -> bool:
    """Whether an envelope of no session along a path causes an initiation."""
    return any(
        out.path == path for out in of(node.receive(bytes((0x40,)) + bytes(range(1, 40)), path, 1.0), Transmit)
    )


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_hints_are_for_the_peer_of_the_line(order: tuple[int, int]) -> None:
    """Both lines have peers. An unknown index on one of them makes the daemon initiate along that one."""
    pair = Pair()
    node: Node = pair.b.node
    charlie = node.add_peer(PeerSettings("charlie", KEY_C.public), 0.0)
    both = ((pair.b.peer, LINE), (charlie, OTHER_LINE))
    for number in order:
        node.set_paths(*both[number][:1], [both[number][1]], 0.0)
    node.set_point_to_point({LINE.socket: [pair.b.peer], OTHER_LINE.socket: [charlie]})
    assert hinted(node, LINE)
    assert hinted(node, OTHER_LINE)


def test_a_cookie_is_valid_on_its_line_alone() -> None:
    """As it is for one address."""
    side: Side = Pair().b
    cookies = side.node._handshakes.own.cookies
    keys = side.node._handshakes.own.mac_keys
    message = bytes(range(100))
    reply = wire.parse_cookie_reply(cookies.reply(keys.add_macs(message, None), 1, LINE, 0.0))
    cookie = keys.open_cookie(reply, keys.add_macs(message, None)[-32:-16])
    answered = keys.add_macs(message, cookie)
    assert cookies.has_valid_mac2(answered, LINE, 1.0)
    assert not cookies.has_valid_mac2(answered, OTHER_LINE, 1.0)
