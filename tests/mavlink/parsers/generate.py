"""Generated streams: frames that role tables pass, containing frames that they refuse."""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Final, NamedTuple

from tests.mavlink.parsers.captured_member import CAST, GOALS, command_long, heartbeat_of, set_mode
from tests.mavlink.parsers.hidden_frames import SIGNATURE_BYTES, Carrier, crc_extra, frame, hide, msgid_of
from tests.mavlink.parsers.receivers import PRIVATE_EXTRAS
from uavlinkd.mavlink.dialect import COMMANDS, MESSAGES, OTHER_EXTRAS
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.gate import Refusal

LETS_UNKNOWN_PASS: Final = frozenset({"private dialect"})
"""For these every CRC_EXTRA counts."""
CLIENTS: Final[Sequence[Mapping[str, object]]] = ({}, {"rate_out": {"HEARTBEAT": 0}})
"""The policies of the endpoints."""
STARTS: Final = (0xFD, 0xFE)
_MOST_FRAMES: Final = 6
_WITH_COMMAND: Final = (75, 76)  # COMMAND_INT, COMMAND_LONG
_ALLOWED_COMMAND: Final = COMMANDS["MAV_CMD_REQUEST_MESSAGE"].to_bytes(2, "little")  # which an observer may send


class Part(NamedTuple):
    """One frame and its sender."""

    sender: str
    raw: bytes


class Recipe(NamedTuple):
    """The frames to one client, in order."""

    client: int
    parts: tuple[Part, ...]


class _Sender(NamedTuple):
    name: str
    systems: tuple[int, ...]
    allowed: tuple[int, ...]
    allowed_1: tuple[int, ...]  # that MAVLink 1 can number


@cache
def _sender(name: str) -> _Sender:
    policy = Policy(CAST[name])
    gate = policy.incoming
    systems = tuple(system for system in range(1, 256) if gate.may_speak_as(system))
    allowed = tuple(msgid for msgid in MESSAGES if not isinstance(gate.decide(msgid, is_known=True), Refusal))
    has_mavlink1 = CAST[name].get("mavlink1", True)
    numbered = tuple(msgid for msgid in allowed if msgid < 256) if has_mavlink1 else ()
    return _Sender(name, systems, allowed, numbered)


@cache
def _goals() -> tuple[tuple[bytes, int], ...]:
    """Frames that most roles forbid, with a CRC_EXTRA of their definition, of others, or 0 for unknown ones."""
    frames = [make() for make in GOALS.values()]
    frames += [set_mode(255, version=1), heartbeat_of(9), set_mode(2), command_long("NAV_LAND", 2, version=1)]
    frames += [frame(23, bytes(20) + b"abc", system, version=version) for system in (2, 255) for version in (1, 2)]
    frames += [frame(30, bytes(28), 99), frame(33, bytes(28), 1), frame(39, bytes(38), 2), frame(150, bytes(40), 9)]
    result = [(raw, crc_extra(msgid_of(raw))) for raw in frames]
    result += [(frame(msgid, bytes(4), 2, extra=0), 0) for msgid in (54321, 9000, 226)]
    result += [(frame(msgid, bytes(4), 1, version=1, extra=0), 0) for msgid in (3, 96, 252)]
    result += [(raw, 0) for raw, _ in result[:6]]
    for msgid, extras in OTHER_EXTRAS.items():
        size = MESSAGES[msgid][3] if msgid in MESSAGES else 8
        result += [(frame(msgid, bytes(size), 9, version=v), extras[0]) for v in ((1, 2) if msgid < 256 else (2,))]
    result += [(frame(msgid, bytes(8), 9), extra) for msgid, extra in PRIVATE_EXTRAS.items()]
    return tuple(result)


