"""Copies that the daemon does not send: they are not counted as lost by their path."""

from __future__ import annotations

from tests.core.harness import AT_B, ELSEWHERE, FRAME, Pair


def test_copy_that_is_not_sent_is_not_counted_and_one_that_waited_is_counted_later() -> None:
    """Totals of the path and of the peer, which a budget is charged for."""
    pair = Pair().establish()
    pair.a.send(1.0)
    state = pair.a.peer.paths.find(AT_B)
    assert state is not None
    totals = state.sent, state.datagrams_sent, state.bytes_sent
    traffic = pair.a.peer.traffic
    bytes_sent, datagrams_sent = traffic.bytes_sent, traffic.datagrams_sent
    pair.a.node.recount(pair.a.peer, AT_B, -1, -len(FRAME))
    assert (state.sent, state.datagrams_sent, state.bytes_sent) == (
        totals[0] - 1,
        totals[1] - 1,
        totals[2] - len(FRAME),
    )
    assert (traffic.datagrams_sent, traffic.bytes_sent) == (datagrams_sent - 1, bytes_sent - len(FRAME))
    pair.a.node.recount(pair.a.peer, AT_B, 1, len(FRAME))
    assert (state.sent, state.datagrams_sent, state.bytes_sent) == totals
    assert (traffic.datagrams_sent, traffic.bytes_sent) == (datagrams_sent, bytes_sent)


def test_path_that_is_gone_has_no_totals() -> None:
    """And those of a session that began meanwhile do not go below zero."""
    pair = Pair().establish()
    before = pair.a.peer.traffic.datagrams_sent
    pair.a.node.recount(pair.a.peer, ELSEWHERE, -1, -100)
    assert pair.a.peer.traffic.datagrams_sent == before
    state = pair.a.peer.paths.find(AT_B)
    assert state is not None
    state.note_session()
    pair.a.node.recount(pair.a.peer, AT_B, -1, -100)
    assert state.sent == 0
