"""A small fleet of real daemons, what speaks at their ends, and who attacks it with keys of its own."""

from __future__ import annotations

import asyncio
import os
import pty
import tty
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from time import monotonic
from typing import Any, Self

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.daemon.harness import PATIENCE_S, DaemonProcess, End, Program, Relay, Sockaddr, Stage, Status, open_socket
from uavlinkd.core.crypto import Secret
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Deliver, Dropped, Output, Transmit
from uavlinkd.core.settings import PeerSettings
from uavlinkd.config.keys import decode_key
from uavlinkd.lab.sim.links import Changes

GROUND_SYSTEM = 255

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


# Frames.


def pack(message: Any, system: int, component: int = 1, *, seq: int = 0, version: int = 2) -> bytes:
    """A message as a genuine frame."""
    codec = mavlink.MAVLink(None, system, component)
    codec.seq = seq % 256
    return bytes(message.pack(codec, force_mavlink1=version == 1))


def heartbeat(system: int, *, seq: int = 0, kind: int = mavlink.MAV_TYPE_QUADROTOR, version: int = 2) -> bytes:
    """A sign of life of a vehicle, or of what ``kind`` says."""
    return pack(mavlink.MAVLink_heartbeat_message(kind, 3, 0, 0, 3, 3), system, seq=seq, version=version)


def ground_heartbeat(seq: int = 0, system: int = GROUND_SYSTEM) -> bytes:
    """A ground station's sign of life."""
    message = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)
    return pack(message, system, 190, seq=seq)


def command_long(
    number: int, system: int, target: tuple[int, int] = (1, 1), *, seq: int = 0, **fields: float
) -> bytes:
    """A command; ``fields`` are ``param1`` to ``param7``."""
    seven = [fields.get(f"param{n}", 0.0) for n in range(1, 8)]
    return pack(mavlink.MAVLink_command_long_message(*target, number, 0, *seven), system, 190, seq=seq)


def numbered(number: int, system: int) -> bytes:
    """Telemetry that says its number, of some 40 bytes."""
    position = mavlink.MAVLink_global_position_int_message(number, 473977420, 85455940, 488000, 3000, 0, 0, 0, 0)
    return pack(position, system, seq=number)


def number_in(frame: bytes) -> int | None:
    """The number in a frame of :func:`numbered`; None for any other."""
    is_one = frame[0] == 0xFD and int.from_bytes(frame[7:10], "little") == mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
    return int.from_bytes(frame[10:14], "little") if is_one else None


SEPARATOR = 2
"""The first filler that `uavlinkd.mavlink.policy.hidden` puts between frames."""


def frames_in(data: bytes | bytearray) -> Iterator[bytes]:
    """The frames in bytes that are whole frames, by their lengths alone, and separator bytes before them."""
    at = 0
    while at < len(data):
        if data[at] == SEPARATOR:
            at += 1
            continue
        assert data[at] in (0xFD, 0xFE), f"no frame starts at byte {at} of {bytes(data).hex(' ')}"
        size = data[at + 1] + (8 if data[at] == 0xFE else 25 if data[at + 2] else 12)
        yield bytes(data[at : at + size])
        at += size
    assert at == len(data), "the last frame is cut"


def name_of(frame: bytes) -> str:
    """The name of a frame's message."""
    number = frame[5] if frame[0] == 0xFE else int.from_bytes(frame[7:10], "little")
    return str(mavlink.mavlink_map[number].msgname)


def sender_of(frame: bytes) -> int:
    """The system that a frame says it is of."""
    return frame[3] if frame[0] == 0xFE else frame[5]


class Station(Program):
    """A program at a daemon's UDP endpoint that knows when each frame came."""

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
    _, found = await asyncio.get_running_loop().create_datagram_endpoint(lambda: Station(sock), sock=sock)
    stage._programs.append(found)
    return found


async def beat(send: Callable[[int], None], every_s: float = 1.0) -> None:
    """Call with 0, 1, 2 … in a steady rhythm, without end."""
    loop = asyncio.get_running_loop()
    began = loop.time()
    number = 0
    while True:
        send(number)
        number += 1
        await asyncio.sleep(began + number * every_s - loop.time())


async def greet(daemon: DaemonProcess, endpoint: str, program: Station, into: Sockaddr, system: int) -> None:
    """Have a daemon know a program at its ``udpin``, and forget what that made others hear."""
    program.send(ground_heartbeat() if system == GROUND_SYSTEM else heartbeat(system), into)
    await daemon.until(lambda status: str(program) in status["endpoints"][endpoint]["programs"])


# Attackers.


class Rogue(asyncio.DatagramProtocol):
    """A program that has the keys of a peer: its envelopes are genuine, what is in them is up to the test."""

    def __init__(self, captured: DaemonProcess, victim: DaemonProcess, psk: str) -> None:
        self._loop = asyncio.get_running_loop()
        self._node = Node(Secret(decode_key(captured.private_key)), os.urandom, self._loop.time())
        settings = PeerSettings(victim.name, decode_key(victim.public_key), Secret(decode_key(psk)))
        self._node.add_peer(settings, self._loop.time())
        self._victim = victim
        self._sock = open_socket("127.0.0.1")
        self._transport: asyncio.BaseTransport
        self._timer: asyncio.TimerHandle | None = None
        self._changes = Changes()
        self.heard = bytearray()
        """The frames that the victim sent it."""

    @property
    def is_up(self) -> bool:
        """Whether the victim talks to it."""
        return self._node.peers[self._victim.name].is_up

    async def until(self, condition: Callable[[], bool]) -> None:
        """Wait for a condition on what the victim said."""
        await self._changes.until(condition, PATIENCE_S)

    def say(self, payload: bytes) -> None:
        """Send a payload in an envelope of its own, whatever it holds."""
        outputs = self._node.send(self._victim.name, [payload], self._loop.time())
        assert not any(isinstance(each, Dropped) for each in outputs), outputs
        self._perform(outputs)

    async def __aenter__(self) -> Self:
        await self._loop.create_datagram_endpoint(lambda: self, sock=self._sock)
        self._node.set_addresses(self._victim.name, [(0, *self._victim.sockaddr)], self._loop.time())
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
        self._perform(self._node.receive(data, (0, addr[0], addr[1]), self._loop.time()))
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
                self._sock.sendto(output.datagram, output.path[1:])
            elif isinstance(output, Deliver):
                self.heard += output.payload
        self._changes.notify()


# Counters.

Tally = Counter[tuple[str, str]]
"""(message or what it was, reason) of everything that a daemon held back."""


def held_back(status: Status, kind: str, name: str, way: str = "in") -> Tally:
    """What one peer (``kind`` is ``peers``) or endpoint may not say, or be told, so far."""
    told = status[kind][name]
    tally: Tally = Counter()
    for message, reasons in told["refused"][way].items():
        for reason, amount in reasons.items():
            tally[message, reason] += amount
    faults = told["malformed"] if kind == "peers" else told["faults"]
    for fault, amount in faults.items():
        tally["malformed", fault] += amount
    for reason, amount in told.get("drops", {}).items():
        tally["dropped", reason] += amount
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
        """The devices, to be opened by the two programs."""
        return [os.ttyname(slave) for slave in self._slaves]

    def __enter__(self) -> Self:
        for _ in range(2):
            master, slave = pty.openpty()
            tty.setraw(slave)
            os.set_blocking(master, False)
            self._masters.append(master)
            self._slaves.append(slave)  # held open: a master whose slave nobody has open gives errors
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
                    return  # nobody reads there: as on a wire, what is not read is lost
