"""The process that forwards for all routers of a laboratory: ``python -m tests.natlab.routing``.

It gets each router's TUN interface over the socket that is its standard input, with the router's settings. A packet
that the kernel routes into the interface comes back out of it translated, or after a delay, or not at all.
"""

from __future__ import annotations

import heapq
import json
import os
import random
import selectors
import socket
from itertools import count
from time import monotonic
from typing import Any, Final

from tests.natlab.translation import Dependence, Translator

PACKET_BYTES: Final = 65536
BATCH: Final = 32
"""Packets of one interface before those of others."""


class Router:
    """A TUN interface with a translator, or one that only delays and loses packets."""

    def __init__(self, tun: int, settings: dict[str, Any]) -> None:
        self.tun = tun
        self.delay_s: float = settings["delay_s"]
        self.loss: float = settings["loss"]
        self.translator: Translator | None = None
        if "external" in settings:
            self.translator = Translator(
                settings["external"],
                settings["inner"],
                Dependence(settings["mapping"]),
                Dependence(settings["filtering"]),
                hairpin=settings["hairpin"],
            )

    def forwarded(self, packet: bytes) -> bytes | None:
        """The packet to forward, or None for a lost or dropped one."""
        if self.loss and random.random() < self.loss:
            return None
        return packet if self.translator is None else self.translator.translate(packet)


class Forwarding:
    """All routers, and the packets that wait for their delay."""

    def __init__(self, control: socket.socket) -> None:
        self._control = control
        self._routers: dict[str, Router] = {}
        self._waiting: list[tuple[float, int, int, bytes]] = []
        self._numbers = count()
        self._selector = selectors.DefaultSelector()
        self._selector.register(control, selectors.EVENT_READ)

    def run(self) -> None:
        while True:
            timeout_s = max(0.0, self._waiting[0][0] - monotonic()) if self._waiting else None
            for key, _ in self._selector.select(timeout_s):
                if key.data is not None:
                    self._read(key.data)
                elif not self._obey():
                    return
            while self._waiting and self._waiting[0][0] <= monotonic():
                _, _, tun, packet = heapq.heappop(self._waiting)
                os.write(tun, packet)

    def _read(self, router: Router) -> None:
        for _ in range(BATCH):
            try:
                packet = os.read(router.tun, PACKET_BYTES)
            except BlockingIOError:
                return
            forwarded = router.forwarded(packet)
            if forwarded is None:
                continue
            if router.delay_s:
                due = monotonic() + router.delay_s
                heapq.heappush(self._waiting, (due, next(self._numbers), router.tun, forwarded))
            else:
                os.write(router.tun, forwarded)

    def _obey(self) -> bool:
        message, descriptors, _, _ = socket.recv_fds(self._control, PACKET_BYTES, 1)
        if not message:
            return False
        settings = json.loads(message)
        name = settings["name"]
        if descriptors:
            os.set_blocking(descriptors[0], False)
            router = self._routers[name] = Router(descriptors[0], settings)
            self._selector.register(router.tun, selectors.EVENT_READ, router)
        elif "loss" in settings:
            self._routers[name].loss = settings["loss"]
        else:
            translator = self._routers[name].translator
            assert translator is not None
            translator.forget()
        self._control.send(b"done")
        return True


if __name__ == "__main__":
    Forwarding(socket.socket(fileno=0)).run()
