"""A fleet of real daemons on hosts of their own, in containers or network namespaces.

The test's own process opens sockets in the hosts' network namespaces, which takes root. A client that speaks MAVLink
there needs no process of its own.
"""

from __future__ import annotations

import asyncio
import os
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Coroutine, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.daemon.udp import Client
from tests.namespaces import entered, udp_socket_in
from tests.waiting import PATIENCE_S, Stopwatch
from uavlinkd.mavlink.frames import SplitCounters, split_datagram
from uavlinkd.ops.control import ControlError, ask

POLL_S = 0.02
ASKED_TIMES = 60
"""A daemon that does not answer so many questions, for a second each, hangs."""
ARRIVED_S = 30.0
"""A frame that has not arrived by then is lost."""
LINKED_S = 5.0
"""From the last daemon's start until all links are up, on an idle machine."""
ENDPOINT = ("127.0.0.1", 14550)
"""Where each daemon listens for its autopilot or ground station."""
COMPONENT = 191
"""Of the frames that the tests send: an onboard computer's, which no autopilot uses."""
HELLO = 0x7FFF_FFFF
"""The number of the frame by which a client makes itself known."""

Status = dict[str, Any]
SYSTEM_IDS = {"drone1": 1, "drone2": 2, "drone3": 3, "ground-station": 255}


class Cluster(ABC):
    """Hosts by name, a daemon on each."""

    @abstractmethod
    def namespace_of(self, name: str) -> Path:
        """The network namespace of a host."""

    @abstractmethod
    def control_socket_of(self, name: str) -> Path:
        """The control socket of the daemon there."""

    @abstractmethod
    def logs(self) -> str:
        """All that the daemons wrote."""

    def status(self, name: str) -> Status | None:
        """What the daemon says; None where it does not answer."""
        with suppress(ControlError, OSError, LookupError):
            return ask(self.control_socket_of(name), "status", timeout_s=1.0)
        return None

    def states(self, name: str) -> dict[str, str]:
        """How its peers are, as it says."""
        status = self.status(name)
        return {} if status is None else {peer: facts["state"] for peer, facts in status["peers"].items()}

    def dropped_while_waiting(self, name: str) -> int:
        """Datagrams that found a full buffer at this host, and frames that the daemon dropped after a pause."""
        count = int(self._udp_counters(name)["RcvbufErrors"])
        answers = (self.status(name) for _ in range(ASKED_TIMES))
        status = next(answer for answer in answers if answer is not None)
        count += int(sum(status["stale"].values()))
        return count + sum(int(peer["drops"].get("delayed", 0)) for peer in status["peers"].values())

    def _udp_counters(self, name: str) -> dict[str, str]:
        with entered(self.namespace_of(name)):
            lines = Path("/proc/thread-self/net/snmp").read_text().splitlines()
        names, values = (line.split() for line in lines if line.startswith("Udp:"))
        return dict(zip(names, values, strict=True))

    def are_all_linked(self) -> bool:
        return all(
            len(states) == len(SYSTEM_IDS) - 1 and set(states.values()) == {"up"}
            for states in map(self.states, SYSTEM_IDS)
        )

    def are_all_calm(self) -> bool:
        """Whether every pair is up, along a path that answered in its session.

        The best path may be one from before the outage of another test, until its silence is noticed. Only a part of
        the stream is copied to another path meanwhile.
        """
        peers = [peer for name in SYSTEM_IDS for peer in (self.status(name) or {"peers": {}})["peers"].values()]
        best = [(path, peer["handshake_s"]) for peer in peers for path in peer["paths"] if path["role"] == "best"]
        return self.are_all_linked() and all(
            path["state"] == "usable" and path["answered_s"] is not None and path["answered_s"] < handshake_s
            for path, handshake_s in best
        )

    async def until_linked(self) -> None:
        """Wait until all daemons listen, and see that all links are up in time from there.

        Raises:
            AssertionError: they are not.
        """
        starting = await until(lambda: all(map(self.status, SYSTEM_IDS)), "all daemons listen")
        took = await until(self.are_all_linked, "all links are up")
        print(f"all daemons listened after {starting:.2f} s, and all links were up {took:.2f} s later")
        assert took < LINKED_S

    async def client(self, name: str) -> Client:
        loop = asyncio.get_running_loop()
        sock = udp_socket_in(self.namespace_of(name))
        _, client = await loop.create_datagram_endpoint(lambda: Client(sock), sock=sock)

        def is_known() -> bool:
            client.send(numbered(SYSTEM_IDS[name], HELLO), ENDPOINT)
            status = self.status(name)
            endpoints = () if status is None else status["endpoints"].values()
            return any(f"127.0.0.1:{client.address[1]}" in addresses for addresses in map(_clients, endpoints))

        await until(is_known, f"{name} knows a client")
        return client


def _clients(endpoint: Status) -> str:
    return " ".join(endpoint["clients"])


async def until(condition: Callable[[], bool], what: str, timeout_s: float = PATIENCE_S) -> float:
    """Wait for a condition; the seconds that it took, without those in which the machine was busy.

    Raises:
        AssertionError: it does not hold in time.
    """
    watch = Stopwatch()
    while not condition():
        assert watch.elapsed_s < timeout_s, f"not in {timeout_s:g} s: {what}"
        await asyncio.sleep(POLL_S)
    return watch.calm_s


