"""The links between both aircraft of a flight: plain MAVLink, the paper's protocol, and two daemons.

Each link has a man in the middle of its own. The attacks are the same, except in the exchange of keys, which differs.
"""

from __future__ import annotations

import asyncio
import socket
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from time import monotonic

from uavlinkd.config.keys import decode_key, generate_psk
from uavlinkd.lab.evaluation.flight_attacks import DisplaceOptions, DisplacePositions, Drift, ExchangeWatch
from uavlinkd.lab.evaluation.flight_plan import (
    ALTERED_SHARE,
    PAIR,
    SYSTEM_IDS,
    AttackPhase,
    FlightSettings,
    LinkKind,
)
from uavlinkd.lab.evaluation.middle import HOST, MiddleHere
from uavlinkd.lab.evaluation.paper_attacks import PaperRelay
from uavlinkd.lab.evaluation.paper_protocol import VERIFIED, PaperEnd
from uavlinkd.lab.mitm.attack import AttackObject, Direction
from uavlinkd.lab.sim.drone_process import DroneProcess
from uavlinkd.lab.sim.loopback_ports import free_ports
from uavlinkd.mavlink.frames import SplitCounters, split_datagram
from uavlinkd.ops.link_problems import LinkProblem

OnDelivered = Callable[[str, bytes], None]
"""Called with the name of the receiver and a frame."""

_DATAGRAM_BYTES = 65536
_DRIFT = DisplaceOptions.model_validate({"share": ALTERED_SHARE})


@dataclass(frozen=True, slots=True)
class LinkNotice:
    """What both ends of a link noticed so far."""

    counts: Counter[str] = field(default_factory=Counter)
    """Refused datagrams and link problems, by reason."""
    state: str = ""
    """What a daemon reports of its link at this moment; empty if nothing is wrong, or if an end cannot tell."""


class PositionLink(ABC):
    """A link with its man in the middle. ``open`` it in flight, ``close`` it last."""

    kind: LinkKind

    def __init__(self, settings: FlightSettings, log: Path) -> None:
        log.unlink(missing_ok=True)  # of an earlier run
        self.settings = settings
        self.middle = MiddleHere(PAIR, log, settings.seed)
        self.watch = ExchangeWatch()

    @abstractmethod
    async def open(self) -> None:
        """Start the link, and in a secured one the exchange of keys."""

    @abstractmethod
    async def close(self) -> None:
        """Stop."""

    @abstractmethod
    def send(self, name: str, frame: bytes) -> None:
        """An aircraft sends a frame to the other."""

    async def notice(self) -> LinkNotice:
        """What both ends noticed so far."""
        return LinkNotice()

    async def attack(self, phase: AttackPhase) -> None:
        """Begin a phase. The attacks of the phase before end; what they hold is lost."""
        specs: dict[AttackPhase, str] = {
            AttackPhase.REPLAY: f"duplicate,when=later,delay_s={self.settings.replay_delay_s:g}",
            AttackPhase.HOLD: f"hold,kinds=any,hold_s={self.settings.hold_s:g}",
            AttackPhase.DROP: "drop",
        }
        if phase in specs:
            await self.middle.attack([specs[phase]])
        elif phase is AttackPhase.ALTER:
            await self.middle.attack([], [self.displacement()])
        elif phase is AttackPhase.KEYS:
            await self.replace_keys()
        else:
            await self.middle.attack([])

    def displacement(self) -> AttackObject:
        """The attack that moves positions, without a key."""
        rng = Random(f"displace {self.settings.seed}")  # noqa: S311  not a secret
        return DisplacePositions(_DRIFT, self.middle.context, rng, monotonic())

    async def replace_keys(self) -> None:
        """Attack the exchange of keys, if there is one, and move positions."""
        await self.middle.attack([], [self.displacement()])

    async def interventions(self) -> int:
        """Datagrams that the attacker altered, dropped, held or injected so far."""
        return sum((await self.middle.statistics()).counts.values())


class _Clients:
    """One UDP socket for each aircraft."""

    def __init__(self, on_delivered: OnDelivered) -> None:
        self._deliver = on_delivered
        self._split = SplitCounters()
        self._loop = asyncio.get_running_loop()
        self._sockets: dict[str, socket.socket] = {}
        for name in PAIR:
            sock = self._sockets[name] = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            sock.setblocking(False)
            sock.bind((HOST, 0))
            self._loop.add_reader(sock, self._on_readable, name, sock)

    @property
    def ports(self) -> dict[str, int]:
        """By aircraft."""
        return {name: int(sock.getsockname()[1]) for name, sock in self._sockets.items()}

    def send(self, name: str, frame: bytes, port: int) -> None:
        """Send a datagram to a port of loopback."""
        with suppress(OSError):  # an earlier one was refused: the other end is starting
            self._sockets[name].sendto(frame, (HOST, port))

    def close(self) -> None:
        """Close the sockets."""
        for sock in self._sockets.values():
            self._loop.remove_reader(sock)
            sock.close()

    def _on_readable(self, name: str, sock: socket.socket) -> None:
        with suppress(OSError):
            # A daemon may deliver several frames in one datagram.
            for frame in split_datagram(sock.recv(_DATAGRAM_BYTES), self._split):
                self._deliver(name, frame.raw)


