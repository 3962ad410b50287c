"""The service without a socket: what hostile datagrams cost, and what is passed on to the switch."""

from __future__ import annotations

import os

import pytest

from tests.fuzz.stations import THERE, Attacked, Outside, alone
from tests.processes.frames import heartbeat
from tests.stations.client import Client
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.path import Path
from uavlinkd.stations import handshake
from uavlinkd.stations.endpoint import CLIENTS
from uavlinkd.system.stall import STALE

STRANGER = ("198.51.100.1", 9)


def test_frames_keep_the_epoch_in_which_they_were_read() -> None:
    """The switch drops those from before a pause of the daemon."""
    outside = Outside()
    with alone(outside):
        attacked = Attacked(outside, has_session=True)
        outside.deliver([(attacked.client.udp(heartbeat()), THERE)], attacked.now, STALE, 0.0)
    assert len(outside.frames) == 1
    assert outside.epochs == {STALE}


def test_responses_to_nothing_take_no_budget() -> None:
    """The genuine one is read behind 20,000 with the right mac1 and an index that nobody has."""
    outside = Outside()
    with alone(outside):
        attacked = Attacked(outside, has_session=False)
        strange = attacked.macs.add(handshake.RESPONSE + bytes(56), None)
        outside.deliver([(strange, STRANGER)] * 20_000, attacked.now, 0, 0.0)
        assert set(outside.drops) == {DropReason.UNKNOWN_INDEX}
        outside.drops.clear()
        attacked.offer(attacked.genuine[0], THERE)
        assert not outside.drops
        assert attacked.endpoint.is_open


def test_strangers_get_no_answer() -> None:
    """One with a key that the daemon does not have, and one that does not have the daemon's."""
    outside = Outside()
    with alone(outside):
        attacked = Attacked(outside, has_session=False)
        initiation = Client(attacked.daemon_key).initiation()
        attacked.offer(initiation, STRANGER)
        attacked.offer(initiation[:-32] + bytes(32), STRANGER)
    assert outside.drops == [DropReason.UNKNOWN_PEER, DropReason.BAD_MAC1]
    assert not outside.sent


def test_cookie_proves_one_address_for_two_minutes() -> None:
    macs, there = handshake.Macs(bytes(32)), Path(0, THERE)
    cookies = handshake.StationCookies(macs, os.urandom, 0.0)
    message = macs.add(bytes(116), None)
    cookie = macs.open(cookies.reply(message, 1, there, 0.0), handshake.mac1_of(message))
    proof = macs.add(bytes(116), cookie)
    assert cookies.has_valid_mac2(proof, there, 119.0)
    assert not cookies.has_valid_mac2(proof, Path(0, STRANGER), 119.0)
    assert not cookies.has_valid_mac2(proof, there, 121.0)


def test_station_cannot_multiply_what_it_receives() -> None:
    """By clients at many ports."""
    outside = Outside()
    with alone(outside):
        attacked = Attacked(outside, has_session=True)
        for port in range(5000, 5050):
            attacked.offer(attacked.client.udp(heartbeat(), port=port), THERE)
    assert len(attacked.endpoint.ports) == CLIENTS
    assert attacked.endpoint.failures["too_many_clients"] == 50 + 1 - CLIENTS


def test_few_pings_of_a_station_are_answered() -> None:
    outside = Outside()
    with alone(outside):
        attacked = Attacked(outside, has_session=True)
        for _ in range(50):
            ping = attacked.client.packet(1, b"\x08\0\xf7\xff" + bytes(4))
            attacked.offer(attacked.client.data(ping), THERE)
    assert len(outside.sent) == 10


def test_strangers_with_the_right_mac1_are_limited() -> None:
    """Initiations cost a key exchange for as many as the budget has. Cookies are no more than messages."""
    outside = Outside()
    with alone(outside):
        attacked = Attacked(outside, has_session=True)
        strange = attacked.macs.add(handshake.INITIATION + bytes(112), None)
        outside.deliver([(strange, STRANGER)] * 2000, attacked.now, 0, 0.0)
        assert outside.drops.count(DropReason.INVALID_KEY_SHARE) < 200
        assert all(len(datagram) == handshake.COOKIE_REPLY_BYTES for datagram, _ in outside.sent)
        attacked.offer(attacked.genuine[1], THERE)  # data of the session
        assert outside.drops.count(DropReason.RATE_LIMITED) + outside.drops.count(DropReason.COOKIE_REQUIRED) > 1500
        assert len(outside.drops) == 2000


@pytest.mark.parametrize("counter", [2**64 - 1, 2**64 - 2**13 - 1, 2**63])
def test_counters_near_the_end_are_dropped(counter: int) -> None:
    """Forged ones, and those beyond the last counter of a session."""
    outside = Outside()
    with alone(outside):
        attacked = Attacked(outside, has_session=True)
        genuine = attacked.genuine[1]
        attacked.check(genuine[:8] + counter.to_bytes(8, "little") + genuine[16:], THERE)
        attacked.check_sequel()


def test_authentic_data_with_the_greatest_counter_passes() -> None:
    """Then all smaller ones beyond the window are old, and nothing fails."""
    outside = Outside()
    with alone(outside):
        attacked = Attacked(outside, has_session=True)
        attacked.client.counter = 2**64 - 2**13 - 2
        attacked.offer(attacked.client.data(b""), THERE)
        assert not outside.drops
        attacked.offer(attacked.genuine[1], THERE)
        assert outside.drops == [DropReason.REPLAYED]


def test_packets_that_are_not_for_the_daemon_are_counted() -> None:
    """Zeros, TCP, and UDP to another port or from the address of another station. An empty one is a keepalive."""
    outside = Outside()
    with alone(outside):
        attacked = Attacked(outside, has_session=True)
        client = attacked.client
        strange = [client.data(bytes(size)) for size in (1, 15, 16, 17, 20, 28, 1500)]
        strange += [client.data(client.packet(6, bytes(20))), client.udp(heartbeat(), to_port=14551)]
        client.host = "10.66.0.3"
        for datagram in (*strange, client.udp(heartbeat()), client.data(b"")):
            attacked.offer(datagram, THERE)
        assert attacked.endpoint.failures["inner_packet"] == len(strange) + 1
        assert not outside.frames
        assert not outside.drops
