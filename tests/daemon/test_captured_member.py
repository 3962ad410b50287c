"""A captured member hides forbidden frames in allowed ones: what a real daemon's clients read, given to real parsers.

One client is at a UDP endpoint, one at a TCP endpoint, one at a serial port. The judge is in `tests.mavlink.parsers`.
"""

from __future__ import annotations

import asyncio
import os
import pty
import tty
from collections.abc import Callable, Iterator, Sequence
from contextlib import AsyncExitStack, contextmanager

import pytest

from tests.daemon.fleet import Rogue, a_member, held_back, pack
from tests.daemon.harness import PATIENCE_S, DaemonProcess, Stage, free_port
from tests.mavlink.parsers.build import compiler
from tests.mavlink.parsers.judge import Stream, judge_all
from tests.mavlink.parsers.receivers import Delivery, all_receivers
from tests.mavlink.parsers.targets import attacks_on, judge_of
from uavlinkd.lab.evaluation.captured_member import Attack
from uavlinkd.config.keys import generate_psk
from uavlinkd.mavlink.frames import SplitCounters, split_datagram
from uavlinkd.lab.sim.links import Changes

pytestmark = pytest.mark.long

DIALECT = "common"
MARKER_SYSTEM = 77


def families() -> dict[str, list[Attack]]:
    """The attacks by the policies of their members."""
    found: dict[str, list[Attack]] = {}
    for attack in attacks_on(DIALECT):
        role = str(attack.members[0].get("role", "everything"))
        found.setdefault(f"{role} x {len(attack.members)}", []).append(attack)
    return found


def marker(number: int) -> bytes:
    """A frame of a peer that takes no part, which ends an attack."""
    from pymavlink.dialects.v20 import ardupilotmega as mavlink

    return pack(mavlink.MAVLink_attitude_message(number, 0, 0, 0, 0, 0, 0), MARKER_SYSTEM, seq=number)


class Reader:
    """A client's bytes."""

    def __init__(self) -> None:
        self.received = bytearray()
        self.changes = Changes()

    def take(self, data: bytes) -> None:
        """More of them."""
        self.received += data
        self.changes.notify()

    async def until(self, condition: Callable[[], bool]) -> None:
        """Wait for a condition on what came."""
        await self.changes.until(condition, PATIENCE_S)


@contextmanager
def serial_reader(reader: Reader) -> Iterator[str]:
    """A pseudo-terminal whose other end the reader reads: the device's name."""
    loop = asyncio.get_running_loop()
    master, slave = pty.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    loop.add_reader(master, lambda: reader.take(os.read(master, 65536)))
    try:
        yield os.ttyname(slave)
    finally:
        loop.remove_reader(master)
        os.close(master)
        os.close(slave)


async def tcp_reader(reader: Reader, port: int) -> asyncio.Task[None]:
    """A client that connects and reads."""
    incoming, outgoing = await asyncio.open_connection("127.0.0.1", port)

    async def read() -> None:
        try:
            while data := await incoming.read(65536):
                reader.take(data)
        finally:
            outgoing.close()

    return asyncio.create_task(read())


@pytest.mark.parametrize("family", families())
async def test_its_hidden_frames_reach_no_parser(stage: Stage, family: str) -> None:
    """Each attack by name: no receiver accepts a forbidden frame, from any offset and after losses."""
    if compiler() is None:
        pytest.skip("needs a C compiler (cc) to build MAVLink's parsers")
    attacks = families()[family]
    policies: list[dict[str, object]] = [dict(policy) for policy in attacks[0].members]
    victim = stage.daemon("victim")
    captured: list[tuple[DaemonProcess, str]] = []
    for number, policy in enumerate([*policies, a_member(MARKER_SYSTEM)]):
        peer, psk = stage.daemon(f"captured{number}"), generate_psk()
        stage.secrets.append(psk)
        victim.add_peer(peer, [], psk, **policy)
        captured.append((peer, psk))
    udp, tcp, serial = await stage.program(), Reader(), Reader()
    port = free_port()
    victim.add_endpoint("udp", f"udpout:{udp}")
    victim.add_endpoint("tcp", f"tcpin:127.0.0.1:{port}")
    async with AsyncExitStack() as stack:
        device = stack.enter_context(serial_reader(serial))
        victim.add_endpoint("serial", f"serial:{device}:921600")
        await stage.start(victim, linked=False)
        task = await tcp_reader(tcp, port)
        stack.callback(task.cancel)
        await victim.until(lambda status: all(each["programs"] for each in status["endpoints"].values()))
        rogues = [await stack.enter_async_context(Rogue(peer, victim, psk)) for peer, psk in captured]
        honest = rogues.pop()
        for number, attack in enumerate(attacks):
            for member, raw in attack.frames:
                rogues[member].say(raw)
                if len(rogues) > 1:  # their order is that of their arrival
                    await udp.until_heard(raw)
            end = marker(number)
            honest.say(end)
            await udp.until_heard(end)
            for reader in (tcp, serial):
                await reader.until(lambda reader=reader, end=end: end in reader.received)  # type: ignore[misc]
            for received in (udp.received, tcp.received, serial.received):
                look(bytes(received), attack)
                received.clear()
        tally = held_back(await victim.status(), "peers", captured[0][0].name)
    assert tally or len(rogues) > 1, "frames of two members come behind separator bytes"
    assert {reason for _, reason in tally} <= {"hidden_frame", "unknown_message"}


def look(received: bytes, attack: Attack) -> None:
    """Let every receiver parse what a client read. The honest peer's frames have no author."""
    at = 0
    delivered: list[tuple[int, int]] = []
    authors: list[tuple[int, str | None]] = []
    names = {raw: f"member {member}" for member, raw in attack.frames}
    for raw in split(received):
        begin = received.index(raw, at)
        if begin > at:
            authors.append((begin, None))
        at = begin + len(raw)
        authors.append((at, names.get(raw)))
        delivered.append((begin, at))
    stream = Stream(Delivery(received, delivered), authors, 0)
    verdicts = judge_all([stream], all_receivers([DIALECT]), judge_of(attack), losses=50)
    assert not verdicts.breaches, attack.name


def split(received: bytes) -> Sequence[bytes]:
    """The frames in it, by the daemon's own reading."""
    return [frame.raw for frame in split_datagram(received, SplitCounters())]
