"""A man in the middle between the real wireguard-go and the daemon; what he holds back, and what arrives when.

One loop moves everything: datagrams of the tunnel, numbered commands of the station each 0.1 s, heartbeats.
"""

from __future__ import annotations

import select
import socket
from collections.abc import Iterator
from contextlib import suppress
from struct import unpack_from
from time import monotonic
from typing import NamedTuple

from tests.namespaces import udp_socket_in
from tests.processes.frames import command_long, frames_in, ground_heartbeat, heartbeat, name_of
from tests.stations.scene import AUTOPILOT_PORT, PORT, App, Scene, text_in
from tests.waiting import Stopwatch

INTERVAL_S = 0.1
DAEMON = ("10.66.0.1", 14550)


class Arrival(NamedTuple):
    """A command at the autopilot. ``calm_s`` is its age without what other work on this machine cost."""

    number: int
    at: float
    age_s: float
    calm_s: float


class Middle:
    """The station's software, the man in the middle and the autopilot. ``delay_s``: what he adds to the station's."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.delay_s = 0.0
        self.arrivals: list[Arrival] = []
        self.recorded: list[bytes] = []
        self.sent: dict[int, tuple[float, Stopwatch]] = {}
        self._held: list[tuple[float, bytes]] = []
        self._app_at: tuple[str, int] | None = None
        self._due = 0.0

    def open(self, printed: str) -> App:
        """The app, switched on, with the man in the middle at its endpoint."""
        tablet, vehicle = self.scene.tablet, self.scene.vehicle
        self._to_app = udp_socket_in(tablet.path)
        self._to_daemon = udp_socket_in(tablet.path, tablet.address)
        self._software = udp_socket_in(tablet.path, "0.0.0.0", 14550)
        self._autopilot = udp_socket_in(vehicle.path)
        host, port = self._to_app.getsockname()
        text = text_in(printed).replace(f"{vehicle.address}:{PORT}", f"{host}:{port}")
        app = App(tablet, text, self.scene.folder)
        app.switch_on()
        return app

    def close(self) -> None:
        for sock in self._sockets():
            sock.close()

    def _sockets(self) -> tuple[socket.socket, ...]:
        return self._to_app, self._to_daemon, self._software, self._autopilot

    def run(self, seconds: float) -> None:
        """Let commands and heartbeats flow for so long."""
        end = monotonic() + seconds
        while (now := monotonic()) < end:
            self._say(now)
            self._release(now)
            readable, _, _ = select.select(self._sockets(), (), (), 0.005)
            for sock in readable:
                for datagram, source in _received(sock):
                    self._take(sock, datagram, source, monotonic())

    def replay(self) -> None:
        """Everything that the station sent, once more."""
        for datagram in self.recorded:
            self._to_daemon.sendto(datagram, (self.scene.vehicle.address, PORT))

    def _say(self, now: float) -> None:
        if now < self._due:
            return
        self._due = now + INTERVAL_S
        number = len(self.sent)
        self.sent[number] = now, Stopwatch()
        with suppress(OSError):  # the tunnel's device may have no room
            self._software.sendto(ground_heartbeat(), DAEMON)
            self._software.sendto(command_long(400, 255, param1=float(number)), DAEMON)
        self._autopilot.sendto(heartbeat(), ("127.0.0.1", AUTOPILOT_PORT))

    def _release(self, now: float) -> None:
        kept = []
        for at, datagram in self._held:
            if now >= at + self.delay_s:
                self._to_daemon.sendto(datagram, (self.scene.vehicle.address, PORT))
            else:
                kept.append((at, datagram))
        self._held = kept

    def _take(self, sock: socket.socket, datagram: bytes, source: tuple[str, int], now: float) -> None:
        if sock is self._to_app:
            self._app_at = source
            self.recorded.append(datagram)
            self._held.append((now, datagram))
            self._release(now)
        elif sock is self._to_daemon and self._app_at is not None:
            self._to_app.sendto(datagram, self._app_at)
        elif sock is self._autopilot:
            for frame in frames_in(datagram):
                if name_of(frame) == "COMMAND_LONG":
                    number = int(unpack_from("<f", frame, 10)[0])  # its first parameter
                    at, watch = self.sent[number]
                    self.arrivals.append(Arrival(number, now, now - at, watch.calm_s))


def _received(sock: socket.socket) -> Iterator[tuple[bytes, tuple[str, int]]]:
    with suppress(BlockingIOError):
        while True:
            yield sock.recvfrom(65536)
