"""Generated frames that a role passes, from the role tables and the definitions of the messages.

Every frame goes through the code that decides in the daemon: the parser, the gate of the policy, and the filter of
the stream to a client. The gate's clock is virtual, so that the role's rates refuse no frame: an autopilot that
withstands these frames at a higher rate withstands them at the role's.
"""

from __future__ import annotations

import random
import struct
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from tests.mavlink.parsers.hidden_frames import SIGNATURE_BYTES, Carrier
from uavlinkd.lab.sim.autopilot import HOME
from uavlinkd.mavlink.dialect import COMMANDS, MESSAGES
from uavlinkd.mavlink.frames import parse_frame
from uavlinkd.mavlink.payloads import HEARTBEAT
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.delivery import DeliveredStream, Source
from uavlinkd.mavlink.policy.gate import REQUEST_MESSAGE, Condition, Refusal

ROLES_TESTED: Final = ("observer", "swarm-member")
SYSTEMS: Final[Mapping[str, Sequence[int]]] = {"observer": (200, 254), "swarm-member": (2, 3)}
"""The `system_ids` of the peers: not the vehicle's, and not its ground station's."""
VEHICLE: Final = 1
STATION: Final = 255
INTERVAL_S: Final = 20.0
"""Between two frames on the gate's clock: no role has a rate below 0.05/s."""

_FLOATS: Final = (
    *(0.0, -0.0, 1.0, -1.0, 0.5, 2.0, 100.0, 360.0, 1e-40, 3.4e38, -3.4e38, 2147483648.0, -2147483648.0, 16777217.0),
    *(float("nan"), float("inf"), float("-inf")),
)
_COMPONENTS: Final = (0, 1, 2, 25, 68, 100, 140, 154, 158, 190, 191, 195, 220, 236, 240, 250, 255)
_MISSION_TYPES: Final = (0, 0, 1, 2, 3, 4, 254, 255)
_NAMES: Final = (
    b"_HASH_CHECK",
    b"SYSID_THISMAV",
    b"MAV_SYS_ID",
    b"FS_GCS_ENABLE",
    b"WPNAV_SPEED",
    b"",
    b"%s%n%x",
    b"/",
)


class FieldOf(NamedTuple):
    """One field of a message as it is packed."""

    name: str
    kind: str  # as in `struct`
    elements: int  # of an array; 1 otherwise


@cache
def fields_of(msgid: int) -> tuple[FieldOf, ...]:
    """The fields of a message in the order of the payload."""
    message: Any = mavlink.mavlink_map[msgid]
    kinds = message.native_format.decode()[1:]
    arrays = zip(message.ordered_fieldnames, kinds, message.array_lengths, strict=True)
    return tuple(FieldOf(name, kind, max(1, count)) for name, kind, count in arrays)


