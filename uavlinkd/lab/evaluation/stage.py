"""The stages of attacks: drones with their clients, the man in the middle between them, and a ledger of the frames.

:class:`DaemonStage` has real daemons, each a process; :class:`PaperStage` two ends of the paper's protocol. Both
continuously carry numbered frames in both directions.
"""

from __future__ import annotations

import asyncio
import json
import signal
import socket
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from time import monotonic
from typing import Any, Self

from uavlinkd.config.keys import decode_key, generate_psk
from uavlinkd.lab.evaluation.ledger import Ledger
from uavlinkd.lab.evaluation.middle import Middle, MiddleHere
from uavlinkd.lab.evaluation.paper_protocol import VERIFIED, PaperEnd
from uavlinkd.lab.mitm.attack import Direction
from uavlinkd.lab.sim.drone_process import DroneProcess
from uavlinkd.lab.sim.loopback_ports import free_ports
from uavlinkd.ops.link_problems import LinkProblem

LINK_UP_S = 120.0
"""How long linking may take; 0.5 s on a quiet machine."""
_LOOK_S = 0.01
_DATAGRAM_BYTES = 65536
_LOG_INTERVAL_S = 1.0
_TICK_S = 0.001
_MOST_A_TICK = 20
"""Frames that are sent at once after a pause of this process; the rest is never sent."""


class StageError(Exception):
    """The drones did not link. The message is for the operator."""


@dataclass(frozen=True, slots=True)
class Notice:
    """The counters of one drone, by reason, and figures of its link."""

    drops: Counter[str] = field(default_factory=Counter)
    figures: Counter[str] = field(default_factory=Counter)

    def since(self, before: Notice) -> Notice:
        """The difference to an earlier notice. Counters that were reset count from zero."""
        return Notice(self.drops - before.drops, self.figures - before.figures)

    def plus(self, other: Notice) -> Notice:
        """The sum of both."""
        return Notice(self.drops + other.drops, self.figures + other.figures)


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
        self.speakers = tuple(name for name in names if ledger.audience[name])
        self.unwritten: dict[str, set[str]] = {name: set() for name in names}
        """By drone: what a killed daemon counted. It logs its totals when it stops."""
        self._traffic: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        try:
            await self.open()
            self._traffic = asyncio.create_task(self._talk())
            await self._until_linked()
        except BaseException:
            await self._end()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._end()

    async def _end(self) -> None:
        if self._traffic is not None:
            self._traffic.cancel()
            await asyncio.gather(self._traffic, return_exceptions=True)
        await self.close()

    async def _until_linked(self) -> None:
        begin = monotonic()
        self.ledger.await_recovery(begin)
        while self.ledger.recovery_s is None:
            if monotonic() > begin + LINK_UP_S:
                raise StageError(f"no link within {LINK_UP_S:g} s: {await self.notices()}")
            await asyncio.sleep(_LOOK_S)

    async def _talk(self) -> None:
        begin, sent = monotonic(), 0
        while True:
            due = int((monotonic() - begin) * self.rate_hz)
            if due - sent > _MOST_A_TICK:
                sent = due - _MOST_A_TICK
            for _ in range(due - sent):
                for name in self.speakers:
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
    async def notices(self) -> dict[str, Notice]:
        """The counters of each drone so far."""

    @abstractmethod
    async def restart(self, name: str) -> None:
        """Simulate a power failure of one drone. Return when it answers again."""

    @abstractmethod
    def logs(self) -> dict[str, list[dict[str, Any]]]:
        """The parsed log lines of each drone so far."""


