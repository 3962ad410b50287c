"""The signatures of one endpoint, with an autopilot that judges them by pymavlink's rules."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.mavlink.signing.autopilot import Autopilot
from tests.mavlink.signing.wire import KEY, OTHER, STATION, Wire, keyed
from tests.samples import pack
from uavlinkd.config.model import LINK_ID
from uavlinkd.mavlink.signing.endpoint_signing import (
    ASK_S,
    MOST_OF_SOURCE,
    MOST_REPORTERS,
    MOST_SENDERS,
    MOST_STREAMS,
    QUESTIONS,
    SigningDrop,
)
from uavlinkd.mavlink.signing.signature import LAST_TIMESTAMP
from uavlinkd.protocol.crypto import Secret

KINDS = pytest.mark.parametrize("kind", ["ardupilot", "px4"])


def with_key(judge: type[Autopilot], kind: str = "ardupilot", key: Secret = KEY) -> Autopilot:
    return keyed(judge(kind), key)


def command(system: int = 255, component: int = 190, number: int = 0) -> bytes:
    message = mavlink.MAVLink_command_long_message(1, 1, 400, 0, 1.0, number, 0, 0, 0, 0, 0)
    return pack(message, system, component)


def report(system: int, component: int = 1) -> bytes:
    return pack(mavlink.MAVLink_attitude_message(1, 2, 3, 4, 5, 6, 7), system, component)


@KINDS
def test_nothing_passes_before_an_answer(judge: type[Autopilot], kind: str) -> None:
    """Until the autopilot answers a question, nothing passes in either direction; then everything that it signs."""
    autopilot = with_key(judge, kind)
    wire = Wire(autopilot)
    assert not wire.to_autopilot(command())
    autopilot.is_deaf = True
    wire.second()
    assert not wire.passed
    assert not wire.to_autopilot(command())
    autopilot.is_deaf = False
    wire.second()
    assert wire.signing.is_proven
    wire.second()
    assert [frame.header.msgid for frame in wire.passed] == [0]
    assert not wire.passed[0].raw[2]  # as if it had never been signed
    assert wire.to_autopilot(command())
    assert [message.get_type() for message in autopilot.accepted] == ["COMMAND_LONG"]
    assert not autopilot.rejected
    assert set(wire.drops) == {SigningDrop.NOT_PROVEN}


def test_unsigned_forged_and_replayed_frames(judge: type[Autopilot]) -> None:
    """A frame of the autopilot counts once, with a valid signature."""
    wire = Wire(with_key(judge))
    wire.second()
    wire.second()
    passed = len(wire.passed)
    for raw in wire.recorded[-2:]:
        assert not wire.to_daemon(raw)
    assert not wire.to_daemon(pack(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)))
    assert not wire.to_daemon(with_key(judge, key=OTHER).heartbeat())
    assert len(wire.passed) == passed
    assert wire.drops[SigningDrop.REPLAYED] == 2
    assert wire.drops[SigningDrop.UNSIGNED] == wire.drops[SigningDrop.BAD_SIGNATURE] == 1


def test_frames_that_somebody_on_the_cable_returns(judge: type[Autopilot]) -> None:
    """What a daemon signed is no frame of the autopilot, nor the answer that it made up for a peer."""
    wire = Wire(with_key(judge))
    wire.second()
    assert wire.to_autopilot(command())
    assert not wire.to_daemon(wire.sent[-1])
    asked: list[bytes] = []
    wire.signing.send = asked.append
    wire.signing.is_proven = False
    wire.signing.ask(wire.signing.signer, wire.now)
    number = int.from_bytes(asked[0][18:26].ljust(8, b"\0")[:8], "little")
    answer = pack(mavlink.MAVLink_timesync_message(7, number), 255, 190)
    second = wire.signing.signer.sign(answer, LINK_ID + 1, wire.signing.timestamp + 9)  # a second daemon's
    assert not wire.to_daemon(second)
    assert not wire.signing.is_proven
    assert wire.drops[SigningDrop.REFLECTED] == 2
    assert not wire.to_daemon(wire.signing.signer.sign(answer, 3, wire.signing.timestamp + 9))
    assert wire.signing.is_proven


def test_recorded_frames_prove_nothing_after_a_restart(judge: type[Autopilot]) -> None:
    """A new daemon accepts no frame that was recorded before it, earlier answers included."""
    wire = Wire(with_key(judge))
    for _ in range(50):
        wire.second()
    camera = wire.signing.signer.sign(report(1, 154), 3, wire.signing.timestamp)
    recorded = [*wire.recorded, camera]
    wire.autopilot.is_deaf = True
    wire.daemon_starts()
    for raw in recorded:
        wire.now += 1
        assert not wire.to_daemon(raw)
    assert not wire.passed[50:]
    assert not wire.to_autopilot(command())
    wire.autopilot.is_deaf = False
    wire.second()
    assert wire.to_autopilot(command())
    for raw in recorded:
        assert not wire.to_daemon(raw)


@KINDS
def test_restarts(judge: type[Autopilot], kind: str) -> None:
    """After a restart of either end, frames pass again with the autopilot's next HEARTBEATs, and none is rejected."""
    autopilot = with_key(judge, kind)
    wire = Wire(autopilot)
    wire.second()
    for number in range(100):
        if number % 3 == 0:
            wire.daemon_starts()
        elif number % 3 == 1:
            autopilot.restart()
        for _ in range(2):
            wire.second()
        assert wire.signing.is_proven
        for one in range(5):
            assert wire.to_autopilot(command(number=one))
    assert not autopilot.rejected
    assert len(autopilot.accepted) == 500


