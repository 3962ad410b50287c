"""The forwarding of datagrams: which ones pass, to where, and what each drop is called."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.relay_records import INNER_STARTS, wrap
from uavlinkd.relay.bindings import ConnectionEnd, MemberConnection
from uavlinkd.relay.forwarding import BURST_S, LEAST_BYTES, Forwarding, Meter, RelayReason

AT_A, AT_B = Path(0, ("192.0.2.1", 1000)), Path(1, ("2001:db8::2", 2000, 0, 0))
A, B = ConnectionEnd(b"a" * 32, AT_A, 0x1111), ConnectionEnd(b"b" * 32, AT_B, 0x2222)
DATAGRAM = b"\x40datagram"
DEFAULT = 20_000_000
AMPLE = 10**10
STRANGER = ("198.51.100.9", 4000)


class Relay:
    """A forwarding with one connection, and what it sent."""

    def __init__(self, bits_s: int = DEFAULT, total: int = AMPLE) -> None:
        self.now = 0.0
        self.sent: list[tuple[bytes, Path]] = []
        self.forwarding = Forwarding(
            lambda datagram, path: self.sent.append((datagram, path)), lambda: self.now, total
        )
        self.meters = Meter(bits_s), Meter(bits_s)
        self.forwarding.open(MemberConnection(A, B), self.meters)

    def arrive(self, *datagrams: bytes, path: Path = AT_A, now: float = 0.0) -> None:
        """These arrive along a path."""
        self.now = now
        for datagram in datagrams:
            self.forwarding.take(path.socket, datagram, path.address)


def test_datagram_is_forwarded_with_the_handle_of_its_receiver() -> None:
    """In both directions, byte for byte, and no longer than it was."""
    relay = Relay()
    relay.arrive(wrap(A.handle, DATAGRAM))
    relay.arrive(wrap(B.handle, DATAGRAM), path=AT_B)
    assert relay.sent == [(wrap(B.handle, DATAGRAM), AT_B), (wrap(A.handle, DATAGRAM), AT_A)]
    size = len(wrap(A.handle, DATAGRAM))
    assert [(meter.datagrams, meter.bytes) for meter in relay.meters] == [(1, size), (1, size)]
    assert not relay.forwarding.dropped


@pytest.mark.parametrize("path", [Path(0, STRANGER), Path(1, AT_A.address), Path(0, ("192.0.2.1", 1001)), AT_B])
def test_handle_counts_only_at_its_address(path: Path) -> None:
    """Not at a stranger's, on another socket, at another port, or at the other member's. No member is charged."""
    relay = Relay()
    relay.arrive(wrap(A.handle, DATAGRAM), path=path)
    assert relay.sent == []
    assert relay.forwarding.dropped == {DropReason.RELAY_UNKNOWN_HANDLE: 1}
    assert not any(meter.datagrams or meter.over_limit for meter in relay.meters)


@pytest.mark.parametrize("inner", [b"", b"\x50" + bytes(9), b"\x00abc", b"\xfd" + bytes(20)])
def test_only_datagrams_of_a_session_pass(inner: bytes) -> None:
    """No relay inside a relay, and no bare MAVLink."""
    relay = Relay()
    relay.arrive(wrap(A.handle, inner))
    assert relay.sent == []
    assert relay.forwarding.dropped == {DropReason.RELAY_MALFORMED: 1}


@pytest.mark.parametrize("start", sorted(INNER_STARTS))
def test_every_datagram_of_a_session_passes(start: int) -> None:
    """Handshake messages, cookie replies and envelopes."""
    relay = Relay()
    relay.arrive(wrap(A.handle, bytes([start])))
    assert [path for _, path in relay.sent] == [AT_B]


@given(st.binary(max_size=12), st.sampled_from((Path(0, STRANGER), AT_A, AT_B)))
def test_no_bytes_raise_or_get_an_answer(data: bytes, path: Path) -> None:
    """Whatever follows the first byte. A stranger's data is dropped."""
    relay = Relay()
    relay.arrive(b"\x50" + data, path=path)
    assert len(relay.sent) + relay.forwarding.dropped.total() == 1
    assert path.address not in [sent.address for _, sent in relay.sent]
    assert path.address != STRANGER or not relay.sent


@given(st.binary(max_size=40), st.sampled_from((AT_A, AT_B)))
def test_no_datagram_grows(tail: bytes, path: Path) -> None:
    """One byte for each byte."""
    relay = Relay()
    for end in (A, B):
        datagram = wrap(end.handle, tail)
        relay.arrive(datagram, path=path)
        assert sum(len(sent) for sent, _ in relay.sent) <= len(datagram)


def test_closed_connection_forwards_nothing() -> None:
    """In neither direction."""
    relay = Relay()
    relay.forwarding.close(MemberConnection(A, B))
    relay.arrive(wrap(A.handle, DATAGRAM))
    relay.arrive(wrap(B.handle, DATAGRAM), path=AT_B)
    assert relay.sent == []
    assert len(relay.forwarding) == 0


