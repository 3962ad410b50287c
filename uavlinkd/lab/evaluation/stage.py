"""The stages of attacks: drones with their clients, the man in the middle between them, and a ledger of the frames.

:class:`DaemonStage` has real daemons, each a process; :class:`PaperStage` two ends of the paper's protocol. Both
continuously carry numbered frames in both directions.
"""

from __future__ import annotations

import asyncio
import json
import signal
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from time import monotonic
from typing import Any, Self

from uavlinkd.config.keys import decode_key, generate_psk
from uavlinkd.lab.evaluation.ledger import Ledger
from uavlinkd.lab.evaluation.middle import HOST, Clients, Middle, MiddleHere
from uavlinkd.lab.evaluation.paper_protocol import RENEW_S, PaperEnd, paper_pair
from uavlinkd.lab.evaluation.records import EvaluationError
from uavlinkd.lab.evaluation.tampering_records import OURS, PAPER
from uavlinkd.lab.mitm.attack import Direction
from uavlinkd.lab.sim.drone_process import DroneProcess
from uavlinkd.lab.sim.loopback_ports import free_ports
from uavlinkd.protocol.drops import LinkProblem

PATIENCE_S = 120.0
"""How long linking may take; 0.5 s on a quiet machine."""
_LOOK_S = 0.01
_TICK_S = 0.001
_MOST_A_TICK = 20
"""Frames that are sent at once after a pause of this process; the rest is never sent."""


async def until(condition: Callable[[], Awaitable[object]], problem: str, limit_s: float = PATIENCE_S) -> None:
    """Wait for a condition. Raises EvaluationError if it does not hold in time."""
    end = monotonic() + limit_s
    while not await condition():
        if monotonic() > end:
            raise EvaluationError(f"{problem} within {limit_s:g} s")
        await asyncio.sleep(_LOOK_S)


class Stage(ABC):
    """The base class of stages: traffic, the man in the middle, the drones' logs.

    Args:
        names: of the drones.
        middle: the man in the middle between them.
        ledger: of the frames. A drone's client sends frames if it has receivers there.
        rate_hz: frames per second of each sending client.
    """

    system = ""

    def __init__(self, names: Sequence[str], middle: Middle, ledger: Ledger, rate_hz: float) -> None:
        self.names = tuple(names)
        self.middle = middle
        self.ledger = ledger
        self.rate_hz = rate_hz
        self.receive: Callable[[str, bytes, float], None] = ledger.on_received
        """Gets what the clients receive: the name of the receiver, the datagram and the time."""
        self._traffic: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        try:
            await self.open()
            self._traffic = asyncio.create_task(self._talk())
            self.ledger.await_recovery(monotonic())
            await until(self._has_recovered, "no link")
        except BaseException:
            await self._end()
            raise
        return self

    async def _has_recovered(self) -> bool:
        return self.ledger.recovery_s is not None

    async def __aexit__(self, *_: object) -> None:
        await self._end()

    async def _end(self) -> None:
        if self._traffic is not None:
            self._traffic.cancel()
            await asyncio.gather(self._traffic, return_exceptions=True)
        await self.close()

    async def _talk(self) -> None:
        speakers = [name for name in self.names if self.ledger.audience[name]]
        begin, sent = monotonic(), 0
        while True:
            due = int((monotonic() - begin) * self.rate_hz)
            if due - sent > _MOST_A_TICK:
                sent = due - _MOST_A_TICK
            for _ in range(due - sent):
                for name in speakers:
                    self.send(name, self.ledger.next_frame(name, monotonic()))
            sent = due
            await asyncio.sleep(max(_TICK_S, 0.5 / self.rate_hz))

    @abstractmethod
    async def open(self) -> None:
        """Start all parts except the traffic."""

    @abstractmethod
    async def close(self) -> None:
        """Stop all parts except the traffic."""

    async def settle(self) -> None:
        """Wait until an attack may begin: nothing of the attack before it is left. Most stages need no pause."""
        return

    @abstractmethod
    def send(self, name: str, frame: bytes) -> None:
        """A drone's client sends a frame."""

    @abstractmethod
    async def notices(self) -> dict[str, Counter[str]]:
        """The counters of drops and link problems of each drone so far, by reason."""

    async def restart(self, name: str) -> None:
        """Simulate a power failure of one drone, if it has a state to lose. Return when it answers again."""
        del name

    def logs(self) -> dict[str, list[dict[str, Any]]]:
        """The parsed log lines of each drone so far."""
        return {name: [] for name in self.names}


