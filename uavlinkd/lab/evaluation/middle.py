"""The man in the middle of an evaluation, in this process. Unlike ``uavlink-mitm`` it can run attackers with keys."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from time import monotonic
from typing import Any, Protocol

import structlog

from uavlinkd.io.sockets import udp_socket
from uavlinkd.lab.mitm.attack import AttackContext, AttackObject, Direction
from uavlinkd.lab.mitm.attacks import parse_attack
from uavlinkd.lab.mitm.proxy import Proxy, received
from uavlinkd.lab.mitm.proxy_settings import MitmLink, MitmPeer, ProxySettings
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.lab.sim.loopback_ports import free_ports
from uavlinkd.system.addresses import Address

HOST = "127.0.0.1"


@dataclass(frozen=True, slots=True)
class Interventions:
    """The counters of the man in the middle."""

    counts: Mapping[str, int] = field(default_factory=dict)
    """By "attack: operation"."""
    bytes_to_strangers: int = 0
    """Bytes that the peers sent to strangers."""
    amplified: Mapping[str, int] = field(default_factory=dict)
    """By "peer to stranger": bytes that the stranger received beyond those it recently sent."""

    def of(self, names: Sequence[str]) -> dict[str, int]:
        return {key: count for key, count in self.counts.items() if key.partition(":")[0] in names}


def interventions(statistics: Mapping[str, Any]) -> Interventions:
    strangers = statistics["strangers"]
    return Interventions(
        dict(statistics["interventions"]), int(strangers["bytes_back"]), dict(strangers["amplified"])
    )


class Middle(Protocol):
    """The interface of those between daemons, on a serial line and in a relay."""

    @property
    def ports(self) -> Mapping[Direction, int]:
        """The port where the sender reaches the receiver."""

    async def start(self, addresses: Mapping[str, int], public_keys: Mapping[str, bytes]) -> None:
        """Start between peers with these ports."""

    async def attack(self, specs: Sequence[str], objects: Sequence[AttackObject] = ()) -> None:
        """Replace the attacks."""

    async def statistics(self) -> Interventions:
        """The counters so far."""

    async def stop(self) -> None:
        """Stop."""


def _links(ports: Mapping[Direction, int]) -> list[MitmLink]:
    """One for each pair and path."""
    return [
        MitmLink(
            (direction.sender, direction.receiver), (Address(HOST, port), Address(HOST, ports[direction.reverse]))
        )
        for direction, port in ports.items()
        if direction.sender < direction.receiver
    ]


class MiddleHere:
    """A :class:`Proxy` in this process. ``paths``: between each pair of peers; ``radios``: as for the proxy."""

    def __init__(
        self,
        names: Sequence[str],
        seed: int,
        paths: int = 1,
        radios: Sequence[tuple[str, RadioSettings]] = (),
    ) -> None:
        directions = AttackContext.between(*names, paths=paths).directions
        self.ports = dict(zip(directions, free_ports(len(directions)), strict=True))
        self._seed = seed
        self._radios = tuple(radios)
        self._proxy: Proxy | None = None

    @property
    def proxy(self) -> Proxy:
        assert self._proxy is not None
        return self._proxy

    @property
    def context(self) -> AttackContext:
        return self.proxy.context

    async def start(self, addresses: Mapping[str, int], public_keys: Mapping[str, bytes]) -> None:
        peers = tuple(MitmPeer(name, Address(HOST, port), public_keys.get(name)) for name, port in addresses.items())
        links = tuple(_links(self.ports))
        proxy = Proxy(ProxySettings(peers, links, radios=self._radios, seed=self._seed))
        proxy.log = silent_log()
        await proxy.start()
        self._proxy = proxy

    async def attack(self, specs: Sequence[str], objects: Sequence[AttackObject] = ()) -> None:
        now = monotonic()
        made = [
            parse_attack(text).make(self.context, f"{self._seed} {position}", now)
            for position, text in enumerate(specs)
        ]
        self.proxy.change_attacks([*made, *objects])

    async def statistics(self) -> Interventions:
        return interventions(self.proxy.statistics())

    async def stop(self) -> None:
        if self._proxy is not None:
            await self._proxy.stop()
            self._proxy = None


def silent_log() -> Any:
    """A logger without output: the proxy counts its interventions."""
    above_all = structlog.make_filtering_bound_logger(logging.CRITICAL)
    return structlog.wrap_logger(structlog.ReturnLogger(), wrapper_class=above_all)


class Clients:
    """The local clients of drones or aircraft: a UDP socket each, by name.

    Args:
        on_datagram: called with the name of the receiver and each datagram.
    """

    def __init__(self, on_datagram: Callable[[str, bytes], None]) -> None:
        self._on_datagram = on_datagram
        self._sockets: dict[str, socket.socket] = {}

    @property
    def ports(self) -> dict[str, int]:
        return {name: sock.getsockname()[1] for name, sock in self._sockets.items()}

    def open(self, names: Sequence[str]) -> None:
        for name in names:
            sock = self._sockets[name] = udp_socket(Address(HOST, 0))
            asyncio.get_running_loop().add_reader(sock, self._on_readable, name, sock)

    def close(self) -> None:
        for sock in self._sockets.values():
            asyncio.get_running_loop().remove_reader(sock)
            sock.close()

    def send(self, name: str, datagram: bytes, port: int) -> None:
        with suppress(OSError):  # an earlier one was refused: the receiver is starting
            self._sockets[name].sendto(datagram, (HOST, port))

    def _on_readable(self, name: str, sock: socket.socket) -> None:
        for datagram, _ in received(sock):
            self._on_datagram(name, datagram)
