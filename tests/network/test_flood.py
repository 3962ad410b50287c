"""Floods of initiations from more networks than a daemon remembers, while its peers start, move and restart."""

from __future__ import annotations

from random import Random

import pytest

from tests.network.attackers import Flooder
from tests.network.network import Network, share_a_session
from uavlinkd.core.drops import DropReason
from uavlinkd.core.settings import Link
from uavlinkd.core.suites import SUITES_BY_NAME
from uavlinkd.lab.mitm.radio import RadioSettings

SOURCES = 10_000
PER_S = 2000.0
RADIO = RadioSettings(delay_s=0.05)


@pytest.mark.parametrize("suite", ["x25519", "mlkem768"])
def test_a_known_peer_starts_during_a_flood_from_ten_thousand_networks(suite: str) -> None:
    """The flooded drone sends the peer its cookie, and the peer is up within two round trips and two retries."""
    with Network(f"flood {suite}", RADIO) as network:
        a, b = network.add("a"), network.add("b")
        link = Link(suites=(SUITES_BY_NAME[suite],))
        a.knows(b, b.addresses, link)
        b.knows(a, a.addresses, link)
        b.is_behind_nat = True  # a's own calls do not reach it
        a.start()
        Flooder(network, a, Random(suite), sources=SOURCES, knows_key=True).flood(PER_S, network.now + 5)
        network.run(1)
        b.start()
        network.traffic(b, a, 0.1)
        network.run_until(lambda: share_a_session(a, b), within_s=1.0)
        network.run(2)
        assert a.drops[DropReason.RATE_LIMITED] > PER_S


def test_a_peer_that_restarts_where_it_was_last_seen_gets_its_session() -> None:
    """It has no configured address: the address that it proved before the flood counts."""
    with Network("flood, restart", RADIO) as network:
        a, b = network.add("a"), network.add("b")
        a.knows(b, ())
        b.knows(a, a.addresses)
        a.start()
        b.start()
        network.talk(a, b, 0.1)
        network.run_until(lambda: share_a_session(a, b), within_s=1.0)
        Flooder(network, a, Random("restart"), sources=SOURCES, knows_key=True).flood(PER_S, network.now + 5)
        network.run(1)
        b.stop()
        b.start()
        network.run_until(lambda: share_a_session(a, b), within_s=1.0)
