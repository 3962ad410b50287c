"""Every cipher suite between real daemons along a real relay: handshakes and rekeys, without a lost frame."""

from __future__ import annotations

import asyncio
from itertools import count

import pytest

from tests.daemon.fleet import relay_for
from tests.daemon.harness import Stage
from tests.relay.relayed_pair import RelayedPair
from uavlinkd.core.suites import SUITES_BY_NAME

HANDSHAKES = 3
"""The first one, and two rekeys."""
EVERYDAY = {"duplicate", "late_copy", "unexpected_response", "late", "old_record"}
"""What rekeys of both ends at the same moment cause."""


@pytest.mark.long
@pytest.mark.parametrize("suite", SUITES_BY_NAME)
async def test_pair_connects_and_rekeys_without_a_lost_frame(suite: str) -> None:
    """With each other and with the relay. Frames flow in both directions all the time."""
    link = {"suites": [suite], "rekey_after_s": 2.0, "reject_after_s": 20.0}
    async with Stage() as stage:
        relay = relay_for(stage)
        relay.config["link"].update(link)
        pair = RelayedPair(stage, relay, **link)
        await relay.start()
        await pair.start()
        ends = [(pair.one, "drone1"), (pair.other, "drone0")]
        for first in count(step=20):
            for flow in pair.ends():
                await flow.pour(range(first, first + 20))
            statuses = [(await daemon.status())["peers"][peer] for daemon, peer in ends]
            if all(status["handshakes"] >= HANDSHAKES for status in statuses):
                break
            await asyncio.sleep(0.02)
        for status in statuses:
            assert status["session"]["suite"] == suite
            assert status["path"].startswith("relayed via vps")
            assert status["paths"][0]["relay_address"] == relay.address
            assert set(status["drops"]) <= EVERYDAY
        for daemon, _ in ends:
            assert not daemon.events("peer_lost")
            assert "unexpected_record" not in (await daemon.status())["drops"]
            assert (await relay.until_logged("session_established", peer=daemon.name))["suite"] == suite
