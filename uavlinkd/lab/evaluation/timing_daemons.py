"""Times the parts of a link in this process, and handshakes and frames of two real daemons, each a process.

A proxy between the daemons sees each datagram. For a handshake it first drops all of them, until both processes are
idle and the initiator waits for its retry. Then it passes them. The time starts when the next initiation reaches the
proxy. It ends when the responder delivers the first frame, which is sent when the initiator has confirmed. So the
start of the processes (about 0.5 s) is not included, and the computation before the initiation is only in the
initiator's processor time. The proxy delays each of the four datagrams; the records of frames with and without it
show by how much.

In this process: tags by the length of their key, and a handshake in the core alone. RFC 2104, section 2: a key longer
than the hash's block (64 bytes for SHA-256) is hashed first, and its hash is the key. The daemon prepares two hash
states per session, so that it computes a tag without the key.
"""

from __future__ import annotations

import asyncio
import hmac
import os
import signal
import socket
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Sequence
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any, Self

from uavlinkd.config.keys import generate_psk
from uavlinkd.core import wire
from uavlinkd.core.crypto import KeyPair, MacKey, Secret
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Deliver, Output, Transmit
from uavlinkd.core.path import Path as PeerPath
from uavlinkd.core.settings import Link, PeerSettings
from uavlinkd.core.suites import Suite
from uavlinkd.lab.child_processes import private_folder
from uavlinkd.lab.evaluation.ledger import numbered_frame
from uavlinkd.lab.evaluation.middle import HOST, MiddleHere
from uavlinkd.lab.evaluation.records import CpuTimeError, EvaluationError, Record, Status, Value, cpu_seconds
from uavlinkd.lab.evaluation.stage import until
from uavlinkd.lab.mitm.attack import Action, Direction, PassiveAttack, Send
from uavlinkd.lab.sim.drone_process import DroneError, DroneProcess
from uavlinkd.lab.sim.loopback_ports import free_ports
from uavlinkd.mavlink.frames import SplitCounters, split_datagram

TAG_KEY_BITS = (256, 512, 520, 1024, 2048)
"""The lengths of the paper and of the daemon; 520 is one byte more than a block."""
MESSAGE_BYTES = (45, 280)
"""An ATTITUDE with the header of its envelope, and the largest frame."""
_BATCHES = 15
_HERE = PeerPath(0, ("127.0.0.1", 1))
_THERE = PeerPath(0, ("127.0.0.1", 2))


@dataclass(frozen=True, slots=True)
class LinkChoice:
    """The settings of a measured link."""

    suite: Suite
    mac_key_bits: int = 256
    confidential: bool = False

    @property
    def point(self) -> dict[str, Value]:
        return {"suite": self.suite.name, "mac_key_bits": self.mac_key_bits, "confidential": self.confidential}


def tag_makers(key: bytes, message: bytes) -> dict[str, Callable[[], bytes]]:
    prepared = MacKey(key)
    return {"prepared": lambda: prepared.tag(message), "from the key": lambda: hmac.digest(key, message, "sha256")}


