"""Attackers with keys against the real daemons: their own, stolen ones, a captured drone's.

Each is a :class:`~uavlinkd.core.node.Node`, the daemon's own core, so the attacker makes no mistakes: it retries,
answers cookies, and confirms what it can confirm. That its sessions come to nothing is the daemons' doing.
"""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass, field

from uavlinkd.core import wire
from uavlinkd.core.cookie import CookieJar, MacKeys
from uavlinkd.core.crypto import KeyPair, Secret
from uavlinkd.core.drops import DropReason
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Deliver, Output, SessionEstablished, Transmit
from uavlinkd.core.settings import Link, PeerSettings, Timers
from uavlinkd.core.suites import Suite
from uavlinkd.lab.mitm.anatomy import Kind, kind_of
from uavlinkd.lab.mitm.attack import NEVER, Action, Intervention, Send, Way, What

RETRY_S = 0.02
"""How often the attacker initiates: as fast as it likes, it is no honest daemon. And how often it speaks."""
_PATH = (0, "192.0.2.1", 1)
"""What the attacker calls the way to its victim."""


class StolenIdentity(KeyPair):
    """Somebody's public key without the private one, and what a thief can compute all the same.

    With the static private key of ``victim`` in hand, the static-static secret between the two is known: it can be
    computed from either side.
    """

    __slots__ = ("_thief", "_victim")

    def __init__(self, public: bytes, thief: KeyPair, victim: KeyPair | None) -> None:
        self.public = public
        self._thief = thief
        self._victim = victim

    def exchange(self, public: bytes) -> bytes:
        """The secret with the holder of ``public`` where it can be known; else a guess."""
        if self._victim is not None and public == self._victim.public:
            return self._victim.exchange(self.public)
        return self._thief.exchange(public)


class ThievingNode(Node):
    """A node that claims to be somebody else."""

    def __init__(self, identity: KeyPair, now: float) -> None:
        super().__init__(Secret(os.urandom(32)), os.urandom, now)
        self._identity = identity
        self._mac_keys = MacKeys(identity.public)


@dataclass(frozen=True, slots=True)
class Disguise:
    """As whom, and with what keys, the attacker goes to one victim."""

    victim: str
    victim_key: bytes
    pose: str
    """Whose address it uses."""
    identity: KeyPair
    psk: bytes | None = None


@dataclass(slots=True)
class Achieved:
    """What the attacker got."""

    initiations: int = 0
    answers: int = 0
    """Responses of the victim."""
    sessions: int = 0
    frames_read: int = 0
    frames_sent: int = 0
    drops: Counter[str] = field(default_factory=Counter)
    """What the attacker itself could make nothing of."""


class Impostor:
    """Goes to each victim in a disguise. With ``relays`` it stands in the way in full: nothing genuine passes.

    Args:
        frames: what to say to a victim on a session, if it gets one.
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
    ) -> None:
        self.name = name
        self.achieved = {each.victim: Achieved() for each in disguises}
        self.relays = relays
        self._frames = frames
        self._speaks_at = now
        self._ways = {each.victim: Way(each.pose, each.victim) for each in disguises}
        self._nodes: dict[str, Node] = {}
        link = Link(suites=suites, timers=Timers(retry_min_s=RETRY_S, retry_max_s=RETRY_S))
        for each in disguises:
            node = self._nodes[each.victim] = ThievingNode(each.identity, now)
            psk = None if each.psk is None else Secret(each.psk)
            node.add_peer(PeerSettings(each.victim, each.victim_key, psk, link), now)
            node.set_addresses(each.victim, [_PATH], now)

    def on_datagram(self, datagram: bytes, way: Way, now: float) -> list[Action]:
        """Look whether it is meant for us; let it pass, unless this is the full relay."""
        node = self._nodes.get(way.sender)
        if node is None or way != self._ways[way.sender].back:
            return [Send(datagram, way)]
        actions: list[Action] = [] if self.relays else [Send(datagram, way)]
        achieved = self.achieved[way.sender]
        before = Counter(node.drops) + Counter(node.peers[way.sender].traffic.drops)
        outputs = node.receive(datagram, _PATH, now)
        after = Counter(node.drops) + Counter(node.peers[way.sender].traffic.drops)
        achieved.drops.update({reason.value: count for reason, count in (after - before).items()})
        if kind_of(datagram) is Kind.RESPONSE and wire.claimed_receiver_index(datagram):
            achieved.answers += not (after - before)[DropReason.UNEXPECTED_RESPONSE]
        return actions + self._perform(way.sender, outputs, now)

    def on_answer(self, datagram: bytes, peer: str, stranger: int, now: float) -> list[Action]:
        """It uses no addresses of its own."""
        return []

    def due(self, now: float) -> list[Action]:
        """Initiate, again and again; speak where there is a session."""
        actions: list[Action] = []
        for victim, node in self._nodes.items():
            actions += self._perform(victim, node.handle_timeout(now), now)
            if self._frames and now >= self._speaks_at and node.peers[victim].sessions.current is not None:
                self.achieved[victim].frames_sent += len(self._frames)
                actions += self._perform(victim, node.send(victim, self._frames, now), now)
        if now >= self._speaks_at:
            self._speaks_at = now + RETRY_S
        return actions

    def next_deadline(self) -> float:
        """The next try."""
        deadlines = [node.next_deadline() for node in self._nodes.values()]
        return min([*deadlines, *([self._speaks_at] if self._frames else [])], default=NEVER)

    def _perform(self, victim: str, outputs: list[Output], now: float) -> list[Action]:
        actions: list[Action] = []
        achieved, way = self.achieved[victim], self._ways[victim]
        for output in outputs:
            match output:
                case Transmit(datagram, _):
                    kind = kind_of(datagram)
                    achieved.initiations += kind is Kind.INITIATION
                    note = Intervention(now, self.name, What.INJECTED, way, 0, kind, len(datagram), "with own keys")
                    actions += [Send(datagram, way), note]
                case SessionEstablished():
                    achieved.sessions += 1
                case Deliver():
                    achieved.frames_read += 1
        return actions


class SealedCookies:
    """Answers each handshake message with a cookie reply that opens, faster than the peer.

    The key that seals a cookie follows from the peer's public key, so anyone who knows it can. Such a cookie is of no
    use to anybody: with it the peer is asked again, which it answers as it does.
    """

    name = "sealed-cookies"

    def __init__(self, public_keys: dict[str, bytes], now: float) -> None:
        self._jars = {name: CookieJar(MacKeys(key), os.urandom, now) for name, key in public_keys.items()}

    def on_datagram(self, datagram: bytes, way: Way, now: float) -> list[Action]:
        """Let it pass, and answer it."""
        actions: list[Action] = [Send(datagram, way)]
        jar = self._jars.get(way.receiver)
        if jar is None or kind_of(datagram) not in (Kind.INITIATION, Kind.RESPONSE) or len(datagram) < 4:
            return actions
        reply = jar.reply(datagram, int.from_bytes(datagram[2:4], "big"), _PATH, now)
        note = Intervention(now, self.name, What.INJECTED, way.back, 0, Kind.COOKIE, len(reply), "cookie that opens")
        return [*actions, Send(reply, way.back), note]

    def on_answer(self, datagram: bytes, peer: str, stranger: int, now: float) -> list[Action]:
        """It uses no addresses of its own."""
        return []

    def due(self, now: float) -> list[Action]:
        """It sends nothing by itself."""
        return []

    def next_deadline(self) -> float:
        """Never."""
        return NEVER
