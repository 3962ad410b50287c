"""A policy limits the messages of a peer, and has no known bypass."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from operator import itemgetter
from random import Random
from typing import Any

import pytest
from fastcrc.crc16 import mcrf4xx
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink

from uavlinkd.mavlink import dialect
from uavlinkd.mavlink.dialect_table import COMMANDS, MESSAGES
from uavlinkd.mavlink.frames import Frame, SplitCounters, split_payload
from uavlinkd.mavlink.policy import gate as gates
from uavlinkd.mavlink.policy.compilation import Policy, PolicyError, compile_policy
from uavlinkd.mavlink.policy.gate import ANY_OTHER, Gate, Refusal
from uavlinkd.mavlink.policy.roles import ROLES

TERMINATE = COMMANDS["MAV_CMD_DO_FLIGHTTERMINATION"]
TAKEOFF = COMMANDS["MAV_CMD_NAV_TAKEOFF"]
OPERATOR = {"role": "operator", "system_ids": [255]}
OPERATOR_WITHOUT_TERMINATION = OPERATOR | {"deny_in": ["MAV_CMD_DO_FLIGHTTERMINATION", "MAV_CMD_DO_SET_MODE"]}


def sent(message: Any, *, system: int = 1, component: int = 1, version: int = 2) -> Frame:
    """The message as pymavlink sends it and the splitter reads it."""
    sender = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
    (frame,) = split_payload(bytes(message.pack(sender, force_mavlink1=version == 1)), SplitCounters())
    return frame


def raw_frame(msgid: int, payload: bytes, *, crc_extra: int | None = None, system: int = 1) -> Frame:
    """A MAVLink 2 frame with any payload and, by default, the dialect's CRC_EXTRA."""
    facts = dialect.facts(msgid)
    extra = crc_extra if crc_extra is not None else facts.crc_extra if facts else 7
    body = bytes([len(payload), 0, 0, 5, system, 1]) + msgid.to_bytes(3, "little") + payload
    raw = b"\xfd" + body + mcrf4xx(body + bytes([extra])).to_bytes(2, "little")
    (frame,) = split_payload(raw, SplitCounters())
    return frame


def blank(msgid: int, system: int = 1) -> Frame:
    """An empty frame of a message of the dialect."""
    return raw_frame(msgid, b"\x00", system=system)


def command_long(number: int, **facts: Any) -> Frame:
    return sent(mavlink.MAVLink_command_long_message(1, 1, number, 0, 1, 0, 0, 0, 0, 0, 0), **facts)


def command_int(number: int, **facts: Any) -> Frame:
    return sent(mavlink.MAVLink_command_int_message(1, 1, 0, number, 0, 0, 1, 0, 0, 0, 0, 0, 0), **facts)


def mission_item(number: int, **facts: Any) -> Frame:
    return sent(mavlink.MAVLink_mission_item_int_message(1, 1, 0, 0, number, 0, 1, 1, 0, 0, 0, 0, 0, 0), **facts)


def heartbeat(kind: int = mavlink.MAV_TYPE_QUADROTOR, **facts: Any) -> Frame:
    return sent(mavlink.MAVLink_heartbeat_message(kind, 3, 81, 5, 4, 3), **facts)


def attitude(**facts: Any) -> Frame:
    return sent(mavlink.MAVLink_attitude_message(1, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), **facts)


def compiled(data: Mapping[str, object], **options: bool) -> Policy:
    """A peer's policy. Without a role, a list that a test does not name passes everything."""
    lists = {} if "role" in data else {"allow_in": ["all"], "allow_out": ["all"]}
    return compile_policy({**lists, **data}, **options)


def incoming(data: Mapping[str, object], **options: bool) -> Gate:
    return compiled(data, **options).incoming


def ids(*names: str) -> list[int]:
    return [dialect.ids_by_name()[name] for name in names]


def test_no_policy_passes_everything_but_signing_keys() -> None:
    """Without a policy all messages pass in both directions and versions; SETUP_SIGNING does not."""
    made = compile_policy({}, is_local=True)
    for gate in (made.incoming, made.outgoing):
        for msgid in MESSAGES:
            refusal = gate.check(blank(msgid, system=77), 0.0)
            assert refusal == (Refusal.SETUP_SIGNING if msgid == 256 else None)
        assert gate.check(raw_frame(0x123456, b"x"), 0.0) is None
        assert gate.check(heartbeat(version=1), 0.0) is None
    assert "any system" in made.warnings[0]


@pytest.mark.parametrize("data", [{"system_ids": "all"}, *({"role": role, "system_ids": "all"} for role in ROLES)])
@pytest.mark.parametrize("extra", [None, 1])
@pytest.mark.parametrize("way", ["incoming", "outgoing"])
def test_setup_signing_never_crosses(data: dict[str, object], extra: int | None, way: str) -> None:
    """Every policy refuses SETUP_SIGNING, in any definition, under its own name."""
    gate: Gate = getattr(compiled(data), way)
    assert gate.check(raw_frame(256, b"\x01\x01" + b"k" * 32, crc_extra=extra), 0.0) is Refusal.SETUP_SIGNING


def test_foreign_system_is_refused() -> None:
    """A peer sends only as its own systems; a frame to the peer may be from any system."""
    made = compiled({"system_ids": [1, "10-12", "20"], "allow_in": ["all"]})
    passing = [s for s in range(256) if made.incoming.check(heartbeat(system=s), 0.0) is None]
    assert passing == [1, 10, 11, 12, 20]
    assert made.incoming.check(heartbeat(system=2), 0.0) is Refusal.FOREIGN_SYSTEM
    assert all(made.outgoing.check(heartbeat(system=s), 0.0) is None for s in range(256))


def test_only_what_is_allowed_passes() -> None:
    """An allow list defines all that passes: names and groups add up."""
    gate = incoming({"system_ids": "all", "allow_in": ["position", "STATUSTEXT"]})
    allowed = {*ids(*dialect.GROUPS["position"]), *ids("STATUSTEXT")}
    assert {m for m in MESSAGES if gate.check(blank(m), 0.0) is None} == allowed
    assert gate.check(blank(23), 0.0) is Refusal.MESSAGE_NOT_ALLOWED


