"""``uavlinkd netcheck`` behind NATs of every kind: what it reports is what the routers do."""

from __future__ import annotations

from typing import Final

import pytest

from tests.daemon.harness import Stage
from tests.natlab import daemons, namespaces
from tests.natlab.kinds import PAIRED
from tests.natlab.laboratory import Laboratory
from tests.needs import need
from uavlinkd.ops.netcheck import ANY_PEER, FEW_PEERS, MOST_PEERS, Filtered, Mapped, behaviours, meaning

pytestmark = [pytest.mark.alone, pytest.mark.long]

OPEN, BY_PORT = Filtered.NOT_BY_PORT, Filtered.BY_PORT
REPORTED: Final = {
    "open": (Mapped.NO_NAT, OPEN, ANY_PEER),
    "firewall": (Mapped.NO_NAT, BY_PORT, MOST_PEERS),
    "full-cone": (Mapped.INDEPENDENT, OPEN, ANY_PEER),
    "address-restricted": (Mapped.INDEPENDENT, OPEN, ANY_PEER),
    "port-restricted": (Mapped.INDEPENDENT, BY_PORT, MOST_PEERS),
    "address-dependent": (Mapped.BY_ADDRESS, OPEN, FEW_PEERS),
    "symmetric": (Mapped.BY_PORT, BY_PORT, FEW_PEERS),
    "linux": (Mapped.INDEPENDENT, BY_PORT, MOST_PEERS),
    "linux-random": (Mapped.BY_PORT, BY_PORT, FEW_PEERS),
    "carrier": (Mapped.INDEPENDENT, BY_PORT, MOST_PEERS),
    "carrier-symmetric": (Mapped.BY_PORT, BY_PORT, FEW_PEERS),
    "no-udp": None,
}
"""By kind, with a relay that has two addresses, and two ports at one of them. None: no relay answers."""


async def test_netcheck_reports_what_the_routers_do() -> None:
    """Twice in a row: the first tests open no NAT for the second ones. No daemon warns of a token."""
    reason = namespaces.why_not()
    need(reason is None, reason or "")
    assert set(REPORTED) == set(PAIRED)

    with Laboratory() as laboratory:
        async with Stage() as stage:
            members = await daemons.start_members(stage, laboratory, PAIRED)
            for kind, member in members.items():
                for _ in range(2):
                    reported = list(behaviours(await member.ask("netcheck")))
                    print(kind, *reported)
                    assert [(mapped, filtered, meaning(mapped, filtered)) for _, mapped, filtered in reported] == (
                        [REPORTED[kind]] if REPORTED[kind] else []
                    )
                drops = (await member.status())["drops"]
                assert not drops, f"{kind}: {drops}"