class PlainLink(PositionLink):
    """Frames as they are, over UDP."""

    kind = LinkKind.PLAIN

    def __init__(self, settings: FlightSettings, log: Path, on_delivered: OnDelivered) -> None:
        super().__init__(settings, log)
        self._clients = _Clients(on_delivered)

    async def open(self) -> None:
        """Start the man in the middle."""
        await self.middle.start(self._clients.ports, {})

    async def close(self) -> None:
        """Close the sockets."""
        self._clients.close()
        await self.middle.stop()

    def send(self, name: str, frame: bytes) -> None:
        """Send a frame."""
        (other,) = set(PAIR) - {name}
        self._clients.send(name, frame, self.middle.ports[Direction(name, other)])


class PaperLink(PositionLink):
    """The paper's protocol: one exchange of keys in flight, then an HMAC for each frame."""

    kind = LinkKind.PAPER

    def __init__(self, settings: FlightSettings, log: Path, on_delivered: OnDelivered) -> None:
        super().__init__(settings, log)
        self._is_relayed = False
        self._ends = {
            name: PaperEnd(
                name,
                is_initiator=name == PAIR[0],
                on_frame=lambda frame, name=name: on_delivered(name, frame),  # type: ignore[misc]
                report=lambda _reason, _meaning: None,
                renew_s=None,
            )
            for name in PAIR
        }

    async def open(self) -> None:
        """Start both ends; the first one initiates."""
        await self.middle.start({name: end.port for name, end in self._ends.items()}, {})
        await self.middle.attack([], [self.watch])
        for one, other in (PAIR, PAIR[::-1]):
            self._ends[one].start((HOST, self.middle.ports[Direction(one, other)]))

    async def close(self) -> None:
        """Stop both ends."""
        for end in self._ends.values():
            end.close()
        await self.middle.stop()

    def send(self, name: str, frame: bytes) -> None:
        """Send a frame with its HMAC."""
        self._ends[name].send(frame)

    async def notice(self) -> LinkNotice:
        """The counters of both ends."""
        counts = Counter[str]()
        for end in self._ends.values():
            counts.update({reason: count for reason, count in end.counters.items() if reason != VERIFIED})
        return LinkNotice(counts)

    async def attack(self, phase: AttackPhase) -> None:
        """After an attack on an exchange, exchange keys again: otherwise no frame would be accepted any more."""
        await super().attack(phase)
        if self._is_relayed and phase is not AttackPhase.KEYS:
            self._is_relayed = False
            self._ends[PAIR[0]].renew()

    async def replace_keys(self) -> None:
        """Exchange keys again, with the attacker between both ends."""
        drift = Drift(_DRIFT.step_m, _DRIFT.limit_m)
        await self.middle.attack([], [PaperRelay(drift.move)])
        self._is_relayed = True
        self._ends[PAIR[0]].renew()


class DaemonLink(PositionLink):
    """Two daemons, each a process. They start in flight, and exchange keys again and again."""

    kind = LinkKind.OURS

    def __init__(self, settings: FlightSettings, log: Path, on_delivered: OnDelivered, folder: Path) -> None:
        super().__init__(settings, log)
        self._clients = _Clients(on_delivered)
        ports = free_ports(2 * len(PAIR))
        self._drones = {
            name: DroneProcess(name, folder / name, ports[2 * number], ports[2 * number + 1])
            for number, name in enumerate(PAIR)
        }

    async def open(self) -> None:
        """Start both daemons, which then link."""
        keys = {name: decode_key(drone.public_key) for name, drone in self._drones.items()}
        await self.middle.start({name: drone.port for name, drone in self._drones.items()}, keys)
        await self.middle.attack([], [self.watch])
        psk = generate_psk()
        link: Mapping[str, object] = {"rekey_after_s": self.settings.rekey_after_s}
        for one, other in (PAIR, PAIR[::-1]):
            drone, peer = self._drones[one], self._drones[other]
            drone.share_psk(psk, "pair.psk")
            address = f"{HOST}:{self.middle.ports[Direction(one, other)]}"
            rules: dict[str, object] = {"role": "swarm-member", "system_ids": [SYSTEM_IDS[other]]}
            drone.configure(link, [peer.as_peer(address, "pair.psk", **rules)])
        for drone in self._drones.values():
            await drone.start()

    async def close(self) -> None:
        """Stop both daemons."""
        await asyncio.gather(*(drone.stop() for drone in self._drones.values()))
        self._clients.close()
        await self.middle.stop()

    def send(self, name: str, frame: bytes) -> None:
        """Send a frame to the daemon's endpoint."""
        self._clients.send(name, frame, self._drones[name].endpoint_port)

    async def notice(self) -> LinkNotice:
        """The counters of both daemons, and the worst state of their links."""
        counts = Counter[str]()
        states = []
        for drone in self._drones.values():
            status = await drone.ask()
            counts.update(status.get("drops", {}))
            for peer in drone.peer_statuses:
                counts.update(peer["drops"])
                counts.update({problem.value: peer[problem] for problem in LinkProblem if peer[problem]})
                if peer["state"] != "up":
                    states.append("link down")
                elif peer["freshness_unverified_s"] is not None:
                    states.append("freshness unverified")
        return LinkNotice(counts, min(states, default="", key=lambda state: state != "link down"))

    async def replace_keys(self) -> None:
        """Replace the public keys of each handshake; the daemons begin one meanwhile."""
        await self.middle.attack(["replace-key"], [self.displacement()])