def test_denial_overrides_everything() -> None:
    """Deny wins over allow, over a role, and over `all`."""
    for allow in (["all"], ["ATTITUDE"], ["telemetry"], [30]):
        for deny in (["ATTITUDE"], ["telemetry"], [30], ["30"], ["all"]):
            gate = incoming({"system_ids": "all", "allow_in": allow, "deny_in": deny})
            assert gate.check(attitude(), 0.0) is Refusal.MESSAGE_NOT_ALLOWED
    gate = incoming({"role": "vehicle", "system_ids": "all", "deny_in": ["telemetry"]})
    assert gate.check(attitude(), 0.0) is Refusal.MESSAGE_NOT_ALLOWED
    assert gate.check(blank(22), 0.0) is None


def test_directions_are_independent() -> None:
    """A list for one direction does not affect the other."""
    made = compiled({"system_ids": "all", "allow_in": ["ATTITUDE"], "deny_out": ["ATTITUDE"]})
    assert made.incoming.check(attitude(), 0.0) is None
    assert made.incoming.check(heartbeat(), 0.0) is Refusal.MESSAGE_NOT_ALLOWED
    assert made.outgoing.check(attitude(), 0.0) is Refusal.MESSAGE_NOT_ALLOWED
    assert made.outgoing.check(heartbeat(), 0.0) is None


@pytest.mark.parametrize(
    "entry", ["MAV_CMD_NAV_TAKEOFF", "command:22", "command:MAV_CMD_NAV_TAKEOFF", "command:NAV_TAKEOFF"]
)
def test_allowed_command_passes_alone(entry: str) -> None:
    """An allowed command passes in both command messages; other commands and mission items do not."""
    gate = incoming({"system_ids": "all", "allow_in": ["telemetry", entry]})
    assert gate.check(command_long(TAKEOFF), 0.0) is None
    assert gate.check(command_int(TAKEOFF), 0.0) is None
    for number in (TERMINATE, TAKEOFF + 1, TAKEOFF + 256, 0, 65535):
        assert gate.check(command_long(number), 0.0) is Refusal.COMMAND_NOT_ALLOWED
        assert gate.check(command_int(number), 0.0) is Refusal.COMMAND_NOT_ALLOWED
    assert gate.check(mission_item(TAKEOFF), 0.0) is Refusal.MESSAGE_NOT_ALLOWED
    assert gate.check(blank(11), 0.0) is Refusal.MESSAGE_NOT_ALLOWED


def test_denied_command_is_refused_in_every_carrier() -> None:
    """A denied command is refused in every command message, mission item and stamped command; others pass."""
    gate = incoming({"system_ids": "all", "deny_in": ["MAV_CMD_DO_FLIGHTTERMINATION"]})
    carriers = [msgid for msgid, row in MESSAGES.items() if row[6] is not None]
    assert len(carriers) == 7
    for msgid in carriers:
        at = MESSAGES[msgid][6]
        assert at is not None
        for number, verdict in ((TERMINATE, Refusal.COMMAND_NOT_ALLOWED), (TAKEOFF, None)):
            payload = bytes(at) + number.to_bytes(2, "little") + b"\x01\x01"
            assert gate.check(raw_frame(msgid, payload), 0.0) is verdict


def test_truncated_command_is_read_as_receivers_read_it() -> None:
    """Truncated bytes of a command count as zeros, as at the receiver."""
    gate = incoming({"system_ids": "all", "allow_in": ["command:185", "command:0"]})
    assert gate.check(raw_frame(76, bytes(28) + b"\xb9"), 0.0) is None
    assert gate.check(raw_frame(76, bytes(28) + b"\xb8"), 0.0) is Refusal.COMMAND_NOT_ALLOWED
    assert gate.check(raw_frame(76, bytes(28) + b"\xb9\x01"), 0.0) is Refusal.COMMAND_NOT_ALLOWED
    assert gate.check(raw_frame(76, bytes(3)), 0.0) is None
    assert (
        incoming({"deny_in": ["command:185"], "system_ids": "all"}).check(raw_frame(76, bytes(28) + b"\xb9"), 0.0)
        is Refusal.COMMAND_NOT_ALLOWED
    )


def test_denied_command_is_denied_in_its_other_form() -> None:
    """Messages with the effect of a command are denied with it: SET_MODE is DO_SET_MODE."""
    assert len(gates.SAME_AS_COMMAND) == 17  # all that are listed: the dialect has them
    for msgid, number in gates.SAME_AS_COMMAND.items():
        gate = incoming({"system_ids": "all", "deny_in": [f"command:{number}"]})
        assert gate.check(blank(msgid), 0.0) is Refusal.COMMAND_NOT_ALLOWED
        assert gate.check(attitude(), 0.0) is None


def mission_item_done_at_once(current: int, *, is_int: bool, version: int = 2) -> Frame:
    """A mission item, float or integer; it ends in zeros, which MAVLink 2 truncates."""
    name = f"MAVLink_mission_item{'_int' if is_int else ''}_message"
    return sent(getattr(mavlink, name)(1, 1, 7, 3, 16, current, 0, 0, 0, 0, 0, 0, 0, 0), version=version)


@pytest.mark.parametrize("is_int", [False, True])
@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize(
    ("denied", "refused"),
    [
        (["MAV_CMD_DO_REPOSITION"], {2}),
        (["MAV_CMD_DO_CHANGE_ALTITUDE"], {3}),
        (["MAV_CMD_DO_REPOSITION", "MAV_CMD_DO_CHANGE_ALTITUDE"], {2, 3}),
        (["MAV_CMD_NAV_TAKEOFF"], set()),
        ([], set()),
    ],
)
def test_mission_item_with_immediate_effect_is_a_command(
    is_int: bool, version: int, denied: list[str], refused: set[int]
) -> None:
    """ArduPilot flies to an item with `current` 2 immediately and climbs for 3: denied with these commands."""
    gate = incoming({"system_ids": "all", "deny_in": denied})
    for current in (0, 1, 2, 3, 4, 255):
        item = mission_item_done_at_once(current, is_int=is_int, version=version)
        expected = Refusal.COMMAND_NOT_ALLOWED if current in refused else None
        assert gate.check(item, 0.0) is expected, current


