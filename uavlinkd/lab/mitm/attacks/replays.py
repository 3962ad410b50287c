"""Replays: now, later, after a rekey or a restart; to the receiver, back to the sender, or to another peer. Roaming.

The datagrams are unaltered, so each was authentic once. Roaming sends them from a stranger's address.
"""

from __future__ import annotations

import heapq
from collections import deque
from typing import ClassVar

from uavlinkd.lab.mitm.anatomy import DatagramKind, has_cookie, kind_of, matches_kind
from uavlinkd.lab.mitm.attack import CATCH_UP_LIMIT, NEVER, Action, Attack, AttackError, Direction, Operation, Send
from uavlinkd.lab.mitm.options import STRANGERS

RECORD_LIMIT = 4096
"""Datagrams recorded for a later replay; the oldest are discarded first."""
SETTLE_S = 0.5
"""The delay after a rekey or a restart, so that the link is up again before the replay."""
SILENCE_S = 0.3
"""A peer that was silent for so long and then initiates has been restarted."""


class Replay(Attack, kinds="any", when="now", delay_s=10.0, rate_per_s=200.0, copies=1, origin="sender", onto=0):
    """The base class of replays. ``rate_per_s`` is for those after a rekey or a restart."""

    operation: ClassVar[Operation] = Operation.REPLAYED

    def prepare(self) -> None:
        self.recorded: deque[tuple[bytes, Direction]] = deque(maxlen=RECORD_LIMIT)
        """Datagrams that wait for a rekey or a restart."""
        self._scheduled: list[tuple[float, int, bytes, Direction]] = []
        self._number = 0
        self._last_seen_at: dict[str, float] = {}
        if self.options.onto:
            self.context.check_path(self.options.onto)

    def is_target(self, datagram: bytes) -> bool:
        """Whether to replay this datagram."""
        return bool(datagram) and matches_kind(self.options.kinds, datagram)

    def target(self, direction: Direction) -> Direction:
        return direction.along(self.options.onto) if self.options.onto else direction

    def intercept(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        actions: list[Action] = [Send(datagram, direction)]
        if self.is_target(datagram) and self.should_attack():
            match self.options.when:
                case "now":
                    actions += self._replay(datagram, direction, now)
                case "later":
                    self._schedule(now + self.options.delay_s, datagram, direction)
                case _:
                    self.recorded.append((datagram, direction))
        return actions

    def on_datagram(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """Watch both directions for a rekey or a restart, also if only one is attacked."""
        self._watch_for_trigger(datagram, direction, now)
        return super().on_datagram(datagram, direction, now)

    def due(self, now: float) -> list[Action]:
        """Send the replays that are due. Scheduled replays continue after the end of the attack."""
        actions: list[Action] = []
        for _ in range(CATCH_UP_LIMIT):
            if not self._scheduled or self._scheduled[0][0] > now:
                break
            _, _, datagram, direction = heapq.heappop(self._scheduled)
            actions += self._replay(datagram, direction, now)
        return actions

    def next_deadline(self) -> float:
        return self._scheduled[0][0] if self._scheduled else NEVER

    def _replay(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        target = self.target(direction)
        actions: list[Action] = []
        for _ in range(self.options.copies):
            stranger = None if self.options.origin == "sender" else self.rng.randrange(STRANGERS)
            detail = f"recorded on {direction}" + ("" if stranger is None else f", from stranger {stranger}")
            log = self.note if self.options.when == "now" else self.own
            actions += [Send(datagram, target, stranger), log(self.operation, datagram, target, now, detail)]
        return actions

    def _schedule(self, at: float, datagram: bytes, direction: Direction) -> None:
        if len(self._scheduled) < RECORD_LIMIT:
            self._number += 1
            heapq.heappush(self._scheduled, (at, self._number, datagram, direction))

    def _watch_for_trigger(self, datagram: bytes, direction: Direction, now: float) -> None:
        kind = kind_of(datagram)
        last_seen_at = self._last_seen_at.get(direction.sender, NEVER)
        self._last_seen_at[direction.sender] = now
        match self.options.when:
            case "rekey" if kind is DatagramKind.RESPONSE:
                triggered = [item for item in self.recorded if item[1] in (direction, direction.reverse)]
            case "restart" if kind is DatagramKind.INITIATION and now - last_seen_at >= SILENCE_S:
                triggered = [item for item in self.recorded if direction.sender in item[1]]
            case _:
                return
        for number, item in enumerate(triggered):
            self.recorded.remove(item)
            self._schedule(now + SETTLE_S + number / self.options.rate_per_s, *item)


class ReplayInitiation(Replay, name="replay-initiation", kinds="initiation"):
    """Replays initiations."""


class ReplayResponse(Replay, name="replay-response", kinds="response"):
    """Replays responses."""


class ReplayCookie(Replay, name="replay-cookie", kinds="cookie"):
    """Replays cookie replies."""


class StolenCookie(Replay, name="stolen-cookie", origin="stranger"):
    """Replays handshake messages with a mac2 from another address, to use the cookie of their sender."""

    def is_target(self, datagram: bytes) -> bool:
        return has_cookie(datagram)


class ReplayData(Replay, name="replay-data", kinds="envelope"):
    """Replays envelopes."""


class Duplicate(Replay, name="duplicate"):
    """Sends everything twice."""


class Reflect(Replay, name="reflect"):
    """Sends datagrams back to their sender, with the other peer's address."""

    operation = Operation.REFLECTED

    def target(self, direction: Direction) -> Direction:
        return direction.reverse


class Misroute(Replay, name="misroute"):
    """Sends datagrams to a peer that is not their receiver; needs three peers."""

    operation = Operation.MISROUTED

    def prepare(self) -> None:
        super().prepare()
        self._others: dict[Direction, list[Direction]] = {}
        for direction in self.directions:
            elsewhere = [other for other in self.context.directions if other.receiver not in direction]
            # Prefer the true sender's address: then only the keys show that the datagram is misrouted.
            self._others[direction] = [one for one in elsewhere if one.sender == direction.sender] or elsewhere
        if not all(self._others.values()):
            raise AttackError("misroute needs at least three peers: configure another link")

    def target(self, direction: Direction) -> Direction:
        return self.rng.choice(self._others[direction])


class Roam(Attack, name="roam", kinds="envelope", mode="race"):
    """Forwards datagrams from a stranger's address, so that the peer moves the traffic there."""

    def intercept(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        if not matches_kind(self.options.kinds, datagram) or not self.should_attack():
            return [Send(datagram, direction)]
        return self.forward(datagram, direction, self._stranger(direction), now)

    def forward(self, datagram: bytes, direction: Direction, stranger: int, now: float) -> list[Action]:
        note = self.note(Operation.FORWARDED, datagram, direction, now, f"from stranger {stranger}")
        race = [Send(datagram, direction)] if self.options.mode == "race" else []
        return [Send(datagram, direction, stranger), note, *race]

    def on_answer(self, datagram: bytes, peer: str, stranger: int, now: float) -> list[Action]:
        """The peer believes that the stranger's address is the other peer's."""
        asked = [one for one in self.directions if one.receiver == peer and self._stranger(one) == stranger]
        if not asked:
            return []
        # The other peer gets the answer from a stranger too. This path works while the attack relays.
        back = asked[0].reverse
        return self.answer(datagram, back, (stranger, self._stranger(back)), now)

    def answer(self, datagram: bytes, back: Direction, strangers: tuple[int, int | None], now: float) -> list[Action]:
        """Relay an answer to the first stranger, from the second one or from the peer's address."""
        note = self.own(Operation.ANSWERED, datagram, back, now, f"to stranger {strangers[0]}")
        is_relayed = self.is_on(now) and self.options.mode == "relay"
        return [Send(datagram, back, strangers[1]), note] if is_relayed else [note]

    def _stranger(self, direction: Direction) -> int:
        """One stranger per direction, so that its answers belong to one direction."""
        return self.context.directions.index(direction) % STRANGERS


class Wander(Roam, name="wander", kinds="any", mode="relay", sources=64):
    """Forwards each datagram from another stranger, like a broken NAT. Relays the answers, unless it races."""

    def prepare(self) -> None:
        self._direction_of: dict[tuple[str, int], Direction] = {}  # at most peers times strangers

    def forward(self, datagram: bytes, direction: Direction, stranger: int, now: float) -> list[Action]:
        stranger = self.attempts % max(2, self.options.sources)
        self._direction_of[direction.receiver, stranger] = direction
        return super().forward(datagram, direction, stranger, now)

    def on_answer(self, datagram: bytes, peer: str, stranger: int, now: float) -> list[Action]:
        """Relay the answer to the sender of the forwarded datagram."""
        direction = self._direction_of.get((peer, stranger))
        return self.answer(datagram, direction.reverse, (stranger, None), now) if direction else []
