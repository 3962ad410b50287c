"""Attacks on a serial line between two daemons, by a modem's firmware or a device on the wires. Sans-IO, seeded.

The attacker reads what comes out of both modems, puts bytes on the lines to the hosts, and can hold modems back. It
has no keys. So it can make a valid frame of the line (COBS and CRC), but no valid envelope.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from random import Random
from types import MappingProxyType
from typing import Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from uavlinkd.lab.mitm.anatomy import DatagramKind, kind_of
from uavlinkd.lab.mitm.attack import CATCH_UP_LIMIT, NEVER, AttackError, Direction, Intervention, Operation
from uavlinkd.lab.mitm.modem import ModemEnd, ModemLink
from uavlinkd.protocol import wire
from uavlinkd.serial.line_framing import DELIMITER, LineDecoder, encode

RECORD_LIMIT: Final = 1024
"""Datagrams recorded at each end, for replays and forgeries."""
_FORGED_BYTES = 40


class LineAttack(BaseModel):
    """An attack on the line, with its parameters. Unknown ones are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, hide_input_in_errors=True, allow_inf_nan=False)

    name: str
    end: Literal["left", "right", "both"] = Field("both", description="the host that is attacked")
    begin_s: float = Field(0.0, ge=0, description="seconds before the attack begins")
    interval_s: float = Field(0.2, gt=0, description="seconds between two interventions")
    limit: int | None = Field(None, ge=1, description="most interventions")
    size: int = Field(64, ge=1, le=4096, description="line-noise: bytes at once")
    hold_s: float = Field(10.0, gt=0, description="line-hold: duration of a hold in seconds")

    @property
    def ends(self) -> tuple[ModemEnd, ...]:
        return tuple(ModemEnd) if self.end == "both" else (ModemEnd(self.end),)


class LineAttacker:
    """Attacks on both lines of a :class:`.ModemLink`.

    Args:
        link: the modems.
        rng: the random source.
        on_done: gets each intervention, for the log.
    """

    def __init__(self, link: ModemLink, rng: Random, on_done: Callable[[Intervention], object]) -> None:
        self._link = link
        self._rng = rng
        self._on_done = on_done
        self._decoders = {end: LineDecoder() for end in ModemEnd}
        self._recorded: dict[ModemEnd, deque[bytes]] = {end: deque(maxlen=RECORD_LIMIT) for end in ModemEnd}
        self._attacks: list[_Running] = []
        self._numbers: Counter[tuple[str, ModemEnd]] = Counter()

    @property
    def names(self) -> list[str]:
        return [running.attack.name for running in self._attacks]

    def observe(self, end: ModemEnd, data: bytes) -> None:
        self._recorded[end].extend(self._decoders[end].feed(data))

    def change(self, attacks: Sequence[LineAttack], now: float) -> None:
        """Run these attacks from now on, in place of the others."""
        self._attacks = [_Running(attack, now + attack.begin_s) for attack in attacks]

    def next_deadline(self) -> float:
        return min((running.next_at for running in self._attacks), default=NEVER)

    def due(self, now: float) -> None:
        for _ in range(CATCH_UP_LIMIT):
            running = min(self._attacks, key=lambda one: one.next_at, default=None)
            if running is None or running.next_at > now:
                return
            running.schedule(now)
            for end in running.attack.ends:
                self.attack(running.attack, end, now)

    def attack(self, attack: LineAttack, end: ModemEnd, now: float) -> None:
        make = _ROWS[attack.name][1]
        if make is None:
            self._link.hold(end, now + attack.hold_s, now)
            self._note(attack.name, Operation.HELD, end, b"", now, f"for {attack.hold_s:g} s")
            return
        number = self._numbers[attack.name, end]
        data, detail = make(attack, self._recorded[end], self._rng, number)
        if data:
            self._link.inject(end, data, now)
            self._note(attack.name, Operation.INJECTED, end, data, now, detail)

    def _note(self, name: str, operation: Operation, end: ModemEnd, data: bytes, now: float, detail: str) -> None:
        self._numbers[name, end] += 1
        direction, kind = Direction(end.other, end), _kind_in(data)
        self._on_done(Intervention(now, name, operation, direction, 0, kind, len(data), detail))