def test_mission_item_is_read_where_its_sender_wrote() -> None:
    """A truncated field is 0, and no byte of the checksum is read for it; an unreadable item is refused."""
    gate = incoming({"system_ids": "all", "deny_in": ["MAV_CMD_DO_REPOSITION", "MAV_CMD_DO_CHANGE_ALTITUDE"]})
    for msgid in ids("MISSION_ITEM", "MISSION_ITEM_INT"):
        for length in range(1, 36):
            for fill in (1, 2, 3):
                payload = bytes(length - 1) + bytes([fill])
                assert gate.check(raw_frame(msgid, payload), 0.0) is None, length
        whole = bytes(35) + b"\x02"
        assert gate.check(raw_frame(msgid, whole), 0.0) is Refusal.COMMAND_NOT_ALLOWED
        assert gate.check(raw_frame(msgid, whole + b"\x01\x01"), 0.0) is Refusal.COMMAND_NOT_ALLOWED
        assert gate.check(raw_frame(msgid, bytes(36), crc_extra=1), 0.0) is Refusal.COMMAND_NOT_ALLOWED


def test_commands_that_cannot_be_read_are_refused_where_any_is_denied() -> None:
    """Another definition of COMMAND_LONG, or five commands in one message, could contain the denied one."""
    free = incoming({"system_ids": "all"})
    strict = incoming({"system_ids": "all", "deny_in": ["MAV_CMD_DO_FLIGHTTERMINATION"]})
    named = incoming({"system_ids": "all", "allow_in": [76], "deny_in": ["MAV_CMD_DO_FLIGHTTERMINATION"]})
    foreign = raw_frame(76, bytes(28) + b"\x16\x00\x01\x01", crc_extra=153)
    waypoints = raw_frame(332, b"\x01")
    assert [free.check(f, 0.0) for f in (foreign, waypoints)] == [None, None]
    assert [strict.check(f, 0.0) for f in (foreign, waypoints)] == [Refusal.COMMAND_NOT_ALLOWED] * 2
    assert named.check(foreign, 0.0) is Refusal.COMMAND_NOT_ALLOWED


def test_unknown_message_passes_by_all_or_by_number_only() -> None:
    """A message that the dialect lacks passes only if everything does, or if its number is allowed."""
    unknown = raw_frame(0xABCDE, b"x")
    assert incoming({"system_ids": "all", "allow_in": ["all"]}).check(unknown, 0.0) is None
    assert incoming({"system_ids": "all", "allow_in": [0xABCDE]}).check(unknown, 0.0) is None
    assert incoming({"system_ids": "all", "allow_in": [str(0xABCDE)]}).check(unknown, 0.0) is None
    assert incoming({"system_ids": "all", "deny_in": [0xABCDE]}).check(unknown, 0.0) is Refusal.MESSAGE_NOT_ALLOWED
    for role in ROLES:
        gate = incoming({"role": role, "system_ids": "all"})
        assert gate.check(unknown, 0.0) is (None if role == "all" else Refusal.UNKNOWN_MESSAGE)


def test_name_allows_the_dialects_definition_only() -> None:
    """Another dialect's message under a known number is unknown: its number allows it, its name does not."""
    foreign = raw_frame(30, b"x", crc_extra=1)
    assert incoming({"system_ids": "all", "allow_in": ["ATTITUDE"]}).check(foreign, 0.0) is Refusal.UNKNOWN_MESSAGE
    assert incoming({"system_ids": "all", "allow_in": [30]}).check(foreign, 0.0) is None
    denied = incoming({"system_ids": "all", "allow_in": ["all"], "deny_in": ["ATTITUDE"]})
    assert denied.check(foreign, 0.0) is Refusal.MESSAGE_NOT_ALLOWED


def test_known_and_foreign_definitions_have_separate_decisions() -> None:
    """A decision about one definition of a message does not apply to the other, in either order."""
    foreign = raw_frame(30, b"x", crc_extra=1)
    for order in ((foreign, attitude()), (attitude(), foreign)):
        gate = incoming({"system_ids": "all", "allow_in": ["ATTITUDE"]})
        for _ in range(2):
            verdicts = {frame.header.is_known: gate.check(frame, 0.0) for frame in order}
            assert verdicts == {True: None, False: Refusal.UNKNOWN_MESSAGE}


def test_mavlink1_can_be_refused() -> None:
    """Both versions pass unless MAVLink 1 is disabled, which applies in both directions."""
    made = compiled({"system_ids": "all", "mavlink1": False})
    for gate in (made.incoming, made.outgoing):
        assert gate.check(heartbeat(version=1), 0.0) is Refusal.MAVLINK1_NOT_ALLOWED
        assert gate.check(heartbeat(version=2), 0.0) is None


@pytest.mark.parametrize("version", [1, 2])
def test_vehicle_does_not_pass_for_a_ground_station(version: int) -> None:
    """A ground station's HEARTBEAT from a vehicle is refused: it would hide the loss of the real one."""
    for role in ("vehicle", "swarm-member"):
        gate = incoming({"role": role, "system_ids": "all"})
        posing = heartbeat(mavlink.MAV_TYPE_GCS, version=version)
        assert gate.check(posing, 0.0) is Refusal.GROUND_STATION_NOT_ALLOWED
        assert gate.check(heartbeat(version=version), 0.0) is None
        assert gate.check(raw_frame(0, b"\x06\x06\x06\x06"), 0.0) is None  # the type is cut: 0, not 6
    trusted = incoming({"role": "vehicle", "system_ids": "all", "ground_station": True})
    assert trusted.check(heartbeat(mavlink.MAV_TYPE_GCS, version=version), 0.0) is None
    assert incoming(OPERATOR).check(heartbeat(mavlink.MAV_TYPE_GCS, system=255), 0.0) is None


def test_unreadable_heartbeat_does_not_pass_for_a_vehicles() -> None:
    """A HEARTBEAT in another definition could be a ground station's, so it is refused too."""
    gate = incoming({"system_ids": "all", "ground_station": False})
    assert gate.check(raw_frame(0, bytes(9), crc_extra=1), 0.0) is Refusal.GROUND_STATION_NOT_ALLOWED


def test_rate_limits_each_message_and_system_separately() -> None:
    """Over time a limited message passes at its rate, per system; other messages are not limited."""
    gate = incoming({"system_ids": "all", "rate_in": {"ATTITUDE": 10}})
    passed = [sum(gate.check(attitude(system=s), i * 0.02) is None for i in range(500)) for s in (1, 2)]
    assert all(100 <= n <= 105 for n in passed)  # ten seconds, and the half second that may come at once
    assert all(gate.check(heartbeat(), 0.0) is None for _ in range(500))
    assert gate.refused == {(30, Refusal.RATE_LIMITED): 1000 - sum(passed)}


