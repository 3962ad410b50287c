"""A policy limits the messages of a peer, and has no known bypass."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from operator import itemgetter
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink

from tests.samples import (
    ID,
    attitude,
    battery,
    blank,
    build,
    command_int,
    command_long,
    frame,
    heartbeat,
    mission_item,
    read,
)
from uavlinkd.mavlink.dialect import COMMANDS, GROUPS, MESSAGES
from uavlinkd.mavlink.frames import Frame, payload_bytes
from uavlinkd.mavlink.policy import gate as gates
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.gate import ANY_OTHER, Gate, Refusal
from uavlinkd.mavlink.policy.roles import ROLES

TERMINATE = COMMANDS["MAV_CMD_DO_FLIGHTTERMINATION"]
TAKEOFF = COMMANDS["MAV_CMD_NAV_TAKEOFF"]
GCS = mavlink.MAV_TYPE_GCS


def foreign(msgid: int, payload: bytes = b"x") -> Frame:
    """The message in another definition than the dialect's."""
    return read(build(msgid, payload, crc_extra=1 if msgid != 76 else 153))


def raw_frame(msgid: int, payload: bytes) -> Frame:
    """A frame with any payload."""
    return read(build(msgid, payload))


def compiled(data: Mapping[str, object]) -> Policy:
    """A peer's policy. Without a role, a list that a test does not name passes everything."""
    lists = {} if "role" in data else {"allow_in": ["all"], "allow_out": ["all"]}
    return Policy({"system_ids": "all", **lists, **data})


def incoming(**data: object) -> Gate:
    return compiled(data).incoming


def passing(gate: Gate) -> set[str]:
    """The messages of the dialect that pass."""
    return {name for name, msgid in ID.items() if gate.check(blank(msgid), 0.0) is None}


@pytest.mark.parametrize("data", [{}, {"role": "all", "system_ids": "all"}])
def test_open_policy_passes_everything_but_signing_keys(data: dict[str, object]) -> None:
    """The wire to a local client is trusted: an endpoint needs no role and no list. A peer may have role = "all"."""
    made = Policy(data, is_local="role" not in data)
    assert passing(made.incoming) == set(ID) - {"SETUP_SIGNING"}
    assert passing(made.outgoing) == set(ID) - {"SETUP_SIGNING"}
    for gate in (made.incoming, made.outgoing):
        for one in (raw_frame(0x123456, b"x"), heartbeat(version=1), heartbeat(kind=GCS, system=77)):
            assert gate.check(one, 0.0) is None
    assert "may send" in made.warnings[0]


@pytest.mark.parametrize("data", [{}, *({"role": role} for role in ROLES)])
def test_setup_signing_never_crosses(data: dict[str, object]) -> None:
    """Every policy refuses SETUP_SIGNING, in any definition and direction, under its own name."""
    made = compiled(data)
    for gate in (made.incoming, made.outgoing):
        for one in (raw_frame(256, b"\1\1" + b"k" * 32), foreign(256)):
            assert gate.check(one, 0.0) is Refusal.SETUP_SIGNING


def test_foreign_system_is_refused() -> None:
    """A peer sends only as its own systems; a frame to the peer may be from any system."""
    made = compiled({"system_ids": [1, "10-12", "20"]})
    verdicts = {system: made.incoming.check(heartbeat(system=system), 0.0) for system in range(256)}
    assert {system for system, verdict in verdicts.items() if verdict is None} == {1, 10, 11, 12, 20}
    assert set(verdicts.values()) == {None, Refusal.FOREIGN_SYSTEM}
    assert all(made.outgoing.check(heartbeat(system=system), 0.0) is None for system in range(256))


