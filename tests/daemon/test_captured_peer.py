"""A captured peer: with its keys an attacker can send what its policy passes, and nothing else reaches a client.

Each table is one victim's view of one captured peer. Every row is an attempt: the payload of a genuine envelope, what
of it is delivered, and what is counted. After each comes a frame that may pass: when it has arrived, so has all
before it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.daemon.fleet import FAST, Rogue, Station, Tally, a_member, held_back, station
from tests.daemon.frames import GROUND_SYSTEM, ground_heartbeat, heartbeat, pack
from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess
from uavlinkd.config.keys import generate_psk

CAPTURED = 2
TABLET = 200
ARM, TAKE_OFF, TERMINATE = (
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM,
    mavlink.MAV_CMD_NAV_TAKEOFF,
    mavlink.MAV_CMD_DO_FLIGHTTERMINATION,
)


class Attempt(NamedTuple):
    """A payload, the part of it that passes, and (message, reason) of what does not, each once unless counted."""

    what: str
    payload: bytes
    passing: bytes
    counted: dict[tuple[str, str], int]


def passes(what: str, frame: bytes) -> Attempt:
    """A frame that policy lets through."""
    return Attempt(what, frame, frame, {})


def refused(what: str, frame: bytes, message: str, reason: str) -> Attempt:
    """A frame that policy refuses."""
    return Attempt(what, frame, b"", {(message, reason): 1})


def long(number: int, system: int, target: int = 1, **fields: float) -> bytes:
    """COMMAND_LONG."""
    seven = [fields.get(f"param{n}", 0.0) for n in range(1, 8)]
    return pack(mavlink.MAVLink_command_long_message(target, 1, number, 0, *seven), system)


def item(number: int, system: int, version: int = 2) -> bytes:
    """MISSION_ITEM."""
    message = mavlink.MAVLink_mission_item_message(1, 1, 0, 0, number, 0, 1, 0, 0, 0, 0, 0, 0, 0)
    return pack(message, system, version=version)


def with_checksum(frame: bytes, crc_extra: int) -> bytes:
    """An unsigned MAVLink 2 frame with the checksum of another definition of its message."""
    crc = mavlink.x25crc(frame[1:-2])
    crc.accumulate(bytes((crc_extra,)))
    return frame[:-2] + int(crc.crc).to_bytes(2, "little")


def broken(frame: bytes) -> bytes:
    """The frame with a checksum that no definition gives."""
    fitting = {with_checksum(frame, extra)[-2:] for extra in range(256)}
    free = next(pair for n in range(65536) if (pair := n.to_bytes(2, "little")) not in fitting)
    return frame[:-2] + free


def unknown(system: int, number: int = 54321) -> bytes:
    """A sound frame of a message that the dialect does not know."""
    header = bytes((0xFD, 4, 0, 0, 0, system, 1)) + number.to_bytes(3, "little")
    return with_checksum(header + b"\1\2\3\4" + b"\0\0", 77)


def setup_signing(system: int, target: int = 1) -> bytes:
    """A new signing key for the victim."""
    return pack(mavlink.MAVLink_setup_signing_message(target, 1, bytes(range(32)), 10**12), system)


def malformed(own: bytes) -> list[Attempt]:
    """Payloads that are not whole genuine frames, for a peer that may say ``own``."""
    order = long(ARM, CAPTURED, param1=1)
    flags = own[:2] + b"\2" + own[3:]
    hiding = pack(mavlink.MAVLink_named_value_int_message(0, b"x", 0), CAPTURED)
    hiding = bytes((0xFD, 255)) + hiding[2:10] + order
    return [
        Attempt("a checksum that fits nothing", broken(own), b"", {("malformed", "bad_crc"): 1}),
        Attempt("that, and then a sound frame", broken(own) + own, own, {("malformed", "bad_crc"): 1}),
        Attempt("half a frame", own[: len(own) // 2], b"", {("malformed", "truncated"): 1}),
        Attempt("a start and nothing more", b"\xfd", b"", {("malformed", "truncated"): 1}),
        Attempt("unknown flags", flags, b"", {("malformed", "unknown_flags"): 1}),
        Attempt("a sound frame and rubbish", own + b"rubbish", own, {("malformed", "not_mavlink"): 1}),
        Attempt("text", b"$GPGGA,1,2,3", b"", {("dropped", "bad_control"): 1}),
        Attempt("an order inside what is cut", hiding, b"", {("malformed", "truncated"): 1}),
        Attempt("invalid control records", b"\7" * 9, b"", {("dropped", "bad_control"): 1}),
    ]


def as_a_member() -> list[Attempt]:
    """What a drone lets another do: say that it is there, and where. One attempt for each reason of a refusal."""
    own = heartbeat(CAPTURED)
    posing = heartbeat(CAPTURED, kind=mavlink.MAV_TYPE_GCS)
    return [
        passes("its heartbeat", own),
        passes("its heartbeat in MAVLink 1", heartbeat(CAPTURED, version=1)),
        refused("the station's order", long(ARM, GROUND_SYSTEM), "COMMAND_LONG", "foreign_system"),
        refused("a station's heartbeat, as itself", posing, "HEARTBEAT", "ground_station_not_allowed"),
        refused("a mission item", item(TERMINATE, CAPTURED), "MISSION_ITEM", "message_not_allowed"),
        refused("a signing key", setup_signing(CAPTURED), "SETUP_SIGNING", "setup_signing"),
        refused("an unknown message", unknown(CAPTURED), "54321", "unknown_message"),
        refused("a heartbeat otherwise defined", with_checksum(own, 51), "HEARTBEAT", "unknown_message"),
        Attempt(
            "an order between what may pass",
            own + long(ARM, CAPTURED, param1=1) + own,
            own + own,
            {("COMMAND_LONG", "message_not_allowed"): 1},
        ),
        *malformed(own),
    ]


def as_an_operator() -> list[Attempt]:
    """What a drone lets its ground station do: operate it, but for what is denied; no MAVLink 1."""
    return [
        passes("its heartbeat", ground_heartbeat()),
        passes("take off", long(TAKE_OFF, GROUND_SYSTEM, param7=3)),
        refused("terminate", long(TERMINATE, GROUND_SYSTEM, param1=1), "COMMAND_LONG", "command_not_allowed"),
        refused("in a mission", item(TERMINATE, GROUND_SYSTEM), "MISSION_ITEM", "command_not_allowed"),
        refused("in MAVLink 1", item(TERMINATE, GROUND_SYSTEM, version=1), "MISSION_ITEM", "mavlink1_not_allowed"),
    ]


class Table(NamedTuple):
    """A victim's policy for the captured peer, the attempts, and a frame that may pass, by its number."""

    policy: dict[str, object]
    attempts: Callable[[], list[Attempt]]
    marker: Callable[[int], bytes]