def test_steady_sender_at_its_limit_loses_nothing() -> None:
    """One frame a second with some jitter passes a limit of one a second; a second frame each second does not."""
    gate = incoming({"system_ids": "all", "rate_in": {"HEARTBEAT": 1}})
    times = [i + (0.2 if i % 2 else 0.0) for i in range(60)]
    assert all(gate.check(heartbeat(), t) is None for t in times)
    passed = sum(gate.check(heartbeat(system=2), t / 2) is None for t in range(120))
    assert 60 <= passed <= 62


def battery(which: int, **facts: Any) -> Frame:
    message = mavlink.MAVLink_battery_status_message(which, 1, 1, 2500, [4000] * 10, 120, 1, 9, 77)
    return sent(message, **facts)


@pytest.mark.parametrize("way", ["in", "out"])
@pytest.mark.parametrize("components", [2, gates.SYSTEM_SHARE])
def test_components_do_not_starve_one_another(way: str, components: int) -> None:
    """Autopilot, gimbals and more send a HEARTBEAT each second for minutes: with a limit of one, nearly all pass."""
    made = compiled({"system_ids": "all", f"rate_{way}": {"HEARTBEAT": 1}})
    gate = made.incoming if way == "in" else made.outgoing
    jitter = Random(1)
    frames = [heartbeat(component=number) for number in range(1, components + 1)]
    beats = [(second + jitter.uniform(0, 0.003), frame) for second in range(300) for frame in frames]
    beats.sort(key=itemgetter(0))
    passed = Counter(frame.header.component for at, frame in beats if gate.check(frame, at) is None)
    assert len(passed) == components
    assert min(passed.values()) >= 298


def test_outgoing_rate_counts_each_instance() -> None:
    """The states of two batteries of one component both pass."""
    gate = compiled({"system_ids": "all", "rate_out": {"BATTERY_STATUS": 1}}).outgoing
    passed = Counter(which for second in range(60) for which in (0, 1) if gate.check(battery(which), second) is None)
    assert passed == {0: 60, 1: 60}
    assert sum(gate.check(battery(0), 60.5) is None for _ in range(10)) == 2


@pytest.mark.parametrize(
    ("denied", "others"),
    [
        ("MAV_CMD_COMPONENT_ARM_DISARM", ["MAV_CMD_DO_AUX_FUNCTION"]),
        ("MAV_CMD_DO_SET_MODE", ["MAV_CMD_DO_AUX_FUNCTION", "MAV_CMD_DO_SET_STANDARD_MODE"]),
        ("MAV_CMD_DO_CHANGE_ALTITUDE", ["MAV_CMD_GUIDED_CHANGE_ALTITUDE"]),
        ("MAV_CMD_GUIDED_CHANGE_ALTITUDE", ["MAV_CMD_DO_CHANGE_ALTITUDE"]),
        ("MAV_CMD_NAV_TAKEOFF", []),
    ],
)
def test_alternatives_are_denied_with_a_command(denied: str, others: list[str]) -> None:
    """A policy that denies arming also denies it by the number of a switch; other commands stay alone."""
    made = compiled({"system_ids": "all", "role": "operator", "deny_in": [denied]})
    refused = {name for name in COMMANDS if made.incoming.check(command_long(COMMANDS[name]), 0.0) is not None}
    assert refused == {denied, *others}
    text = {row.subject: row.incoming for row in made.describe()}["commands by number"]
    assert all(name in text for name in refused), "what is denied is shown"


def test_each_client_has_the_rate() -> None:
    """Two clients at one endpoint: the frames to the first do not use up the rate of the second."""
    gate = compiled({"system_ids": "all", "rate_out": {"HEARTBEAT": 1}}).outgoing
    passed = Counter(to for second in range(60) for to in (1, 2) if gate.check(heartbeat(), second, to) is None)
    assert passed == {1: 60, 2: 60}
    assert sum(gate.check(heartbeat(), 60.0, 3) is None for _ in range(10)) == 2


def test_a_groups_rate_does_not_limit_messages_sent_once() -> None:
    """All lines of a text go out at any rate of their group. A rate of its own limits it, as an incoming one does."""
    group = {"telemetry": 0.5}

    def passed(gate: Gate, msgid: int) -> int:
        return sum(gate.check(blank(msgid), 0.0) is None for _ in range(10))

    for rates, texts in ((group, 10), (group | {"STATUSTEXT": 1}, 2)):
        gate = compiled({"system_ids": "all", "rate_out": rates}).outgoing
        assert [passed(gate, dialect.ids_by_name()[name]) for name in ("ATTITUDE", "STATUSTEXT")] == [2, texts]
    assert passed(incoming({"system_ids": "all", "rate_in": group}), dialect.ids_by_name()["STATUSTEXT"]) == 2


def test_flow_of_commands_is_limited_message_by_message() -> None:
    """Commands and their answers are one flow to the link, but each message has its own rate."""
    gate = compiled({"system_ids": "all", "rate_out": {"COMMAND_LONG": 1, "COMMAND_INT": 1}}).outgoing
    assert [gate.check(command_long(TAKEOFF), 0.0) for _ in range(3)] == [None, None, Refusal.RATE_LIMITED]
    assert [gate.check(command_int(TAKEOFF), 0.0) for _ in range(3)] == [None, None, Refusal.RATE_LIMITED]


def test_invented_components_hardly_raise_the_rate() -> None:
    """A sender with another component in each frame gets sixteen times the rate, for any number of components."""
    gate = incoming({"system_ids": "all", "rate_in": {"HEARTBEAT": 1}})
    passed = sum(gate.check(heartbeat(component=n % 256), n / 100) is None for n in range(10_000))  # 100 s
    assert gates.SYSTEM_SHARE * 100 <= passed <= gates.SYSTEM_SHARE * (100 + 2)
    assert gate.check(heartbeat(system=2), 100.0) is None