class RoleFrames:
    """An endless generator of frames that a role passes, from a seed."""

    def __init__(self, role: str, seed: int) -> None:
        self.role = role
        self.systems = SYSTEMS[role]
        self.policy: Mapping[str, object] = {"role": role, "system_ids": list(self.systems)}
        self.by_message: Counter[str] = Counter()
        self._rng = random.Random(seed)
        self._gate = Policy(self.policy).incoming
        self._stream = DeliveredStream(Policy({}, is_local=True).outgoing)
        self._source = Source(role, self._gate)
        self._now = 0.0
        verdicts = {msgid: self._gate.decide(msgid, is_known=True) for msgid in MESSAGES}
        self.messages = tuple(msgid for msgid, verdict in verdicts.items() if not isinstance(verdict, Refusal))
        self._commands = {
            msgid: tuple(sorted(verdict.only_commands))
            for msgid, verdict in verdicts.items()
            if isinstance(verdict, Condition) and verdict.only_commands is not None
        }
        self._special: Mapping[str, Callable[[], object]] = {
            "target_system": lambda: self._one_of(VEHICLE, VEHICLE, VEHICLE, VEHICLE, 0, STATION, *self.systems),
            "target_component": lambda: self._one_of(1, 1, 1, 0, 0, *_COMPONENTS),
            "mission_type": lambda: self._one_of(*_MISSION_TYPES),
            "param_id": self._parameter,
            "lat": lambda: self._near(HOME.latitude_deg),
            "lat_int": lambda: self._near(HOME.latitude_deg),
            "latitude": lambda: self._near(HOME.latitude_deg),
            "lon": lambda: self._near(HOME.longitude_deg),
            "lon_int": lambda: self._near(HOME.longitude_deg),
            "longitude": lambda: self._near(HOME.longitude_deg),
            "seq": lambda: self._one_of(0, 0, 1, 1, 2, 3, 4, 65535),
            "idx": lambda: self._one_of(0, 0, 1, 2, 255),
            "param_index": lambda: self._one_of(-1, -1, -1, -2, 0, 1, 2, 700, 32767, -32768),
            "frame": lambda: self._one_of(0, 1, 2, 3, 5, 6, 8, 10, 11, 21, 255),
        }

    def draw(self) -> bytes:
        """The next frame, as the daemon would deliver it: perhaps behind separator bytes.

        Raises:
            AssertionError: the policy refuses a frame that the generator made by the role's table.
        """
        while True:
            msgid = self.messages[int(self._rng.random() * len(self.messages))]
            raw = self._carrier(msgid).build()
            frame = parse_frame(raw)
            assert frame is not None, raw.hex(" ")
            self._now += INTERVAL_S
            refusal = self._gate.check(frame, self._now)
            if refusal is Refusal.COMMAND_NOT_ALLOWED and frame.header.command == REQUEST_MESSAGE:
                continue  # of a message that may not go to this role, or of a number that is not one
            assert refusal is None, (refusal, raw.hex(" "))
            delivered = self._stream.admit(frame, self._source, self._now)
            if delivered:  # otherwise its random bytes hide a frame
                self.by_message[MESSAGES[msgid][0]] += 1
                return delivered

    def _carrier(self, msgid: int) -> Carrier:
        rng = self._rng
        _, _, shortest, longest, *_ = MESSAGES[msgid]
        payload = bytearray(b"".join(self._packed(msgid, one) for one in fields_of(msgid)))
        payload += rng.randbytes(longest - len(payload))  # extensions that pymavlink lacks
        version = 1 if msgid < 256 and rng.random() < 0.3 else 2
        if version == 1:
            del payload[shortest:]
        else:
            self._cut(msgid, payload, shortest)
        is_signed = version == 2 and rng.random() < 0.1
        return Carrier(
            msgid,
            payload,
            self._one_of(*self.systems),
            rng.randrange(256) if rng.random() < 0.4 else self._one_of(1, 1, 1, 1, *_COMPONENTS),
            version,
            seq=rng.randrange(256),
            compat=rng.randrange(256) if rng.random() < 0.1 else 0,
            signature=bytearray(rng.randbytes(SIGNATURE_BYTES)) if is_signed else bytearray(),
        )

    def _cut(self, msgid: int, payload: bytearray, shortest: int) -> None:
        """Shorten a payload of MAVLink 2: its zeros, its extensions, or more, except fields that policy reads."""
        kind = self._rng.random()
        if kind < 0.5:
            while len(payload) > 1 and payload[-1] == 0:
                payload.pop()
        elif kind < 0.7:
            del payload[shortest:]
        elif kind < 0.8 and msgid not in self._commands and msgid != HEARTBEAT:
            del payload[self._rng.randint(1, len(payload)) :]

    def _packed(self, msgid: int, one: FieldOf) -> bytes:
        if one.kind == "c":
            text = self._special["param_id"]() if one.name == "param_id" else self._rng.randbytes(one.elements)
            return struct.pack(f"{one.elements}s", text)
        return struct.pack(f"<{one.elements}{one.kind}", *(self._value(msgid, one) for _ in range(one.elements)))

    def _value(self, msgid: int, one: FieldOf) -> Any:
        rng = self._rng
        if one.name == "command":
            return self._one_of(*self._commands.get(msgid) or COMMANDS.values())
        if one.name == "type" and msgid == HEARTBEAT:
            return self._one_of(2, 2, 1, 5, 13, *(kind for kind in range(48) if kind != mavlink.MAV_TYPE_GCS), 255)
        if one.name == "param1" and rng.random() < 0.7:  # of MAV_CMD_REQUEST_MESSAGE
            return float(self._one_of(0, 1, 24, 33, 49, 148, 242, 244, 435, 65535, *MESSAGES))
        special = self._special.get(one.name)
        if special is not None and rng.random() < 0.9:
            return special()
        if one.kind in "fd":
            kind = rng.random()
            if kind < 0.5:
                return self._one_of(*_FLOATS)
            bits = rng.getrandbits(32 if one.kind == "f" else 64).to_bytes(struct.calcsize(one.kind), "little")
            return rng.gauss(0, 30) if kind < 0.9 else struct.unpack("<" + one.kind, bits)[0]
        bits_count = 8 * struct.calcsize("<" + one.kind)
        is_signed = one.kind.islower()
        least, most = (-(1 << bits_count - 1), (1 << bits_count - 1) - 1) if is_signed else (0, (1 << bits_count) - 1)
        kind = rng.random()
        if kind < 0.5:
            edges = (0, 0, 1, 2, least, most, most - 1, most // 2, -1 if is_signed else most)
            return self._one_of(*edges)
        return rng.randint(least, most) if kind < 0.8 else rng.randint(0, min(most, 100))

    def _parameter(self) -> bytes:
        if self._rng.random() < 0.85:
            return self._rng.choice(_NAMES)
        return self._rng.randbytes(16)

    def _near(self, degrees: float) -> int:
        """1e-7 degrees within some tens of metres of the vehicle."""
        return round(degrees * 1e7 + self._rng.gauss(0, 2000))

    def _one_of(self, *values: Any) -> Any:
        return values[int(self._rng.random() * len(values))]
