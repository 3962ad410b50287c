"""A small fleet of real daemons, the clients at their ends, and an attacker with keys of its own."""

from __future__ import annotations

import asyncio
import os
import pty
import tty
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from time import monotonic
from typing import Any, Self

from tests.daemon.frames import GROUND_SYSTEM, frames_in
from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess, Status
from tests.daemon.relay import End, Relay
from tests.daemon.udp import Client, open_socket
from tests.waiting import PATIENCE_S
from uavlinkd.config.keys import decode_key
from uavlinkd.core.crypto import Secret
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Deliver, Dropped, Output, Transmit
from uavlinkd.core.path import Path
from uavlinkd.core.settings import PeerSettings
from uavlinkd.lab.sim.links import ChangeNotifier

# What each side of a link between a drone and its ground station says of the other.
AN_OPERATOR: dict[str, object] = {"role": "operator", "system_ids": [GROUND_SYSTEM]}


def a_vehicle(system: int) -> dict[str, object]:
    """How a ground station sees a drone."""
    return {"role": "vehicle", "system_ids": [system]}


def a_member(system: int) -> dict[str, object]:
    """How a drone sees another."""
    return {"role": "swarm-member", "system_ids": [system]}


FAST: dict[str, object] = {"rate_in": {"heartbeat": 1000, "position": 1000, "PING": 1000}}
"""In place of a role's own rates, where a test sends faster than they allow."""


def introduce(
    stage: Stage,
    a: DaemonProcess,
    b: DaemonProcess,
    *,
    a_sees_b: dict[str, object],
    b_sees_a: dict[str, object],
    through: Relay | None = None,
) -> str:
    """Make two daemons peers that see each other differently; the key that they share."""
    psk = stage.psk()
    if through is not None:
        through.attach(End.A, a.sockaddr)
        through.attach(End.B, b.sockaddr)
    at = {end: "{}:{}".format(*through.address_for(end)) for end in End} if through else {}
    a.add_peer(b, [at.get(End.A, b.address)], psk, **a_sees_b)
    b.add_peer(a, [at.get(End.B, a.address)], psk, **b_sees_a)
    return psk


def drone_and_ground(
    stage: Stage, relay: Relay | None = None, system: int = 1, **settings: Any
) -> tuple[DaemonProcess, DaemonProcess]:
    """A drone and its ground station, each with the role that the other has in force; ``settings`` for both."""
    drone, ground = stage.daemon(f"drone{system}"), stage.daemon("ground")
    introduce(
        stage,
        drone,
        ground,
        a_sees_b={**AN_OPERATOR, **settings},
        b_sees_a={**a_vehicle(system), **settings},
        through=relay,
    )
    return drone, ground


def relay_for(stage: Stage, *members: DaemonProcess, name: str = "vps") -> DaemonProcess:
    """A relay by which these daemons, which need no addresses of each other, can be peers. It is not started."""
    relay = stage.daemon(name)
    make_relay(relay, *members)
    return relay


def make_relay(relay: DaemonProcess, *members: DaemonProcess) -> None:
    """Make a daemon the relay of others, and nothing else."""
    relay.command = "relay"
    del relay.config["endpoint"], relay.config["peer"]
    relay.config["member"] = [{"name": member.name, "public_key": member.public_key} for member in members]
    for member in members:
        section = {"name": relay.name, "public_key": relay.public_key, "addresses": [relay.address]}
        member.config.setdefault("relay", []).append(section)


