"""An attack on what is inside data along a relay, between a member and its relay.

The attacker needs no key for that: the header of such data is in the clear. README.md of :mod:`uavlinkd.core`,
section 21.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from uavlinkd.core.relay_records import RELAYED, handle_of
from uavlinkd.lab.mitm.attack import NEVER, Action, AttackObject, Direction, Intervention, Send

_START: Final = bytes((RELAYED,))
_HEADER_BYTES: Final = 3


class InsideData:
    """Shows an attack only the inner datagrams, and adds the header of their direction to what it sends.

    Other datagrams pass. An inner datagram for a direction without data so far is dropped: it has no handle.
    """

    def __init__(self, attack: AttackObject) -> None:
        self._attack = attack
        self._headers: dict[Direction, bytes] = {}

    @property
    def name(self) -> str:
        """That of the attack."""
        return self._attack.name

    def on_datagram(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        """A peer sent a datagram to another."""
        if not datagram.startswith(_START) or not handle_of(datagram):
            return [Send(datagram, direction)]
        self._headers[direction] = datagram[:_HEADER_BYTES]
        return self._wrapped(self._attack.on_datagram(datagram[_HEADER_BYTES:], direction, now))

    def on_answer(self, datagram: bytes, peer: str, stranger: int, now: float) -> list[Action]:
        """A peer sent a datagram to a stranger: not along a relay."""
        del datagram, peer, stranger, now
        return []

    def due(self, now: float) -> list[Action]:
        """The actions that are due at ``now``."""
        return self._wrapped(self._attack.due(now)) if self._headers else []

    def next_deadline(self) -> float:
        """The time of the next call of :meth:`due`."""
        return self._attack.next_deadline() if self._headers else NEVER

    def _wrapped(self, actions: Sequence[Action]) -> list[Action]:
        wrapped: list[Action] = []
        for action in actions:
            if isinstance(action, Intervention):
                wrapped.append(action)
            elif (header := self._headers.get(action.direction)) is not None:
                wrapped.append(action._replace(datagram=header + action.datagram))
        return wrapped
