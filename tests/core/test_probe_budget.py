"""Probes on a network with a budget use at most a twentieth of it."""

from __future__ import annotations

import pytest

from tests.core.harness import AT_B, KEY_C, Pair
from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.core.path_state import PathState
from uavlinkd.core.probe import ANSWER_BYTES, QUESTION_BYTES
from uavlinkd.core.settings import PeerSettings

BUDGET_BITS_S = 4000


def only_path(pair: Pair) -> PathState:
    """Alpha's path to bravo."""
    state = pair.a.peer.paths.find(AT_B)
    assert state is not None
    return state


def test_bytes_of_a_question_and_its_answer() -> None:
    """With the long header and the usual tag; the same of an echo request and its reply."""
    assert c.PROBE_BYTES == QUESTION_BYTES + ANSWER_BYTES + 2 * (wire.LONG_HEADER_BYTES + 16)
    echoes = [wire.Echo(is_reply, 0, 0, 0).encode() for is_reply in (False, True)]
    assert sum(map(len, echoes)) + 2 * (wire.LONG_HEADER_BYTES + 16) == c.ECHO_BYTES


def test_interval_grows_with_the_number_of_peers_and_is_that_of_a_free_network_without_a_budget() -> None:
    """The budget is of all peers together."""
    pair = Pair()
    state, paths = only_path(pair), pair.a.peer.paths
    free_s = paths.interval_s(state, 0.0)
    least_s = 8 * (c.PROBE_BYTES + 2 * c.IP_BYTES) / (c.PROBE_BUDGET_SHARE * BUDGET_BITS_S)
    assert free_s < least_s
    pair.a.node.set_budgets({AT_B.socket: BUDGET_BITS_S})
    assert paths.interval_s(state, 0.0) == pytest.approx(least_s)
    other = pair.a.node.add_peer(PeerSettings("other", KEY_C.public), 0.0)
    assert paths.interval_s(state, 0.0) == pytest.approx(2 * least_s)
    pair.a.node.remove_peer(other, 0.0)
    assert paths.interval_s(state, 0.0) == pytest.approx(least_s)
    pair.a.node.set_budgets({AT_B.socket + 1: BUDGET_BITS_S})
    assert paths.interval_s(state, 0.0) == free_s


def test_fast_network_is_probed_as_often_as_one_without_a_budget() -> None:
    """Probes are a small part of it anyway."""
    pair = Pair()
    state, paths = only_path(pair), pair.a.peer.paths
    free_s = paths.interval_s(state, 0.0)
    pair.a.node.set_budgets({AT_B.socket: 10_000_000})
    assert paths.interval_s(state, 0.0) == free_s
