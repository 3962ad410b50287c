"""Attackers with keys against real daemons: with their own keys, stolen ones, or those of a captured drone.

Each is a :class:`~uavlinkd.core.node.Node`, so the attacker follows the protocol: it retries, answers cookies and
confirms sessions. If it gets no session, the reason is the daemon's check.
"""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass, field

from uavlinkd.core import wire
from uavlinkd.core.constants import REFUSALS_PER_REPORT
from uavlinkd.core.cookie import CookieJar, MacKeys
from uavlinkd.core.crypto import KeyPair, Secret
from uavlinkd.core.drops import DropReason
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Deliver, Output, SessionEstablished, Transmit
from uavlinkd.core.path import Path
from uavlinkd.core.peer import Peer
from uavlinkd.core.refusals import RefusalReport, Refused
from uavlinkd.core.send import seal
from uavlinkd.core.session import Session
from uavlinkd.core.settings import Class, Link, PeerSettings, Timers
from uavlinkd.core.suites import Suite
from uavlinkd.lab.mitm.anatomy import DatagramKind, kind_of
from uavlinkd.lab.mitm.attack import NEVER, Action, Direction, Intervention, Operation, PassiveAttack, Send

RETRY_S = 0.02
"""How often the attacker initiates, much faster than a daemon, and how often it sends frames."""
REPORTS_AT_ONCE = 4
_PATH = Path(0, ("192.0.2.1", 1))
"""The attacker's path to its victim."""


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
        own = self._handshakes.own
        own.identity, own.mac_keys = identity, MacKeys(identity.public)


@dataclass(frozen=True, slots=True)
class Disguise:
    """The identity and the keys that the attacker uses against one victim."""

    victim: str
    victim_key: bytes
    pose: str
    """The peer whose address it uses."""
    identity: KeyPair
    psk: bytes | None = None


@dataclass(slots=True)
class Achieved:
    """The results of the attacker."""

    initiations: int = 0
    answers: int = 0
    """Responses of the victim."""
    sessions: int = 0
    frames_read: int = 0
    frames_sent: int = 0
    drops: Counter[str] = field(default_factory=Counter)
    """Datagrams that the attacker's node dropped."""


class Impostor(PassiveAttack):
    """Initiates to each victim with a false identity. With ``relays``, genuine datagrams do not pass.

    Args:
        frames: the frames to send on a session, if it gets one.
        claims: whether it also reports refusals that it invents.
    """

    def __init__(
        self,
        name: str,
        disguises: list[Disguise],
        suites: tuple[Suite, ...],
        now: float,
        *,
        relays: bool = False,
        frames: tuple[bytes, ...] = (),
        claims: bool = False,
    ) -> None:
        self.name = name
        self.achieved = {disguise.victim: Achieved() for disguise in disguises}
        self.relays = relays
        self._frames = frames
        self._claims = claims
        self._claimed = 0
        self._speaks_at = now
        self._directions = {disguise.victim: Direction(disguise.pose, disguise.victim) for disguise in disguises}
        self._nodes: dict[str, Node] = {}
        link = Link(suites=suites, timers=Timers(retry_min_s=RETRY_S, retry_max_s=RETRY_S))
        for disguise in disguises:
            node = self._nodes[disguise.victim] = ThievingNode(disguise.identity, now)
            psk = None if disguise.psk is None else Secret(disguise.psk)
            node.set_paths(
                node.add_peer(PeerSettings(disguise.victim, disguise.victim_key, psk, link), now), [_PATH], now
            )

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
        """Initiate repeatedly, and send frames on sessions."""
        actions: list[Action] = []
        for victim, node in self._nodes.items():
            actions += self._perform(victim, node.handle_timeout(now), now)
            peer = node.peers[victim]
            if self._frames and now >= self._speaks_at and peer.sessions.current is not None:
                self.achieved[victim].frames_sent += len(self._frames)
                actions += self._perform(victim, node.send(peer, self._frames, now), now)
                if self._claims:
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
            out += seal(
                peer,
                session,
                RefusalReport(tuple(entries)).encode(),
                peer.paths.routes[Class.BULK],
                now,
                is_answer=True,
            )
        return out

    def next_deadline(self) -> float:
        """The time of the next action."""
        deadlines = [node.next_deadline() for node in self._nodes.values()]
        return min([*deadlines, *([self._speaks_at] if self._frames else [])], default=NEVER)

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


class SealedCookies(PassiveAttack):
    """Answers each handshake message with a cookie reply that can be decrypted, before the peer answers.

    The key of a cookie reply is derived from the peer's public key, so an attacker can know it. Such a cookie is
    useless: with it, the sender only sends its message again.
    """

    name = "sealed-cookies"

    def __init__(self, public_keys: dict[str, bytes], now: float) -> None:
        self._jars = {name: CookieJar(MacKeys(key), os.urandom, now) for name, key in public_keys.items()}

    def on_datagram(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Pass the datagram and answer it."""
        actions: list[Action] = [Send(datagram, direction)]
        jar = self._jars.get(direction.receiver)
        if (
            jar is None
            or kind_of(datagram) not in (DatagramKind.INITIATION, DatagramKind.RESPONSE)
            or len(datagram) < 4
        ):
            return actions
        reply = jar.reply(datagram, int.from_bytes(datagram[2:4], "big"), _PATH, now)
        note = Intervention(
            now,
            self.name,
            Operation.INJECTED,
            direction.reverse,
            0,
            DatagramKind.COOKIE,
            len(reply),
            "valid cookie reply",
        )
        return [*actions, Send(reply, direction.reverse), note]
