"""Attacks on the line: what they put there, and what the framing makes of it."""

from __future__ import annotations

from random import Random

import pytest

from uavlinkd.lab.mitm.attack import Intervention
from uavlinkd.lab.mitm.line_attacks import LineAttack, LineAttacker, parse_line_attack
from uavlinkd.lab.mitm.modem import ModemEnd, ModemLink, ModemSettings
from uavlinkd.serial.line_framing import LineDecoder, encode

LEFT, RIGHT = ModemEnd.LEFT, ModemEnd.RIGHT
DATAGRAMS = [Random(number).randbytes(3 + 7 * number) for number in range(40)]


class Scene:
    """Modems, an attacker on their lines, and the decoder of each host."""

    def __init__(self, *attacks: LineAttack, seed: int = 1) -> None:
        self.now = 0.0
        self.done: list[Intervention] = []
        self.link = ModemLink(ModemSettings(), Random(seed))
        self.attacker = LineAttacker(self.link, Random(seed), self.done.append)
        self.attacker.change(attacks, 0.0)
        self.decoders = {end: LineDecoder() for end in ModemEnd}
        self.received: dict[ModemEnd, list[bytes]] = {end: [] for end in ModemEnd}

    def run(self, until: float) -> None:
        """Let time jump from event to event."""
        while (at := min(self.link.next_deadline(), self.attacker.next_deadline())) <= until:
            self.now = max(self.now, at)
            self.attacker.due(self.now)
            for end, data in self.link.advance(self.now):
                self.attacker.observe(end, data)
                for datagram in self.decoders[end].feed(data):
                    self.received[end].append(datagram)
        self.now = until

    def talk(self, until: float) -> None:
        """The left host sends a datagram every 0.2 s."""
        number = 0
        while self.now < until:
            self.link.write(LEFT, encode(DATAGRAMS[number % len(DATAGRAMS)]), self.now)
            number += 1
            self.run(self.now + 0.2)
        self.run(self.now + 1)


@pytest.mark.parametrize("name", ["line-noise", "line-bad-crc", "line-cut"])
def test_framing_drops_what_is_broken(name: str) -> None:
    """No datagram comes out that was not sent. Those with no such bytes before them arrive. Pieces are counted."""
    scene = Scene(parse_line_attack(f"{name},end=right,interval_s=0.53"))
    scene.talk(20)

    assert set(scene.received[RIGHT]) <= set(DATAGRAMS)
    assert len(scene.received[RIGHT]) > 30
    assert scene.decoders[RIGHT].line_noise > 10
