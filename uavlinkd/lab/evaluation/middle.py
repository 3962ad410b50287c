"""The man in the middle between the two ends of an evaluation: ``uavlink-mitm`` as a process, or in this one.

In this process it can be given attackers that hold keys, which ``uavlink-mitm`` never has.
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

from uavlinkd.system.addresses import Address
from uavlinkd.ops.control import ControlError, ask
from uavlinkd.config.keys import encode_key
from uavlinkd.lab.mitm.attack import AttackObject, Surroundings
from uavlinkd.lab.mitm.attacks import parse_attack
from uavlinkd.lab.mitm.proxy import Proxy
from uavlinkd.lab.mitm.proxy_settings import MitmLink, MitmPeer, ProxySettings
from uavlinkd.lab.sim.drone_process import free_udp_ports

HOST = "127.0.0.1"
START_S = 60.0


class MiddleError(Exception):
    """The man in the middle does not do what it was told. The message is for a person."""


@dataclass(frozen=True, slots=True)
class Interventions:
    """What it did so far, as its statistics say."""

    counts: Mapping[str, int] = field(default_factory=dict)
    """By "attack: what"."""
    bytes_to_strangers: int = 0
    """What was sent back to addresses of the attacker's own."""
    amplified: Mapping[str, int] = field(default_factory=dict)
    """By "peer to address of the attacker's own": bytes that came back beyond what lately went there."""

    def of(self, names: Sequence[str]) -> dict[str, int]:
        """Of these attacks."""
        return {key: count for key, count in self.counts.items() if key.partition(":")[0] in names}


def interventions(statistics: Mapping[str, Any]) -> Interventions:
    """From the statistics of a :class:`Proxy`."""
    strangers = statistics["strangers"]
    return Interventions(
        dict(statistics["interventions"]), int(strangers["bytes_back"]), dict(strangers["amplified"])
    )


class Middle(Protocol):
    """One of the two below."""

    @property
    def ports(self) -> Mapping[tuple[str, str], int]:
        """By peer and by whom it reaches there."""

    async def start(self, addresses: Mapping[str, int], public_keys: Mapping[str, bytes]) -> None:
        """Stand between peers, whose ports these are."""

    async def attack(self, specs: Sequence[str], objects: Sequence[AttackObject] = ()) -> None:
        """Do this from now on, and nothing of before."""

    async def statistics(self) -> Interventions:
        """What it did so far."""

    async def stop(self) -> None:
        """Leave."""


def _faces(names: Sequence[str]) -> dict[tuple[str, str], int]:
    pairs = [(one, other) for one in names for other in names if one != other]
    return dict(zip(pairs, free_udp_ports(len(pairs)), strict=True))


def _pairs(names: Sequence[str]) -> list[tuple[str, str]]:
    return [(one, other) for number, one in enumerate(names) for other in names[number + 1 :]]


class MiddleProcess:
    """``uavlink-mitm``, controlled by its socket. It writes every intervention to ``log``."""

    def __init__(self, names: Sequence[str], folder: Path, log: Path, seed: int) -> None:
        self.ports = _faces(names)
        self._names = tuple(names)
        self._socket = folder / "mitm.sock"
        self._log = log
        self._seed = seed
        self._process: asyncio.subprocess.Process | None = None

    async def start(self, addresses: Mapping[str, int], public_keys: Mapping[str, bytes]) -> None:
        """Start the process, and wait until it answers.

        Raises:
            MiddleError: it does not.
        """
        flags = ["--seed", str(self._seed), "--log", str(self._log), "--control-socket", str(self._socket)]
        for name, port in addresses.items():
            key = f",{encode_key(public_keys[name])}" if name in public_keys else ""
            flags += ["--peer", f"{name}={HOST}:{port}{key}"]
        for one, other in _pairs(self._names):
            here, there = self.ports[one, other], self.ports[other, one]
            flags += ["--link", f"{one}@{HOST}:{here},{other}@{HOST}:{there}"]
        self._process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "uavlinkd.lab.mitm", *flags),
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
        """Do this from now on.

        Raises:
            MiddleError: it is refused.
        """
        assert not objects, "attackers with keys stay out of uavlink-mitm"
        answer = await self._ask("attack " + (" ".join(specs) or "none"))
        if "refused" in answer:
            raise MiddleError(f"{' '.join(specs)}: {answer['refused']}")

    async def statistics(self) -> Interventions:
        """What it did so far."""
        return interventions(await self._ask("statistics"))

    async def _ask(self, request: str) -> dict[str, Any]:
        return await asyncio.to_thread(ask, self._socket, request)

    async def stop(self) -> None:
        """End the process."""
        if self._process is not None and self._process.returncode is None:
            self._process.send_signal(signal.SIGTERM)
            with suppress(TimeoutError):
                await asyncio.wait_for(self._process.wait(), 5.0)
            if self._process.returncode is None:
                self._process.kill()
                await self._process.wait()


class MiddleHere:
    """A :class:`Proxy` in this process."""

    def __init__(self, names: Sequence[str], log: Path | None, seed: int) -> None:
        self.ports = _faces(names)
        self._names = tuple(names)
        self._log = log
        self._seed = seed
        self._proxy: Proxy | None = None

    @property
    def proxy(self) -> Proxy:
        """Once it has started."""
        assert self._proxy is not None
        return self._proxy

    @property
    def surroundings(self) -> Surroundings:
        """What attacks know."""
        return self.proxy.surroundings

    async def start(self, addresses: Mapping[str, int], public_keys: Mapping[str, bytes]) -> None:
        """Stand between peers."""
        peers = tuple(MitmPeer(name, Address(HOST, port), public_keys.get(name)) for name, port in addresses.items())
        links = tuple(
            MitmLink(pair, (Address(HOST, self.ports[pair]), Address(HOST, self.ports[pair[::-1]])))
            for pair in _pairs(self._names)
        )
        proxy = Proxy(ProxySettings(peers, links, seed=self._seed, log=self._log), [])
        proxy.log = silent_log()
        await proxy.start()
        self._proxy = proxy

    async def attack(self, specs: Sequence[str], objects: Sequence[AttackObject] = ()) -> None:
        """Do this from now on."""
        now = monotonic()
        made = [
            parse_attack(text).make(self.surroundings, f"{self._seed} {position}", now)
            for position, text in enumerate(specs)
        ]
        self.proxy.change_attacks([*made, *objects])

    async def statistics(self) -> Interventions:
        """What it did so far."""
        return interventions(json.loads(json.dumps(self.proxy.statistics())))

    async def stop(self) -> None:
        """Leave."""
        if self._proxy is not None:
            await self._proxy.stop()
            self._proxy = None


def silent_log() -> Any:
    """A logger that says nothing: what the proxy does is told elsewhere."""
    return structlog.wrap_logger(structlog.ReturnLogger(), processors=[_drop_event])


def _drop_event(_logger: Any, _name: str, _event: Any) -> Any:
    raise structlog.DropEvent
