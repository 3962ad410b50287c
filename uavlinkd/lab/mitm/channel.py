"""What lies between peers: attacks, one behind the other, then a radio for each direction. Sans-IO and seeded.

What one attack sends under a peer's address is what the next one sees, as if they stood one behind the other on the
cable. What is sent from an address of the attacker's own goes straight to the receiver.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from random import Random

from uavlinkd.lab.mitm.attack import NEVER, Action, AttackObject, Intervention, Send, Surroundings, Way
from uavlinkd.lab.mitm.radio import Radio, RadioSettings


class Channel:
    """Attacks and radios between peers; an :class:`AttackObject` itself.

    Args:
        surroundings: between whom it stands.
        attacks: in the order in which a datagram meets them.
        radios: what each direction does to what the attacks let pass. Without settings nothing.
        seed: of the radios' luck; the attacks have their own.
        now: seconds on the caller's clock.
    """

    name = "channel"

    def __init__(
        self,
        surroundings: Surroundings,
        attacks: Sequence[AttackObject] = (),
        radios: Mapping[Way, RadioSettings] | None = None,
        seed: int | str = 0,
        now: float = 0.0,
    ) -> None:
        self.surroundings = surroundings
        self.attacks: tuple[AttackObject, ...] = tuple(attacks)
        """May be replaced at any time; what the old ones held is lost then."""
        self.is_paused = False
        """Everything passes, and nothing is done; what attacks hold waits."""
        self.radios: dict[Way, Radio] = {}
        for way, settings in (radios or {}).items():
            self.radios[way] = Radio(settings, Random(f"radio {seed} {way}"), now)  # noqa: S311  luck, no secret

    def on_datagram(self, datagram: bytes, way: Way, now: float) -> list[Action]:
        """A peer sent a datagram to another."""
        return self._carry([Send(datagram, way)], 0, now)

    def on_answer(self, datagram: bytes, peer: str, stranger: int, now: float) -> list[Action]:
        """A peer sent a datagram to an address of the attacker's own."""
        if self.is_paused:
            return []
        return self._each(lambda attack: attack.on_answer(datagram, peer, stranger, now), now)

    def due(self, now: float) -> list[Action]:
        """What is to be done at ``now``."""
        actions = [] if self.is_paused else self._each(lambda attack: attack.due(now), now)
        return actions + self._arrived(now)

    def next_deadline(self) -> float:
        """When :meth:`due` has something to do."""
        deadlines = [] if self.is_paused else [attack.next_deadline() for attack in self.attacks]
        deadlines += [radio.next_deadline() for radio in self.radios.values()]
        return min(deadlines, default=NEVER)

    def _each(self, act: Callable[[AttackObject], list[Action]], now: float) -> list[Action]:
        return [
            carried
            for position, attack in enumerate(self.attacks)
            for carried in self._carry(act(attack), position + 1, now)
        ]

    def _carry(self, actions: Sequence[Action], position: int, now: float) -> list[Action]:
        """Past the attacks from ``position`` on, then onto the radio."""
        carried: list[Action] = []
        for action in actions:
            if isinstance(action, Intervention) or action.stranger is not None:
                carried.append(action)
            elif position < len(self.attacks) and not self.is_paused:
                met = self.attacks[position].on_datagram(action.datagram, action.way, now)
                carried += self._carry(met, position + 1, now)
            elif action.way in self.radios:
                self.radios[action.way].send(action.datagram, now)
                carried += self._arrived(now)
            else:
                carried.append(action)
        return carried

    def _arrived(self, now: float) -> list[Action]:
        return [Send(datagram, way) for way, radio in self.radios.items() for datagram in radio.due(now)]