class Generator:
    """An endless generator of recipes, from a seed."""

    def __init__(self, seed: int) -> None:
        self._rng = random.Random(seed)

    def recipe(self) -> Recipe:
        """The next recipe."""
        rng = self._rng
        names = rng.sample(tuple(CAST), rng.choice((1, 1, 2, 2, 3)))
        count = rng.randint(1, _MOST_FRAMES)
        carriers = [self._carrier(_sender(names[rng.randrange(len(names))])) for _ in range(count)]
        senders = [carrier_name for _, carrier_name in carriers]
        built = self._hide([carrier for carrier, _ in carriers])
        client = rng.randrange(len(CLIENTS)) if rng.random() < 0.3 else 0
        return Recipe(client, tuple(map(Part, senders, built)))

    def _carrier(self, sender: _Sender) -> tuple[Carrier, str]:
        rng = self._rng
        draw = rng.random
        version = 1 if sender.allowed_1 and draw() < 0.25 else 2
        allowed = sender.allowed_1 if version == 1 else sender.allowed
        msgid = allowed[int(draw() * len(allowed))]
        _, _, shortest, longest, *_ = MESSAGES[msgid]
        if version == 1:
            size = shortest
        elif draw() < 0.6:
            size = longest
        else:  # zeros at the end are cut
            size = 1 + int(draw() * longest)
        kind = draw()
        if kind < 0.4:
            payload = bytearray(size)
        elif kind < 0.8:
            payload = bytearray(rng.randbytes(size))
        else:
            payload = bytearray(rng.choices((0xFD, 0xFE, 0, 1, 9, 255), k=size))
        if msgid in _WITH_COMMAND and size > 29 and draw() < 0.8:
            payload[28:30] = _ALLOWED_COMMAND
        ends_in = STARTS[draw() < 0.5] if draw() < 0.3 else None
        return (
            Carrier(
                msgid,
                payload,
                sender.systems[int(draw() * len(sender.systems))],
                self._byte(1),
                version,
                seq=self._byte(0),
                compat=self._byte(0) if draw() < 0.2 else 0,
                signature=bytearray(rng.randbytes(13)) if version == 2 and draw() < 0.3 else bytearray(),
                checksum_ends_in=ends_in,
            ),
            sender.name,
        )

    def _byte(self, usual: int) -> int:
        """A header byte that the sender chooses."""
        kind = self._rng.random()
        return usual if kind < 0.5 else STARTS[kind < 0.6] if kind < 0.7 else int(self._rng.random() * 256)

    def _hide(self, carriers: list[Carrier]) -> list[bytes]:
        rng = self._rng
        begins = [0]
        for carrier in carriers:
            begins.append(begins[-1] + carrier.size)
        total = begins[-1]
        kind = rng.random()
        if kind < 0.05:
            return [carrier.build() for carrier in carriers]
        index = rng.randrange(len(carriers))
        carrier = carriers[index]
        if kind < 0.15 and carrier.version == 2:  # the frame itself, read as MAVLink 1
            goal = bytes((0xFE, len(carrier.payload), 0, self._byte(255), self._byte(1), carrier.system))
            whole = goal + bytes(len(carrier.payload) + 2)
            return hide(carriers, whole, begins[index], crc_extra(carrier.system))
        goal, extra = _goals()[int(rng.random() * len(_goals()))]
        if kind < 0.35:  # at the end of a checksum
            at = begins[index] + carrier.payload_at + len(carrier.payload) + 1
            carrier.checksum_ends_in = goal[0] if rng.random() < 0.7 else 0xFD
        elif kind < 0.5 and carrier.signature:
            at = begins[index + 1] - 1 - rng.randrange(SIGNATURE_BYTES)
        elif kind < 0.8:  # its header at the end of a payload
            last = begins[index] + carrier.payload_at + len(carrier.payload)
            at = max(begins[index] + 1, last - rng.randint(1, 12))
        else:
            at = rng.randrange(total)
        return hide(carriers, self._fitted(goal, at, carriers, begins), at, extra)

    def _fitted(self, goal: bytes, at: int, carriers: Sequence[Carrier], begins: Sequence[int]) -> bytes:
        """The same with a payload so long that its checksum lies in some carrier's payload, if it can.

        The C library accepts any length.
        """
        shortest = at + len(goal) - 2
        longest = shortest + 255 - goal[1]
        places = []
        for begin, carrier in zip(begins, carriers, strict=False):
            first = max(shortest, begin + carrier.payload_at)
            last = min(longest, begin + carrier.payload_at + len(carrier.payload) - 2)
            if first <= last:
                places.append((first, last))
        if not places:
            return goal
        first, last = places[int(self._rng.random() * len(places))]
        more = first + int(self._rng.random() * (last - first + 1)) - shortest
        return goal[:1] + bytes((goal[1] + more,)) + goal[2:-2] + bytes(more + 2)