def test_only_what_is_allowed_passes_in_its_direction() -> None:
    """An allow list defines all that passes: names and groups add up. The other direction has its own."""
    made = compiled({"allow_in": ["position", "STATUSTEXT"], "rate_out": {"ATTITUDE": 0}})
    assert passing(made.incoming) == {*GROUPS["position"], "STATUSTEXT"}
    assert passing(made.outgoing) == set(ID) - {"ATTITUDE", "SETUP_SIGNING"}


@pytest.mark.parametrize(
    "entry", ["MAV_CMD_NAV_TAKEOFF", "command:22", "command:MAV_CMD_NAV_TAKEOFF", "command:NAV_TAKEOFF"]
)
def test_allowed_command_passes_alone(entry: str) -> None:
    """An allowed command passes in both command messages; others, mission items and cancellations do not."""
    gate = incoming(allow_in=["telemetry", entry])
    assert gate.check(command_long(TAKEOFF), 0.0) is gate.check(command_int(TAKEOFF), 0.0) is None
    for number in (TERMINATE, TAKEOFF + 1, TAKEOFF + 256, 0, 65535):
        for one in (command_long(number), command_int(number)):
            assert gate.check(one, 0.0) is Refusal.COMMAND_NOT_ALLOWED
    for one in (mission_item(TAKEOFF), blank("SET_MODE"), raw_frame(80, b"\x16\0\1\1")):
        assert gate.check(one, 0.0) is Refusal.MESSAGE_NOT_ALLOWED


def test_truncated_command_is_read_as_receivers_read_it() -> None:
    """Truncated bytes of a command count as zeros, as at the receiver."""
    gate = incoming(allow_in=["command:185", "command:0"])
    for payload, verdict in (
        (bytes(28) + b"\xb9", None),
        (bytes(3), None),
        (bytes(28) + b"\xb8", Refusal.COMMAND_NOT_ALLOWED),
        (bytes(28) + b"\xb9\1", Refusal.COMMAND_NOT_ALLOWED),
    ):
        assert gate.check(raw_frame(76, payload), 0.0) is verdict


@pytest.mark.parametrize("name", ["mission_item", "mission_item_int"])
@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("allowed", [{2}, {3}, {2, 3}, set()])
def test_mission_item_with_immediate_effect_is_a_command(name: str, version: int, allowed: set[int]) -> None:
    """ArduPilot flies to an item with `current` 2 immediately and climbs for 3: that needs these commands."""
    commands = {2: "MAV_CMD_DO_REPOSITION", 3: "MAV_CMD_DO_CHANGE_ALTITUDE"}
    gate = incoming(allow_in=["heartbeat", "mission", *(commands[current] for current in allowed)])
    for current in (0, 1, 2, 3, 4, 255):
        # It ends in zeros, which MAVLink 2 truncates.
        message = getattr(mavlink, f"MAVLink_{name}_message")(1, 1, 7, 3, 16, current, *[0] * 8)
        verdict = gate.check(frame(message, version=version), 0.0)
        assert verdict is (Refusal.COMMAND_NOT_ALLOWED if current in {2, 3} - allowed else None), current


def test_mission_item_is_read_where_its_sender_wrote() -> None:
    """A truncated field is 0, and no byte of the checksum is read for it."""
    gate = incoming(allow_in=["mission"])
    for msgid in (ID["MISSION_ITEM"], ID["MISSION_ITEM_INT"]):
        for length in range(1, 36):
            for fill in (1, 2, 3):
                assert gate.check(raw_frame(msgid, bytes(length - 1) + bytes([fill])), 0.0) is None, length
        whole = bytes(35) + b"\2"
        for one in (raw_frame(msgid, whole), raw_frame(msgid, whole + b"\1\1")):
            assert gate.check(one, 0.0) is Refusal.COMMAND_NOT_ALLOWED
        for entry in ("commands", "COMMAND_LONG", 75, "all"):
            assert incoming(allow_in=["mission", entry]).check(raw_frame(msgid, whole), 0.0) is None


