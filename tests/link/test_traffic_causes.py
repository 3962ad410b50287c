"""Findings about traffic between real daemons: what policies refuse, and signs of a captured member."""

from __future__ import annotations

from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.daemon.frames import command_long, ground_heartbeat, heartbeat, numbered, pack
from tests.daemon.harness import Stage
from tests.daemon.udp import Client, Sockaddr
from tests.link.found import findings, sending, until_found, until_gone
from uavlinkd.link.history import MAX_SESSIONS, GateHistory, History, SessionBegin
from uavlinkd.link.traffic_causes import FLIPS_S, SECURITY_S, alternating, commands
from uavlinkd.mavlink.frames import SplitCounters, split_payload
from uavlinkd.mavlink.policy.compilation import compile_policy
from uavlinkd.ops.causes import Cause
from uavlinkd.ops.findings import Subject

ARM = mavlink.MAV_CMD_COMPONENT_ARM_DISARM


class Link:
    """Two linked daemons, each with a client. ``rules`` are those of the other end's [[peer]]."""

    def __init__(self, stage: Stage, here: dict[str, Any], there: dict[str, Any]) -> None:
        self.stage = stage
        self.a, self.b = stage.daemon("drone0"), stage.daemon("drone1")
        self.a.add_peer(self.b, [self.b.address], **here)
        self.b.add_peer(self.a, [self.a.address], **there)
        self.into_a, self.into_b = self.a.add_endpoint("autopilot"), self.b.add_endpoint("autopilot")
        self.client_a: Client
        self.client_b: Client

    async def start(self) -> tuple[tuple[Client, Sockaddr], tuple[Client, Sockaddr]]:
        """Start both; each client with the address of its endpoint."""
        await self.stage.start(self.a, self.b)
        return (await self.stage.client(), self.into_a), (await self.stage.client(), self.into_b)


OPEN: dict[str, Any] = {"system_ids": [1, 2, 255]}


async def test_autopilot_with_another_system_id(stage: Stage) -> None:
    """The line names the system, and the parameter that changes it; it goes when the autopilot is corrected."""
    link = Link(stage, OPEN, {"system_ids": [2]})
    (autopilot, into), _ = await link.start()
    async with sending(autopilot, into, lambda n: [heartbeat(1, seq=n)]):
        finding = await until_found(link.b, Cause.FOREIGN_SYSTEM, "drone0")
        assert "of system 1; its system_ids here are 2" in finding["text"]
        assert "SYSID_THISMAV" in finding["remedy"]
        assert "write it into system_ids" in finding["remedy"]
    async with sending(autopilot, into, lambda n: [heartbeat(2, seq=n)]):
        await until_gone(link.b, Cause.FOREIGN_SYSTEM)
        assert Cause.IMPERSONATION not in findings(await link.b.status(), "peer", "drone0")


async def test_peer_that_also_sends_as_another(stage: Stage) -> None:
    """A second system is a warning; the system of another peer is an attack, and trusting it is not advised."""
    link = Link(stage, OPEN, {"system_ids": [1]})
    link.b.add_peer(stage.daemon("drone9"), [], system_ids=[9])
    await stage.start(link.b, linked=False)
    await stage.start(link.a)
    autopilot = await stage.client()
    async with sending(autopilot, link.into_a, lambda n: [heartbeat(1, seq=n), heartbeat(7, seq=n)]):
        assert "system 7" in (await until_found(link.b, Cause.OTHER_SYSTEM, "drone0"))["text"]
        assert Cause.IMPERSONATION not in findings(await link.b.status(), "peer", "drone0")
    async with sending(autopilot, link.into_a, lambda n: [heartbeat(1, seq=n), heartbeat(9, seq=n)]):
        finding = await until_found(link.b, Cause.IMPERSONATION, "drone0")
        assert "9 (drone9)" in finding["text"]
        other = await until_found(link.b, Cause.OTHER_SYSTEM, "drone0")
        assert "write it into system_ids" not in other["remedy"]
    assert (await link.b.status())["findings"][0]["cause"] == Cause.IMPERSONATION


