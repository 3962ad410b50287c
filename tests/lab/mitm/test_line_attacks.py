"""Attacks on the line: what they put there, and what the framing and two nodes make of it."""

from __future__ import annotations

from pathlib import Path
from random import Random

import pytest

from uavlinkd import lab
from uavlinkd.endpoints.line_framing import LineDecoder, encode
from uavlinkd.lab.mitm.attack import NEVER, AttackError, Intervention
from uavlinkd.lab.mitm.line_attacks import (
    LINE_ATTACKS,
    LineAttack,
    LineAttacker,
    damaged,
    list_line_attacks,
    parse_line_attack,
)
from uavlinkd.lab.mitm.modem import ModemEnd, ModemLink, ModemSettings

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
        self.arrived_at: list[float] = []

    def run(self, until: float) -> None:
        """Let time jump from event to event."""
        while (at := min(self.link.next_deadline(), self.attacker.next_deadline())) <= until:
            self.now = max(self.now, at)
            self.attacker.due(self.now)
            for end, data in self.link.advance(self.now):
                self.attacker.observe(end, data)
                for datagram in self.decoders[end].feed(data):
                    self.received[end].append(datagram)
                    self.arrived_at.append(self.now)
        self.now = until

    def talk(self, until: float) -> None:
        """The left host sends a datagram every 0.2 s."""
        number = 0
        while self.now < until:
            self.link.write(LEFT, encode(DATAGRAMS[number % len(DATAGRAMS)]), self.now)
            number += 1
            self.run(self.now + 0.2)
        self.run(self.now + 1)


@pytest.mark.parametrize("name", sorted(set(LINE_ATTACKS) - {"line-hold"}))
def test_injected_bytes_are_counted(name: str) -> None:
    """In the journal's records and in the modem's counters."""
    scene = Scene(parse_line_attack(f"{name},end=right,interval_s=0.13"))
    scene.talk(10)

    assert 60 < len(scene.done) < 95
    assert {done.attack for done in scene.done} == {name}
    assert scene.link.bytes[RIGHT]["injected"] == sum(done.length for done in scene.done)  # type: ignore[index]
    assert not scene.link.bytes[LEFT]["injected"]  # type: ignore[index]


@pytest.mark.parametrize("name", ["line-noise", "line-bad-crc", "line-cut"])
def test_framing_drops_what_is_broken(name: str) -> None:
    """No datagram comes out that was not sent. Those with no such bytes before them arrive. Pieces are counted."""
    scene = Scene(parse_line_attack(f"{name},end=right,interval_s=0.53"))
    scene.talk(20)

    assert set(scene.received[RIGHT]) <= set(DATAGRAMS)
    assert len(scene.received[RIGHT]) > 30
    assert scene.decoders[RIGHT].line_noise > 10


def test_forged_datagrams_pass_the_framing() -> None:
    """A CRC is not a secret: the core must refuse these."""
    scene = Scene(parse_line_attack("line-forge,end=right,interval_s=0.13"))
    scene.talk(10)

    forged = [datagram for datagram in scene.received[RIGHT] if datagram not in DATAGRAMS]
    assert len(forged) > 30
    assert {done.detail == "invented" for done in scene.done} == {False, True}


def test_replayed_datagrams_pass_the_framing() -> None:
    """As often as the attacker likes."""
    scene = Scene(parse_line_attack("line-replay,end=right,interval_s=0.05,limit=60"))
    scene.talk(10)

    assert set(scene.received[RIGHT]) <= set(DATAGRAMS)
    assert len(scene.received[RIGHT]) >= 50 + 55
    assert len(scene.done) <= 60


def test_held_frames_are_released() -> None:
    """After 10 s, all of them in order."""
    scene = Scene(parse_line_attack("line-hold,end=right,limit=1"))
    scene.talk(12)

    assert scene.arrived_at[0] > 10
    assert scene.received[RIGHT][:40] == DATAGRAMS
    assert [done.operation for done in scene.done] == ["held"]


def test_line_cut_at_every_offset() -> None:
    """Whatever was cut off, the next datagram after a delimiter arrives, and nothing else does."""
    before, cut, after = DATAGRAMS[2], DATAGRAMS[20], DATAGRAMS[5]
    framed = encode(cut)
    for at in range(1, len(framed)):
        decoder = LineDecoder()
        received = decoder.feed(encode(before) + framed[:at])
        received += decoder.feed(encode(after))
        assert received == ([before, after] if at < len(framed) - 1 else [before, cut, after]), at


def test_plug_pulled_at_every_offset() -> None:
    """The modem of the sender is pulled after each byte. Nothing that was not sent arrives, and all does later."""
    first, second = DATAGRAMS[9], DATAGRAMS[12]
    size = len(encode(first))
    byte_s = 10 / 57_600
    for at in range(0, 3 * size, 2):
        scene = Scene(seed=at)
        scene.link.write(LEFT, encode(first), 0.0)
        scene.run(at * byte_s + 1e-9)
        scene.link.pull(LEFT, scene.now)
        scene.run(scene.now + 1)
        assert scene.received[RIGHT] in ([], [first])
        scene.link.plug(LEFT, scene.now)
        scene.link.write(LEFT, encode(second), scene.now)
        scene.run(scene.now + 1)
        assert scene.received[RIGHT] in ([second], [first, second])


def test_damaged_frame_keeps_its_length_and_has_no_delimiter() -> None:
    """So that the CRC decides."""
    for seed in range(200):
        rng = Random(seed)
        framed = encode(DATAGRAMS[seed % 40])
        data = damaged(framed, rng)
        assert len(data) == len(framed) - 2
        assert data != framed[1:-1]
        assert 0 not in data
        assert not LineDecoder().feed(data + b"\0")


def test_attacks_can_be_changed_and_ended() -> None:
    """By the operator, while they run."""
    scene = Scene(parse_line_attack("line-noise"))
    assert scene.attacker.names == ["line-noise"]
    scene.run(1)
    count = len(scene.done)
    scene.attacker.change([], scene.now)
    scene.run(3)
    assert len(scene.done) == count > 5
    assert scene.attacker.next_deadline() == NEVER


def test_attacker_does_not_catch_up_on_a_long_pause() -> None:
    """The process may have been stopped for an hour."""
    scene = Scene(parse_line_attack("line-noise,end=left,interval_s=0.01"))
    scene.attacker.due(3600.0)
    assert len(scene.done) <= 256


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("line-nois", "line-noise"),
        ("line-noise,end=middle", "end"),
        ("line-noise,interval_s=0", "interval_s"),
        ("line-noise,rate=3", "rate"),
    ],
)
def test_wrong_attack_is_explained(text: str, message: str) -> None:
    """With what to write instead."""
    with pytest.raises(AttackError, match=message):
        parse_line_attack(text)


def test_readme_has_every_attack() -> None:
    """In the table of the laboratory."""
    rows = (Path(lab.__path__[0]) / "README.md").read_text().splitlines()
    assert {name for row in rows for name in LINE_ATTACKS if row.startswith(f"| `{name}` |")} == set(LINE_ATTACKS)


def test_list_has_every_attack_and_parameter() -> None:
    """For the command line."""
    text = list_line_attacks()
    assert {line.partition(" ")[0] for line in text.splitlines()} >= set(LINE_ATTACKS)
    assert all(name in text for name in LineAttack.model_fields if name != "name")