# What a receiver executes when the message arrives (ArduPilot's and PX4's handlers), and the group that says so.
AT_ONCE = {
    "commands": "SET_MODE MISSION_SET_CURRENT SET_HOME_POSITION SET_GPS_GLOBAL_ORIGIN COMMAND_LONG COMMAND_INT",
    "parameters": "PARAM_SET PARAM_EXT_SET PARAM_MAP_RC SET_MAG_OFFSETS",
    "setpoints": "SET_ATTITUDE_TARGET SET_POSITION_TARGET_LOCAL_NED SET_POSITION_TARGET_GLOBAL_INT",
    "manual": "MANUAL_CONTROL RC_CHANNELS_OVERRIDE",
    "streams": "REQUEST_DATA_STREAM",
    "camera": "DIGICAM_CONFIGURE DIGICAM_CONTROL",
    "gimbal": "MOUNT_CONFIGURE MOUNT_CONTROL GIMBAL_MANAGER_SET_ATTITUDE GIMBAL_MANAGER_SET_PITCHYAW",
    "transponder": "UAVIONIX_ADSB_OUT_CONTROL",
}


def test_no_group_for_transfers_or_reports_acts_at_once() -> None:
    """Such a message is in the group that names its effect, and in no other but that of urgent ones."""
    for group, names in AT_ONCE.items():
        for name in names.split():
            assert {other for other, members in GROUPS.items() if name in members} - {"urgent"} == {group}, name


def test_unknown_message_passes_by_all_or_by_number_only() -> None:
    """A message that the dialect lacks passes only if everything does, or if its number is allowed."""
    unknown = raw_frame(0xABCDE, b"x")
    for allowed in ("all", 0xABCDE, str(0xABCDE)):
        assert incoming(allow_in=[allowed]).check(unknown, 0.0) is None
    for role in ROLES:
        assert incoming(role=role).check(unknown, 0.0) is (None if role == "all" else Refusal.UNKNOWN_MESSAGE)


def test_name_allows_the_dialects_definition_only() -> None:
    """Another dialect's message under a known number is unknown: its number allows it, its name does not."""
    for order in ((foreign(30), attitude()), (attitude(), foreign(30))):
        gate = incoming(allow_in=["ATTITUDE"])
        for _ in range(2):  # decisions are remembered
            verdicts = {one.header.is_known: gate.check(one, 0.0) for one in order}
            assert verdicts == {True: None, False: Refusal.UNKNOWN_MESSAGE}
    assert incoming(allow_in=[30]).check(foreign(30), 0.0) is None


def grown(one: Frame, version: int) -> Frame:
    """The same message by a newer definition: with one more field behind those of the dialect."""
    payload = payload_bytes(one, 0, 255).ljust(MESSAGES[one.header.msgid][3], b"\0") + b"\7"
    return read(build(one.header.msgid, payload, one.header.system, version=version))


@pytest.mark.parametrize("role", ROLES)
def test_extension_fields_change_no_verdict(role: str) -> None:
    """Every message that grew passes or is refused by the fields that the dialect has: message, command, type."""
    frames = [blank(msgid) for msgid, row in MESSAGES.items() if row[3] < 255]
    frames += [command_long(TAKEOFF), command_long(TERMINATE), command_int(TERMINATE), mission_item(TAKEOFF)]
    frames += [heartbeat(), heartbeat(kind=GCS)]
    gate = compiled({"role": role}).incoming
    for one in frames:
        verdicts = [gate.permits(grown(one, version)) for version in (1, 2)[one.header.msgid > 255 :]]
        assert set(verdicts) == {gate.permits(one)}, one.header


def test_mavlink1_can_be_refused() -> None:
    """Both versions pass unless MAVLink 1 is disabled, which applies in both directions."""
    made = compiled({"mavlink1": False})
    for gate in (made.incoming, made.outgoing):
        assert gate.check(heartbeat(version=1), 0.0) is Refusal.MAVLINK1_NOT_ALLOWED
        assert gate.check(heartbeat(version=2), 0.0) is None


