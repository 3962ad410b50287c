"""Many peers of one daemon in one process: the protocol's core, once for each, with a socket of its own.

``swarm FILE``: FILE (JSON) names the daemon's address and public key, and each peer's private key. When all are
linked it takes the orders of :mod:`tests.bench.generator` and answers as that does; a frame is sealed by each in
turn, so with N peers and a rate R each sends R / N frames a second, evenly.
"""

from __future__ import annotations

import ctypes
import json
import os
import select
import socket
import sys
import time
from base64 import b64decode
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from tests.bench.frames import PROBE_EVERY, is_probe, read_frames, said_by, stamp
from tests.bench.generator import BUFFER_BYTES, PR_SET_TIMERSLACK, Pace, Sent
from uavlinkd.protocol.crypto import Secret
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Output, Transmit
from uavlinkd.protocol.path import Path as PeerPath
from uavlinkd.protocol.settings import PeerSettings

DAEMON: Final = "daemon"
FRAMES_EACH: Final = 20 * PROBE_EVERY
CARE_EVERY_S: Final = 0.01
"""Interval for reading the daemon's datagrams and checking timers."""
CALLING_MOST: Final = 2
SETTLE_S: Final = 1.0
RECEIVE_BYTES: Final = 65536


class Member:
    """One peer: a node that knows only the daemon."""

    def __init__(self, private_key: bytes, system: int, daemon: tuple[str, int], public_key: bytes) -> None:
        self.sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
        self.sock.setblocking(False)
        self.sock.connect(daemon)
        self.system = system
        self._path = PeerPath(0, daemon)
        now = time.monotonic()
        self._node = Node(Secret(private_key), os.urandom, now)
        self._peer = self._node.add_peer(PeerSettings(DAEMON, public_key), now)
        self._frames: list[bytearray] = []
        self._next = 0

    def call(self) -> None:
        """Initiate to the daemon until it answers."""
        self._node.set_paths(self._peer, [self._path], time.monotonic())

    @property
    def is_up(self) -> bool:
        return self._peer.is_up

    def take(self, frames: Iterable[bytes]) -> None:
        self._frames = [bytearray(said_by(frame, self.system)) for frame in frames]

    def send(self) -> None:
        frame = self._frames[self._next]
        self._next = (self._next + 1) % len(self._frames)
        if is_probe(frame):
            stamp(frame, 0, time.monotonic_ns())
        self._perform(self._node.send(self._peer, [bytes(frame)], time.monotonic()))

    def hear(self) -> None:
        while True:
            try:
                datagram = self.sock.recv(RECEIVE_BYTES)
            except OSError:  # no more datagrams; or the daemon did not listen yet
                return
            self._perform(self._node.receive(datagram, self._path, time.monotonic()))

    def be_in_time(self, now: float) -> None:
        if self._node.next_deadline() <= now:
            self._perform(self._node.handle_timeout(now))

    def _perform(self, outputs: Iterable[Output]) -> None:
        for output in outputs:
            if isinstance(output, Transmit):
                try:
                    self.sock.send(output[0])
                except OSError:  # as if the network had lost it
                    continue


class Swarm:
    """All members."""

    def __init__(self, members: Sequence[Member], frames: Sequence[bytes]) -> None:
        self._members = members
        self._epoll = select.epoll()
        self._by_descriptor = {member.sock.fileno(): member for member in members}
        for descriptor in self._by_descriptor:
            self._epoll.register(descriptor, select.EPOLLIN)
        for number, member in enumerate(members):
            first = number * 7 % max(1, len(frames) - FRAMES_EACH)
            member.take(frames[first : first + FRAMES_EACH])

    def care(self, wait_s: float = 0.0) -> None:
        """Read datagrams, and process due timers."""
        for descriptor, _ in self._epoll.poll(wait_s, len(self._members)):
            self._by_descriptor[descriptor].hear()
        now = time.monotonic()
        for member in self._members:
            member.be_in_time(now)

    def link(self, patience_s: float) -> int:
        """Link one after the other, a few at a time, and wait; returns how many did not link in time.

        All at once they would meet the daemon's limits against floods, and try again while frames are counted.
        """
        deadline = time.monotonic() + patience_s
        waiting, calling = list(reversed(self._members)), list[Member]()
        while (waiting or calling) and time.monotonic() < deadline:
            calling = [member for member in calling if not member.is_up]
            while waiting and len(calling) < CALLING_MOST:
                calling.append(waiting.pop())
                calling[-1].call()
            self.care(CARE_EVERY_S)
        settled = time.monotonic() + SETTLE_S
        while time.monotonic() < settled:
            self.care(CARE_EVERY_S)
        return sum(not member.is_up for member in self._members)

    def send_evenly(self, per_s: float, seconds: float) -> Sent:
        """Send so many frames a second in total, each member in turn."""
        members, size = self._members, len(self._members)
        count = max(1, round(per_s * seconds))
        pace = Pace(per_s)
        cared_at = time.monotonic()
        for number in range(count):
            pace.wait(number)
            members[number % size].send()
            if time.monotonic() - cared_at >= CARE_EVERY_S:
                self.care()
                cared_at = time.monotonic()
        return pace.sent(count)


def main() -> None:
    """Link, report it, and execute orders; between them keep the links up."""
    ctypes.CDLL(None).prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0)
    plan: dict[str, Any] = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    daemon, public_key = (plan["host"], plan["port"]), b64decode(plan["public_key"])
    members = [
        Member(b64decode(private), system, daemon, public_key)
        for system, private in enumerate(plan["private_keys"], 1)
    ]
    swarm = Swarm(members, read_frames(Path(plan["frames"])))
    missing = swarm.link(plan["patience_s"])
    if missing:
        sys.exit(f"{missing} of {len(members)} are not linked")
    print(json.dumps({"ready": True}), flush=True)
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    poll = select.poll()
    poll.register(0, select.POLLIN)
    line = b""
    while True:
        swarm.care()
        if not poll.poll(CARE_EVERY_S * 1000):
            continue
        given = os.read(0, 4096)
        if not given:
            return
        line += given
        if line.endswith(b"\n"):
            order, line = json.loads(line), b""
            print(json.dumps(asdict(swarm.send_evenly(order["rate"], order["seconds"]))), flush=True)


if __name__ == "__main__":
    main()