@pytest.mark.parametrize("timestamp", [10, 2**40, 2**48 - 2**28])
def test_clocks(judge: type[Autopilot], timestamp: int) -> None:
    """The autopilot's clock may jump to any time: the daemon follows its next frame."""
    wire = Wire(with_key(judge))
    wire.second()
    wire.autopilot.set_time(timestamp)
    wire.second()
    for sender in range(2):
        assert wire.to_autopilot(command(component=190 + sender))
    assert len(wire.autopilot.accepted) == 2
    assert not wire.autopilot.rejected


def test_a_step_of_the_timestamp_is_proven(judge: type[Autopilot]) -> None:
    """A frame far ahead may be an old one of an autopilot that went back: an answer comes before it counts."""
    wire = Wire(with_key(judge))
    wire.second()
    ahead = with_key(judge)
    ahead.set_time(2**40)
    wire.autopilot.is_deaf = True
    wire.to_daemon(ahead.heartbeat())
    assert not wire.signing.is_proven
    assert not wire.to_daemon(ahead.heartbeat())
    wire.autopilot.is_deaf = False
    wire.second()
    wire.second()
    assert len(wire.passed) == 1
    assert not wire.to_daemon(ahead.heartbeat())
    assert wire.drops[SigningDrop.REPLAYED] == 1


def test_an_answer_that_somebody_kept(judge: type[Autopilot]) -> None:
    """It does not bring back the time of the question, for no sender."""
    wire = Wire(with_key(judge))
    wire.second()
    kept: list[bytes] = []

    def keep(question: bytes) -> None:
        kept.extend(wire.autopilot.receive(question))

    wire.signing.send = keep
    wire.now += 1
    wire.to_daemon(wire.recorded[0])  # a replay: the daemon asks
    (answer,) = kept
    signer, first = wire.signing.signer, wire.signing.timestamp
    later = [signer.sign(report(1, 154), 3, first + number) for number in range(1, 4)]
    assert all(wire.to_daemon(raw) for raw in later)
    wire.to_daemon(answer)
    assert not any(wire.to_daemon(raw) for raw in later)


def test_an_answer_that_somebody_kept_proves_no_later_step(judge: type[Autopilot]) -> None:
    """The autopilot went back to an earlier time, and somebody recorded the later one."""
    wire = Wire(with_key(judge))
    wire.second()
    asked: list[bytes] = []
    wire.signing.send = asked.append
    wire.now += 1
    wire.to_daemon(wire.recorded[0])
    (kept,) = wire.autopilot.receive(asked[0])
    recorded = [wire.signing.signer.sign(report(1), 3, 2**40 + number) for number in range(3)]
    assert not wire.to_daemon(recorded[0])
    wire.to_daemon(kept)
    assert not any(wire.to_daemon(raw) for raw in recorded[1:])


