"""Frames on which real autopilots acted although a role only reads. The fuzzer of `tests.sitl.roles` sent them."""

from __future__ import annotations

import struct

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.samples import ID, build, frame, read
from uavlinkd.mavlink.frames import Frame
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.gate import REQUEST_MESSAGE, Refusal

OBSERVER = {"role": "observer", "system_ids": [200]}
ADSB_OUT_CFG = ID["UAVIONIX_ADSB_OUT_CFG"]
NOT_A_NUMBER = [float("nan"), float("inf"), -float("inf"), 3.4e38, -1.0, 0.5, 2.0**24, 2.0**31]


def request(number: float, *, is_int: bool = False, version: int = 2) -> Frame:
    """MAV_CMD_REQUEST_MESSAGE in COMMAND_LONG or COMMAND_INT."""
    if is_int:
        payload = struct.pack("<4fiifHBBBBB", number, 0, 0, 0, 0, 0, 0.0, REQUEST_MESSAGE, 1, 1, 0, 0, 0)
        return read(build(ID["COMMAND_INT"], payload, 200, version=version))
    payload = struct.pack("<7fHBBB", number, 0, 0, 0, 0, 0, 0, REQUEST_MESSAGE, 1, 1, 0)
    return read(build(ID["COMMAND_LONG"], payload, 200, version=version))


def test_osd_request_that_ends_arducopter_is_refused() -> None:
    """ArduCopter 4.7 reads a null pointer: screen 5, parameter 1. As the fuzzer sent it."""
    gate = Policy(OBSERVER).incoming
    culprit = read(bytes.fromhex("fd080000bbc82f1b2b00ffffffff01010501bc6f"))
    assert gate.check(culprit, 0.0) is Refusal.MESSAGE_NOT_ALLOWED
    by_group = {"system_ids": [200], "allow_in": ["parameter-reads"], "allow_out": []}
    assert Policy(by_group).incoming.check(culprit, 0.0) is Refusal.MESSAGE_NOT_ALLOWED


def test_request_of_every_event_is_refused() -> None:
    """PX4 answers it with 65,536 frames."""
    gate = Policy(OBSERVER).incoming
    everything = build(ID["REQUEST_EVENT"], struct.pack("<HHBB", 0, 65535, 1, 1), 200)
    assert gate.check(read(everything), 0.0) is Refusal.MESSAGE_NOT_ALLOWED


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("is_int", [False, True], ids=["COMMAND_LONG", "COMMAND_INT"])
def test_observer_requests_only_what_it_may_receive(version: int, *, is_int: bool) -> None:
    """PX4 adds ten parameters to its list if it is asked for UAVIONIX_ADSB_OUT_CFG."""
    gate = Policy(OBSERVER).incoming
    for name in ("AUTOPILOT_VERSION", "HOME_POSITION", "MESSAGE_INTERVAL", "PROTOCOL_VERSION", "HEARTBEAT"):
        asked = request(ID[name], is_int=is_int, version=version)
        assert gate.check(asked, 1.0) is None
    for number in (ADSB_OUT_CFG, ID["PARAM_SET"], 54321, *NOT_A_NUMBER):
        asked = request(number, is_int=is_int, version=version)
        assert gate.check(asked, 100.0) is Refusal.COMMAND_NOT_ALLOWED
        assert not gate.permits(asked)


def test_what_may_go_out_may_be_requested() -> None:
    """The rule follows the lists of the file. A role that has all commands has no such limit."""
    more = Policy({**OBSERVER, "allow_out": ["UAVIONIX_ADSB_OUT_CFG"]}).incoming
    assert more.permits(request(ADSB_OUT_CFG))
    fewer = Policy({**OBSERVER, "rate_out": {"HOME_POSITION": 0}}).incoming
    assert not fewer.permits(request(ID["HOME_POSITION"]))
    operator = Policy({"role": "operator", "system_ids": [200]}).incoming
    assert operator.permits(request(ADSB_OUT_CFG))
    assert operator.permits(request(float("nan")))


@pytest.mark.parametrize("name", ["PARAM_REQUEST_LIST", "PARAM_EXT_REQUEST_LIST"])
@pytest.mark.long
def test_observer_requests_few_lists_of_parameters(name: str) -> None:
    """ArduPilot slows its telemetry to a quarter while it sends one. Two at once pass, then one in 20 s."""
    gate = Policy(OBSERVER).incoming
    message = getattr(mavlink, f"MAVLink_{name.lower()}_message")
    passed = [
        now
        for now in range(100)
        for component in range(1, 201)
        if gate.check(frame(message(1, 1), 200, component), now) is None
    ]
    assert passed == [0, 0, 20, 40, 60, 80]


def test_request_needs_an_answer_that_may_pass() -> None:
    """In both directions of lists."""
    lists = {"system_ids": [1], "allow_in": ["telemetry"], "allow_out": ["MAV_CMD_REQUEST_MESSAGE"]}
    policy = Policy(lists)
    assert policy.outgoing.check(request(ID["SYS_STATUS"]), 0.0) is None
    assert policy.outgoing.check(request(ADSB_OUT_CFG), 0.0) is Refusal.COMMAND_NOT_ALLOWED
