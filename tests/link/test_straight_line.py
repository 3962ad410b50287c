"""Two daemons that reach only relays: frames in both directions, and what happens when relays fail."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from itertools import count

import pytest

from tests.daemon.frames import ground_heartbeat, heartbeat
from tests.link.relay_line import RelayLine
from tests.link.test_calls_per_frame import attitude
from tests.waiting import Stopwatch, until
from uavlinkd.link import down_causes
from uavlinkd.link.control_answers import answer
from uavlinkd.link.diagnosis import find
from uavlinkd.ops.causes import Cause
from uavlinkd.system.clock import monotonic

FAST_S = 10.0
"""What takes less than 2 s on an idle machine takes less than this of calm time on any."""


@asynccontextmanager
async def linked(*names: str) -> AsyncIterator[RelayLine]:
    """A line whose daemons are linked along each of these relays."""
    line = RelayLine(*names)
    await line.start()
    try:
        await until(lambda: all(len(line.usable(link)) == len(names) for link in line.links))
        yield line
    finally:
        await line.stop()


async def send_until(line: RelayLine, is_over: Callable[[], bool], first: int = 1000) -> None:
    """Frames of the client, twenty a second."""
    for number in count(first):
        if is_over():
            return
        line.send(attitude(number))
        await asyncio.sleep(0.05)


async def test_frames_cross_in_both_directions() -> None:
    """Neither daemon knows an address of the other, and the relay has no key of their session."""
    async with linked("vps") as line:
        line.send(attitude(1))
        await line.ground.until_received(attitude(1))
        line.ground.send(ground_heartbeat(), line.ground.sources[0])
        await line.client.until_received(ground_heartbeat())
        assert all(state.path.is_relayed for link in line.links for state in link.peer.paths.states)
        relay = line.relays["vps"].relay
        assert relay is not None
        assert all(member.meter.datagrams > 2 for member in relay.members.values())


async def test_relay_that_is_killed_and_started_again() -> None:
    """It has forgotten everything. The link comes back along new handles."""
    async with linked("vps") as line:
        before = [list(link.relayed) for link in line.links]
        await line.kill_relay("vps")
        watch = Stopwatch()
        await send_until(line, lambda: watch.elapsed_s > 1.0)
        await line.start_relay("vps")
        watch = Stopwatch()
        line.ground.clear()
        await send_until(line, lambda: bool(line.ground.received), 2000)
        assert watch.calm_s < FAST_S
        assert all(set(link.relayed).isdisjoint(old) for link, old in zip(line.links, before, strict=True))


async def test_one_of_two_relays_dies_and_no_critical_frame_is_lost() -> None:
    """Copies of critical frames go along both."""
    async with linked("vps", "spare") as line:
        sent = [heartbeat(1, seq=number) for number in range(100)]
        for number, frame in enumerate(sent):
            line.send(frame)
            if number == 30:
                await line.kill_relay("vps")
            await asyncio.sleep(0.02)
        await line.ground.until_received(sent[-1])
        assert line.ground.datagrams == sent
        assert line.is_up


async def test_peer_that_does_not_ask_for_this_one_is_waited_for() -> None:
    """The relay binds only members that both ask. The other daemon uses no relay."""
    line = RelayLine("vps")
    await line.start(left_uses=())
    try:
        relay = line.right.relays.by_name["vps"]
        await until(lambda: relay.state_for(line.links[1]) != "unanswered")
        assert relay.state_for(line.links[1]) == "waiting"
        assert line.links[1].relayed == []
        await until(lambda: Cause.NOT_BOUND in {finding.cause for finding in find(line.right, monotonic())})
    finally:
        await line.stop()


@pytest.mark.long
async def test_relay_that_does_not_answer_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """With its addresses, and with each peer that needs it, although the peer was bound there.

    If the cause is here, the relay and the peer are not blamed.
    """
    async with linked("vps") as line:
        await line.kill_relay("vps")
        await send_until(line, lambda: Cause.RELAY_NOT_ANSWERING in causes(line))
        (finding,) = (one for one in find(line.left, monotonic()) if one.cause is Cause.RELAY_NOT_ANSWERING)
        assert finding.name == "right"
        assert "127.0.0.1" in finding.text
        assert "no process listens there" in finding.text
        assert line.left.relays.by_name["vps"].state_for(line.links[0]) == "bound"
        assert Cause.NO_ANSWER not in causes(line)
        monkeypatch.setattr(down_causes, "_has_unconfirmed", lambda _: True)
        assert Cause.NOT_CONFIRMED in causes(line)
        address = line.left.relays.by_name["vps"].peer.paths.states[0].path.address
        for error, cause in (("ENETUNREACH", Cause.NO_ROUTE), ("EPERM", Cause.FIREWALL_HERE)):
            line.left.evidence.add_failure(error, address, monotonic())
            (finding,) = (one for one in find(line.left, monotonic()) if one.cause is cause)
            assert finding.name == "right"
            assert "127.0.0.1" in finding.text
            assert not causes(line) & {Cause.RELAY_NOT_ANSWERING, Cause.NOT_CONFIRMED}


def causes(line: RelayLine) -> set[str]:
    """What the left daemon finds."""
    return {finding.cause for finding in find(line.left, monotonic())}


async def test_ping_asks_along_each_path() -> None:
    """The next answer has the results; a name that is not a peer's is refused."""
    async with linked("vps", "spare") as line:
        first = await answer(line.left, "ping right")
        assert first is not None

        async def answers() -> list[int]:
            pinged = await answer(line.left, "ping right")
            assert pinged is not None
            paths = pinged["paths"]
            assert isinstance(paths, list)
            assert {path["relay"] for path in paths} == {"vps", "spare"}
            return [state.answers for state in line.links[0].peer.paths.states]

        before = await answers()
        states = line.links[0].peer.paths.states
        await until(lambda: all(state.answers > count for state, count in zip(states, before, strict=True)))
        refused = await answer(line.left, "ping stranger")
        assert refused is not None
        assert "error" in refused
