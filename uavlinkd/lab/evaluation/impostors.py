"""Attackers with keys against real daemons: with their own keys, stolen ones, or those of a captured drone.

Each is a :class:`~uavlinkd.protocol.node.Node`, so the attacker follows the protocol: it retries, answers cookies and
confirms sessions. If it gets no session, the reason is the daemon's check.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import cycle, islice
from time import monotonic

from uavlinkd.config.keys import decode_key
from uavlinkd.lab.evaluation.ledger import numbered_frame
from uavlinkd.lab.evaluation.paper_attacks import PaperRelay
from uavlinkd.lab.evaluation.stage import DaemonStage
from uavlinkd.lab.evaluation.tampering_bench import Bench, KeyHolder
from uavlinkd.lab.evaluation.tampering_plan import KEYS, TrialPlan
from uavlinkd.lab.evaluation.tampering_records import RELAY
from uavlinkd.lab.mitm.anatomy import DatagramKind, kind_of
from uavlinkd.lab.mitm.attack import NEVER, Action, Direction, Intervention, Operation, PassiveAttack, Send
from uavlinkd.protocol import wire
from uavlinkd.protocol.constants import FEATURE_FLEET, FEATURE_RECORDS, PROBLEMS_PER_REPORT, REFUSALS_PER_REPORT
from uavlinkd.protocol.cookie import MacKeys
from uavlinkd.protocol.crypto import KeyPair, Secret
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Deliver, Output, SessionEstablished, Transmit
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.relay_records import FleetRecord
from uavlinkd.protocol.send import send_payloads
from uavlinkd.protocol.session import Session
from uavlinkd.protocol.settings import Class, Link, PeerSettings, Timers
from uavlinkd.protocol.suites import X25519
from uavlinkd.protocol.wire import ProblemReport, RefusalReport, Refused

RETRY_S = 0.02
"""How often the attacker initiates, much faster than a daemon, and how often it sends frames."""
REPORTS_AT_ONCE = 4
_PATH = Path(0, ("192.0.2.1", 1))


class StolenIdentity(KeyPair):
    """A public key without its private key, and the secrets that an attacker can compute for it.

    With the static private key of ``victim``, the attacker can compute the static-static secret between the two.
    """

    __slots__ = ("_thief", "_victim")

    def __init__(self, public: bytes, thief: KeyPair, victim: KeyPair | None) -> None:
        self.public = public
        self._thief = thief
        self._victim = victim

    def exchange(self, public: bytes) -> bytes:
        """The secret with the owner of ``public``, if the attacker can compute it; otherwise a wrong one."""
        if self._victim is not None and public == self._victim.public:
            return self._victim.exchange(self.public)
        return self._thief.exchange(public)


class ThievingNode(Node):
    """A node that claims another identity."""

    def __init__(self, identity: KeyPair, now: float) -> None:
        super().__init__(Secret(os.urandom(32)), os.urandom, now)
        self._handshakes.identity, self._handshakes.cookies.keys = identity, MacKeys(identity.public)


@dataclass(frozen=True, slots=True)
class Disguise:
    """The identity and the keys that the attacker uses against one victim."""

    victim: str
    victim_key: bytes
    pose: str
    """The peer whose address it uses."""
    identity: KeyPair
    psk: bytes | None = None
    certificate: bytes = b""


@dataclass(slots=True)
class Achieved:
    """The results of the attacker."""

    initiations: int = 0
    answers: int = 0
    sessions: int = 0
    frames_read: int = 0
    frames_sent: int = 0
    drops: Counter[str] = field(default_factory=Counter)
    """Datagrams that the attacker's node dropped."""


