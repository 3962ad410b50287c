"""A small fleet of real daemons, the clients at their ends, and an attacker with keys of its own."""

from __future__ import annotations

import asyncio
import os
from collections import Counter
from collections.abc import Callable
from typing import Any, Self

from tests import waiting
from tests.processes.frames import GROUND_SYSTEM
from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess, Status
from tests.processes.udp import open_socket
from uavlinkd.config.keys import decode_key
from uavlinkd.protocol.crypto import Secret
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Deliver, Dropped, Output, Transmit
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.settings import PeerSettings

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


def drone_and_ground(stage: Stage, system: int = 1) -> tuple[DaemonProcess, DaemonProcess]:
    """A drone and its ground station, each with the role that the other has in force."""
    drone, ground, psk = stage.daemon(f"drone{system}"), stage.daemon("ground"), stage.psk()
    drone.add_peer(ground, [ground.address], psk, **AN_OPERATOR)
    ground.add_peer(drone, [drone.address], psk, **a_vehicle(system))
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
        self.received = bytearray()

    @property
    def is_up(self) -> bool:
        return self._peer.is_up

    async def until(self, condition: Callable[[], bool]) -> None:
        await waiting.until(condition)

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
