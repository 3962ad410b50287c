"""A daemon with many peers, such as a relay, starts again: all of them initiate at once, on a virtual clock."""

from __future__ import annotations

import heapq
from itertools import count

import pytest

from tests.core.harness import seeded
from uavlinkd.core import constants as c
from uavlinkd.core.crypto import KeyPair, Secret
from uavlinkd.core.limits import TokenBucket
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Output, Transmit
from uavlinkd.core.path import Path
from uavlinkd.core.settings import PeerSettings

DELAY_S = 0.05
AT_RELAY = Path(0, ("203.0.113.1", 5790))


def all_up_after(peers: int, until: float) -> float:
    """Seconds until a daemon that has just started has sessions with so many peers behind one carrier's NAT."""
    relay = Node(Secret(bytes([200]) * 32), seeded(0), 0.0)
    members: dict[Path, Node] = {}
    for number in range(peers):
        private = number.to_bytes(2, "big") * 16
        at = Path(0, (f"198.51.100.{number % 16}", 1024 + number))
        node = members[at] = Node(Secret(private), seeded(number + 1), 0.0)
        relay.add_peer(PeerSettings(f"m{number}", KeyPair(private).public), 0.0)
        node.set_paths(node.add_peer(PeerSettings("relay", relay.public_key), 0.0), [AT_RELAY], 0.0)
    order = count()
    queue: list[tuple[float, int, Node | None, Path, bytes]] = []  # arrivals, and turns of timers (no bytes)
    up: set[Path] = set()

    def send(outputs: list[Output], at: Path, now: float) -> None:
        for output in outputs:
            if isinstance(output, Transmit):
                towards_relay = at != AT_RELAY
                target = relay if towards_relay else members[output.path]
                source = at if towards_relay else output.path
                heapq.heappush(queue, (now + DELAY_S, next(order), target, source, output.datagram))

    for at in members:
        heapq.heappush(queue, (0.0, next(order), None, at, b""))
    while queue:
        now, _, target, at, datagram = heapq.heappop(queue)
        if now > until:
            break
        node = members[at]
        if target is None:
            send(node.handle_timeout(now), at, now)
            heapq.heappush(queue, (max(now + 0.01, node.next_deadline()), next(order), None, at, b""))
        elif target is relay:
            send(relay.receive(datagram, at, now), AT_RELAY, now)
        else:
            send(node.receive(datagram, AT_RELAY, now), at, now)
            if node.peers["relay"].is_up:
                up.add(at)
                if len(up) == peers:
                    return now
    raise AssertionError(f"{len(up)} of {peers} peers are up after {until} s")


def test_all_peers_have_sessions_soon_after_a_restart() -> None:
    """Without cookies, which a flood from elsewhere would cause: after one round trip, although a NAT hides them."""
    assert all_up_after(500, until=2.0) == pytest.approx(2 * DELAY_S)


@pytest.mark.parametrize(("peers", "expected"), [(1, 50), (25, 50), (26, 52), (1000, 2000), (1001, 2000)])
def test_burst_grows_with_the_peers_and_is_bounded(peers: int, expected: int) -> None:
    """It shrinks with them too."""
    node = Node(Secret(bytes([200]) * 32), seeded(0), 0.0)
    added = [
        node.add_peer(PeerSettings(f"m{number}", KeyPair(number.to_bytes(2, "big") * 16).public), 0.0)
        for number in range(1, peers + 1)
    ]
    bucket = node._handshakes.admission._initiations
    assert bucket.has(0.0, expected)
    assert not bucket.has(0.0, expected + 1)
    for peer in added:
        node.remove_peer(peer, 0.0)
    assert not bucket.has(0.0, c.INITIATIONS_BURST + 1)


def test_spent_tokens_stay_spent_when_the_burst_changes() -> None:
    """A reload does not fill the bucket."""
    bucket = TokenBucket(1.0, 50, 0.0)
    assert bucket.take(0.0, 40)
    bucket.set_burst(100)
    assert bucket.has(0.0, 60)
    assert not bucket.has(0.0, 61)
    bucket.set_burst(30)
    assert not bucket.has(0.0, 1)
