"""Whatever goes wrong around a daemon, it goes on, says so in a few lines, and is soon back when it is mended."""

from __future__ import annotations

import asyncio
import os
import random
import signal
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from time import monotonic

from tests.faults import network
from tests.faults.clocks import faked_clock
from tests.faults.network import FAULT_S
from tests.faults.talk import Log, Outcome, Talk, grew, prepare, reported
from tests.namespaces import need_namespaces
from tests.processes.fleet import Rogue
from tests.processes.frames import frame
from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess
from tests.waiting import until
from uavlinkd.ops.line_limits import LINES_BURST, LINES_PER_S

SUSPENDED_S = float(os.environ.get("UAVLINKD_SIGSTOP_S", FAULT_S))
"""How long a process is stopped; 10 in CI."""
LINES_AT_MOST = 12
"""That a daemon may log for one of these faults, and two more each ten seconds."""


async def _linked(stage: Stage, a: DaemonProcess, b: DaemonProcess, talk: Talk) -> None:
    await stage.start(a, b)
    await talk.start()


# Clocks.


async def clock_jumps(stage: Stage) -> Outcome:
    """The system's clock leaps ten years ahead, and then 54 back; keys are made in either time."""
    environ = faked_clock("2026-01-01 00:00:00")
    del environ["FAKETIME"]
    a, b = stage.pair(rekey_after_s=1.0, reject_after_s=5.0)
    clock = a.folder / "clock"
    clock.write_text("+0")
    a.config["log"] = {"level": "debug"}  # rekeys are logged
    talk = prepare(a, b)
    environ |= {"FAKETIME_TIMESTAMP_FILE": str(clock), "FAKETIME_NO_CACHE": "1"}
    a.environ = environ
    await stage.start(a, b)
    await talk.start()
    began, log = monotonic(), Log(a)
    recovered_s = 0.0
    for years in (10, -54):
        clock.write_text(f"{365 * years:+}d")
        jumped = monotonic()
        recovered_s = max(recovered_s, await talk.back(jumped))
        await until(lambda years=years: _has_keys_of(a, years))  # type: ignore[misc]
    ended = monotonic()
    await talk.check_lost_none(began, ended, a, b)
    assert not a.events("peer_lost")
    talk.stop()
    return Outcome("no frame lost, new keys made meanwhile", recovered_s, log.count)


def _has_keys_of(daemon: DaemonProcess, years: int) -> bool:
    """Whether keys were made at a time so far from now, by the daemon's clock."""
    days = [
        (datetime.fromisoformat(event["timestamp"]) - datetime.now(UTC)).days
        for event in daemon.events("session_established")
    ]
    return any(abs(day - 365 * years) < 2 for day in days)


# The scheduler.


async def suspended(stage: Stage) -> Outcome:
    """The process is stopped, and goes on."""
    a, b = stage.pair()
    talk = prepare(a, b)
    await _linked(stage, a, b, talk)
    log = Log(a)
    await a.send_signal(signal.SIGSTOP)
    began = monotonic()
    await asyncio.sleep(SUSPENDED_S)
    waiting, sent = monotonic(), len(talk.voices[1].sent_at)
    # What the other daemon passes on later is new to this one.
    await b.until(lambda status: status["endpoints"]["talk"]["frames_received"] >= sent)
    ended = monotonic()
    await a.send_signal(signal.SIGCONT)
    recovered_s = await talk.back(ended)
    for speaker, hearer in (talk.voices, talk.voices[::-1]):
        old = {n for n, at in speaker.sent_at.items() if began + 0.1 < at < waiting}
        assert not [n for n in old if speaker.frame(n) in hearer.received_at], (
            "what had waited came as if it were new"
        )
    talk.check_no_copies()
    talk.stop()
    await a.until_logged("daemon_paused")
    await a.until_logged("frames_dropped", reason="stale")
    dropped = sum((await a.status())["stale"].values())  # the log's counts come in portions
    return Outcome(
        f"daemon_paused reported; {dropped} frames that had waited dropped as stale", recovered_s, log.count
    )


# A peer.


