"""The emulated radio: each impairment within exact bounds, and all of them together."""

from __future__ import annotations

import math
from collections import Counter
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavlinkd.lab.mitm.radio import Bursts, Outcome, Radio, RadioSettings

N = 20_000


def _numbered(count: int, size: int = 8) -> list[bytes]:
    return [number.to_bytes(size, "big") for number in range(count)]


def _play(radio: Radio, datagrams: list[bytes], interval_s: float = 0.01) -> list[tuple[float, bytes]]:
    """Send one datagram each interval from 0 on, and take each out when it is due: (when, datagram)."""
    arrivals: list[tuple[float, bytes]] = []

    def drain(until: float) -> None:
        while radio.next_deadline() <= until:
            moment = radio.next_deadline()
            arrivals.extend((moment, datagram) for datagram in radio.due(moment))

    for number, datagram in enumerate(datagrams):
        drain(number * interval_s)
        radio.send(datagram, number * interval_s)
    drain(1e12)
    return arrivals


def _is_accounted_for(radio: Radio) -> bool:
    outcomes = radio.outcomes
    ends = (
        *(Outcome.DELIVERED, Outcome.LOST, Outcome.LOST_IN_BURST),
        *(Outcome.QUEUE_FULL, Outcome.TOO_MANY_IN_FLIGHT),
    )
    return (
        outcomes[Outcome.SENT] + outcomes[Outcome.DUPLICATED] == sum(outcomes[end] for end in ends) + radio.in_flight
    )


def test_bursts_have_their_length_and_share() -> None:
    """Bursts have a mean length of 1 / to_good datagrams, and a share of to_bad / (to_bad + to_good)."""
    radio = Radio(RadioSettings(bursts=Bursts(to_bad=0.02, to_good=0.1)), Random(4))
    arrived = {datagram for _, datagram in _play(radio, _numbered(N))}
    lost = "".join(" " if datagram in arrived else "x" for datagram in _numbered(N)).split()
    lengths = [len(burst) for burst in lost]
    assert 9 < sum(lengths) / len(lengths) < 11
    assert 0.14 < sum(lengths) / N < 0.19  # 1/6; the bursts are few, so it scatters more than single losses
    assert radio.outcomes[Outcome.LOST_IN_BURST] == sum(lengths)


def test_bandwidth_spaces_datagrams_and_the_queue_drops_its_tail() -> None:
    """A datagram takes its bits' time; what finds no room in the queue is dropped, what was queued is not."""
    settings = RadioSettings(bits_per_s=8000, overhead_bytes=28, queue_bytes=300, delay_s=0.5)
    radio = Radio(settings, Random(10))
    for datagram in _numbered(5, size=72):  # 100 bytes with overhead: 0.1 s each
        radio.send(datagram, 0.0)
    moments = []
    while radio.in_flight:
        moments.append(round(radio.next_deadline(), 9))
        radio.due(radio.next_deadline())
    assert moments == [0.6, 0.7, 0.8]
    assert radio.outcomes[Outcome.QUEUE_FULL] == 2
    radio.send(b"later", 0.31)
    assert radio.next_deadline() == pytest.approx(0.31 + 0.033 + 0.5)


_SHARES = st.floats(0, 1)
_TIMES = st.floats(0, 0.5)
_BURSTS = st.none() | st.builds(Bursts, to_bad=_SHARES, to_good=_SHARES)
_SETTINGS = st.builds(
    RadioSettings,
    loss=_SHARES,
    bursts=_BURSTS,
    duplication=_SHARES,
    delay_s=_TIMES,
    jitter_s=_TIMES,
    reordering=_SHARES,
    bits_per_s=st.none() | st.floats(1000, 1e6),
    queue_bytes=st.integers(0, 2000),
)


@given(settings=_SETTINGS, seed=st.integers(0, 2**32), gaps=st.lists(st.floats(0, 0.2), max_size=60))
def test_every_datagram_is_accounted_for(settings: RadioSettings, seed: int, gaps: list[float]) -> None:
    """With any settings, datagrams are neither invented, altered nor early, and each outcome is counted."""
    radio, now = Radio(settings, Random(seed)), 0.0
    sent_at: dict[bytes, float] = {}
    arrived: Counter[bytes] = Counter()
    for number, gap in enumerate(gaps):
        now += gap
        datagram = number.to_bytes(4, "big")
        sent_at[datagram] = now
        radio.send(datagram, now)
        for one in radio.due(now):
            assert now >= sent_at[one] + settings.delay_s
            arrived[one] += 1
        assert radio.next_deadline() > now
        assert _is_accounted_for(radio)
    arrived.update(radio.due(math.inf))
    assert set(arrived) <= set(sent_at)
    assert all(count <= 2 for count in arrived.values())
    assert radio.outcomes[Outcome.DELIVERED] == arrived.total()
    assert _is_accounted_for(radio)
