"""The paper's protocol, and the relay that its bare public keys let through."""

from __future__ import annotations

import asyncio
from collections import Counter
from pathlib import Path

import pytest

from uavlinkd.evaluation import paper_protocol as paper
from uavlinkd.evaluation.ledger import Fault, numbered_frame
from uavlinkd.evaluation.middle import MiddleHere
from uavlinkd.evaluation.paper_attacks import CHANGES, AlterKeys, PaperRelay
from uavlinkd.evaluation.stage import PaperStage
from uavlinkd.mitm.attack import AttackObject

NAMES = ("drone0", "drone1")
PATIENCE_S = 20.0


def test_two_keys_give_both_ends_the_same_hmac_key() -> None:
    """Diffie-Hellman."""
    a, b = paper.PaperKey(), paper.PaperKey()
    assert a.mac_key(b.public) == b.mac_key(a.public)
    assert a.mac_key(paper.PaperKey().public) != b.mac_key(a.public)


def test_data_is_opened_under_its_key_alone() -> None:
    """And unaltered alone."""
    frame = numbered_frame(1, 7)
    for number in (0, 2**16 - 1, 2**16, 2**20):
        datagram = paper.seal(b"k" * 32, number, frame)
        assert paper.unseal(b"k" * 32, datagram) == frame
        assert paper.unseal(b"j" * 32, datagram) is None
        for at in range(len(datagram)):
            assert paper.unseal(b"k" * 32, datagram[:at] + bytes((datagram[at] ^ 1,)) + datagram[at + 1 :]) is None


async def attacked(tmp_path: Path, attack: AttackObject, seconds: float = 0.8) -> tuple[Counter[Fault], Counter[str]]:
    """What comes out falsely, and what the ends notice, while this stands in the way."""
    stage = PaperStage(NAMES, MiddleHere(NAMES, tmp_path / "mitm.jsonl", 1), rate_hz=100.0)
    async with stage:
        await stage.middle.attack([], [attack])
        await asyncio.sleep(seconds)  # new keys come each quarter of a second
        async with asyncio.timeout(PATIENCE_S):
            while not (await stage.middle.statistics()).counts:  # noqa: ASYNC110  sockets set no event
                await asyncio.sleep(0.01)
        noticed: Counter[str] = Counter()
        for notice in (await stage.notices()).values():
            noticed += notice.drops
    return stage.ledger.faults, noticed


@pytest.mark.parametrize("name", CHANGES)
async def test_the_papers_own_attacks_are_detected(tmp_path: Path, name: str) -> None:
    """A key that was tampered with or replaced gives the ends different keys, or is refused."""
    from random import Random

    faults, noticed = await attacked(tmp_path, AlterKeys(name, Random(1)))
    assert not faults
    assert set(noticed) <= {"hmac_mismatch", "bad_public_key"}
    assert noticed.total() > 0


async def test_the_two_sided_relay_succeeds(tmp_path: Path) -> None:
    """An exchange with each side, and altered frames are accepted as genuine."""
    relay = PaperRelay()
    faults, _ = await attacked(tmp_path, relay)
    assert relay.exchanges >= 2
    assert relay.read > relay.altered > 0
    assert faults[Fault.FALSE] > 0
    assert set(faults) == {Fault.FALSE}


async def test_without_an_attack_everything_comes_out(tmp_path: Path) -> None:
    """The ends do speak with each other."""
    stage = PaperStage(NAMES, MiddleHere(NAMES, tmp_path / "mitm.jsonl", 1), rate_hz=100.0)
    async with stage:
        begin = stage.ledger.mark()
        await asyncio.sleep(0.8)  # three exchanges
        end = stage.ledger.mark()
        async with asyncio.timeout(PATIENCE_S):
            while len(set(stage.ledger.count(begin, end))) != 1:  # noqa: ASYNC110  likewise
                await asyncio.sleep(0.01)
        assert stage.ledger.count(begin, end)[0] > 20
        assert all(not notice.drops for notice in (await stage.notices()).values())
        assert all(notice.figures["exchanges"] >= 2 for notice in (await stage.notices()).values())
    assert not stage.ledger.faults