async def test_commands_by_name(stage: Stage) -> None:
    """The end that withholds a command names it, and so does the end that refuses one."""
    link = Link(stage, {"role": "swarm-member", "system_ids": [2]}, {"role": "swarm-member", "system_ids": [1, 255]})
    (ground, into), _ = await link.start()
    ground.send(command_long(ARM, 255, (2, 1), param1=1), into)
    finding = await until_found(link.a, Cause.COMMANDS_WITHHELD, "drone1")
    assert finding["text"] == "COMMAND_LONG (COMPONENT_ARM_DISARM) 1x withheld: role swarm-member"
    assert finding["severity"] == "warning"
    counts = (await link.a.status())["peers"]["drone1"]["refused_commands"]["out"]
    assert counts == {"MAV_CMD_COMPONENT_ARM_DISARM": {"message_not_allowed": 1}}


async def test_commands_that_a_peer_may_not_send(stage: Stage) -> None:
    """The receiver names them: its member may be captured, or its role is too narrow."""
    link = Link(stage, OPEN, {"role": "swarm-member", "system_ids": [1, 255]})
    (ground, into), _ = await link.start()
    ground.send(command_long(ARM, 255, (2, 1), param1=1), into)
    finding = await until_found(link.b, Cause.COMMANDS_REFUSED, "drone0")
    assert "COMMAND_LONG (COMPONENT_ARM_DISARM) 1x refused from it" in finding["text"]


async def test_exchanged_roles(stage: Stage) -> None:
    """Each end has the role of its own side: both say so, and what to write."""
    link = Link(stage, {"role": "operator", "system_ids": [2]}, {"role": "vehicle", "system_ids": [255]})
    (ground, into_a), (autopilot, into_b) = await link.start()
    request = pack(mavlink.MAVLink_param_request_list_message(2, 1), 255, 190)
    async with (
        sending(ground, into_a, lambda n: [ground_heartbeat(n), request]),
        sending(autopilot, into_b, lambda n: [heartbeat(2, seq=n), numbered(n, 2)]),
    ):
        here = await until_found(link.a, Cause.ROLES_EXCHANGED, "drone1")
        assert 'write role = "vehicle"' in here["remedy"]
        there = await until_found(link.b, Cause.ROLES_EXCHANGED, "drone0")
        assert "ground station's heartbeat" in there["text"]
        await link.b.until(lambda status: any(finding["severity"] == "fault" for finding in status["findings"]))


@pytest.mark.parametrize(
    ("role", "sign"), [("operator", "a vehicle's telemetry"), ("vehicle", "sends a vehicle's telemetry")]
)
async def test_one_wrong_role(stage: Stage, role: str, sign: str) -> None:
    """Only one file is wrong: telemetry shows it."""
    link = Link(stage, OPEN, {"role": role, "system_ids": [1]})
    (autopilot, into_a), (other, into_b) = await link.start()
    async with (
        sending(autopilot, into_a, lambda n: [numbered(n, 1)]),
        sending(other, into_b, lambda n: [numbered(n, 2)]),
    ):
        assert sign in (await until_found(link.b, Cause.ROLES_EXCHANGED, "drone0"))["text"]


async def test_policy_that_refuses_everything(stage: Stage) -> None:
    """Frames arrive, and none passes: in either direction."""
    rules: dict[str, object] = {"allow_in": ["PING"], "allow_out": ["PING"], "system_ids": [1]}
    link = Link(stage, OPEN, rules)
    (autopilot, into_a), (other, into_b) = await link.start()
    async with sending(autopilot, into_a, lambda n: [heartbeat(1, seq=n)]):
        finding = await until_found(link.b, Cause.ALL_REFUSED, "drone0")
        assert "its policy refuses every frame from it: the role, or the lists" in finding["text"]
    async with sending(other, into_b, lambda n: [heartbeat(2, seq=n)]):
        await link.b.until(
            lambda status: any("every frame to it" in finding["text"] for finding in status["findings"])
        )


