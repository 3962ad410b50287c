"""The man in the middle of the evaluation has the same interface as a process and in this one."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

from uavlinkd.lab.evaluation.middle import MiddleError, MiddleHere, MiddleProcess
from uavlinkd.lab.mitm.attack import AttackError, Direction

NAMES = ("a", "b")
KEYS = {"a": b"\1" * 32, "b": b"\2" * 32}
ENVELOPE = b"\x40\x00\x01\x00\x07" + bytes(40)


@pytest.fixture
def ends() -> Iterator[dict[str, socket.socket]]:
    """A socket for each peer."""
    sockets = {name: socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for name in NAMES}
    for sock in sockets.values():
        sock.bind(("127.0.0.1", 0))
        sock.setblocking(False)
    yield sockets
    for sock in sockets.values():
        sock.close()


@pytest.fixture(params=["process", "here"])
async def middle(
    request: pytest.FixtureRequest, tmp_path: Path, ends: dict[str, socket.socket]
) -> AsyncIterator[MiddleProcess | MiddleHere]:
    """One of the two, standing between the sockets."""
    log = tmp_path / "mitm.jsonl"
    made = MiddleProcess(NAMES, tmp_path, log, 1) if request.param == "process" else MiddleHere(NAMES, log, 1)
    try:
        await made.start({name: sock.getsockname()[1] for name, sock in ends.items()}, KEYS)
        yield made
    finally:
        await made.stop()
    assert "mitm_stopped" in log.read_text()


async def passed(ends: dict[str, socket.socket], middle: MiddleProcess | MiddleHere) -> bytes:
    """What b gets when a sends an envelope."""
    ends["a"].sendto(ENVELOPE, ("127.0.0.1", middle.ports[Direction("a", "b")]))
    return await asyncio.wait_for(asyncio.get_running_loop().sock_recv(ends["b"], 2048), 20)


async def test_attacks_are_started_and_counted(
    middle: MiddleProcess | MiddleHere, ends: dict[str, socket.socket]
) -> None:
    """The counters grow only during the attack."""
    assert await passed(ends, middle) == ENVELOPE
    assert (await middle.statistics()).counts == {}
    await middle.attack(["alter-frame"])
    assert await passed(ends, middle) != ENVELOPE
    assert (await middle.statistics()).of(["alter-frame"]) == {"alter-frame: altered": 1}
    assert (await middle.statistics()).of(["bit-flip"]) == {}
    await middle.attack([])
    assert await passed(ends, middle) == ENVELOPE
    assert (await middle.statistics()).counts == {"alter-frame: altered": 1}
    assert (await middle.statistics()).bytes_to_strangers == 0


async def test_what_cannot_be_done_is_refused(middle: MiddleProcess | MiddleHere) -> None:
    """In words; two peers are too few for this."""
    with pytest.raises((MiddleError, AttackError), match="three peers"):
        await middle.attack(["misroute"])


async def test_knowing_the_public_keys_it_can_make_mac1(
    middle: MiddleProcess | MiddleHere, ends: dict[str, socket.socket]
) -> None:
    """A flood that takes the keys is made."""
    await passed(ends, middle)
    await middle.attack(["flood-initiations,rate_per_s=100"])
    async with asyncio.timeout(240):
        while not (await middle.statistics()).of(["flood-initiations"]):  # noqa: ASYNC110  sockets set no event
            await asyncio.sleep(0.01)


async def test_a_process_that_cannot_start_says_so(tmp_path: Path) -> None:
    """Here because its log cannot be written."""
    middle = MiddleProcess(NAMES, tmp_path, tmp_path / "none" / "mitm.jsonl", 1)
    with pytest.raises(MiddleError, match="did not start"):
        await middle.start({"a": 1, "b": 2}, KEYS)
    await middle.stop()