def measure_tags(tags: int) -> list[Record]:
    """Measure the seconds per tag in batches of ``tags``, for every length of key and message."""
    makers: list[tuple[dict[str, Value], Callable[[], bytes]]] = [
        ({"mac_key_bits": bits, "states": states, "message_bytes": message_bytes}, make)
        for message_bytes in MESSAGE_BYTES
        for bits in TAG_KEY_BITS
        for states, make in tag_makers(os.urandom(bits // 8), os.urandom(message_bytes)).items()
    ]
    times: list[list[float]] = [[] for _ in makers]
    for _ in range(_BATCHES):  # the variants alternate, so that load affects all of them equally
        for (_, make), batch in zip(makers, times, strict=True):
            before = time.perf_counter()
            for _ in range(tags):
                make()
            batch.append((time.perf_counter() - before) / tags)
    return [
        Record("mac", point, {"tag_least_s": min(batch)}) for (point, _), batch in zip(makers, times, strict=True)
    ]


def measure_core(choice: LinkChoice) -> Record:
    """One handshake between two new nodes, and one frame: cryptography and protocol, no sockets."""
    link = Link(suites=(choice.suite,), mac_key_bits=choice.mac_key_bits, confidential=choice.confidential)
    keys = [os.urandom(32), os.urandom(32)]
    psk = Secret(os.urandom(32))
    initiator, responder = (Node(Secret(key), os.urandom, 0.0) for key in keys)
    b = initiator.add_peer(PeerSettings("b", KeyPair(keys[1]).public, psk, link), 0.0)
    a = responder.add_peer(PeerSettings("a", KeyPair(keys[0]).public, psk, link), 0.0)
    initiator.set_paths(b, [_THERE], 0.0)

    frame = numbered_frame(1, 1)
    moments = [time.perf_counter()]
    initiation = initiator.handle_timeout(0.0)
    moments.append(time.perf_counter())
    response = responder.receive(_first_datagram(initiation), _HERE, 0.001)
    moments.append(time.perf_counter())
    confirmation = initiator.receive(_first_datagram(response), _THERE, 0.002)
    moments.append(time.perf_counter())
    responder.receive(_first_datagram(confirmation), _HERE, 0.003)
    moments.append(time.perf_counter())
    envelope = initiator.send(b, [frame], 0.004)
    delivered = responder.receive(_first_datagram(envelope), _HERE, 0.005)
    moments.append(time.perf_counter())

    if Deliver(a, frame) not in delivered:
        return Record("core", choice.point, {}, Status.FAILED, "the other node did not deliver the frame")
    names = ("initiate_s", "respond_s", "finish_s", "confirm_s", "frame_s")
    steps = {name: after - before for name, before, after in zip(names, moments, moments[1:], strict=False)}
    return Record("core", choice.point, {"total_s": moments[-1] - moments[0], **steps})


def _first_datagram(outputs: Sequence[Output]) -> bytes:
    return next(output.datagram for output in outputs if isinstance(output, Transmit))


START_S = 120.0
"""How long daemons may take to start and link: about 0.5 s, and much more on a busy or small machine."""
HANDSHAKE_LIMIT_S = 20.0
"""Enough for some retries: a handshake that takes longer has failed."""
FRAMES_PER_S = 250.0
"""About twice the rate of a flying PX4 in its default mode. The link is idle between two frames."""
_SETTLE_S = 0.01
"""The delay after the frame until both processes are idle, so that their processor time is complete."""
_LAST_S = 2.0
"""How long the last frame may take."""
_AGAIN_S = 0.25
_LOOK_S = 0.005
_INITIATOR, _RESPONDER = "initiator", "responder"
_ENVELOPES = (wire.SHORT_ENVELOPE, wire.LONG_ENVELOPE)


class Watch(PassiveAttack):
    """Passes datagrams while it is open, and counts them by sender."""

    name = "watch"

    def __init__(self) -> None:
        self.is_open = False
        self.dropped = 0
        self.datagrams: Counter[str] = Counter()
        self.bytes: Counter[str] = Counter()
        self.initiated_at: float | None = None
        self.on_confirmed: Callable[[], object] | None = None
        """Called when the initiator's first envelope passes: it confirms the session of both."""

    def on_datagram(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        if not self.is_open:
            self.dropped += 1
            return []
        self.datagrams[direction.sender] += 1
        self.bytes[direction.sender] += len(datagram)
        if direction.sender == _INITIATOR and datagram[0] == wire.INITIATION:
            self.initiated_at = self.initiated_at or monotonic()
        elif direction.sender == _INITIATOR and datagram[0] in _ENVELOPES and self.on_confirmed:
            asyncio.get_running_loop().call_soon(self.on_confirmed)
            self.on_confirmed = None
        return [Send(datagram, direction)]


class Pair:
    """Two daemons, a client of each, and the proxy between them, if there is one. Entering it starts all."""

    def __init__(self, choice: LinkChoice, *, with_proxy: bool = True) -> None:
        self.watch = Watch()
        self.arrived: dict[bytes, float] = {}
        """When each frame arrived first at the responder's client."""
        self._link: dict[str, object] = {
            "suites": [choice.suite.name],
            "mac_key_bits": choice.mac_key_bits,
            "confidential": choice.confidential,
        }
        self._with_proxy = with_proxy
        self._clients: dict[str, socket.socket] = {}
        self._number = 0
        self._delivered = asyncio.Event()
        self._stack = AsyncExitStack()

    async def __aenter__(self) -> Self:
        async with AsyncExitStack() as stack:
            await self._open(stack, stack.enter_context(private_folder("uavlinkd-")))
            self._stack = stack.pop_all()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._stack.aclose()

    async def _open(self, stack: AsyncExitStack, folder: Path) -> None:
        names, ports = (_INITIATOR, _RESPONDER), free_ports(4)
        self.drones = {name: DroneProcess(name, folder / name, *ports[2 * n :][:2]) for n, name in enumerate(names)}
        initiator, responder = self.drones.values()
        address = f"{HOST}:{responder.port}"
        if self._with_proxy:
            middle = MiddleHere(names, None, 0)
            stack.push_async_callback(middle.stop)
            await middle.start({name: drone.port for name, drone in self.drones.items()}, {})
            await middle.attack([], [self.watch])
            address = f"{HOST}:{middle.ports[Direction(_INITIATOR, _RESPONDER)]}"
        psk = generate_psk()
        for drone, peer, addresses in ((responder, initiator, []), (initiator, responder, [address])):
            drone.share_psk(psk, "pair.psk")
            drone.configure(self._link, [peer.as_peer("", "pair.psk", addresses=addresses)])
            stack.push_async_callback(drone.stop, signal.SIGKILL)  # a close message would be traffic
            await drone.start()
        loop = asyncio.get_running_loop()
        for name, drone in self.drones.items():
            await until(drone.ask, f"{name} did not start")
            client = self._clients[name] = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            client.setblocking(False)
            client.connect((HOST, drone.endpoint_port))
        loop.add_reader(self._clients[_RESPONDER], self._on_readable)
        stack.callback(loop.remove_reader, self._clients[_RESPONDER])
        self._clients[_RESPONDER].send(numbered_frame(2, 0))  # the daemon learns its client

    def _on_readable(self) -> None:
        now = monotonic()
        for frame in split_datagram(self._clients[_RESPONDER].recv(65536), SplitCounters()):
            self.arrived.setdefault(frame.raw, now)
            self._delivered.set()

    def send_frame(self) -> tuple[bytes, float]:
        """Send a new frame to the initiator's daemon. Return the frame and the time."""
        self._number += 1
        frame, now = numbered_frame(1, self._number), monotonic()
        self._clients[_INITIATOR].send(frame)
        return frame, now

    def cpu_s(self) -> dict[str, float]:
        return {f"cpu_{name}_s": cpu_seconds(drone.pid) for name, drone in self.drones.items()}

    def cpu_since(self, before: dict[str, float]) -> dict[str, float]:
        return {name: seconds - before[name] for name, seconds in self.cpu_s().items()}

    async def until_delivered(self, limit_s: float) -> None:
        """Wait for the first frame. A frame that arrives before the initiator has a session is dropped: send others.

        Raises:
            EvaluationError: no frame was delivered in time.
        """
        end = monotonic() + limit_s
        while not self.arrived:
            with suppress(TimeoutError):
                async with asyncio.timeout(_AGAIN_S):
                    await self._delivered.wait()
                    return
            if monotonic() > end:
                raise EvaluationError(f"no frame was delivered within {limit_s:g} s")
            self.send_frame()


async def measured(kind: str, point: dict[str, Value], measure: Awaitable[dict[str, Any]]) -> Record:
    """The record of a measurement, also of one that fails."""
    try:
        return Record(kind, point, await measure)
    except (EvaluationError, DroneError, CpuTimeError, OSError) as error:
        return Record(kind, point, {}, Status.FAILED, str(error))


async def time_handshake(choice: LinkChoice) -> dict[str, Any]:
    """One handshake between two new processes with new keys."""
    async with Pair(choice) as pair:
        watch = pair.watch

        async def has_initiated() -> bool:
            return watch.dropped > 0

        await until(has_initiated, "the initiator did not send an initiation", HANDSHAKE_LIMIT_S)
        before = pair.cpu_s()
        watch.on_confirmed, watch.is_open = pair.send_frame, True
        await pair.until_delivered(HANDSHAKE_LIMIT_S)
        counts = {name: [getattr(watch, name)[end] for end in pair.drones] for name in ("bytes", "datagrams")}
        await asyncio.sleep(_SETTLE_S)
        assert watch.initiated_at is not None, "a frame was delivered"
        return {"total_s": min(pair.arrived.values()) - watch.initiated_at, **counts, **pair.cpu_since(before)}


async def time_frames(choice: LinkChoice, count: int, *, with_proxy: bool) -> dict[str, Any]:
    """The latency of each delivered frame, from client to client, and the processor time."""
    async with Pair(choice, with_proxy=with_proxy) as pair:
        pair.watch.is_open = True
        await pair.until_delivered(START_S)
        before, started_at = pair.cpu_s(), monotonic()
        sent: list[tuple[bytes, float]] = []

        async def has_all() -> bool:
            return all(frame in pair.arrived for frame, _ in sent)

        for number in range(count):
            await asyncio.sleep(started_at + number / FRAMES_PER_S - monotonic())
            sent.append(pair.send_frame())
        with suppress(EvaluationError):  # some are lost
            await until(has_all, "a frame was lost", _LAST_S)
        latencies = [pair.arrived[frame] - at for frame, at in sent if frame in pair.arrived]
        return {"sent": count, **pair.cpu_since(before), "latency_s": latencies}
