"""The links between both aircraft of a flight: plain MAVLink, the paper's protocol, and two daemons.

Each link has a man in the middle of its own. The attacks are the same, except in the exchange of keys, which differs.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from time import monotonic

from uavlinkd.config.keys import decode_key, generate_psk
from uavlinkd.lab.evaluation.flight_plan import (
    ALTERED_SHARE,
    PAIR,
    SYSTEM_IDS,
    AttackPhase,
    DisplacePositions,
    Drift,
    FlightSettings,
    LinkKind,
)
from uavlinkd.lab.evaluation.middle import HOST, Clients, MiddleHere
from uavlinkd.lab.evaluation.paper_attacks import PaperRelay
from uavlinkd.lab.evaluation.paper_protocol import PaperEnd, paper_pair
from uavlinkd.lab.mitm.attack import AttackObject, Direction
from uavlinkd.lab.sim.drone_process import DroneProcess
from uavlinkd.lab.sim.loopback_ports import free_ports
from uavlinkd.mavlink.frames import SplitCounters, split_datagram
from uavlinkd.ops.findings import LinkProblem

OnDelivered = Callable[[str, bytes], None]
"""Called with the name of the receiver and a frame."""

_HALF = DisplacePositions.options_model.model_validate({"share": ALTERED_SHARE})
_WAYS = (PAIR, PAIR[::-1])


@dataclass(frozen=True, slots=True)
class LinkNotice:
    """What both ends of a link noticed so far."""

    counts: Counter[str] = field(default_factory=Counter)
    """Refused datagrams and link problems, by reason."""
    state: str = ""
    """What a daemon reports of its link at this moment; empty if nothing is wrong, or if an end cannot tell."""


class PlainLink:
    """Frames as they are, over UDP. ``open`` it in flight, ``close`` it last. The other links derive from it."""

    kind = LinkKind.PLAIN

    def __init__(self, settings: FlightSettings, log: Path, on_delivered: OnDelivered) -> None:
        log.unlink(missing_ok=True)  # of an earlier run
        self.settings = settings
        self.middle = MiddleHere(PAIR, log, settings.seed)
        self._on_delivered = on_delivered
        self._clients = Clients(self._on_datagram)

    async def open(self) -> None:
        """Start the link, and in a secured one the exchange of keys."""
        self._clients.open(PAIR)
        await self.middle.start(self._clients.ports, {})

    def _on_datagram(self, name: str, datagram: bytes) -> None:
        # A daemon may deliver several frames in one datagram.
        for frame in split_datagram(datagram, SplitCounters()):
            self._on_delivered(name, frame.raw)

    async def close(self) -> None:
        self._clients.close()
        await self.middle.stop()

    def send(self, name: str, frame: bytes) -> None:
        """An aircraft sends a frame to the other."""
        self._clients.send(name, frame, self._port(name))

    def _port(self, name: str) -> int:
        (other,) = set(PAIR) - {name}
        return self.middle.ports[Direction(name, other)]

    async def notice(self) -> LinkNotice:
        """What both ends noticed so far."""
        return LinkNotice()

    async def attack(self, phase: AttackPhase) -> None:
        """Begin a phase. The attacks of the phase before end; what they hold is lost."""
        specs = {
            AttackPhase.REPLAY: [f"duplicate,when=later,delay_s={self.settings.replay_delay_s:g}"],
            AttackPhase.HOLD: [f"hold,kinds=any,hold_s={self.settings.hold_s:g}"],
            AttackPhase.DROP: ["drop"],
        }
        if phase is AttackPhase.KEYS:
            await self.replace_keys()
        else:
            await self.middle.attack(
                specs.get(phase, []), [self.displacement()] if phase is AttackPhase.ALTER else []
            )

    def displacement(self) -> AttackObject:
        rng = Random(f"displace {self.settings.seed}")  # noqa: S311  not a secret
        return DisplacePositions(_HALF, self.middle.context, rng, monotonic())

    async def replace_keys(self) -> None:
        """Attack the exchange of keys, if there is one, and move positions."""
        await self.middle.attack([], [self.displacement()])


class PaperLink(PlainLink):
    """The paper's protocol: one exchange of keys in flight, then an HMAC for each frame."""

    kind = LinkKind.PAPER
    _ends: Mapping[str, PaperEnd] = {}
    _is_relayed = False

    async def open(self) -> None:
        """Start both ends; the first one initiates."""
        self._ends = paper_pair(PAIR, self._on_delivered, renew_s=None)
        await self.middle.start({name: end.port for name, end in self._ends.items()}, {})
        for name, end in self._ends.items():
            end.start((HOST, self._port(name)))

    async def close(self) -> None:
        for end in self._ends.values():
            end.close()
        await super().close()

    def send(self, name: str, frame: bytes) -> None:
        self._ends[name].send(frame)

    async def notice(self) -> LinkNotice:
        return LinkNotice(sum((end.counters for end in self._ends.values()), Counter[str]()))

    async def attack(self, phase: AttackPhase) -> None:
        """After an attack on an exchange, exchange keys again: otherwise no frame would be accepted any more."""
        await super().attack(phase)
        if self._is_relayed and phase is not AttackPhase.KEYS:
            self._is_relayed = False
            self._ends[PAIR[0]].renew()

    async def replace_keys(self) -> None:
        """Exchange keys again, with the attacker between both ends."""
        await self.middle.attack([], [PaperRelay(Drift().move)])
        self._is_relayed = True
        self._ends[PAIR[0]].renew()


class DaemonLink(PlainLink):
    """Two daemons, each a process. They start in flight, and exchange keys again and again."""

    kind = LinkKind.OURS

    def __init__(self, settings: FlightSettings, log: Path, on_delivered: OnDelivered, folder: Path) -> None:
        super().__init__(settings, log, on_delivered)
        ports = free_ports(2 * len(PAIR))
        self._drones = {name: DroneProcess(name, folder / name, *ports[2 * n :][:2]) for n, name in enumerate(PAIR)}

    async def open(self) -> None:
        """Start both daemons, which then link."""
        self._clients.open(PAIR)
        keys = {name: decode_key(drone.public_key) for name, drone in self._drones.items()}
        await self.middle.start({name: drone.port for name, drone in self._drones.items()}, keys)
        psk = generate_psk()
        for one, other in _WAYS:
            drone = self._drones[one]
            drone.share_psk(psk, "pair.psk")
            rules: dict[str, object] = {"role": "swarm-member", "system_ids": [SYSTEM_IDS[other]]}
            peer = self._drones[other].as_peer(f"{HOST}:{super()._port(one)}", "pair.psk", **rules)
            drone.configure({"rekey_after_s": self.settings.rekey_after_s}, [peer])
            await drone.start()

    async def close(self) -> None:
        await asyncio.gather(*(drone.stop() for drone in self._drones.values()))
        await super().close()

    def _port(self, name: str) -> int:
        return self._drones[name].endpoint_port

    async def notice(self) -> LinkNotice:
        """The counters of both daemons, and the state of their link."""
        counts, states = Counter[str](), []
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