def test_refused_frame_does_not_use_the_other_limit() -> None:
    """One component that floods uses its own share of the system's rate, and the others keep theirs."""
    gate = incoming({"system_ids": "all", "rate_in": {"HEARTBEAT": 1}})
    assert sum(gate.check(heartbeat(component=1), 0.0) is None for _ in range(1000)) == 2
    share = gates.SYSTEM_SHARE
    others = [sum(gate.check(heartbeat(component=2 + n), 0.0) is None for _ in range(9)) for n in range(share)]
    assert others == [2] * (share - 1) + [0]
    late = heartbeat(component=1 + share)
    assert gate.check(late, 0.5 / share) is Refusal.RATE_LIMITED
    assert [gate.check(late, 2.01 / share) for _ in range(3)] == [None, None, Refusal.RATE_LIMITED]


def test_refused_frame_does_not_use_the_rate() -> None:
    """Only frames that would pass count against a limit."""
    gate = incoming({"system_ids": [1], "allow_in": ["MAV_CMD_NAV_TAKEOFF"], "rate_in": {"COMMAND_LONG": 2}})
    for _ in range(50):
        assert gate.check(command_long(TERMINATE), 0.0) is Refusal.COMMAND_NOT_ALLOWED
        assert gate.check(command_long(TAKEOFF, system=9), 0.0) is Refusal.FOREIGN_SYSTEM
    assert gate.check(command_long(TAKEOFF), 0.0) is None


def test_own_rate_replaces_the_groups() -> None:
    """A group's rate applies to its messages, unless a message has its own. Of two groups' the lowest counts."""
    rates = {"position": 5, "telemetry": 20, "ATTITUDE": 50, "112233": 1}
    rows = compiled({"system_ids": "all", "rate_in": rates}).describe()
    text = {row.subject: row.incoming for row in rows}["rates"]
    assert "ATTITUDE 50/s" in text
    assert "GLOBAL_POSITION_INT 5/s" in text
    assert "STATUSTEXT 20/s" in text
    assert "112233 1/s" in text


def test_rate_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Invented systems do not enlarge the table of rates."""
    monkeypatch.setattr(gates, "MAX_BUCKETS", 8)
    gate = incoming({"system_ids": "all", "rate_in": {"HEARTBEAT": 1}})
    for system in range(1, 256):
        assert gate.check(heartbeat(system=system), 0.0) is None
    assert len(gate._buckets) == len(gate._of_systems) == 8


def test_every_refusal_is_counted_by_message_and_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    """Counts are exact per message until there are too many kinds; from then on the rest is counted together."""
    monkeypatch.setattr(gates, "MAX_COUNTED", 4)
    monkeypatch.setattr(gates, "MAX_DECISIONS", 4)
    gate = incoming({"role": "swarm-member", "system_ids": "all"})
    for msgid in range(0xA0000, 0xA0010):
        for _ in range(2):
            gate.check(raw_frame(msgid, b"x"), 0.0)
    assert gate.check(heartbeat(), 0.0) is None
    assert gate.refused == {
        **{(msgid, Refusal.UNKNOWN_MESSAGE): 2 for msgid in range(0xA0000, 0xA0004)},
        (ANY_OTHER, Refusal.UNKNOWN_MESSAGE): 24,
    }
    assert len(gate._decisions) <= 4


def test_refused_commands_are_counted_by_name() -> None:
    """By message, command and reason; numbers without a name together. A truncated payload counts as read."""
    gate = incoming({"role": "swarm-member", "system_ids": [1]})
    truncated = sent(mavlink.MAVLink_command_long_message(0, 0, TAKEOFF, 0, 0, 0, 0, 0, 0, 0, 0))
    assert truncated.raw[1] == 29  # the high byte of the command was zero
    frames = [command_long(TAKEOFF), truncated, command_int(TERMINATE), command_long(TAKEOFF, system=9)]
    for frame in [*frames, command_long(2), command_long(3), raw_frame(76, b"x", crc_extra=1), heartbeat(system=9)]:
        gate.check(frame, 0.0)
    assert gate.refused_commands == {
        (76, TAKEOFF, Refusal.MESSAGE_NOT_ALLOWED): 2,
        (75, TERMINATE, Refusal.MESSAGE_NOT_ALLOWED): 1,
        (76, TAKEOFF, Refusal.FOREIGN_SYSTEM): 1,
        (ANY_OTHER, ANY_OTHER, Refusal.MESSAGE_NOT_ALLOWED): 2,
        (ANY_OTHER, ANY_OTHER, Refusal.UNKNOWN_MESSAGE): 1,
    }
    assert gate.refused_systems == {9: 2}
    assert gate.totals == {
        Refusal.MESSAGE_NOT_ALLOWED: 5,
        Refusal.FOREIGN_SYSTEM: 2,
        Refusal.UNKNOWN_MESSAGE: 1,
    }


CAPTURED = [
    ("takes off another", command_long(TAKEOFF), Refusal.MESSAGE_NOT_ALLOWED),
    ("terminates another", command_int(TERMINATE), Refusal.MESSAGE_NOT_ALLOWED),
    ("commands as the ground station", command_long(TERMINATE, system=255), Refusal.FOREIGN_SYSTEM),
    ("speaks as another drone", heartbeat(system=3), Refusal.FOREIGN_SYSTEM),
    ("speaks as all", heartbeat(system=0), Refusal.FOREIGN_SYSTEM),
    ("poses as a ground station", heartbeat(mavlink.MAV_TYPE_GCS), Refusal.GROUND_STATION_NOT_ALLOWED),
    ("plants a mission", mission_item(TERMINATE), Refusal.MESSAGE_NOT_ALLOWED),
    ("plants a signing key", blank(256), Refusal.SETUP_SIGNING),
    ("sends an unknown message", raw_frame(0xFFFFFF, b"x"), Refusal.UNKNOWN_MESSAGE),
    ("sends its own ATTITUDE", raw_frame(30, b"x", crc_extra=1), Refusal.UNKNOWN_MESSAGE),
    ("sends MAVLink 1", heartbeat(version=1), Refusal.MAVLINK1_NOT_ALLOWED),
]


@pytest.mark.parametrize(("attempt", "frame", "reason"), CAPTURED, ids=[c[0] for c in CAPTURED])
def test_captured_swarm_member_cannot_command(attempt: str, frame: Frame, reason: Refusal) -> None:
    """With its real keys a captured drone can still send only presence and position; each attempt is counted."""
    gate = incoming({"role": "swarm-member", "system_ids": [1], "mavlink1": False})
    assert gate.check(frame, 0.0) is reason, attempt
    assert gate.refused == {(frame.header.msgid, reason): 1}
    assert gate.check(heartbeat(), 0.0) is None
    assert gate.check(attitude(), 0.0) is None


COMMANDING = [
    *("commands", "parameters", "setpoints", "manual", "shell", "firmware", "control-access", "sensors"),
    *("simulation", "rtk", "signing", "test", "transponder"),
]


@pytest.mark.parametrize("role", ["swarm-member", "observer"])
@pytest.mark.parametrize("group", COMMANDING)
def test_only_an_operator_changes_a_vehicle(role: str, group: str) -> None:
    """No role but the operator's may send messages that change a vehicle, apart from reading."""
    gate = incoming({"role": role, "system_ids": "all"})
    reads = set(dialect.GROUPS["parameter-reads"])
    for name in set(dialect.GROUPS[group]) - reads:
        assert gate.check(blank(dialect.ids_by_name()[name]), 0.0) is not None, name


