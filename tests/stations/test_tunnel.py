"""The tunnel in virtual time, with a client written from the whitepaper: handshakes, replays, old commands."""

from __future__ import annotations

import pytest

from tests.stations.world import THERE, World
from uavlinkd.protocol.drops import DropReason
from uavlinkd.stations.session import MOST_AGE_S, REJECT_AFTER_S
from uavlinkd.stations.tunnel import ASK_S, REKEY_ATTEMPT_S

BACK_S = 0.5
"""How soon a command passes after a delay of the network ended."""


@pytest.mark.parametrize(("host", "daemon"), [("10.66.0.2", "10.66.0.1"), ("fd66::2", "fd66::1")])
def test_station_connects_and_its_commands_pass(host: str, daemon: str) -> None:
    """Soon after the first answer, and each once."""
    world = World(host=host, daemon_host=daemon)
    world.connect()
    world.commands(10.0)
    payloads = [payload for payload, _, _ in world.delivered]
    assert len(payloads) == len(set(payloads)) == 20
    assert [is_new for _, is_new, _ in world.delivered].count(False) == 1  # the one that begins the questions
    assert max(world.ages) < 0.1
    assert world.drops == []


def test_keys_are_renewed_and_nothing_is_lost() -> None:
    """Of an idle station too, for an hour: the daemon makes new keys if the station should have."""
    world = World()
    world.connect()
    for _ in range(20):
        world.from_daemon(world.tunnel.seal(b"", world.now))
        world.commands(180.0, every=2.0)
        assert world.tunnel.is_open
    assert len(world.delivered) == 20 * 90
    assert world.drops == []


@pytest.mark.parametrize("answers", [True, False])
@pytest.mark.parametrize("held_s", [1.0, 4.0, 4.3, 4.7, 5.1, 20.0, 120.0])
def test_no_command_is_older_than_its_bound(held_s: float, *, answers: bool) -> None:
    """An attacker holds everything that the station sends, and later everything passes again."""
    world = World()
    world.client.answers_pings = answers
    world.connect()
    world.commands(10.0)
    begun = world.now
    world.to_daemon = lambda datagram: max(0.02, begun + held_s - world.now)
    world.commands(held_s)
    world.to_daemon = lambda datagram: 0.02
    assert len(world.delivered) > 0
    world.commands(10.0, every=0.1)
    assert max(world.ages) <= MOST_AGE_S
    back = next(at for payload, is_new, at in world.delivered if is_new and float(payload) >= begun + held_s)
    assert back - (begun + held_s) <= BACK_S


def test_nothing_that_answers_nothing_commands() -> None:
    """Neither echo requests nor initiations are answered: reports pass, commands never do after the first seconds."""
    world = World()
    world.client.answers_pings = False
    world.to_client = lambda datagram: None if datagram[0] == 1 else 0.02
    world.connect()
    world.commands(30.0)
    assert len(world.delivered) == 60
    assert world.ages == []


def test_replayed_and_altered_messages_change_nothing() -> None:
    """Data twice, data below a counter, an initiation twice, an older one, and each byte of a message altered."""
    world = World()
    first = world.client.initiation()
    world.receive(first)
    world.run(world.now + 0.1)
    message = world.client.udp(b"once")
    world.receive(message)
    world.receive(message)
    world.receive(first)
    assert world.drops == [DropReason.REPLAYED, DropReason.REPLAYED_INITIATION]
    world.drops.clear()
    fresh = world.client.udp(b"twice")
    for at in range(8, len(fresh)):
        altered = bytearray(fresh)
        altered[at] ^= 1
        world.receive(bytes(altered))
    assert set(world.drops) <= {DropReason.BAD_TAG, DropReason.REPLAYED}
    assert len(world.drops) == len(fresh) - 8
    assert [payload for payload, _, _ in world.delivered] == [b"once"]
    world.receive(fresh)
    assert [payload for payload, _, _ in world.delivered] == [b"once", b"twice"]


def test_recorded_initiations_make_no_session_that_counts() -> None:
    """After a restart the daemon has forgotten the greatest timestamp. The genuine station connects all the same."""
    world = World()
    recorded = [world.client.initiation() for _ in range(5)]
    world.to_client = lambda datagram: None
    for initiation in recorded:
        world.run(world.now + 1.0)
        world.receive(initiation)
    assert not world.tunnel.is_open
    assert world.tunnel.address is None
    world.to_client = lambda datagram: 0.02
    world.run(world.now + 1.0)
    world.connect()
    for initiation in recorded:
        world.receive(initiation)
    assert world.drops == [DropReason.REPLAYED_INITIATION] * 5


def test_address_follows_the_newest_data_alone() -> None:
    """An older message from elsewhere, and an initiation, do not move it."""
    world = World()
    world.connect()
    older, newer = world.client.udp(b"older"), world.client.udp(b"newer")
    index = int.from_bytes(newer[4:8], "little")
    world.tunnel.open(newer, index, THERE, world.now)
    world.tunnel.open(older, index, ("198.51.100.1", 1), world.now)
    assert world.tunnel.address == THERE
    world.tunnel.open(world.client.udp(b"moved"), index, ("198.51.100.2", 2), world.now)
    assert world.tunnel.address == ("198.51.100.2", 2)


def test_daemon_gives_up_a_station_that_is_gone() -> None:
    """No initiation after 90 s, and nothing is due any more. The next one of the station is answered."""
    world = World()
    world.connect()
    world.to_client = lambda datagram: None
    world.from_daemon(world.tunnel.seal(b"x", world.now))
    world.run(world.now + REJECT_AFTER_S + REKEY_ATTEMPT_S + 200.0)
    assert not world.tunnel.is_open
    assert world.tunnel.next_at == float("inf")
    assert len(world.indices) == 0
    world.to_client = lambda datagram: 0.02
    world.connect()


def test_idle_station_is_not_asked() -> None:
    """Only a keepalive every ten seconds answers what it sent."""
    world = World()
    world.connect()
    world.commands(4.0)
    sent: list[bytes] = []

    def pass_on(datagram: bytes) -> float:
        sent.append(datagram)
        return 0.02

    world.to_client = pass_on
    world.run(world.now + 60.0)
    assert 3 <= len(sent) <= 3 / ASK_S + 2


def test_nothing_is_due_without_keys_to_send_it() -> None:
    """The station uses the older of two sessions last. It ends first, and the station goes on with the newer one."""
    world = World()
    world.connect()
    world.to_daemon = lambda datagram: 0.02 if datagram[0] == 1 else None
    world.from_client(world.client.initiation())
    world.run(world.now + 0.1)
    older = world.client.udp(b"older")
    world.to_daemon = lambda datagram: None if datagram[4:8] == older[4:8] else 0.02
    world.run(world.now + 100.0)
    world.from_daemon(world.tunnel.initiate(world.now))
    world.run(world.now + 1.0)
    world.to_client = lambda datagram: None
    world.receive(older)
    world.run(world.now + REJECT_AFTER_S - 100.0)
    world.command(b"newer")
    world.run(world.now + 50.0)
    assert [payload for payload, _, _ in world.delivered] == [b"older", b"newer"]
