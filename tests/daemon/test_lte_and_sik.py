"""Real daemons with LTE and a SiK modem: each network fails and returns while the other one carries the link."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.daemon.harness import Stage
from tests.daemon.lte_and_sik import LteAndSik
from uavlinkd.lab.mitm.modem import Fate, ModemEnd, ModemSettings

SIK = ModemSettings(air_bits_s=24_000, line_baud=57_600)
NOISY = replace(SIK, byte_error_rate=0.001, packet_loss=0.02)


@pytest.mark.long
async def test_no_critical_frame_is_lost_while_lte_or_the_modem_is_gone(stage: Stage) -> None:
    """Heartbeats, commands and answers all arrive, unaltered and once. A bad line alone loses what it damages."""
    pair = LteAndSik(stage, NOISY)
    try:
        await pair.start()
        await pair.until_best(None)
        begin = pair.mark()
        await pair.cross(8)
        for end in ModemEnd:
            await pair.pull_modem(end)
            await pair.cross(3)
            pair.ports.plug(end)
            await pair.until_usable(2)
        assert all(pair.ports.link.bytes[end][Fate.ALTERED] for end in ModemEnd)

        pair.ports.change_modem(SIK)
        await pair.cross(2)  # what the line damaged is over
        await pair.until_usable(2)
        pair.pull_lte()
        await pair.until_best("sik")
        await pair.cross(12)
        pair.restore_lte()
        await pair.until_best(None)
        await pair.until_usable(2)
        clean = await pair.outcome(begin)
        print(clean)
        assert len(clean.lost) <= clean.to_waiting, (clean, pair.ports.link.bytes)
        assert clean.superseded <= 0.02 * clean.arrived, clean

        # The bad line alone: only what it damages is lost.
        pair.pull_lte()
        await pair.until_best("sik")
        pair.ports.change_modem(replace(SIK, byte_error_rate=0.001))
        damaged, alone = await pair.line_noise(), pair.mark()
        await pair.cross(12)
        bad = await pair.outcome(alone)
        damaged = await pair.line_noise() - damaged
        print(bad, damaged)
        # An altered delimiter joins two datagrams to one damaged piece.
        assert len(bad.lost) <= 2 * damaged + bad.to_waiting, bad
        pair.check()
    finally:
        await pair.stop()