def test_vehicle_cannot_command_its_operator() -> None:
    """A vehicle's role allows reports and answers; it sends no command and sets nothing."""
    gate = incoming({"role": "vehicle", "system_ids": [1]})
    for name in ("COMMAND_ACK", "PARAM_VALUE", "MISSION_COUNT", "STATUSTEXT", "FILE_TRANSFER_PROTOCOL", "LOG_DATA"):
        assert gate.check(blank(dialect.ids_by_name()[name]), 0.0) is None
    doing = [*COMMANDING, "streams", "signals"]
    passing = {n for g in doing for n in dialect.GROUPS[g] if gate.check(blank(ids(n)[0]), 0.0) is None}
    harmless = {*dialect.GROUPS["answers"], *dialect.GROUPS["telemetry"], *dialect.GROUPS["traffic"]}
    harmless |= {"UAVIONIX_ADSB_OUT_STATUS", "UAVIONIX_ADSB_TRANSCEIVER_HEALTH_REPORT"}
    assert passing - {"COMMAND_LONG", "COMMAND_INT"} <= harmless
    assert gate.check(command_long(COMMANDS["MAV_CMD_ACCELCAL_VEHICLE_POS"]), 0.0) is None
    assert gate.check(command_long(TAKEOFF), 0.0) is Refusal.COMMAND_NOT_ALLOWED


def test_operator_may_operate() -> None:
    """An operator commands, sets parameters and plans missions; it has no shell, and no simulator's sensors."""
    gate = incoming(OPERATOR)
    assert gate.check(command_long(TERMINATE, system=255), 0.0) is None
    for name in ("PARAM_SET", "MISSION_ITEM_INT", "SET_MODE", "MANUAL_CONTROL", "LOG_REQUEST_DATA"):
        assert gate.check(blank(dialect.ids_by_name()[name], system=255), 0.0) is None
    for name in ("SERIAL_CONTROL", "TUNNEL", "HIL_SENSOR", "SECURE_COMMAND", "CUBEPILOT_FIRMWARE_UPDATE_START"):
        assert gate.check(blank(dialect.ids_by_name()[name], system=255), 0.0) is Refusal.MESSAGE_NOT_ALLOWED


FROM_PX4 = [
    *("HEARTBEAT", "SYS_STATUS", "EXTENDED_SYS_STATE", "BATTERY_STATUS", "BATTERY_INFO", "ESC_INFO", "ESC_STATUS"),
    *("EVENT", "CURRENT_EVENT_SEQUENCE", "RESPONSE_EVENT_ERROR", "COMPONENT_INFORMATION", "COMPONENT_METADATA"),
    *("COMPONENT_INFORMATION_BASIC", "PROTOCOL_VERSION", "TIME_ESTIMATE_TO_TARGET", "FIGURE_EIGHT_EXECUTION_STATUS"),
    *("ILLUMINATOR_STATUS", "FUEL_STATUS", "AVAILABLE_MODES", "CURRENT_MODE", "OPEN_DRONE_ID_ARM_STATUS"),
]


def test_px4_messages_pass_in_both_directions() -> None:
    """PX4's events and metadata reach operator and observer. Only the operator may request events again."""
    vehicle = {"role": "vehicle", "system_ids": [1]}
    others = [compiled({"role": role, "system_ids": [1]}) for role in ("operator", "observer")]
    reporting = [incoming(vehicle), *(other.outgoing for other in others)]
    asked = [compiled(vehicle).outgoing, others[0].incoming]
    member = incoming({"role": "swarm-member", "system_ids": [1]})
    for gate in reporting:
        assert not [name for name in FROM_PX4 if gate.check(blank(*ids(name)), 0.0)]
        assert gate.check(blank(*ids("REQUEST_EVENT")), 0.0) is Refusal.MESSAGE_NOT_ALLOWED
    for gate in asked:
        assert gate.check(blank(*ids("REQUEST_EVENT")), 0.0) is None
        assert gate.check(blank(*ids("EVENT")), 0.0) is Refusal.MESSAGE_NOT_ALLOWED
    operator, observer = (other.incoming for other in others)
    assert observer.check(blank(*ids("REQUEST_EVENT")), 0.0) is Refusal.MESSAGE_NOT_ALLOWED
    for name in ("COMMAND_CANCEL", "PLAY_TUNE_V2", "TIMESYNC"):
        assert operator.check(blank(*ids(name)), 0.0) is None
        assert observer.check(blank(*ids(name)), 0.0) is Refusal.MESSAGE_NOT_ALLOWED
    passing = {name for name, msgid in dialect.ids_by_name().items() if member.check(blank(msgid), 0.0) is None}
    assert passing == {
        *("HEARTBEAT", "ATTITUDE", "ATTITUDE_QUATERNION", "GLOBAL_POSITION_INT", "LOCAL_POSITION_NED", "VFR_HUD"),
        *("POSITION_TARGET_GLOBAL_INT", "HOME_POSITION", "EXTENDED_SYS_STATE"),
    }


def test_denied_command_cannot_be_cancelled() -> None:
    """COMMAND_CANCEL is refused by its command number, and an allowed command does not allow it."""
    number = TERMINATE.to_bytes(2, "little")
    denied = incoming(OPERATOR_WITHOUT_TERMINATION)
    assert denied.check(raw_frame(80, number + b"\x01\x01", system=255), 0.0) is Refusal.COMMAND_NOT_ALLOWED
    assert denied.check(raw_frame(80, b"\x16\x00\x01\x01", system=255), 0.0) is None
    named = incoming({"system_ids": "all", "allow_in": ["MAV_CMD_NAV_TAKEOFF"]})
    assert named.check(raw_frame(80, b"\x16\x00\x01\x01"), 0.0) is Refusal.MESSAGE_NOT_ALLOWED


