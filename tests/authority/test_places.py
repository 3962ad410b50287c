"""Which peer by certificate gives way to a new one."""

from __future__ import annotations

from tests.protocol.harness import seeded
from uavlinkd.authority.trust import longest_down
from uavlinkd.protocol.crypto import Secret
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.settings import PeerSettings


def test_peer_that_is_down_for_longest_gives_way() -> None:
    """None that is up or kept, and none of the configuration. One that was never up counts from its addition."""
    node = Node(Secret(bytes(32)), seeded(1), 0.0)
    added = [
        node.add_peer(PeerSettings(f"v{number}", bytes([number]) * 32, is_certified=number > 0), float(number))
        for number in range(5)
    ]
    _, never_up, seen_early, seen_late, up = added
    seen_early.received_at, seen_late.received_at, up.received_at, up.is_up = 0.5, 9.0, 0.0, True
    kept = set[bytes]()
    for expected in (seen_early, never_up, seen_late):
        assert longest_down(added, kept) is expected
        kept.add(expected.settings.public_key)
    assert longest_down(added, kept) is None
