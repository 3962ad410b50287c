"""The man in the middle of an evaluation: ``uavlink-mitm`` as a process, or a proxy in this process.

In this process, it can run attackers that have keys, unlike ``uavlink-mitm``.
"""

from __future__ import annotations

import asyncio
import json
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any, Protocol

import structlog

from uavlinkd.config.keys import encode_key
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.mitm.attack import AttackContext, AttackObject, Direction
from uavlinkd.lab.mitm.attacks import parse_attack
from uavlinkd.lab.mitm.proxy import Proxy
from uavlinkd.lab.mitm.proxy_settings import MitmLink, MitmPeer, ProxySettings
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.lab.sim.loopback_ports import free_ports
from uavlinkd.ops.control import ControlError, ask
from uavlinkd.system.addresses import Address

HOST = "127.0.0.1"
START_S = 120.0


class MiddleError(Exception):
    """The man in the middle failed. The message is for the operator."""


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
        """The counters of these attacks."""
        return {key: count for key, count in self.counts.items() if key.partition(":")[0] in names}


def interventions(statistics: Mapping[str, Any]) -> Interventions:
    """Read the counters from the statistics of a :class:`Proxy`."""
    strangers = statistics["strangers"]
    return Interventions(
        dict(statistics["interventions"]), int(strangers["bytes_back"]), dict(strangers["amplified"])
    )


class Middle(Protocol):
    """The interface of both."""

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


def _listen_ports(names: Sequence[str], paths: int) -> dict[Direction, int]:
    directions = AttackContext.between(*names, paths=paths).directions
    return dict(zip(directions, free_ports(len(directions)), strict=True))


def _links(ports: Mapping[Direction, int]) -> list[MitmLink]:
    """One for each pair and path."""
    return [
        MitmLink(
            (direction.sender, direction.receiver), (Address(HOST, port), Address(HOST, ports[direction.reverse]))
        )
        for direction, port in ports.items()
        if direction.sender < direction.receiver
    ]


class MiddleProcess:
    """``uavlink-mitm`` as a process, controlled by its socket. It writes every intervention to ``log``."""

    def __init__(self, names: Sequence[str], folder: Path, log: Path, seed: int) -> None:
        self.ports = _listen_ports(names, 1)
        self._socket = folder / "mitm.sock"
        self._log = log
        self._seed = seed
        self._process: asyncio.subprocess.Process | None = None

    async def start(self, addresses: Mapping[str, int], public_keys: Mapping[str, bytes]) -> None:
        """Start the process, and wait for its answer.

        Raises:
            MiddleError: it does not answer.
        """
        flags = ["--seed", str(self._seed), "--log", str(self._log), "--control-socket", str(self._socket)]
        for name, port in addresses.items():
            key = f",{encode_key(public_keys[name])}" if name in public_keys else ""
            flags += ["--peer", f"{name}={HOST}:{port}{key}"]
        for link in _links(self.ports):
            flags += ["--link", ",".join(f"{name}@{at}" for name, at in zip(link.peers, link.listen, strict=True))]
        self._process = await asyncio.create_subprocess_exec(
            *end_with_parent(sys.executable, "-m", "uavlinkd.lab.mitm", *flags),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.DEVNULL,
        )
        until = time.monotonic() + START_S
        while True:
            try:
                await self._ask("statistics")
            except ControlError:
                if time.monotonic() >= until or self._process.returncode is not None:
                    raise MiddleError("uavlink-mitm did not start") from None
                await asyncio.sleep(0.02)
            else:
                return

    async def attack(self, specs: Sequence[str], objects: Sequence[AttackObject] = ()) -> None:
        """Replace the attacks.

        Raises:
            MiddleError: the attacks are refused.
        """
        assert not objects, "attackers with keys stay out of uavlink-mitm"
        answer = await self._ask("attack " + (" ".join(specs) or "none"))
        if "refused" in answer:
            raise MiddleError(f"{' '.join(specs)}: {answer['refused']}")

    async def statistics(self) -> Interventions:
        """The counters so far."""
        return interventions(await self._ask("statistics"))

    async def _ask(self, request: str) -> dict[str, Any]:
        return await asyncio.to_thread(ask, self._socket, request)

    async def stop(self) -> None:
        """Stop the process."""
        if self._process is not None and self._process.returncode is None:
            self._process.send_signal(signal.SIGTERM)
            with suppress(TimeoutError):
                await asyncio.wait_for(self._process.wait(), 5.0)
            if self._process.returncode is None:
                self._process.kill()
                await self._process.wait()


class MiddleHere:
    """A :class:`Proxy` in this process. ``paths``: between each pair of peers; ``radios``: as for the proxy."""

    def __init__(
        self,
        names: Sequence[str],
        log: Path | None,
        seed: int,
        paths: int = 1,
        radios: Sequence[tuple[str, RadioSettings]] = (),
    ) -> None:
        self.ports = _listen_ports(names, paths)
        self._log = log
        self._seed = seed
        self._radios = tuple(radios)
        self._proxy: Proxy | None = None

    @property
    def proxy(self) -> Proxy:
        """The running proxy."""
        assert self._proxy is not None
        return self._proxy

    @property
    def context(self) -> AttackContext:
        """The context of the attacks."""
        return self.proxy.context

    async def start(self, addresses: Mapping[str, int], public_keys: Mapping[str, bytes]) -> None:
        """Start between peers."""
        peers = tuple(MitmPeer(name, Address(HOST, port), public_keys.get(name)) for name, port in addresses.items())
        links = tuple(_links(self.ports))
        proxy = Proxy(ProxySettings(peers, links, radios=self._radios, seed=self._seed, log=self._log), [])
        proxy.log = silent_log()
        await proxy.start()
        self._proxy = proxy

    async def attack(self, specs: Sequence[str], objects: Sequence[AttackObject] = ()) -> None:
        """Replace the attacks."""
        now = monotonic()
        made = [
            parse_attack(text).place(self.context, f"{self._seed} {position}", now)
            for position, text in enumerate(specs)
        ]
        self.proxy.change_attacks([*made, *objects])

    async def statistics(self) -> Interventions:
        """The counters so far."""
        return interventions(json.loads(json.dumps(self.proxy.statistics())))

    async def stop(self) -> None:
        """Stop."""
        if self._proxy is not None:
            await self._proxy.stop()
            self._proxy = None


def silent_log() -> Any:
    """A logger without output: the proxy's journal has its interventions."""
    return structlog.wrap_logger(structlog.ReturnLogger(), processors=[_drop_event])


def _drop_event(_logger: Any, _name: str, _event: Any) -> Any:
    raise structlog.DropEvent