def numbered(system: int, number: int) -> bytes:
    """A frame that differs from that of every other number, of a message that its sender may send often.

    Drones send VFR_HUD: `swarm-member` passes 250 a second by default. A ground station may send its HEARTBEAT.
    """
    codec = mavlink.MAVLink(None, system, COMPONENT)
    codec.seq = number % 256
    if system == SYSTEM_IDS["ground-station"]:
        return bytes(mavlink.MAVLink_heartbeat_message(18, 8, 0, number, 4, 3).pack(codec))
    return bytes(mavlink.MAVLink_vfr_hud_message(0, 0, number >> 16, number & 0xFFFF, 1, 0).pack(codec))


class Conversation:
    """Clients beside some daemons, which send numbered frames that each other must receive once."""

    _numbers_used = 0
    """In conversations before: a daemon takes the same frame, soon after, for one that came by another way."""

    def __init__(self, cluster: Cluster, names: Sequence[str]) -> None:
        self._cluster = cluster
        self._names = names
        self._clients: dict[str, Client] = {}
        self._dropped_before = 0
        self._first = self.said = self._numbers_used
        """The numbers of the first frame that counts, and of the next; each says one of every number."""
        self._forgotten = {numbered(system, HELLO) for system in SYSTEM_IDS.values()}

    async def open(self) -> None:
        """Make the clients known, and check that all reach each other: a daemon that paused drops frames at first."""
        for name in self._names:
            self._clients[name] = await self._cluster.client(name)
        await until(self._does_latest_arrive, "a frame of each reaches all others")
        self.forget()
        self._dropped_before = self._dropped()

    def _dropped(self) -> int:
        """What these hosts dropped because a process did not run: at a full buffer, or as too old afterwards."""
        return sum(map(self._cluster.dropped_while_waiting, self._names))

    def _does_latest_arrive(self) -> bool:
        """Whether the last frames reached all; if not, more are sent."""
        if self.said > self._first:
            latest = {name: numbered(SYSTEM_IDS[name], self.said - 1) for name in self._names}
            if all(self.received(name).keys() >= set(latest.values()) - {latest[name]} for name in self._names):
                return True
        self.say()
        return False

    def close(self) -> None:
        Conversation._numbers_used = self.said
        for client in self._clients.values():
            client.close()

    def say(self) -> None:
        for name, client in self._clients.items():
            client.send(numbered(SYSTEM_IDS[name], self.said), ENDPOINT)
        self.said += 1

    async def say_many(self, count: int, interval_s: float = 0.005) -> None:
        """So many by each, in that rhythm."""
        for _ in range(count):
            self.say()
            await asyncio.sleep(interval_s)

    async def during(self, work: Coroutine[None, None, None]) -> int:
        stop = asyncio.Event()

        async def talk() -> None:
            while not stop.is_set():
                self.say()
                await asyncio.sleep(0.02)

        before = self.said
        talking = asyncio.create_task(talk())
        try:
            await work
        finally:
            stop.set()
            await talking
        return self.said - before

    def received(self, name: str) -> Counter[bytes]:
        frames = split_datagram(bytes(self._clients[name].received), SplitCounters())
        ours = (frame for frame in frames if frame.header.component == COMPONENT)
        return Counter(frame.raw for frame in ours if frame.raw not in self._forgotten)

    def expected(self, name: str) -> Counter[bytes]:
        """What each other said, once."""
        return Counter(
            numbered(SYSTEM_IDS[other], number)
            for other in self._names
            if other != name
            for number in range(self._first, self.said)
        )

    def forget(self) -> None:
        """Start again: frames sent so far do not count, received or still in flight."""
        self._forgotten |= {
            numbered(SYSTEM_IDS[name], number) for name in self._names for number in range(self._first, self.said)
        }
        self._first = self.said

    def check_nothing_else(self) -> None:
        """Every received frame was sent, and is received once.

        Raises:
            AssertionError: something was forged, or repeated.
        """
        for name in self._names:
            forged = self.received(name) - self.expected(name)
            assert not forged, f"{name} received {forged.total()} frames too many"

    async def check(self) -> None:
        """Every sent frame is received once by each other, and no other frame is. Pauses of a host are excused.

        Raises:
            AssertionError: with what is missing or too much.
        """
        with suppress(AssertionError):
            await until(
                lambda: all(self.received(name) >= self.expected(name) for name in self._names), "", ARRIVED_S
            )
        explained = self._dropped() - self._dropped_before
        for name in self._names:
            received, expected = self.received(name), self.expected(name)
            # The frame of one client goes to all others.
            is_explained = received <= expected and (expected - received).total() <= explained * len(self._names)
            assert is_explained, (
                f"{name} missed {(expected - received).total()} of {expected.total()} frames, and received"
                f" {(received - expected).total()} too much"
            )


async def check_frames(cluster: Cluster, count: int = 200) -> None:
    """Each vehicle's frames reach all others once."""
    conversation = Conversation(cluster, tuple(SYSTEM_IDS))
    try:
        await conversation.open()
        await conversation.say_many(count)
        await conversation.check()
    finally:
        conversation.close()


async def run(*command: str, environ: dict[str, str] | None = None, check: bool = True) -> str:
    """Run a command to its end; what it printed. Raises AssertionError if it failed."""
    process = await asyncio.create_subprocess_exec(
        *command,
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
        env={**os.environ, **(environ or {})},
    )
    output, _ = await process.communicate()
    text = output.decode(errors="replace")
    assert not (check and process.returncode), f"{' '.join(command)} failed:\n{text}"
    return text
