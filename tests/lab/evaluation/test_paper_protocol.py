"""The paper's protocol, and the relay that its bare public keys let through."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.waiting import PATIENCE_S, until
from uavlinkd.lab.evaluation import paper_protocol as paper
from uavlinkd.lab.evaluation.ledger import Fault, numbered_frame
from uavlinkd.lab.evaluation.middle import MiddleHere
from uavlinkd.lab.evaluation.paper_attacks import CHANGES, AlterKeys, PaperRelay
from uavlinkd.lab.evaluation.stage import PaperStage
from uavlinkd.lab.mitm.attack import AttackObject

NAMES = ("drone0", "drone1")


def test_data_is_opened_under_its_key_alone() -> None:
    frame = numbered_frame(1, 7)
    for number in (0, 2**16 - 1, 2**16, 2**20):
        datagram = paper.seal(b"k" * 32, number, frame)
        assert paper.unseal(b"k" * 32, datagram) == frame
        assert paper.unseal(b"j" * 32, datagram) is None
        for at in range(len(datagram)):
            assert paper.unseal(b"k" * 32, datagram[:at] + bytes((datagram[at] ^ 1,)) + datagram[at + 1 :]) is None


Outcome = tuple[Counter[Fault], Counter[str]]
"""The false frames, and the counters of the ends."""


async def attacked(tmp_path: Path, attack: AttackObject, is_enough: Callable[[Outcome], bool]) -> Outcome:
    """The result of an attack during at least three exchanges."""
    stage = PaperStage(NAMES, MiddleHere(NAMES, tmp_path / "mitm.jsonl", 1), rate_hz=100.0)
    async with stage:
        await stage.middle.attack([], [attack])
        await asyncio.sleep(3.2 * paper.RENEW_S)
        async with asyncio.timeout(PATIENCE_S):
            while not is_enough(await outcome(stage)):  # noqa: ASYNC110  sockets set no event
                await asyncio.sleep(0.01)
        assert (await stage.middle.statistics()).counts
        return await outcome(stage)


async def outcome(stage: PaperStage) -> Outcome:
    noticed: Counter[str] = Counter()
    for counters in (await stage.notices()).values():
        noticed += counters
    return stage.ledger.faults, noticed


@pytest.mark.parametrize("name", CHANGES)
async def test_the_papers_own_attacks_are_detected(tmp_path: Path, name: str) -> None:
    """A key that was tampered with or replaced gives the ends different keys, or is refused."""
    from random import Random

    faults, noticed = await attacked(tmp_path, AlterKeys(name, Random(1)), lambda so_far: so_far[1].total() > 0)
    assert not faults
    assert noticed.keys() <= {"hmac_mismatch", "bad_public_key"}


async def test_the_two_sided_relay_succeeds(tmp_path: Path) -> None:
    """An exchange with each side, and altered frames are accepted as genuine."""
    relay = PaperRelay()
    faults, _ = await attacked(
        tmp_path,
        relay,
        lambda so_far: relay.exchanges >= 2 and relay.read > relay.altered > 0 and so_far[0][Fault.FALSE] > 0,
    )
    assert faults.keys() == {Fault.FALSE}


async def test_without_an_attack_everything_comes_out(tmp_path: Path) -> None:
    """The ends do speak with each other."""
    stage = PaperStage(NAMES, MiddleHere(NAMES, tmp_path / "mitm.jsonl", 1), rate_hz=100.0)
    async with stage:
        begin = stage.ledger.mark()
        before = [end.exchanges for end in stage.ends.values()]
        await until(
            lambda: (
                stage.ledger.count(begin, stage.ledger.mark())[0] > 20
                and all(end.exchanges >= count + 3 for end, count in zip(stage.ends.values(), before, strict=True))
            )
        )
        end = stage.ledger.mark()
        await until(lambda: len(set(stage.ledger.count(begin, end))) == 1)
        assert not any((await stage.notices()).values())
    assert not stage.ledger.faults