class Station(Client):
    """A client at a daemon's UDP endpoint that knows when each frame came."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.arrivals: list[tuple[float, bytes]] = []

    @property
    def frames(self) -> list[bytes]:
        """What came, in its order."""
        return [frame for _, frame in self.arrivals]

    def count(self, frame: bytes) -> int:
        """How many times this frame came."""
        return self.frames.count(frame)

    def clear(self) -> None:
        """Forget what has come."""
        super().clear()
        self.arrivals.clear()

    def datagram_received(self, data: bytes, addr: tuple[str | Any, int]) -> None:
        now = monotonic()
        self.arrivals += [(now, frame) for frame in frames_in(data)]
        super().datagram_received(data, addr)


async def station(stage: Stage) -> Station:
    """A station on loopback, closed when the stage ends."""
    sock = open_socket("127.0.0.1")
    _, station = await asyncio.get_running_loop().create_datagram_endpoint(lambda: Station(sock), sock=sock)
    stage._clients.append(station)
    return station


async def beat(send: Callable[[int], None], every_s: float = 1.0) -> None:
    """Call with 0, 1, 2 … in a steady rhythm, without end."""
    loop = asyncio.get_running_loop()
    began = loop.time()
    number = 0
    while True:
        send(number)
        number += 1
        await asyncio.sleep(began + number * every_s - loop.time())


# Attackers.


class Rogue(asyncio.DatagramProtocol):
    """A client that has the keys of a peer: its envelopes are genuine, what is in them is up to the test."""

    def __init__(self, captured: DaemonProcess, victim: DaemonProcess, psk: str) -> None:
        self._loop = asyncio.get_running_loop()
        self._node = Node(Secret(decode_key(captured.private_key)), os.urandom, self._loop.time())
        settings = PeerSettings(victim.name, decode_key(victim.public_key), Secret(decode_key(psk)))
        self._peer = self._node.add_peer(settings, self._loop.time())
        self._victim = victim
        self._sock = open_socket("127.0.0.1")
        self._transport: asyncio.BaseTransport
        self._timer: asyncio.TimerHandle | None = None
        self._changes = ChangeNotifier()
        self.received = bytearray()
        """The frames that the victim sent it."""

    @property
    def is_up(self) -> bool:
        """Whether the victim talks to it."""
        return self._peer.is_up

    async def until(self, condition: Callable[[], bool]) -> None:
        """Wait for a condition on what the victim said."""
        await self._changes.until(condition, PATIENCE_S)

    def say(self, payload: bytes) -> None:
        """Send a payload in an envelope of its own, whatever it holds."""
        outputs = self._node.send(self._peer, [payload], self._loop.time())
        assert not any(isinstance(output, Dropped) for output in outputs), outputs
        self._perform(outputs)

    async def __aenter__(self) -> Self:
        await self._loop.create_datagram_endpoint(lambda: self, sock=self._sock)
        self._node.set_paths(self._peer, [Path(0, self._victim.sockaddr)], self._loop.time())
        self._on_timer()
        await self.until(lambda: self.is_up)
        return self

    async def __aexit__(self, *_: object) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._perform(self._node.close(self._loop.time()))
        self._transport.close()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport

    def datagram_received(self, data: bytes, addr: tuple[str | Any, int]) -> None:
        self._perform(self._node.receive(data, Path(0, (addr[0], addr[1])), self._loop.time()))
        self._arm()

    def _on_timer(self) -> None:
        self._perform(self._node.handle_timeout(self._loop.time()))
        self._arm()

    def _arm(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        deadline = max(self._node.next_deadline(), self._loop.time() + 0.001)
        self._timer = self._loop.call_at(deadline, self._on_timer)

    def _perform(self, outputs: list[Output]) -> None:
        for output in outputs:
            if isinstance(output, Transmit):
                self._sock.sendto(output.datagram, output.path.address)
            elif isinstance(output, Deliver):
                self.received += output.payload
        self._changes.notify()


# Counters.

Tally = Counter[tuple[str, str]]
"""(message or what it was, reason) of everything that a daemon held back."""


def held_back(status: Status, kind: str, name: str, way: str = "in") -> Tally:
    """What one peer (``kind`` is ``peers``) or endpoint may not send or receive, so far."""
    reported = status[kind][name]
    tally: Tally = Counter()
    for message, reasons in reported["refused"][way].items():
        for reason, number_of in reasons.items():
            tally[message, reason] += number_of
    faults = reported["malformed"] if kind == "peers" else reported["faults"]
    for fault, number_of in faults.items():
        tally["malformed", fault] += number_of
    for reason, number_of in reported.get("drops", {}).items():
        tally["dropped", reason] += number_of
    return tally


# Serial cables.


class Cable:
    """A serial cable between two pseudo-terminals: what is written to one end comes out of the other."""

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._masters: list[int] = []
        self._slaves: list[int] = []

    @property
    def ends(self) -> Sequence[str]:
        """The devices, to be opened by the two clients."""
        return [os.ttyname(slave) for slave in self._slaves]

    def __enter__(self) -> Self:
        for _ in range(2):
            master, slave = pty.openpty()
            tty.setraw(slave)
            os.set_blocking(master, False)
            self._masters.append(master)
            self._slaves.append(slave)  # held open: a master without an open slave returns errors
        there, back = self._masters
        self._loop.add_reader(there, self._copy, there, back)
        self._loop.add_reader(back, self._copy, back, there)
        return self

    def __exit__(self, *_: object) -> None:
        for master in self._masters:
            self._loop.remove_reader(master)
        for fd in self._masters + self._slaves:
            os.close(fd)
        self._masters.clear()

    def _copy(self, source: int, sink: int) -> None:
        with suppress(BlockingIOError):
            data = os.read(source, 4096)
            while data:
                try:
                    data = data[os.write(sink, data) :]
                except BlockingIOError:
                    return  # no reader: as on a wire, what is not read is lost