class Impostor(PassiveAttack):
    """Initiates to each victim with a false identity. With ``relays``, genuine datagrams do not pass.

    Args:
        frames: the frames to send on a session, if it gets one. Then it also invents refusals and problems.
    """

    def __init__(
        self,
        name: str,
        disguises: Sequence[Disguise],
        now: float,
        *,
        relays: bool = False,
        frames: tuple[bytes, ...] = (),
    ) -> None:
        self.name = name
        self.achieved = {disguise.victim: Achieved() for disguise in disguises}
        self.relays = relays
        self._frames = frames
        self.records: Iterator[FleetRecord] = iter(())
        """To be sent on a session, without an end."""
        self._claimed = 0
        self._speaks_at = now
        self._directions = {disguise.victim: Direction(disguise.pose, disguise.victim) for disguise in disguises}
        self._nodes: dict[str, Node] = {}
        link = Link(suites=(X25519,), timers=Timers(retry_min_s=RETRY_S, retry_max_s=RETRY_S))
        of_fleet = replace(link, features=FEATURE_RECORDS | FEATURE_FLEET)
        for disguise in disguises:
            node = self._nodes[disguise.victim] = ThievingNode(disguise.identity, now)
            psk, is_certified = None if disguise.psk is None else Secret(disguise.psk), bool(disguise.certificate)
            node.set_certificate(disguise.certificate)
            settings = PeerSettings(disguise.victim, disguise.victim_key, psk, link, is_certified=is_certified)
            settings = replace(settings, link=of_fleet) if is_certified else settings
            node.set_paths(node.add_peer(settings, now), [_PATH], now)

    def on_datagram(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Process a datagram of a victim; pass it, except as a full relay."""
        node = self._nodes.get(direction.sender)
        if node is None or direction != self._directions[direction.sender].reverse:
            return [Send(datagram, direction)]
        actions: list[Action] = [] if self.relays else [Send(datagram, direction)]
        achieved = self.achieved[direction.sender]
        before = Counter(node.drops) + Counter(node.peers[direction.sender].traffic.drops)
        outputs = node.receive(datagram, _PATH, now)
        after = Counter(node.drops) + Counter(node.peers[direction.sender].traffic.drops)
        achieved.drops.update({reason.value: count for reason, count in (after - before).items()})
        if kind_of(datagram) is DatagramKind.RESPONSE and wire.claimed_receiver_index(datagram):
            achieved.answers += not (after - before)[DropReason.UNEXPECTED_RESPONSE]
        return actions + self._perform(direction.sender, outputs, now)

    def due(self, now: float) -> list[Action]:
        actions: list[Action] = []
        for victim, node in self._nodes.items():
            actions += self._perform(victim, node.handle_timeout(now), now)
            peer = node.peers[victim]
            if now < self._speaks_at or peer.sessions.current is None:
                continue
            for record in islice(self.records, REPORTS_AT_ONCE):
                actions += self._perform(victim, node.send_record(peer, None, record, now), now)
            if self._frames:
                self.achieved[victim].frames_sent += len(self._frames)
                actions += self._perform(victim, node.send(peer, self._frames, now), now)
                actions += self._perform(victim, self._invent(peer, peer.sessions.current, now), now)
        if now >= self._speaks_at:
            self._speaks_at = now + RETRY_S
        return actions

    def _invent(self, peer: Peer, session: Session, now: float) -> list[Output]:
        """A flood of reports, each about other frames, without regard to the limits of an honest sender."""
        out: list[Output] = []
        for _ in range(REPORTS_AT_ONCE):
            self._claimed += 1
            entries = (Refused(self._claimed % 2**24, 400, place, 2**32 - 1) for place in range(REFUSALS_PER_REPORT))
            problems = ProblemReport(tuple(range(self._claimed % 249, self._claimed % 249 + PROBLEMS_PER_REPORT)))
            payloads = RefusalReport(tuple(entries)).encode(), problems.encode()
            out += send_payloads(peer, session, payloads, peer.paths.routes[Class.BULK], now, is_answer=True)
        return out

    def next_deadline(self) -> float:
        deadlines = [node.next_deadline() for node in self._nodes.values()]
        return min([*deadlines, self._speaks_at], default=NEVER)

    def _perform(self, victim: str, outputs: list[Output], now: float) -> list[Action]:
        actions: list[Action] = []
        achieved, direction = self.achieved[victim], self._directions[victim]
        for output in outputs:
            match output:
                case Transmit(datagram, _):
                    kind = kind_of(datagram)
                    achieved.initiations += kind is DatagramKind.INITIATION
                    note = Intervention(
                        now, self.name, Operation.INJECTED, direction, 0, kind, len(datagram), "with own keys"
                    )
                    actions += [Send(datagram, direction), note]
                case SessionEstablished():
                    achieved.sessions += 1
                case Deliver():
                    achieved.frames_read += 1
        return actions


@dataclass(frozen=True, slots=True)
class KeyAttack:
    """One attacker with keys against the first two drones of three."""

    name: str
    notes: str
    disguises: Sequence[Disguise]
    relays: bool = False
    frames: tuple[bytes, ...] = ()
    records: Sequence[FleetRecord] = ()
    group: str = KEYS
    needs: tuple[str, ...] = ()


def key_attacks(stage: DaemonStage) -> list[KeyAttack]:
    """The attacks with own or stolen keys on the first two drones of three."""
    (a, b, c), keys = stage.names, stage.public_keys
    own, key_of_a, captured = KeyPair(os.urandom(32)), *(KeyPair(stage.drones[name].private_key) for name in (a, c))
    pair, with_c = (decode_key(stage.psks[frozenset((a, other))]) for other in (b, c))
    number = stage.names.index(b) + 1
    of_b = (numbered_frame(number, 2**31), numbered_frame(number, 0))

    def to_a(identity: KeyPair, psk: bytes | None = None) -> Disguise:
        return Disguise(a, keys[a], b, identity, psk)

    def to_both(psk: bytes | None = None) -> list[Disguise]:
        return [to_a(own, psk), Disguise(b, keys[b], a, own, psk)]

    return [
        KeyAttack(RELAY, "handshakes with its own keys, with both sides", to_both(), relays=True),
        KeyAttack("impostor, unknown key", "genuine traffic continues", to_both()),
        KeyAttack("impostor, stolen PSK", "the pair's PSK, but no static key", to_both(pair)),
        KeyAttack(
            "key compromise impersonation",
            f"holds the static key of {a} and the PSK, and poses as {b} to {a}",
            [to_a(StolenIdentity(keys[b], own, key_of_a), pair)],
        ),
        KeyAttack(
            "captured drone, as another",
            f"holds all keys of {c}, and claims the identity of {b}",
            [to_a(StolenIdentity(keys[b], captured, None), with_c)],
        ),
        KeyAttack(
            "captured drone, as itself",
            f"holds all keys of {c}, has a session as {c}, sends frames that only {b} may send, and reports invented "
            "refusals and problems",
            [to_a(captured, with_c)],
            frames=of_b,
        ),
    ]


async def run_key_attack(bench: Bench, attack: KeyAttack) -> None:
    impostor = Impostor(attack.name, attack.disguises, monotonic(), relays=attack.relays, frames=attack.frames)
    impostor.records = cycle(attack.records)

    def total(name: str) -> int:
        return sum(getattr(achieved, name) for achieved in impostor.achieved.values())

    attacker = KeyHolder(
        [impostor],
        # As itself, a captured drone has a genuine session: only its frames and reports matter.
        sessions=lambda: 0 if attack.frames or attack.records else total("sessions"),
        achieved=lambda: {name: total(name) for name in ("initiations", "answers", "sessions", "frames_read")},
    )
    least_s = 2.0 if attack.relays else 0.5
    plan = TrialPlan(
        attack.name, attack.group, (), restarts=attack.relays, least_s=least_s, needs=attack.needs, notes=attack.notes
    )
    await bench.run(plan, attacker)


async def run_paper_relay(bench: Bench) -> None:
    """Run the full relay between the two ends of the paper's protocol."""
    relay = PaperRelay()
    attacker = KeyHolder(
        [relay],
        sessions=lambda: relay.exchanges,
        achieved=lambda: {"sessions": relay.exchanges, "frames_read": relay.read, "frames_altered": relay.altered},
    )
    notes = "a key exchange with each side; every second frame altered"
    await bench.run(TrialPlan(RELAY, KEYS, (), least_s=1.0, notes=notes), attacker)