def test_bounds(judge: type[Autopilot]) -> None:
    """Whoever replays frames causes few questions, old ones count no more, and few senders are remembered."""
    wire = Wire(with_key(judge))
    wire.second()
    asked: list[bytes] = []
    wire.signing.send = asked.append
    for _ in range(320):
        wire.now += ASK_S / 8
        wire.to_daemon(wire.recorded[0])
    assert len(asked) == 40
    wire.signing.is_proven = False
    wire.to_daemon(wire.autopilot.receive(asked[-1 - QUESTIONS])[0])
    before = wire.signing.is_proven
    wire.to_daemon(wire.autopilot.receive(asked[-1])[0])
    assert (before, wire.signing.is_proven) == (False, True)
    signer, first = wire.signing.signer, wire.signing.timestamp
    passed = [wire.to_daemon(signer.sign(report(1, number), 3, first + number)) for number in range(2, 200)]
    assert sum(map(bool, passed)) == MOST_STREAMS - 1
    assert wire.drops[SigningDrop.TOO_MANY_SENDERS] == 198 - (MOST_STREAMS - 1)


@KINDS
def test_an_autopilot_that_was_restarted_accepts_no_old_frame(judge: type[Autopilot], kind: str) -> None:
    """It knows no sender then, and accepts what is less than a minute old: a question leaps over that."""
    wire = Wire(with_key(judge, kind))
    wire.second()
    assert wire.to_autopilot(command())
    old = wire.sent[-1]
    wire.autopilot.save()
    wire.autopilot.restart()
    wire.second()
    wire.second()
    assert not wire.autopilot.receive(old)
    assert len(wire.autopilot.accepted) == 1
    assert wire.to_autopilot(command())
    assert len(wire.autopilot.accepted) == 2


@KINDS
def test_frames_after_a_question_that_was_lost(judge: type[Autopilot], kind: str) -> None:
    """The next question leaps over them too."""
    wire = Wire(with_key(judge, kind))
    wire.second()
    send, wire.signing.send = wire.signing.send, lambda _: None
    wire.now += 1
    wire.to_daemon(wire.recorded[0])
    wire.signing.send = send
    assert wire.to_autopilot(command())
    old = wire.sent[-1]
    wire.autopilot.restart()
    wire.second()
    wire.autopilot.receive(old)
    assert len(wire.autopilot.accepted) == 1


def test_both_ends_are_restarted(judge: type[Autopilot]) -> None:
    """The first question of a daemon leaps over what ArduPilot signed since it stored its timestamp."""
    wire = Wire(with_key(judge))
    wire.second()
    wire.autopilot.save()
    wire.autopilot.set_time(wire.signing.timestamp + 50_000)
    wire.second()
    assert wire.to_autopilot(command())
    old = wire.sent[-1]
    wire.autopilot.restart()
    wire.daemon_starts()
    wire.second()
    wire.autopilot.receive(old)
    assert len(wire.autopilot.accepted) == 1


def test_the_last_timestamp(judge: type[Autopilot]) -> None:
    """There is none behind it: frames leave with this one, and the autopilot rejects all but the first."""
    wire = Wire(with_key(judge))
    wire.second()
    wire.autopilot.set_time(LAST_TIMESTAMP)
    wire.second()
    for number in range(3):
        assert wire.to_autopilot(command(number=number))
    assert wire.signing.timestamp == LAST_TIMESTAMP
    assert len(wire.autopilot.accepted) <= 1


def test_a_station_cannot_move_the_timestamp(judge: type[Autopilot]) -> None:
    """The timestamp in a station's own signature is replaced with the signature."""
    wire = Wire(with_key(judge))
    wire.second()
    before = wire.signing.timestamp
    codec = mavlink.MAVLink(None, 255, 190)
    codec.signing.secret_key, codec.signing.sign_outgoing, codec.signing.timestamp = b"s" * 32, True, LAST_TIMESTAMP
    assert wire.to_autopilot(bytes(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3).pack(codec)))
    assert wire.signing.timestamp == before + 1
    assert len(wire.autopilot.accepted) == 1


