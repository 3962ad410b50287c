"""The tunnel to one station: handshakes, sessions, and the questions that show whether a command is new. No I/O.

WireGuard as its whitepaper defines it (section 6), in both roles. README.md says what is used of it and why.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

from uavlinkd.protocol.constants import KEY_BYTES, NEVER
from uavlinkd.protocol.crypto import Entropy, KeyPair
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.path import SocketAddress
from uavlinkd.stations import inner
from uavlinkd.stations.handshake import (
    Initiating,
    Macs,
    StationInitiation,
    StationKey,
    initiate,
    mac1_of,
    read_response,
    respond,
)
from uavlinkd.stations.session import MOST_AGE_S, REJECT_AFTER_S, TunnelSession

REKEY_AFTER_S: Final = 120.0
"""The age at which the initiator of a session makes new keys (section 6.1)."""
REKEY_TIMEOUT_S: Final = 5.0
"""Between two initiations without a response (section 6.1)."""
REKEY_ATTEMPT_S: Final = 90.0
"""How long this daemon initiates without a response; then the station has to (section 6.1)."""
KEEPALIVE_S: Final = 10.0
"""A station that sent something gets an answer within this time (section 6.5)."""
RESPONDER_REKEY_S: Final = REJECT_AFTER_S - KEEPALIVE_S
"""The age at which this daemon makes new keys if the station should have, and did not."""
COOKIE_S: Final = 120.0
"""How long a cookie of the station is used (section 6.6)."""

ASK_S: Final = 1.0
"""Between two questions while the station sends. A question and its answer take 148 bytes each, with IPv4 and UDP."""
ASK_AGAIN_S: Final = 0.25
"""Between two questions while commands are dropped because nothing shows that they are new."""
ACTIVE_S: Final = 3.0
"""A station that sent no frame for this time is not asked."""
DOUBT_S: Final = 2.0
"""How long a dropped command causes more questions, and how long a command is a reason to make new keys."""
RENEW_S: Final = 1.5
"""Between two handshakes that take the place of answers, which a firewall of the station drops."""
UNANSWERED_S: Final = 1.0
"""Questions without an answer for this time: the station answers none, or the link is cut."""
QUESTIONS: Final = 32
"""Questions that wait for an answer: all of :data:`.session.MOST_AGE_S`, and more."""


class Opened(NamedTuple):
    """An authentic packet of the station; empty: a keepalive."""

    packet: bytes
    session: TunnelSession
    counter: int

    def is_new(self, now: float) -> bool:
        """Whether it is at most :data:`.session.MOST_AGE_S` old."""
        return self.session.is_new(self.counter, now)


class Tunnel:
    """All state of one station. All times are monotonic seconds.

    ``indices``: the numbers of the sessions and initiations of all tunnels. A received message names one.
    ``timestamp`` returns one that is greater than all before, also than those before a restart.
    """

    def __init__(
        self,
        own: StationKey,
        key: bytes,
        ends: inner.Ends,
        entropy: Entropy,
        indices: dict[int, Tunnel],
        timestamp: Callable[[], bytes],
    ) -> None:
        self.key = key
        """The station's public key."""
        self.ends = ends
        self.address: SocketAddress | None = None
        """Where its newest authentic packet came from; None before the first."""
        self.next_at = NEVER
        """When :meth:`do_due` has something to do."""
        self._own = own
        self._entropy = entropy
        self._indices = indices
        self._timestamp = timestamp
        self._current: TunnelSession | None = None
        self._previous: TunnelSession | None = None
        self._next: TunnelSession | None = None  # answered by this daemon, and not used by the station yet
        self._pending: Initiating | None = None
        self._initiated_at = self._trying_since = -NEVER
        self._received_at = -NEVER  # its last frames
        self._commanded_at = -NEVER  # the last frame that must be new, whether it was or not
        self._doubted_at = -NEVER  # the last one that was dropped because nothing showed that it is new
        self._used_at = -NEVER  # when the newest session began with which the station sent something
        self._sent_after = -NEVER  # the newest time of which is known that the station sent something later
        self._newest_timestamp = b""  # of the station, since this daemon started
        self._questions: dict[bytes, float] = {}  # when each was asked, by its token
        self._ask_at = NEVER
        self._asked_at = -NEVER
        self._unanswered_since = NEVER
        self._keepalive_at = NEVER  # when to send one, since nothing else answers what was received
        self._silent_at = NEVER  # when to make new keys, since nothing answers what was sent
        self._cookie = b"", -NEVER

    @property
    def is_open(self) -> bool:
        """Whether the station uses a session."""
        return self._current is not None

    # Handshakes.

    def on_initiation(self, initiation: StationInitiation, now: float) -> bytes:
        """The response to an authentic initiation of the station. Raises ``REPLAYED_INITIATION``.

        After a restart it may be a recorded one: it changes nothing until the station uses the session.
        """
        if initiation.timestamp <= self._newest_timestamp:
            raise Drop(DropReason.REPLAYED_INITIATION)
        self._newest_timestamp = initiation.timestamp
        index = self._new_index()
        datagram, keys = respond(initiation, KeyPair(self._entropy(KEY_BYTES)), index)
        self._forget(self._next)
        self._next = TunnelSession(index, keys, now, self._sent_after, is_initiator=False)
        self._set_next(now)
        return datagram

    def initiate(self, now: float) -> list[bytes]:
        """An initiation of this daemon, if it knows where the station is."""
        if self.address is None:
            return []
        if self._pending is None:
            self._trying_since = now
        self._give_up()
        cookie, until = self._cookie
        pair, index = KeyPair(self._entropy(KEY_BYTES)), self._new_index()
        usable = cookie if now < until else None
        self._pending = initiate(self._own, self.key, self._timestamp(), pair, index, usable)
        self._initiated_at = now
        self._set_next(now)
        return [self._pending.datagram]

    def on_response(self, datagram: bytes, index: int, now: float) -> list[bytes]:
        """The station answered an initiation of this daemon. The packets returned confirm the session to it.

        Raises ``UNEXPECTED_RESPONSE`` or ``BAD_HANDSHAKE``.
        """
        pending = self._pending
        if pending is None or pending.number != index:
            raise Drop(DropReason.UNEXPECTED_RESPONSE)
        keys = read_response(self._own, pending, datagram)
        self._pending = None
        self._use(TunnelSession(index, keys, self._initiated_at, self._sent_after, is_initiator=True))
        return self._ask(now)

    def on_cookie(self, reply: bytes, index: int, now: float) -> None:
        """The station wants its cookie in the next initiation. Raises ``UNEXPECTED_COOKIE`` or ``BAD_COOKIE``."""
        if self._pending is None or self._pending.number != index:
            raise Drop(DropReason.UNEXPECTED_COOKIE)
        self._cookie = Macs(self.key).open(reply, mac1_of(self._pending.datagram)), now + COOKIE_S

    # Packets.

    def seal(self, packet: bytes, now: float) -> list[bytes]:
        """The data message with an inner packet, or with nothing: a keepalive. Without a session there is none."""
        session = self._current
        if session is None or session.is_over(now):
            return []
        self._keepalive_at = NEVER
        if packet and self._silent_at == NEVER:
            self._silent_at = now + KEEPALIVE_S + REKEY_TIMEOUT_S
            self.next_at = min(self.next_at, self._silent_at)
        return [session.seal(packet)]

    def open(self, datagram: bytes, index: int, address: SocketAddress, now: float) -> Opened:
        """The packet in a data message. Raises Drop, and then nothing has changed."""
        session = next((one for one in self._sessions() if one.index == index), None)
        if session is None:  # the number is that of an initiation
            raise Drop(DropReason.UNKNOWN_INDEX)
        counter, packet = session.open(datagram, now)
        if session is self._next:
            self._next = None
            self._use(session)
        # A station that has keys sends at once what its system kept until then, in order. So what comes with later
        # keys was sent by its software after this. README.md, "A command is new".
        self._sent_after = max(self._sent_after, session.born_at)
        self._used_at = max(self._used_at, session.born_at)
        if session.born_at == self._used_at and counter == session.highest:
            self.address = address
        self._silent_at = NEVER
        if packet:
            self._keepalive_at = min(self._keepalive_at, now + KEEPALIVE_S)
        self._set_next(now)
        return Opened(packet, session, counter)

    # A command is new, or it is not delivered.

    def on_answer(self, opened: Opened, token: bytes) -> bool:
        """The station answered a question in this packet. Returns False if it is no question of the last seconds."""
        asked_at = self._questions.pop(token, None)
        if asked_at is None:
            return False
        opened.session.prove(opened.counter, asked_at)
        self._sent_after = max(self._sent_after, asked_at)
        self._unanswered_since = NEVER
        return True

    def on_frames(self, now: float, *, is_new: bool, has_commands: bool) -> None:
        """Frames came. If nothing shows that they are new, the commands among them were dropped."""
        if now - self._received_at > ACTIVE_S:
            self._ask_at = now
        self._received_at = now
        if has_commands:
            self._commanded_at = now
            if not is_new:
                self._doubted_at = now
                self._ask_at = min(self._ask_at, max(now, self._asked_at + ASK_AGAIN_S))
        self._set_next(now)

    def _ask(self, now: float) -> list[bytes]:
        """A question, and when the next one is due."""
        self._ask_at = now + (ASK_AGAIN_S if now - self._doubted_at < DOUBT_S else ASK_S)
        token = self._entropy(inner.TOKEN_BYTES)
        if len(self._questions) >= QUESTIONS:
            del self._questions[next(iter(self._questions))]
        self._questions[token] = self._asked_at = now
        self._unanswered_since = min(self._unanswered_since, now)
        self._set_next(now)
        return self.seal(inner.echo(self.ends, bytes(4) + token, is_answer=False), now)

    # Time.

    def do_due(self, now: float) -> list[bytes]:
        """The datagrams that are due, for :attr:`address`. Sessions that are over end."""
        out: list[bytes] = []
        over = [session for session in self._sessions() if session.is_over(now)]
        if over:
            slots = (self._current, self._previous, self._next)
            self._current, self._previous, self._next = (None if one in over else one for one in slots)
            for session in over:
                self._forget(session)
        if self._current is None:
            self._ask_at = self._silent_at = self._keepalive_at = NEVER
        if now >= self._ask_at:
            if now - self._received_at <= ACTIVE_S:
                out += self._ask(now)
            else:
                self._ask_at = NEVER
        if now >= self._keepalive_at:
            out += self.seal(b"", now)
        if now >= self._gives_up_at:
            self._give_up()
        if now >= self._initiate_at(now):
            self._silent_at = NEVER
            out += self.initiate(now)
        self._set_next(now)
        return out

    def _initiate_at(self, now: float) -> float:
        """When to make new keys."""
        renew_at = max(self._initiated_at + RENEW_S, now) if self._needs_handshakes(now) else NEVER
        if self._pending is not None:
            again_at = min(self._initiated_at + REKEY_TIMEOUT_S, renew_at)
            return again_at if again_at < self._gives_up_at else NEVER
        if (session := self._current) is None:
            return NEVER
        oldest = now - MOST_AGE_S
        if renew_at != NEVER and session.proved_at < oldest <= self._sent_after:
            return now  # these keys show nothing, and new ones will, as when a delay of the network ends
        age_s = REKEY_AFTER_S if session.is_initiator else RESPONDER_REKEY_S
        return min(session.born_at + age_s, self._silent_at, renew_at)

    def _needs_handshakes(self, now: float) -> bool:
        """Whether commands come, and the station answers no questions."""
        return now - self._commanded_at < DOUBT_S and now - self._unanswered_since >= UNANSWERED_S

    @property
    def _gives_up_at(self) -> float:
        return NEVER if self._pending is None else self._trying_since + REKEY_ATTEMPT_S

    def _set_next(self, now: float) -> None:
        ends = (session.ends_at for session in self._sessions())
        self.next_at = min(self._ask_at, self._keepalive_at, self._initiate_at(now), self._gives_up_at, *ends)

    def _sessions(self) -> Iterator[TunnelSession]:
        return (one for one in (self._current, self._previous, self._next) if one is not None)

    def _new_index(self) -> int:
        """A random unused number."""
        while (index := int.from_bytes(self._entropy(4), "little")) in self._indices:
            pass
        self._indices[index] = self
        return index

    def _use(self, session: TunnelSession) -> None:
        self._forget(self._previous)
        self._previous, self._current = self._current, session

    def _give_up(self) -> None:
        if self._pending is not None:
            del self._indices[self._pending.number]
            self._pending = None

    def _forget(self, session: TunnelSession | None) -> None:
        if session is not None:
            del self._indices[session.index]