class DaemonStage(Stage):
    """Real daemons. Each pair is linked through the man in the middle, with a PSK.

    Args:
        link: the ``[link]`` section of every daemon.
        silent: drones whose client neither sends nor receives frames, and that may send only as themselves.
    """

    system = "uavlinkd"

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
        self.drones = {
            name: DroneProcess(name, folder / name, ports[2 * number], ports[2 * number + 1])
            for number, name in enumerate(names)
        }
        self.psks: dict[frozenset[str], str] = {}
        self._link = link
        self._silent = frozenset(silent)
        self._clients: dict[str, socket.socket] = {}
        self._before: dict[str, Notice] = {name: Notice() for name in names}

    @property
    def public_keys(self) -> dict[str, bytes]:
        """The public keys of the drones."""
        return {name: decode_key(drone.public_key) for name, drone in self.drones.items()}

    async def open(self) -> None:
        """Configure and start the daemons, the man in the middle, and a client of each daemon."""
        self._configure()
        await self.middle.start(*self.attacked())
        loop = asyncio.get_running_loop()
        for name in self.names:
            sock = self._clients[name] = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            sock.setblocking(False)
            sock.bind(("127.0.0.1", 0))
            loop.add_reader(sock, self._on_readable, name, sock)
        for drone in self.drones.values():
            await drone.start()
        await self._until_up(*self.names)

    def attacked(self) -> tuple[dict[str, int], dict[str, bytes]]:
        """The ports and public keys of what the man in the middle is between, by name."""
        return {name: drone.port for name, drone in self.drones.items()}, self.public_keys

    def _configure(self) -> None:
        for one in self.names:
            peers = []
            for other in self.names:
                if one == other:
                    continue
                pair = frozenset((one, other))
                psk = self.psks.setdefault(pair, generate_psk())
                file = f"{other}.psk"
                self.drones[one].share_psk(psk, file)
                settings = {"addresses": self.addresses(one, other), **self.rules(one, other)}
                peers.append(self.drones[other].as_peer("", file, **settings))
            self.drones[one].configure(self._link, peers, self.networks(one), self.relays(one))

    def addresses(self, one: str, other: str) -> list[object]:
        """The addresses where one drone reaches another: in front of the man in the middle."""
        return [
            f"127.0.0.1:{port}"
            for direction, port in self.middle.ports.items()
            if (direction.sender, direction.receiver) == (one, other)
        ]

    def networks(self, name: str) -> list[dict[str, object]]:
        """The networks of a drone; by default none is configured."""
        del name
        return []

    def relays(self, name: str) -> list[dict[str, object]]:
        """The relays of a drone; by default it uses none."""
        del name
        return []

    def rules(self, one: str, other: str) -> dict[str, object]:
        """The policy of one drone for another."""
        rules: dict[str, object] = {}
        if self._silent:
            rules["system_ids"] = [self.names.index(other) + 1]
        if {one, other} & self._silent:
            rules["deny_out"] = ["ATTITUDE", "HEARTBEAT"]
        return rules

    async def _until_up(self, *names: str) -> None:
        begin = monotonic()
        waiting = [self.drones[name] for name in names]
        while waiting:
            for drone in list(waiting):
                await drone.ask()
                if drone.peer_statuses and all(status["state"] == "up" for status in drone.peer_statuses):
                    waiting.remove(drone)
            if monotonic() > begin + LINK_UP_S:
                lines = "\n".join(line for drone in waiting for line in drone.last_lines(3))
                raise StageError(f"the daemons did not link within {LINK_UP_S:g} s; their last log lines:\n{lines}")
            await asyncio.sleep(_LOOK_S)

    async def close(self) -> None:
        """Stop all processes."""
        await asyncio.gather(*(drone.stop() for drone in self.drones.values()))
        await self.middle.stop()
        loop = asyncio.get_running_loop()
        for sock in self._clients.values():
            loop.remove_reader(sock)
            sock.close()

    def send(self, name: str, frame: bytes) -> None:
        """Send a frame to the daemon's endpoint."""
        with suppress(OSError):  # its daemon is being restarted
            self._clients[name].sendto(frame, ("127.0.0.1", self.drones[name].endpoint_port))

    def _on_readable(self, name: str, sock: socket.socket) -> None:
        now = monotonic()
        for _ in range(64):
            try:
                datagram = sock.recv(_DATAGRAM_BYTES)
            except BlockingIOError:
                return
            except OSError:
                continue
            self.ledger.on_received(name, datagram, now)

    async def notices(self) -> dict[str, Notice]:
        """The counters of each daemon's status, with those before a restart."""
        return {name: self._before[name].plus(_notice(await drone.ask())) for name, drone in self.drones.items()}

    async def restart(self, name: str) -> None:
        """Kill the daemon and restart it."""
        drone = self.drones[name]
        notice = _notice(await drone.ask())
        self._before[name] = self._before[name].plus(notice)
        self.unwritten[name] |= set(notice.drops)
        await drone.stop(signal.SIGKILL)
        await asyncio.sleep(0.4)  # long enough for replay attacks to detect the restart
        drone.status = {}
        await drone.start()
        begin = monotonic()
        while not await drone.ask():
            if monotonic() > begin + LINK_UP_S:
                raise StageError(f"{name} did not start again within {LINK_UP_S:g} s")
            await asyncio.sleep(_LOOK_S)

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