def test_mavlink_1(judge: type[Autopilot]) -> None:
    """A MAVLink 1 frame cannot be signed, also where its bytes look like those of a sender that may."""
    wire = Wire(with_key(judge))
    wire.second()
    assert wire.to_autopilot(command(mavlink.MAVLINK_MSG_ID_SET_MODE, 190))
    assert not wire.to_autopilot(pack(mavlink.MAVLink_set_mode_message(1, 0, 190), 255, 190, version=1))
    assert not wire.to_autopilot(pack(mavlink.MAVLink_param_request_list_message(1, 1), 255, 190, version=1))
    assert wire.drops[SigningDrop.MAVLINK1] == 2


def test_places(judge: type[Autopilot]) -> None:
    """An autopilot keeps few senders. Other vehicles' reports and one peer that invents senders leave room."""
    wire = Wire(with_key(judge))
    wire.second()
    for system in range(1, 50):
        wire.to_autopilot(report(system), f"vehicle {system}")
    assert wire.drops[SigningDrop.TOO_MANY_SENDERS] == 49 - MOST_REPORTERS
    for component in range(1, 50):
        wire.to_autopilot(command(200, component), "captured")
    for component in range(1, 5):
        wire.to_autopilot(command(255, component), STATION)
    assert wire.drops[SigningDrop.TOO_MANY_SENDERS] == 49 - MOST_REPORTERS + 49 - MOST_OF_SOURCE + 2
    assert len(wire.autopilot.accepted) == MOST_SENDERS
    wire.to_autopilot(command(255, 1), STATION)
    assert len(wire.autopilot.accepted) == MOST_SENDERS + 1
    assert not wire.autopilot.rejected


def test_set_up(judge: type[Autopilot]) -> None:
    """An autopilot without a key gets one, and proves it; what peers claim to be a question gets no way around."""
    autopilot = judge()
    wire = Wire(autopilot)
    assert not wire.to_autopilot(pack(mavlink.MAVLink_timesync_message(0, 9), 51, 240))
    wire.signing.set_up(KEY, 1)
    assert autopilot.key == KEY.reveal()
    wire.signing.ask(wire.signing.signer, wire.now)
    assert wire.signing.is_proven
    assert not wire.to_daemon(pack(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)))
    assert wire.to_autopilot(command())
    assert len(autopilot.accepted) == 1


@pytest.mark.parametrize("arrives", [False, True])
def test_a_rotation_that_is_interrupted(judge: type[Autopilot], *, arrives: bool) -> None:
    """A daemon that gets the new key again uses the one that the autopilot has, and the new one ends the old one."""
    autopilot = with_key(judge)
    wire = Wire(autopilot)
    wire.second()
    if arrives:
        wire.signing.set_up(OTHER, 1)
    wire.daemon_starts()
    wire.signing.add(OTHER)
    wire.second()
    assert wire.signing.is_proven
    assert wire.signing.signer.secret == (OTHER if arrives else KEY)
    if not arrives:
        wire.signing.set_up(OTHER, 1)
        wire.second()
    wire.second()
    assert wire.signing.signer.secret == OTHER
    assert not wire.to_daemon(with_key(judge).heartbeat())
    assert wire.drops[SigningDrop.BAD_SIGNATURE] == 1
    assert wire.to_autopilot(command())


@KINDS
def test_rotations_under_traffic(judge: type[Autopilot], kind: str) -> None:
    """At each of 1,000 disarms the key changes. No frame is rejected, and the old key is void at once."""
    autopilot = with_key(judge, kind)
    wire = Wire(autopilot)
    wire.second()
    keys = [Secret(bytes([1 + number % 250, number // 250]) * 16) for number in range(1000)]
    for key in keys:
        autopilot.is_armed = True
        wire.second()
        assert wire.to_autopilot(command())
        autopilot.is_armed = False
        wire.second()
        before = wire.signing.signer
        newest = wire.signing.add(key)
        wire.signing.set_up(key, 1)
        wire.signing.ask(newest, wire.now)
        assert autopilot.key == key.reveal()
        assert wire.signing.signer is newest
        assert wire.to_autopilot(command())
        assert not wire.to_daemon(before.sign(pack(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)), 3, 2**47))
    assert not autopilot.rejected
    assert len(autopilot.accepted) == 2000
