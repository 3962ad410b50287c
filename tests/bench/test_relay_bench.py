"""The bench of the relay measures what it says, at a rate that every machine carries."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.bench import held
from tests.bench.measure import resident_bytes
from tests.bench.relay import turn
from tests.bench.relay.load import Generator
from tests.bench.relay.members import Members, crews, members
from tests.needs import need

PAIRS, RATE_S, SECONDS = 3, 20, 1.0

pytestmark = pytest.mark.long


def check(generator: Generator) -> None:
    """All datagrams of six hosts arrive, each after some time, and the relay works for them."""
    row = generator.run(RATE_S, SECONDS)
    assert row.lost == 0
    assert generator.relay.hosts.received >= len(generator.relay.flows) * RATE_S * SECONDS / 2
    assert 0 < row.delay_ms <= row.slowest_ms
    assert resident_bytes(generator.relay.pid()) > 1e6


def test_members_are_bound_and_again_after_a_restart(tmp_path: Path) -> None:
    """The hosts of a relay that was killed get other handles, and datagrams pass."""
    with members(tmp_path, PAIRS) as (relay, generator):
        check(generator)
        before = relay.flows
        relay.process.end()
        relay.process.start()
        relay.find_again(generator)
        assert relay.flows != before
        check(generator)


@pytest.mark.parametrize("senders", [slice(0, None, 2), slice(1, None, 2)])
def test_members_by_tls_and_by_udp_reach_each_other(tmp_path: Path, senders: slice) -> None:
    """In both directions."""
    with members(tmp_path, PAIRS, slice(1, None, 2)) as (relay, generator):
        relay.senders = senders
        check(generator)


def test_members_by_tls_are_bound_again(tmp_path: Path) -> None:
    """They connect again after a restart."""
    with crews(tmp_path, 2, 2, tls=slice(None)) as both:
        both.do(Members.bind)
        assert min(both.restart().after_s) > 0


@pytest.mark.parametrize("has_fleet", [False, True])
def test_members_in_several_processes_are_bound_again(tmp_path: Path, *, has_fleet: bool) -> None:
    """Each needs a handshake, and the figures are of this restart only. Members may be those with a certificate."""
    with crews(tmp_path, 2, 2, has_fleet=has_fleet) as both:
        first, again = both.do(Members.bind), both.restart()
        assert len(first.after_s) == len(again.after_s) == 4
        assert min(again.after_s) > 0
        assert again.initiations >= 4
        assert again.relay_cpu_s > 0


def test_what_a_relay_drops_is_lost(tmp_path: Path) -> None:
    """Datagrams with a handle that belongs to no member."""
    with members(tmp_path, PAIRS) as (relay, generator):
        for member in relay.members:
            member.handle = 0
        assert generator.run(RATE_S, SECONDS).lost == 1


def test_coturn_does_the_same_work(tmp_path: Path) -> None:
    """One end of each pair has an allocation."""
    need(turn.is_there(), "coturn")
    with turn.clients(tmp_path, PAIRS) as (_, generator):
        check(generator)


def test_addresses_in_stun() -> None:
    """RFC 5769, section 2.2: 192.0.2.1, port 32853."""
    value = bytes.fromhex("0001a147e112a643")
    assert turn.xored(("192.0.2.1", 32853)) == value
    response = turn.message(0x0103, bytes(12), {0x0022: b"test", 0x0016: value})
    assert turn.relayed_address(response) == ("192.0.2.1", 32853)
    assert turn.relayed_address(turn.message(0x0103, bytes(12), {0x0022: b"test"})) is None


async def test_certificates_are_held() -> None:
    """The daemon holds as many as it is asked about, and none of their links is up."""
    before, after = await held.memory(PAIRS, SECONDS)
    assert 1e6 < before <= after