class DaemonStage(Stage):
    """Real daemons. Each pair is linked through the man in the middle, with a PSK.

    Args:
        link: the ``[link]`` section of every daemon.
        silent: drones whose client neither sends nor receives frames, and that may send only as themselves.
    """

    system = OURS

    def __init__(
        self,
        names: Sequence[str],
        folder: Path,
        middle: Middle,
        link: Mapping[str, object],
        *,
        rate_hz: float,
        silent: Sequence[str] = (),
    ) -> None:
        speakers = [name for name in names if name not in silent]
        audience = {name: set(speakers) - {name} if name in speakers else set() for name in names}
        super().__init__(names, middle, Ledger(names, audience), rate_hz)
        ports = free_ports(2 * len(names))
        self.drones = {name: DroneProcess(name, folder / name, *ports[2 * n :][:2]) for n, name in enumerate(names)}
        self.psks: dict[frozenset[str], str] = {}
        self.link = link
        self._silent = frozenset(silent)
        self._clients = Clients(lambda name, datagram: self.receive(name, datagram, monotonic()))
        self._before: dict[str, Counter[str]] = {name: Counter() for name in names}

    @property
    def public_keys(self) -> dict[str, bytes]:
        return {name: decode_key(drone.public_key) for name, drone in self.drones.items()}

    async def open(self) -> None:
        """Configure and start the daemons, the man in the middle, and a client of each daemon."""
        for one in self.names:
            self.configure(one)
        await self.middle.start(*self.attacked())
        self._clients.open(self.names)
        for drone in self.drones.values():
            await drone.start()
        for drone in self.drones.values():
            await until(lambda drone=drone: self._is_up(drone), f"{drone.name} did not link")  # type: ignore[misc]

    def configure(self, one: str) -> None:
        """Write the configuration of a drone."""
        peers = [self._peer(one, other) for other in self.names if other != one]
        self.drones[one].configure(self.link, peers, self.networks(one), self.relays(one))

    def _peer(self, one: str, other: str) -> dict[str, object]:
        file = f"{other}.psk"
        self.drones[one].share_psk(self.psks.setdefault(frozenset((one, other)), generate_psk()), file)
        settings = {"addresses": self.addresses(one, other), **self.rules(one, other)}
        return self.drones[other].as_peer("", file, **settings)

    async def _is_up(self, drone: DroneProcess) -> bool:
        if not await drone.ask():
            return False
        states = [drone.status["peers"].get(name, {}).get("state") for name in self.names if name != drone.name]
        return set(states) == {"up"}

    def attacked(self) -> tuple[dict[str, int], dict[str, bytes]]:
        """The ports and public keys of what the man in the middle is between, by name."""
        return {name: drone.port for name, drone in self.drones.items()}, self.public_keys

    def addresses(self, one: str, other: str) -> list[object]:
        """The addresses where one drone reaches another: in front of the man in the middle."""
        ways = self.middle.ports.items()
        return [f"{HOST}:{port}" for way, port in ways if (way.sender, way.receiver) == (one, other)]

    def networks(self, name: str) -> list[dict[str, object]]:
        """The networks of a drone; by default none is configured."""
        del name
        return []

    def relays(self, name: str) -> list[dict[str, object]]:
        """The relays of a drone; by default it uses none."""
        del name
        return []

    def rules(self, one: str, other: str) -> dict[str, object]:
        rules: dict[str, object] = {}
        if self._silent:
            rules["system_ids"] = [self.names.index(other) + 1]
        if {one, other} & self._silent:
            rules["rate_out"] = {"ATTITUDE": 0, "HEARTBEAT": 0}
        return rules

    async def close(self) -> None:
        await asyncio.gather(*(drone.stop() for drone in self.drones.values()))
        await self.middle.stop()
        self._clients.close()

    def send(self, name: str, frame: bytes) -> None:
        self._clients.send(name, frame, self.drones[name].endpoint_port)

    async def notices(self) -> dict[str, Counter[str]]:
        """The counters of each daemon's status, with those before a restart."""
        return {name: self._before[name] + _counters(await drone.ask()) for name, drone in self.drones.items()}

    async def restart(self, name: str) -> None:
        """Kill the daemon and restart it."""
        drone = self.drones[name]
        self._before[name] += _counters(await drone.ask())
        await drone.stop(signal.SIGKILL)
        await asyncio.sleep(0.4)  # long enough for replay attacks to detect the restart
        drone.status = {}
        await drone.start()
        await until(drone.ask, f"{name} did not start again")

    def logs(self) -> dict[str, list[dict[str, Any]]]:
        """The parsed JSON lines, and other lines as events."""
        return {
            name: [_parsed(line) for line in drone.last_lines(1 << 20)] if drone.log.exists() else []
            for name, drone in self.drones.items()
        }


def _parsed(line: str) -> dict[str, Any]:
    try:
        fields = json.loads(line)
    except ValueError:
        return {"event": line}
    return fields if isinstance(fields, dict) else {"event": line}


def _counters(status: Mapping[str, Any]) -> Counter[str]:
    counters: Counter[str] = Counter(status.get("drops", {}))
    for peer in status.get("peers", {}).values():
        counters.update(peer["drops"])
        counters.update({sign: peer[sign] for sign in LinkProblem if peer[sign]})
        for reasons in peer["refused"]["in"].values():
            counters.update({f"refused_{reason}": count for reason, count in reasons.items()})
    for network in status.get("networks", {}).values():
        if network["serial"] is not None:
            counters["line_noise"] += network["serial"]["line_noise"]
    return counters


class PaperStage(Stage):
    """Two ends of the paper's protocol. A restart would lose nothing: its keys change every ``renew_s`` seconds."""

    system = PAPER

    def __init__(
        self, names: Sequence[str], middle: MiddleHere, *, rate_hz: float, renew_s: float | None = RENEW_S
    ) -> None:
        super().__init__(names, middle, Ledger(names), rate_hz)
        self.ends: dict[str, PaperEnd] = {}
        self._renew_s = renew_s

    async def open(self) -> None:
        self.ends = paper_pair(self.names, lambda name, frame: self.receive(name, frame, monotonic()), self._renew_s)
        await self.middle.start({name: end.port for name, end in self.ends.items()}, {})
        for one, other in (self.names, self.names[::-1]):
            self.ends[one].start((HOST, self.middle.ports[Direction(one, other)]))

    async def close(self) -> None:
        for end in self.ends.values():
            end.close()
        await self.middle.stop()

    def send(self, name: str, frame: bytes) -> None:
        self.ends[name].send(frame)

    async def notices(self) -> dict[str, Counter[str]]:
        return {name: Counter(end.counters) for name, end in self.ends.items()}