def test_observer_reads() -> None:
    """An observer may request parameters, the mission and single messages; its heartbeat is refused."""
    gate = incoming({"role": "observer", "system_ids": [250]})
    assert gate.check(blank(21, system=250), 0.0) is None
    assert gate.check(blank(43, system=250), 0.0) is None
    assert gate.check(command_long(512, system=250), 0.0) is gate.check(command_int(512, system=250), 0.0) is None
    assert gate.check(command_long(511, system=250), 0.0) is Refusal.COMMAND_NOT_ALLOWED
    assert gate.check(command_long(TAKEOFF, system=250), 0.0) is Refusal.COMMAND_NOT_ALLOWED
    assert gate.check(heartbeat(mavlink.MAV_TYPE_GCS, system=250), 0.0) is Refusal.MESSAGE_NOT_ALLOWED


FOR_AUTOPILOTS = [
    *("SET_MODE", "PARAM_SET", "MISSION_CLEAR_ALL", "MISSION_SET_CURRENT", "SET_HOME_POSITION", "MANUAL_CONTROL"),
    *("RC_CHANNELS_OVERRIDE", "SET_POSITION_TARGET_LOCAL_NED", "SET_ATTITUDE_TARGET", "GPS_RTCM_DATA", "LOG_ERASE"),
    *("CHANGE_OPERATOR_CONTROL", "LED_CONTROL", "REQUEST_DATA_STREAM", "TRAJECTORY_REPRESENTATION_WAYPOINTS"),
]
FOR_NO_ROLE = [
    *("SERIAL_CONTROL", "TUNNEL", "CAN_FRAME", "DEVICE_OP_WRITE", "V2_EXTENSION", "SECURE_COMMAND"),
    *("GPS_INPUT", "VISION_POSITION_ESTIMATE"),
]
OF_VEHICLES = ["MISSION_COUNT", "ADSB_VEHICLE", "FOLLOW_TARGET", "FILE_TRANSFER_PROTOCOL"]


@pytest.mark.parametrize(
    ("role", "passing"),
    [
        ("swarm-member", []),
        ("observer", []),
        ("vehicle", [*OF_VEHICLES, "RADIO_STATUS"]),
        ("operator", [*FOR_AUTOPILOTS, *OF_VEHICLES]),
    ],
)
def test_role_passes_these_messages_of_an_operator(role: str, passing: list[str]) -> None:
    """Of messages that make an autopilot do something, each role passes its own, and the rest is not allowed."""
    gate = incoming({"role": role, "system_ids": [1]})
    for name in (*FOR_AUTOPILOTS, *FOR_NO_ROLE, *OF_VEHICLES, "RADIO_STATUS"):
        assert gate.check(blank(*ids(name)), 0.0) is (None if name in passing else Refusal.MESSAGE_NOT_ALLOWED), name


def test_vehicle_and_operator_mirror_each_other() -> None:
    """A vehicle may send what its operator may receive, and vice versa."""
    vehicle, operator = ROLES["vehicle"], ROLES["operator"]
    assert (vehicle.allow_in, vehicle.allow_out) == (operator.allow_out, operator.allow_in)


@pytest.mark.parametrize("role", sorted(ROLES))
def test_role_compiles_and_is_described(role: str) -> None:
    """Each preset names only messages that exist, and its table has a line for each group."""
    made = compiled({"role": role, "system_ids": [1]})
    rows = {row.subject: row for row in made.describe()}
    assert set(dialect.GROUPS) <= set(rows)
    assert rows["signing"][1:] == ("never", "never")
    assert rows["may speak as"].incoming == "1"
    assert rows["role"].incoming == role
    assert made.warnings == (
        ('role = "all": it may send every message and command that no list denies',) if role == "all" else ()
    )


def test_table_describes_the_gate() -> None:
    """A group's line distinguishes all, none, most, some, and those that depend on the command."""
    made = compiled(
        {
            "system_ids": [1, "5-9"],
            "allow_in": ["telemetry", "mission", "MAV_CMD_NAV_TAKEOFF", 99999],
            "deny_in": ["MISSION_CLEAR_ALL", "MAV_CMD_DO_FLIGHTTERMINATION", 88888],
            "deny_out": ["files"],
            "mavlink1": False,
            "ground_station": False,
            "rate_out": {"ATTITUDE": 2.5},
        }
    )
    rows = {row.subject: row for row in made.describe()}
    assert rows["telemetry"][1:] == ("all", "all")
    assert rows["files"].outgoing == "none"
    assert rows["mission"].incoming.startswith("all but MISSION_CLEAR_ALL")
    assert "by command: MISSION_ITEM, MISSION_ITEM_INT" in rows["mission"].incoming
    assert rows["commands"].incoming == "only COMMAND_LONG, COMMAND_INT (by command: COMMAND_LONG, COMMAND_INT)"
    assert rows["commands by number"].incoming == (
        "allowed: MAV_CMD_NAV_TAKEOFF; denied: MAV_CMD_DO_FLIGHTTERMINATION, MAV_CMD_DO_AUX_FUNCTION"
    )
    assert rows["messages by number"].incoming == "allowed: 99999; denied: 88888"
    assert rows["messages unknown to the dialect"][1:] == ("refused", "passes")
    assert rows["MAVLink 1"][1:] == ("refused", "refused")
    assert rows["ground station's HEARTBEAT"][1:] == ("refused", "passes")
    assert rows["rates"][1:] == ("-", "ATTITUDE 2.5/s")
    assert rows["may speak as"].incoming == "1, 5-9"


def test_warnings_name_ways_around() -> None:
    """There is a warning about any system id, and about a denied command while opaque messages pass."""
    assert "any system" in compiled({"system_ids": "all"}).warnings[0]
    *_, warning = compiled(OPERATOR_WITHOUT_TERMINATION).warnings
    assert warning.startswith("deny_in names commands")
    assert "FILE_TRANSFER_PROTOCOL" in warning
    assert "SERIAL_CONTROL" not in warning
    closed = OPERATOR | {"deny_in": ["MAV_CMD_DO_FLIGHTTERMINATION", "files", "shell"]}
    assert not any("cannot inspect" in warning for warning in compiled(closed).warnings)
    assert compiled({"system_ids": [1], "deny_out": ["all", "command:1"]}).warnings == ()