TABLES = {
    "member": Table(a_member(CAPTURED) | FAST, as_a_member, lambda n: heartbeat(CAPTURED, seq=n, kind=13)),
    "operator": Table(
        {
            "role": "operator",
            "system_ids": [GROUND_SYSTEM],
            "deny_in": ["MAV_CMD_DO_FLIGHTTERMINATION", "MAV_CMD_DO_SET_MODE"],
            "mavlink1": False,
        },
        as_an_operator,
        lambda n: ground_heartbeat(seq=1 + n % 255),
    ),
}


async def besieged(stage: Stage, policy: dict[str, object], psk: str) -> tuple[DaemonProcess, DaemonProcess, Station]:
    """A victim with one peer, whose keys are out, and a client that receives what passes."""
    victim, captured = stage.daemon("victim"), stage.daemon("captured")
    stage.secrets.append(psk)
    victim.add_peer(captured, [], psk, **policy)
    client = await station(stage)
    victim.add_endpoint("client", f"udpout:{client}")
    await stage.start(victim, linked=False)
    await victim.until(lambda status: bool(status["endpoints"]["client"]["clients"]))
    return victim, captured, client


@pytest.mark.parametrize("kind", TABLES)
async def test_it_says_what_its_policy_lets_it_say(stage: Stage, kind: str) -> None:
    """Of each attempt exactly what the policy allows is delivered, and all else is counted under its reason."""
    table = TABLES[kind]
    psk = generate_psk()
    victim, captured, client = await besieged(stage, table.policy, psk)
    wrong: list[str] = []
    async with Rogue(captured, victim, psk) as rogue:
        before: Tally = Counter()
        for number, attempt in enumerate(table.attempts()):
            marker = table.marker(number)
            client.clear()
            rogue.say(attempt.payload)
            rogue.say(marker)
            await client.until_received(marker)
            tally = held_back(await victim.status(), "peers", captured.name)
            if bytes(client.received) != attempt.passing + marker:
                wrong.append(f"{attempt.what}: {bytes(client.received).hex(' ')} came out")
            if tally - before != Counter(attempt.counted):
                wrong.append(f"{attempt.what}: counted {dict(tally - before)}")
            before = tally
    assert not wrong, "\n".join(wrong)


async def test_rates_bind_it(stage: Stage) -> None:
    """Of a burst of a message with a rate limit two pass, and the rest are counted; other messages go on."""
    psk = generate_psk()
    policy = {**a_member(CAPTURED), "rate_in": {"ATTITUDE": 2}}
    victim, captured, client = await besieged(stage, policy, psk)
    burst = [pack(mavlink.MAVLink_attitude_message(n, 0, 0, 0, 0, 0, 0), CAPTURED, seq=n) for n in range(20)]
    async with Rogue(captured, victim, psk) as rogue:
        rogue.say(b"".join(burst) + heartbeat(CAPTURED))
        await client.until_received(heartbeat(CAPTURED))
        assert client.frames == [*burst[:2], heartbeat(CAPTURED)]
        tally = held_back(await victim.status(), "peers", captured.name)
        assert tally == {("ATTITUDE", "rate_limited"): 18}


async def test_it_receives_only_what_its_role_allows(stage: Stage) -> None:
    """An observer gets telemetry; orders, keys and parameters set are never sent to it, and are counted."""
    psk = generate_psk()
    victim, captured, client = await besieged(stage, {"role": "observer", "system_ids": [TABLET]}, psk)
    setting = pack(mavlink.MAVLink_param_set_message(0, 1, b"FS_GCS_ENABLE", 0, 9), GROUND_SYSTEM)
    async with Rogue(captured, victim, psk) as rogue:
        rogue.say(pack(mavlink.MAVLink_ping_message(1, 2, 0, 0), TABLET))
        await client.until(lambda: bool(client.received))
        into = client.sources[-1]
        for frame in (heartbeat(1), setting, long(ARM, GROUND_SYSTEM, 0), setup_signing(GROUND_SYSTEM, 0)):
            client.send(frame, into)
        client.send(heartbeat(1, seq=1), into)
        await rogue.until(lambda: heartbeat(1, seq=1) in rogue.received)
        status = await victim.status()
        tally = held_back(status, "peers", captured.name, "out")
        unsaid = held_back(status, "endpoints", "client")
    assert bytes(rogue.received) == heartbeat(1) + heartbeat(1, seq=1)
    assert unsaid == {("SETUP_SIGNING", "setup_signing"): 1}
    assert tally == {(name, "message_not_allowed"): 1 for name in ("COMMAND_LONG", "PARAM_SET")}
