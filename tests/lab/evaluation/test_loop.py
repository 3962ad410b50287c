"""The relay of the measurements counts, and forwards all datagrams or none."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from uavlinkd.core import wire
from uavlinkd.lab.evaluation.loop import Loop, Relay, Sink, udp_socket
from uavlinkd.lab.evaluation.pair import numbered_frame


@pytest.fixture
def loop() -> Iterator[Loop]:
    """Closed afterwards."""
    loop = Loop()
    yield loop
    loop.close()


def test_a_relay_counts_both_directions_and_forwards_unaltered(loop: Loop) -> None:
    """Datagrams, bytes, kinds, and the moment of the first of each kind."""
    target, initiator = udp_socket(), udp_socket()
    relay = Relay(loop, target.getsockname())
    sink: list[tuple[bytes, tuple[str, int]]] = []
    back: list[bytes] = []
    loop.add(target, lambda: sink.append(target.recvfrom(65536)))
    loop.add(initiator, lambda: back.append(initiator.recv(65536)))
    relay.open()
    sent = [
        bytes((wire.INITIATION,)) * 100,
        bytes((wire.SHORT_ENVELOPE,)) * 30,
        bytes((wire.SHORT_ENVELOPE,)) * 5,
        b"",
    ]
    for datagram in sent:
        initiator.sendto(datagram, relay.address)
    assert loop.until(lambda: len(sink) == 4, 60)
    target.sendto(b"\x02 answer", sink[0][1])
    assert loop.until(lambda: len(back) == 1, 60)

    assert [datagram for datagram, _ in sink] == sent
    assert back == [b"\x02 answer"]
    assert (relay.there.datagrams, relay.there.bytes) == (4, 135)
    assert relay.there.kinds[wire.SHORT_ENVELOPE] == 2
    assert relay.there.first_at[wire.INITIATION] <= relay.there.first_at[wire.SHORT_ENVELOPE]
    assert (relay.back.datagrams, relay.back.bytes) == (1, 8)
    relay.close()
    for sock in (target, initiator):
        loop.remove(sock)
        sock.close()


def test_a_closed_relay_drops_and_opening_it_resets_the_counters(loop: Loop) -> None:
    """What was turned away is not in the counts."""
    target, initiator = udp_socket(), udp_socket()
    relay = Relay(loop, target.getsockname())
    initiator.sendto(b"\x01 early", relay.address)
    assert loop.until(lambda: relay.turned_away == 1, 60)
    relay.open()
    initiator.sendto(b"\x01 now", relay.address)
    assert loop.until(lambda: relay.there.datagrams == 1, 60)
    target.setblocking(True)
    target.settimeout(60)
    assert target.recv(100) == b"\x01 now"
    relay.close()
    target.close()
    initiator.close()


def test_a_condition_that_does_not_come_true_ends_with_the_limit(loop: Loop) -> None:
    """The measurement continues, and the failure can be recorded."""
    assert not loop.until(lambda: False, 0.01)
    assert loop.until(lambda: True, 0.0)


def test_a_sink_remembers_when_a_frame_came_first(loop: Loop) -> None:
    """A second copy does not make a frame younger."""
    sink = Sink(loop)
    source = udp_socket()
    one, other = numbered_frame(1), numbered_frame(2)
    for datagram in (one, one, other):
        source.sendto(datagram, ("127.0.0.1", sink.port))
        loop.rest(0.02)
    assert loop.until(lambda: other in sink.arrived, 60)
    assert list(sink.arrived) == [one, other]
    assert sink.arrived[other] - sink.arrived[one] > 0.03
    sink.close()
    source.close()


def test_a_sink_counts_each_frame_of_a_datagram(loop: Loop) -> None:
    """A busy daemon puts several into one; trailing rubbish ends the datagram and no more."""
    sink = Sink(loop)
    source = udp_socket()
    frames = [numbered_frame(number) for number in range(5)]
    source.sendto(b"".join(frames), ("127.0.0.1", sink.port))
    source.sendto(b"\xfd", ("127.0.0.1", sink.port))
    assert loop.until(lambda: len(sink.arrived) == 5, 60)
    assert list(sink.arrived) == frames
    assert len(set(sink.arrived.values())) == 1
    sink.close()
    source.close()