WRONG: list[tuple[dict[str, object], str, str]] = [
    ({"allow": ["all"]}, "allow", "allow_in"),
    ({"role": "pilot"}, "role", "operator"),
    ({"role": 3}, "role", "operator"),
    ({"system_ids": []}, "system_ids", "[1]"),
    ({"system_ids": 1}, "system_ids", "[1]"),
    ({"system_ids": [0]}, "system_ids[0]", "[1]"),
    ({"system_ids": [1, 256]}, "system_ids[1]", "[1]"),
    ({"system_ids": [True]}, "system_ids[0]", "[1]"),
    ({"system_ids": ["1-x"]}, "system_ids[0]", "[1]"),
    ({"system_ids": ["9-3"]}, "system_ids[0]", "3-9"),
    ({"system_ids": [1, "all"]}, "system_ids[1]", "all"),
    ({"allow_in": "telemetry"}, "allow_in", "["),
    ({"allow_in": ["attitude"]}, "allow_in[0]", "'ATTITUDE'"),
    ({"allow_out": ["telemetry", "Telemetri"]}, "allow_out[1]", "'telemetry'"),
    ({"deny_in": ["qwzxy"]}, "deny_in[0]", "capitals"),
    ({"deny_in": [True]}, "deny_in[0]", ""),
    ({"deny_in": [1.5]}, "deny_in[0]", ""),
    ({"deny_out": [-1]}, "deny_out[0]", "16777215"),
    ({"deny_out": [1 << 24]}, "deny_out[0]", "16777215"),
    ({"deny_in": ["MAV_CMD_NAV_TAKEOF"]}, "deny_in[0]", "'MAV_CMD_NAV_TAKEOFF'"),
    ({"deny_in": ["command:qwzxy"]}, "deny_in[0]", "command:NUMBER"),
    ({"deny_in": ["command:65536"]}, "deny_in[0]", "65535"),
    ({"allow_in": ["signing"]}, "allow_in[0]", "leave"),
    ({"allow_in": ["SETUP_SIGNING"]}, "allow_in[0]", "leave"),
    ({"allow_out": [256]}, "allow_out[0]", "leave"),
    ({"rate_in": 5}, "rate_in", "{"),
    ({"rate_in": {"ATTITUDE": 0}}, "rate_in.ATTITUDE", "above 0"),
    ({"rate_in": {"ATTITUDE": float("nan")}}, "rate_in.ATTITUDE", "above 0"),
    ({"rate_in": {"ATTITUDE": "10"}}, "rate_in.ATTITUDE", "above 0"),
    ({"rate_in": {"ATTITUDE": True}}, "rate_in.ATTITUDE", "above 0"),
    ({"rate_out": {"ATTITUD": 10}}, "rate_out.ATTITUD", "'ATTITUDE'"),
    ({"rate_out": {"all": 10}}, "rate_out.all", "group"),
    ({"rate_out": {"MAV_CMD_NAV_TAKEOFF": 10}}, "rate_out.MAV_CMD_NAV_TAKEOFF", "group"),
    ({"mavlink1": "no"}, "mavlink1", "false"),
    ({"ground_station": 1}, "ground_station", "true"),
]


@pytest.mark.parametrize(("data", "key", "remedy"), WRONG, ids=[f"{w[0]}" for w in WRONG])
def test_mistake_is_named_with_its_remedy(data: dict[str, object], key: str, remedy: str) -> None:
    """Each mistake in the data is one problem with its key and what to write instead."""
    with pytest.raises(PolicyError) as caught:
        compiled({"system_ids": [1]} | data)
    (problem,) = caught.value.problems
    assert problem.key == key
    assert remedy in problem.remedy
    assert str(problem) in str(caught.value)


def test_all_mistakes_are_named_at_once() -> None:
    """One run reports every problem of a file."""
    data: dict[str, object] = {}
    for wrong, _, _ in (WRONG[0], WRONG[1], WRONG[4], WRONG[12], WRONG[13], WRONG[16], WRONG[26], WRONG[33]):
        data |= wrong
    with pytest.raises(PolicyError) as caught:
        compiled(data)
    assert len(caught.value.problems) == 8


def test_a_mistake_does_not_affect_a_corrected_list() -> None:
    """A refused list has no effect on the corrected list that follows."""
    with pytest.raises(PolicyError):
        compiled({"system_ids": "all", "allow_in": [True]})
    assert incoming({"system_ids": "all", "allow_in": [1]}).check(blank(1), 0.0) is None


entries = st.sampled_from(
    [
        *("all", "telemetry", "commands", "ATTITUDE", "COMMAND_LONG", 76, 30, "MAV_CMD_NAV_TAKEOFF"),
        *("command:185", "mission"),
    ]
)
frames = st.sampled_from(
    [
        *(attitude(), heartbeat(), command_long(TAKEOFF), command_long(TERMINATE), command_int(TERMINATE)),
        *(mission_item(TAKEOFF), mission_item(TERMINATE), raw_frame(0xAAAAAA, b"x"), blank(256), blank(11)),
        raw_frame(76, b"x", crc_extra=1),
    ]
)


@given(allow=st.lists(entries, max_size=4), deny=st.lists(entries, max_size=3), more=entries, frame=frames)
@settings(max_examples=400, deadline=None)
def test_lists_are_monotonic(allow: list[Any], deny: list[Any], more: Any, frame: Frame) -> None:
    """One more allowed entry never refuses a frame, and one more denied entry never passes one."""
    data = {"system_ids": "all", "allow_in": allow, "deny_in": deny}
    before = incoming(data).check(frame, 0.0)
    wider = incoming(data | {"allow_in": [*allow, more]}).check(frame, 0.0)
    narrower = incoming(data | {"deny_in": [*deny, more]}).check(frame, 0.0)
    if before is None:
        assert wider is None
    else:
        assert narrower is not None
    if "all" in deny or not allow or frame.header.msgid == 256:
        assert before is not None
    gate = incoming(data)
    assert [gate.check(frame, 0.0) for _ in range(3)] == [before] * 3
