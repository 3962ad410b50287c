"""Features that change while a session is there."""

from __future__ import annotations

from tests.core.harness import Pair, quiet, run
from uavlinkd.core import constants as c
from uavlinkd.core.drops import DropReason
from uavlinkd.core.outputs import Dropped, Transmit

BOTH = c.FEATURE_REFUSALS | c.FEATURE_RECORDS


def test_other_features_get_new_keys_without_losing_the_link() -> None:
    """The end that offers them wants new keys at once. A session has the features that both offer."""
    pair = Pair(quiet(), quiet()).establish()
    first = pair.a.session
    pair.a.node.offer(pair.a.peer, BOTH, 10.0)
    assert pair.a.node.next_deadline() <= 10.0
    assert pair.carries(10.0), "the session stays meanwhile"
    list(run(pair, 10.0, 10.5, lambda *_: True))
    assert pair.a.session is not first
    assert pair.a.session.parameters.features == c.FEATURE_REFUSALS

    pair.b.node.offer(pair.b.peer, BOTH, 20.0)
    pair.b.configure_path(20.0)
    list(run(pair, 20.0, 20.5, lambda *_: True))
    assert {side.session.parameters.features for side in (pair.a, pair.b)} == {BOTH}
    assert pair.carries(21.0)
    assert {side.peer.traffic.handshakes for side in (pair.a, pair.b)} == {3}


def test_new_keys_for_other_features_are_tried_until_they_are_there() -> None:
    """A lost initiation is repeated; after the handshake there is nothing to try."""
    pair = Pair(quiet(), quiet()).establish()
    pair.a.node.offer(pair.a.peer, BOTH, 10.0)
    lost = pair.initiation(10.0)
    again = pair.a.node.next_deadline()
    assert again < 10.0 + c.RETRY_MAX_S
    assert pair.initiation(again) != lost
    list(run(pair, again, 15.0, lambda *_: True))
    handshakes = pair.a.peer.traffic.handshakes
    list(run(pair, 15.0, 60.0, lambda *_: True))
    assert pair.a.peer.traffic.handshakes == handshakes == 2


def test_same_features_begin_no_handshake() -> None:
    """A reload that changes something else."""
    pair = Pair(quiet(), quiet()).establish()
    pair.a.node.offer(pair.a.peer, c.FEATURE_REFUSALS, 10.0)
    assert pair.a.peer.keys_wanted_at() > 10.0


def test_handshake_in_flight_does_not_bring_the_features_before() -> None:
    """Its response, which an attacker may hold, makes no session. The next handshake has the new features."""
    pair = Pair(quiet(), quiet(features=BOTH))
    (response,) = [
        output.datagram for output in pair.b.receive(pair.initiation(0.0), 0.0) if isinstance(output, Transmit)
    ]
    pair.a.node.offer(pair.a.peer, BOTH, 0.1)
    assert [output.reason for output in pair.a.receive(response, 0.2) if isinstance(output, Dropped)] == [
        DropReason.UNEXPECTED_RESPONSE
    ]
    list(run(pair, 0.2, 3.0, lambda *_: True))
    assert pair.a.session.parameters.features == BOTH
    assert pair.carries(3.0)