def test_address_that_another_member_has_now_keeps_its_route() -> None:
    """A NAT may assign the address of one member to another, with the same handle."""
    relay = Relay()
    later = ConnectionEnd(b"c" * 32, AT_A, A.handle)
    to = ConnectionEnd(b"d" * 32, Path(0, ("192.0.2.4", 1)), 0x4444)
    relay.forwarding.open(MemberConnection(later, to), relay.meters)
    relay.forwarding.close(MemberConnection(A, B))
    relay.arrive(wrap(A.handle, DATAGRAM))
    assert relay.sent == [(wrap(to.handle, DATAGRAM), to.path)]


# Limits.


def test_member_over_its_limit_slows_only_itself() -> None:
    """The rest of what it sends is dropped and counted as its own; the other member is not affected."""
    relay = Relay(10_000_000)
    for tick in range(1000):
        relay.arrive(*[wrap(A.handle, DATAGRAM)] * 10, now=tick / 1000)
        relay.arrive(wrap(B.handle, DATAGRAM), path=AT_B, now=tick / 1000)
    greedy, modest = relay.meters
    assert greedy.datagrams == pytest.approx(1000 + 1000 * BURST_S, abs=2)
    assert greedy.over_limit == 10_000 - greedy.datagrams
    assert (modest.datagrams, modest.over_limit) == (1000, 0)
    assert relay.forwarding.dropped == {DropReason.RELAY_OVER_LIMIT: greedy.over_limit}
    assert len(relay.sent) == greedy.datagrams + modest.datagrams


def test_bits_are_limited_too() -> None:
    """By the length of the datagrams."""
    meter = Meter(1_000_000)
    passed = sum(2000 for tick in range(1000) if meter.take(2000, tick / 1000))
    assert passed * 8 == pytest.approx(1_000_000 * (1 + BURST_S), abs=8 * 2000)


def test_lowest_limits_let_single_datagrams_pass() -> None:
    """Although their rate has none in a burst's time."""
    meter = Meter(1000)
    assert [meter.take(1232, now) for now in (0.0, 1.0, 10.0, 20.0)] == [True, False, True, True]


def test_silence_saves_up_no_more_than_a_burst() -> None:
    """A bucket, not an account."""
    meter = Meter(10_000_000)
    meter.take(10, 0.0)
    assert sum(meter.take(10, 3600.0) for _ in range(1000)) == pytest.approx(1000 * BURST_S, abs=1)


def test_log_download_survives_a_pause() -> None:
    """A process that did not run for a quarter of a second sends, or receives, at once what a download brought."""
    relay = Relay(DEFAULT)
    per_s, paused_s = 1_700, 0.25
    at = [number / per_s for number in range(2 * per_s)]
    for now in at:
        relay.arrive(wrap(A.handle, DATAGRAM), now=max(now, 1.0 + paused_s) if now > 1.0 else now)
    assert len(relay.sent) == len(at)


def test_limit_of_all_members_together() -> None:
    """A datagram that exceeds it is counted for no member. Beside it the limits of a member hold again later."""
    relay = Relay(total=10_000_000)
    for _ in range(400):
        relay.arrive(wrap(A.handle, DATAGRAM))
        relay.arrive(wrap(B.handle, DATAGRAM), path=AT_B)
    assert len(relay.sent) == pytest.approx(1000 * BURST_S, abs=1)
    half = len(relay.sent) / 2
    assert all(abs(meter.datagrams - half) <= 1 for meter in relay.meters)
    assert [meter.over_limit for meter in relay.meters] == [0, 0]
    assert relay.forwarding.dropped == {RelayReason.OVER_TOTAL: 800 - len(relay.sent)}
    relay.forwarding.total.set_limit(AMPLE)
    relay.arrive(*[wrap(A.handle, DATAGRAM)] * 1000, now=1.0)
    assert relay.meters[0].datagrams - half == pytest.approx(DEFAULT / (8 * LEAST_BYTES) * BURST_S, abs=2)


def test_member_above_its_limit_uses_up_nothing_of_the_others() -> None:
    """The limit of all members together has room for both. One of them sends more than all may."""
    bits_s = 2_000_000
    relay = Relay(bits_s, total=10_000_000)
    relay.arrive(*[wrap(A.handle, DATAGRAM)] * 1000)
    relay.arrive(*[wrap(B.handle, DATAGRAM)] * 1000, path=AT_B)
    assert [meter.datagrams for meter in relay.meters] == pytest.approx([200 * BURST_S] * 2, abs=1)
    assert RelayReason.OVER_TOTAL not in relay.forwarding.dropped


def test_limits_can_change() -> None:
    """From then on."""
    meter = Meter(10_000_000)
    meter.take(10, 0.0)
    meter.set_limit(1_000_000_000)
    assert sum(meter.take(10, 1.0) for _ in range(100_000)) == pytest.approx(100_000 * BURST_S, abs=1)