def _notice(status: Mapping[str, Any]) -> Notice:
    drops: Counter[str] = Counter(status.get("drops", {}))
    figures: Counter[str] = Counter()
    for peer in status.get("peers", {}).values():
        drops.update(peer["drops"])
        figures["handshakes"] += peer["handshakes"]
        figures["envelopes_received"] += peer["envelopes_received"]
        drops.update({sign: peer[sign] for sign in LinkProblem if peer[sign]})
        for reasons in peer["refused"]["in"].values():
            for reason, count in reasons.items():
                drops[f"refused_{reason}"] += count
    for network in status.get("networks", {}).values():
        if network["serial"] is not None:
            drops["line_noise"] += network["serial"]["line_noise"]
    return Notice(drops, figures)


class PaperStage(Stage):
    """Two ends of the paper's protocol."""

    system = "paper"

    def __init__(self, names: Sequence[str], middle: MiddleHere, *, rate_hz: float) -> None:
        super().__init__(names, middle, Ledger(names), rate_hz)
        self.ends: dict[str, PaperEnd] = {}
        self._lines: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
        self._reported: Counter[tuple[str, str]] = Counter()
        self._quiet_until: dict[tuple[str, str], float] = {}

    async def open(self) -> None:
        """Start both ends and the man in the middle."""
        for number, name in enumerate(self.names):
            self.ends[name] = PaperEnd(
                name,
                is_initiator=number == 0,
                on_frame=lambda frame, name=name: self.ledger.on_received(name, frame, monotonic()),  # type: ignore[misc]
                report=lambda reason, meaning, name=name: self._report(name, reason, meaning),  # type: ignore[misc]
            )
        await self.middle.start({name: end.port for name, end in self.ends.items()}, {})
        for one, other in (self.names, self.names[::-1]):
            self.ends[one].start(("127.0.0.1", self.middle.ports[Direction(one, other)]))

    async def close(self) -> None:
        """Stop."""
        for end in self.ends.values():
            end.close()
        await self.middle.stop()

    def send(self, name: str, frame: bytes) -> None:
        """Send a frame with its HMAC."""
        self.ends[name].send(frame)

    async def notices(self) -> dict[str, Notice]:
        """The counters of both ends."""
        return {
            name: Notice(Counter(end.counters), Counter(exchanges=end.exchanges)) for name, end in self.ends.items()
        }

    async def restart(self, name: str) -> None:
        """Do nothing: an end has no state that a restart would lose, and its keys change continually."""

    def logs(self) -> dict[str, list[dict[str, Any]]]:
        """The reported events of both ends."""
        return self._lines

    def _report(self, name: str, reason: str, meaning: str) -> None:
        # As in the daemon's log: one line immediately, then one per second.
        self._reported[name, reason] += 1
        now = monotonic()
        if now < self._quiet_until.get((name, reason), now):
            return
        self._quiet_until[name, reason] = now + _LOG_INTERVAL_S
        event = "data_verified" if reason == VERIFIED else "tampering_detected"
        stamp = datetime.now(UTC).isoformat().replace("+00:00", "Z")
        facts = {"reason": reason, "count": self._reported[name, reason], "meaning": meaning, "timestamp": stamp}
        self._lines[name].append({"event": event, **facts})