async def garbage_with_valid_keys(stage: Stage) -> Outcome:
    """A peer's own keys seal thousands of records and invalid frames; another peer talks meanwhile."""
    a, b = stage.pair()
    captured = stage.daemon("captured")
    psk = stage.psk()
    a.add_peer(captured, [], psk)
    talk = prepare(a, b)
    await stage.start(b, a, linked=False)
    await talk.start()
    rng = random.Random(8)
    genuine = frame(1 << 21, 7)
    began = monotonic()
    before, log = await a.status(), Log(a)
    async with Rogue(captured, a, psk) as rogue:
        while monotonic() < began + FAULT_S:
            for _ in range(50):
                if rogue.is_up:
                    with suppress(AssertionError):  # it sent a close itself: there are no keys for a moment
                        rogue.say(garbage(rng, genuine))
            await asyncio.sleep(0.02)
        ended = monotonic()
        recovered_s = await talk.back(ended)
        await rogue.until(lambda: rogue.is_up)
    after = await a.status()
    await talk.check_lost_none(began, ended, a, b)
    talk.check_no_copies()
    talk.stop()
    drops = grew(before, after, "peers", "captured", "drops")
    malformed = grew(before, after, "peers", "captured", "malformed")
    assert drops.get("bad_control", 0) > 100
    assert malformed
    return Outcome(
        f"the other peer lost no frame; dropped: {reported(drops)}; malformed: {reported(malformed)}",
        recovered_s,
        log.count,
    )


def garbage(rng: random.Random, genuine: bytes) -> bytes:
    """An invalid payload: noise, records with a right first byte, frames cut or altered."""
    noise = rng.randbytes(rng.randrange(1, 400))
    at = rng.randrange(len(genuine))
    return rng.choice(
        (
            noise,
            bytes((rng.randrange(8),)) + noise[: rng.randrange(40)],
            genuine[: at + 1],
            genuine[:at] + bytes((genuine[at] ^ 1 << rng.randrange(8),)) + genuine[at + 1 :],
            genuine + noise,
        )
    )


AT_ONCE = 8
"""Faults that are there at the same time: mostly they wait."""
BACK_S = 2.0
"""All works again so long after the end of any fault."""


class _Stage(Stage):
    """One of several: daemons are started in turns, as that is what takes the processor's time."""

    def __init__(self, starting: asyncio.Lock) -> None:
        super().__init__()
        self._starting = starting

    async def start(self, *daemons: DaemonProcess, linked: bool = True) -> None:
        async with self._starting:
            await super().start(*daemons, linked=linked)


FAULTS: Mapping[str, Callable[[Stage], Awaitable[Outcome]]] = {
    "the process is stopped (`SIGSTOP`)": suspended,
    "the clock leaps ten years ahead, and 54 back": clock_jumps,
    "a peer seals garbage with its valid keys": garbage_with_valid_keys,
    **{fault.what: partial(network.suffer, name=name) for name, fault in network.NETWORK_FAULTS.items()},
}


async def test_daemon_withstands_each_fault_and_is_back_in_time() -> None:
    """It keeps running and keeps its log short. The faults happen at the same time, each to daemons of its own."""
    need_namespaces("nft", "tc")
    turns, starting = asyncio.Semaphore(AT_ONCE), asyncio.Lock()

    async def happen(what: str) -> Outcome:
        async with turns, _Stage(starting) as stage:
            return await FAULTS[what](stage)

    results = await asyncio.gather(*map(happen, FAULTS), return_exceptions=True)
    for what, outcome in zip(FAULTS, results, strict=True):
        print(what, outcome)
    for what, outcome in zip(FAULTS, results, strict=True):
        if isinstance(outcome, BaseException):
            raise AssertionError(what) from outcome
        assert outcome.recovered_s < BACK_S, what
        # A sender with valid keys can cause a line a handshake, up to what the log grants one peer.
        of_peer = LINES_BURST + FAULT_S * LINES_PER_S if "garbage" in what else 0
        assert outcome.lines <= LINES_AT_MOST + FAULT_S / 5 + of_peer, what