@pytest.mark.parametrize("version", [1, 2])
def test_vehicle_does_not_pass_for_a_ground_station(version: int) -> None:
    """A ground station's HEARTBEAT from a vehicle is refused: it would hide the loss of the real one."""
    posing = heartbeat(kind=GCS, version=version)
    for role in ("vehicle", "swarm-member"):
        gate = incoming(role=role)
        assert gate.check(posing, 0.0) is Refusal.GROUND_STATION_NOT_ALLOWED
        assert gate.check(heartbeat(version=version), 0.0) is None
        assert gate.check(raw_frame(0, b"\6\6\6\6"), 0.0) is None  # the type is cut: 0, not 6
    assert incoming(ground_station=False).check(foreign(0, bytes(9)), 0.0) is Refusal.GROUND_STATION_NOT_ALLOWED
    assert incoming(role="vehicle", ground_station=True).check(posing, 0.0) is None
    assert incoming(role="operator").check(posing, 0.0) is None


# Rates.


@pytest.mark.parametrize("way", ["in", "out"])
@pytest.mark.parametrize("components", [2, gates.SYSTEM_SHARE])
def test_components_do_not_starve_one_another(way: str, components: int) -> None:
    """Autopilot, gimbals and more send a HEARTBEAT each second for minutes: with a limit of one, nearly all pass."""
    made = compiled({f"rate_{way}": {"HEARTBEAT": 1}})
    gate = made.incoming if way == "in" else made.outgoing
    jitter = Random(1)
    frames = [heartbeat(component=number) for number in range(1, components + 1)]
    beats = [(second + jitter.uniform(0, 0.003), one) for second in range(300) for one in frames]
    passed = Counter(one.header.component for at, one in sorted(beats, key=itemgetter(0)) if not gate.check(one, at))
    assert len(passed) == components
    assert min(passed.values()) >= 298


def test_outgoing_rate_counts_each_instance_client_and_message() -> None:
    """Two batteries, and two clients, have a rate each; so have two messages of the flow of commands."""
    gate = compiled({"rate_out": {"BATTERY_STATUS": 1, "COMMAND_LONG": 1, "COMMAND_INT": 1}}).outgoing
    keys = [(which, to) for which in (0, 1) for to in (1, 2)]
    passed = Counter(
        key for second in range(60) for key in keys if not gate.check(battery(1, key[0]), second, key[1])
    )
    assert passed == dict.fromkeys(keys, 60)
    for one in (battery(1, 2), command_long(TAKEOFF), command_int(TAKEOFF)):
        assert [gate.check(one, 60.5) for _ in range(3)] == [None, None, Refusal.RATE_LIMITED]


def test_a_groups_rate_does_not_limit_messages_sent_once() -> None:
    """All lines of a text go out at any rate of their group. A rate of its own limits it, as an incoming one does."""
    group = {"telemetry": 0.5}

    def passed(gate: Gate, name: str) -> int:
        return sum(gate.check(blank(name), 0.0) is None for _ in range(10))

    for rates, texts in ((group, 10), (group | {"STATUSTEXT": 1}, 2)):
        gate = compiled({"rate_out": rates}).outgoing
        assert [passed(gate, name) for name in ("ATTITUDE", "STATUSTEXT")] == [2, texts]
    assert passed(incoming(rate_in=group), "STATUSTEXT") == 2


def test_invented_components_hardly_raise_the_rate() -> None:
    """A sender with another component in each frame gets sixteen times the rate, for any number of components."""
    gate = incoming(rate_in={"HEARTBEAT": 1})
    passed = sum(gate.check(heartbeat(component=n % 256), n / 100) is None for n in range(10_000))  # 100 s
    assert gates.SYSTEM_SHARE * 100 <= passed <= gates.SYSTEM_SHARE * (100 + 2)
    assert gate.check(heartbeat(system=2), 100.0) is None