class _Running:
    """An attack, and when it acts next."""

    def __init__(self, attack: LineAttack, begin_at: float) -> None:
        self.attack = attack
        self.next_at = begin_at
        self._left = math.inf if attack.limit is None else attack.limit

    def schedule(self, now: float) -> None:
        self._left -= 1
        # After a pause of the process, do not catch up on more than one call allows.
        earliest = now - CATCH_UP_LIMIT * self.attack.interval_s
        self.next_at = max(self.next_at, earliest) + self.attack.interval_s if self._left else NEVER


def _kind_in(data: bytes) -> DatagramKind:
    """The kind of the first datagram in bytes of the line."""
    datagrams = LineDecoder().feed(data)
    return kind_of(datagrams[0]) if datagrams else DatagramKind.OTHER


# What is put on the line. Each maker returns bytes, none if it needs a recorded datagram first, and a detail.

Made = tuple[bytes, str]
Maker = Callable[[LineAttack, Sequence[bytes], Random, int], Made]


def _noise(attack: LineAttack, recorded: Sequence[bytes], rng: Random, number: int) -> Made:
    del recorded, number
    return rng.randbytes(attack.size), ""


def _bad_crc(attack: LineAttack, recorded: Sequence[bytes], rng: Random, number: int) -> Made:
    del attack, number
    datagram = rng.choice(recorded) if recorded else _invented(rng)
    return DELIMITER + damaged(encode(datagram), rng) + DELIMITER, ""


def _forge(attack: LineAttack, recorded: Sequence[bytes], rng: Random, number: int) -> Made:
    """In turn: a genuine datagram with one bit changed, and an envelope that is invented."""
    del attack
    if recorded and number % 2:
        datagram = bytearray(rng.choice(recorded))
        at = rng.randrange(len(datagram))
        datagram[at] ^= 1 << rng.randrange(8)
        return encode(bytes(datagram)), f"bit in byte {at}"
    return encode(_invented(rng)), "invented"


def _replay(attack: LineAttack, recorded: Sequence[bytes], rng: Random, number: int) -> Made:
    del attack, number
    return (encode(rng.choice(recorded)), "") if recorded else (b"", "")


def _cut(attack: LineAttack, recorded: Sequence[bytes], rng: Random, number: int) -> Made:
    """The first bytes of a genuine frame: one more each time."""
    del attack, rng
    if not recorded:
        return b"", ""
    framed = encode(recorded[-1])
    at = number % (len(framed) - 1)
    return framed[: at + 1], f"at {at} of {len(framed) - 1}"


def _invented(rng: Random) -> bytes:
    return bytes((wire.SHORT_ENVELOPE,)) + rng.randbytes(_FORGED_BYTES)


def damaged(framed: bytes, rng: Random) -> bytes:
    """A frame of the line, without its delimiters, of which one byte is another that is not a delimiter."""
    data = bytearray(framed.strip(DELIMITER))
    at = rng.randrange(len(data))
    data[at] = rng.choice([byte for byte in range(1, 256) if byte != data[at]])
    return bytes(data)


_ROWS: Final[Mapping[str, tuple[str, Maker | None]]] = MappingProxyType(
    {
        "line-noise": ("random bytes between and inside the frames of the line", _noise),
        "line-bad-crc": ("frames of the line with one altered byte", _bad_crc),
        "line-forge": ("forged and altered datagrams in frames with a valid CRC", _forge),
        "line-replay": ("datagrams that were received before, in frames with a valid CRC", _replay),
        "line-cut": ("genuine frames cut off, after one byte more each time", _cut),
        "line-hold": ("everything is held back in the modem, and then released", None),
    }
)
LINE_ATTACKS: Final[Mapping[str, str]] = MappingProxyType({name: text for name, (text, _) in _ROWS.items()})
"""What each attack puts on the line."""


def parse_line_attack(text: str) -> LineAttack:
    """Parse ``NAME,key=value,key=value``. Raises AttackError if there is no such attack, or a parameter is wrong."""
    name, *pairs = (part.strip() for part in text.split(","))
    if name not in LINE_ATTACKS:
        raise AttackError(f"there is no attack {name!r} on the line: choose one of {', '.join(LINE_ATTACKS)}")
    values = {key.strip(): value.strip() for key, _, value in (pair.partition("=") for pair in pairs)}
    try:
        return LineAttack.model_validate_strings({**values, "name": name})
    except ValidationError as error:
        problems = (f"{'.'.join(map(str, item['loc']))}: {item['msg']}" for item in error.errors())
        raise AttackError(f"{name}: {'; '.join(problems)}") from None