async def test_hidden_frame_is_the_first_line(stage: Stage) -> None:
    """A captured member hides a command in text. Everyday findings do not displace the line."""
    link = Link(stage, {"system_ids": [2], "role": "all"}, {"role": "vehicle", "system_ids": [1]})
    (captured, into_a), (ground, into_b) = await link.start()
    carrier = pack(mavlink.MAVLink_statustext_message(6, command_long(ARM, 1, (2, 1), param1=1)), 1)
    async with (
        sending(ground, into_b, lambda n: [ground_heartbeat(n)]),
        sending(captured, into_a, lambda n: [heartbeat(1, seq=n), carrier]),
    ):
        assert (await until_found(link.b, Cause.HIDDEN_FRAME, "drone0"))["severity"] == "security"
        assert (await link.b.status())["findings"][0]["cause"] == Cause.HIDDEN_FRAME


A, B, C = (("192.0.2.1", port) for port in (1, 2, 3))


@pytest.mark.parametrize(
    ("begins", "now", "shown"),
    [
        ([], 0.0, []),
        ([(0.0, A), (1.0, B), (2.0, A), (3.0, B)], 4.0, ["192.0.2.1:1", "192.0.2.1:2"]),
        ([(0.0, A), (1.0, B), (2.0, A), (3.0, B)], 3.0 + SECURITY_S, []),
        ([(0.0, A), (1.0, B), (2.0, A)], 4.0, []),
        ([(0.0, A), (1.0, B), (2.0, A), (3.0 + FLIPS_S, B)], 40.0, []),
        ([(0.0, A), (1.0, B), (2.0, C), (3.0, ("192.0.2.1", 4))], 4.0, []),
        ([(float(at), A) for at in range(8)], 8.0, []),
    ],
    ids=["none", "two machines", "long ago", "a change and back", "slow changes", "roaming", "rekeys"],
)
def test_alternating_sessions(begins: list[tuple[float, tuple[str, int]]], now: float, shown: list[str]) -> None:
    """Sessions that return to an address again and again, within a short time."""
    assert alternating([SessionBegin(*begin) for begin in begins], now) == shown


def test_other_commands_do_not_hide_those_of_a_flight() -> None:
    """Sixty-four numbers without a name and ten other commands came first."""
    incoming = compile_policy({"role": "vehicle", "system_ids": [3]}).incoming
    history = GateHistory()
    for number in (*range(50000, 50064), *range(200, 210), ARM, mavlink.MAV_CMD_NAV_TAKEOFF):
        for sent in split_payload(command_long(number, 3), SplitCounters()):
            incoming.check(sent, 0.0)
    history.update(incoming, 1.0)
    (finding,) = commands(Subject.PEER, "drone3", history, GateHistory(), {"role": "vehicle"}, 1.0)
    assert finding.text.startswith("COMMAND_LONG (COMPONENT_ARM_DISARM) 1x, COMMAND_LONG (NAV_TAKEOFF) 1x, ")


def test_many_sessions_of_a_thief_hide_nothing() -> None:
    """It makes more sessions than are remembered between two of the machine that it copied."""
    history = History(0.0)
    for second in range(3):
        history.add_session("drone1", A, float(second))
        for number in range(1, MAX_SESSIONS + 1):
            history.add_session("drone1", B, second + number / 100)
    assert alternating(history.sessions("drone1"), 3.0) == ["192.0.2.1:1", "192.0.2.1:2"]


def test_a_long_stay_before_the_first_move() -> None:
    """The session at the first address may have begun long ago."""
    begins = [SessionBegin(0.0, A), *(SessionBegin(SECURITY_S + at, (B, A)[at % 2]) for at in range(3))]
    assert alternating(begins, SECURITY_S + 3.0) == ["192.0.2.1:1", "192.0.2.1:2"]