def test_refused_frame_does_not_use_the_other_limit() -> None:
    """One component that floods uses its own share of the system's rate, and the others keep theirs."""
    gate = incoming(rate_in={"HEARTBEAT": 1})
    assert sum(gate.check(heartbeat(component=1), 0.0) is None for _ in range(1000)) == 2
    share = gates.SYSTEM_SHARE
    others = [sum(gate.check(heartbeat(component=2 + n), 0.0) is None for _ in range(9)) for n in range(share)]
    assert others == [2] * (share - 1) + [0]
    late = heartbeat(component=1 + share)
    assert gate.check(late, 0.5 / share) is Refusal.RATE_LIMITED
    assert [gate.check(late, 2.01 / share) for _ in range(3)] == [None, None, Refusal.RATE_LIMITED]


def test_refused_frame_does_not_use_the_rate() -> None:
    """Only frames that would pass count against a limit."""
    gate = incoming(system_ids=[1], allow_in=["MAV_CMD_NAV_TAKEOFF"], rate_in={"COMMAND_LONG": 2})
    for _ in range(50):
        assert gate.check(command_long(TERMINATE), 0.0) is Refusal.COMMAND_NOT_ALLOWED
        assert gate.check(command_long(TAKEOFF, 9), 0.0) is Refusal.FOREIGN_SYSTEM
    assert gate.check(command_long(TAKEOFF), 0.0) is None


# Counts and bounds.


def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Invented systems and messages. Counts are exact per message until there are too many kinds."""
    for name, most in (("MAX_BUCKETS", 8), ("MAX_COUNTED", 4), ("MAX_DECISIONS", 4)):
        monkeypatch.setattr(gates, name, most)
    gate = incoming(rate_in={"HEARTBEAT": 1})
    for system in range(1, 256):
        assert gate.check(heartbeat(system=system), 0.0) is None
    assert len(gate._buckets) == len(gate._of_systems) == 8
    gate = incoming(role="swarm-member")
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
    gate = incoming(role="swarm-member", system_ids=[1])
    truncated = command_long(TAKEOFF, target=(0, 0))
    assert truncated.raw[1] == 29  # the high byte of the command was zero
    frames = [command_long(TAKEOFF), truncated, command_int(TERMINATE), command_long(TAKEOFF, 9)]
    for one in [*frames, command_long(2), command_long(3), foreign(76), heartbeat(system=9)]:
        gate.check(one, 0.0)
    assert gate.refused_commands == {
        (76, TAKEOFF, Refusal.MESSAGE_NOT_ALLOWED): 2,
        (75, TERMINATE, Refusal.MESSAGE_NOT_ALLOWED): 1,
        (76, TAKEOFF, Refusal.FOREIGN_SYSTEM): 1,
        (ANY_OTHER, ANY_OTHER, Refusal.MESSAGE_NOT_ALLOWED): 2,
        (ANY_OTHER, ANY_OTHER, Refusal.UNKNOWN_MESSAGE): 1,
    }
    assert gate.refused_systems == {9: 2}
    assert gate.totals == {Refusal.MESSAGE_NOT_ALLOWED: 5, Refusal.FOREIGN_SYSTEM: 2, Refusal.UNKNOWN_MESSAGE: 1}


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
        foreign(76),
    ]
)


@given(allow=st.lists(entries, max_size=4), more=entries, one=frames)
@settings(max_examples=100)
def test_lists_are_monotonic(allow: list[Any], more: Any, one: Frame) -> None:
    """One more allowed entry never refuses a frame."""
    gate = incoming(allow_in=allow)
    before = gate.check(one, 0.0)
    wider = incoming(allow_in=[*allow, more]).check(one, 0.0)
    if before is None:
        assert wider is None
    if not allow or one.header.msgid == 256:
        assert before is not None
    assert [gate.check(one, 0.0) for _ in range(3)] == [before] * 3
