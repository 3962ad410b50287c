"""The path between peers: a chain of attacks, then a radio for each direction. Sans-IO and seeded.

The next attack gets the datagrams that an attack sends from a peer's address. Datagrams from a stranger's address go
directly to the receiver.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from random import Random

from uavlinkd.lab.mitm.attack import NEVER, Action, AttackContext, AttackObject, Direction, Intervention, Send
from uavlinkd.lab.mitm.radio import Radio, RadioSettings


class AttackChannel:
    """Attacks and radios between peers; an :class:`AttackObject` itself.

    Args:
        context: the directions between the peers.
        attacks: in the order in which a datagram passes them.
        radios: the radio of each direction. A direction without one passes datagrams unchanged.
        seed: of the radios. Each attack has its own random source.
        now: monotonic seconds.
    """

    name = "channel"

    def __init__(
        self,
        context: AttackContext,
        attacks: Sequence[AttackObject] = (),
        radios: Mapping[Direction, RadioSettings] | None = None,
        seed: int | str = 0,
        now: float = 0.0,
    ) -> None:
        self.context = context
        self.attacks: tuple[AttackObject, ...] = tuple(attacks)
        """May be replaced at any time. Datagrams that the old attacks hold are lost."""
        self.radios: dict[Direction, Radio] = {}
        for direction, settings in (radios or {}).items():
            self.radios[direction] = Radio(settings, Random(f"radio {seed} {direction}"), now)  # noqa: S311  not a secret

    def on_datagram(self, datagram: bytes, direction: Direction, now: float) -> list[Action]:
        return self._carry([Send(datagram, direction)], 0, now)

    def on_answer(self, datagram: bytes, peer: str, stranger: int, now: float) -> list[Action]:
        return self._each(lambda attack: attack.on_answer(datagram, peer, stranger, now), now)

    def due(self, now: float) -> list[Action]:
        return self._each(lambda attack: attack.due(now), now) + self._arrived(now)

    def next_deadline(self) -> float:
        deadlines = [attack.next_deadline() for attack in self.attacks]
        deadlines += [radio.next_deadline() for radio in self.radios.values()]
        return min(deadlines, default=NEVER)

    def _each(self, act: Callable[[AttackObject], list[Action]], now: float) -> list[Action]:
        return [
            carried
            for position, attack in enumerate(self.attacks)
            for carried in self._carry(act(attack), position + 1, now)
        ]

    def _carry(self, actions: Sequence[Action], position: int, now: float) -> list[Action]:
        """Pass the attacks from ``position`` on, then the radio."""
        carried: list[Action] = []
        for action in actions:
            if isinstance(action, Intervention) or action.stranger is not None:
                carried.append(action)
            elif position < len(self.attacks):
                met = self.attacks[position].on_datagram(action.datagram, action.direction, now)
                carried += self._carry(met, position + 1, now)
            elif action.direction in self.radios:
                self.radios[action.direction].send(action.datagram, now)
                carried += self._arrived(now)
            else:
                carried.append(action)
        return carried

    def _arrived(self, now: float) -> list[Action]:
        return [Send(datagram, direction) for direction, radio in self.radios.items() for datagram in radio.due(now)]
