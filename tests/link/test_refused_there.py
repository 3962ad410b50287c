"""The ground station sees why the aircraft refuses its command: reports between links, and their words."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from tests.core.harness import KEY_A, KEY_B, Pair, Side, datagrams, of, quiet
from tests.daemon.frames import command_long, ground_heartbeat, heartbeat
from tests.daemon.harness import Stage
from tests.endpoints.clients import PASSES
from tests.policies import TRUSTED
from uavlinkd.config import PeerConfig
from uavlinkd.core.outputs import Output, Transmit
from uavlinkd.core.refusals import RefusalReport, Refused
from uavlinkd.core.settings import PeerSettings
from uavlinkd.link import refused_there
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.mavlink.egress.budgeted import EgressSettings
from uavlinkd.mavlink.frames import SplitCounters, split_payload
from uavlinkd.ops.causes import Cause

ARM = 400
MEMBER = {"role": "swarm-member", "system_ids": [1, 255]}


def link_of(side: Side, public_key: bytes, perform: Callable[[list[Output]], None], config: PeerConfig) -> PeerLink:
    """The link to the peer that this side's node has already."""
    settings = PeerSettings(side.peer_name, public_key, None, quiet())
    link = PeerLink(replace(config, settings=settings), side.node, perform, 0.0)
    link.peers.append(side.peer)
    return link


def refuse(link: PeerLink, *raws: bytes) -> None:
    """Let the policy judge frames of the peer."""
    for frame in split_payload(b"".join(raws), SplitCounters()):
        link.policy.incoming.check(frame, 0.0)


def config(**changes: object) -> PeerConfig:
    """A swarm member, whose key `link_of` sets."""
    return replace(PeerConfig(PeerSettings("", bytes(32)), (), MEMBER), **changes)  # type: ignore[arg-type]


def test_from_the_refusal_to_the_words() -> None:
    """Three refused commands and a refused heartbeat: one report, JSON and one sentence with the command first."""
    pair, sent = Pair().establish(), list[Output]()
    there = link_of(pair.b, KEY_A.public, sent.extend, config())
    here = link_of(pair.a, KEY_B.public, lambda _: None, config(policy=TRUSTED))
    refuse(there, ground_heartbeat(), *(command_long(ARM, 255),) * 3, heartbeat(9))
    for second in range(1, 10):
        there.report_refusals(float(second))
        for datagram in datagrams(sent):
            pair.a.receive(datagram, float(second))
        sent.clear()
    claims = refused_there.as_json(here, 11.0)
    assert all(claim["last_s"] == 10.0 for claim in claims)
    assert {(claim["message"], claim["command"], claim["reason"], claim["count"]) for claim in claims} == {
        ("HEARTBEAT", None, "foreign_system", 1),
        ("COMMAND_LONG", "MAV_CMD_COMPONENT_ARM_DISARM", "message_not_allowed", 3),
        ("HEARTBEAT", None, "ground_station_not_allowed", 1),
    }
    text = refused_there.describe(here, 11.0)
    assert text.startswith(
        "it reports that it refuses COMMAND_LONG COMPONENT_ARM_DISARM"
        " (the role, or the lists, do not allow the message, 3 frames, 10 s ago); "
    )
    assert refused_there.describe(here, 62.0) == ""
    assert len(refused_there.as_json(here, 62.0)) == 3


def test_a_lying_peer_fills_one_line() -> None:
    """Claims of unknown messages, commands and reasons are numbers, and their text is bounded."""
    pair = Pair().establish()
    here = link_of(pair.a, KEY_B.public, lambda _: None, config())
    for number in range(100):
        entries = tuple(Refused(0xFFFFFF - number, 60000 + place, 200, 2**32 - 1) for place in range(16))
        pair.a.receive(pair.b.envelope(1.0, RefusalReport(entries).encode()), 1.0)
    text = refused_there.describe(here, 1.0)
    assert "16777116 60015 (4,294,967,295 frames, 0 s ago), " in text
    assert text.endswith(": a reason that this version does not know; and 61 more kinds of frames")
    assert text.count("a reason that") == 1
    assert len(text) < 500
    assert refused_there.as_json(here, 1.0)[0]["reason"] == "reason_200"


@pytest.mark.parametrize("budget", [0, 4000])
def test_reports_leave_room_for_frames(budget: int) -> None:
    """On a link with a budget, a report is sent while no frame waits and the budget covers it, and it is charged."""
    pair, sent = Pair().establish(), list[Output]()
    link = link_of(pair.b, KEY_A.public, sent.extend, config(egress=EgressSettings(budget_bits_s=budget)))
    link.follow_paths(0.0)
    link.report_refusals(1.0)
    frames = split_payload(b"".join(heartbeat(1, seq=number) for number in range(50)), SplitCounters())
    link.send(frames, PASSES, 1.0, 0.0)
    refuse(link, command_long(ARM, 255))
    sent.clear()
    link.report_refusals(1.0)
    assert len(of(sent, Transmit)) == (0 if budget else 1)
    if budget and link.output.egress is not None:
        link.output.egress.clear(2.0)
        before = link.output.egress.demand(30.0)
        link.report_refusals(30.0)
        assert len(of(sent, Transmit)) == 1
        assert link.output.egress.demand(30.0) > before


def test_coalescing_delays_no_report() -> None:
    """A delay without a budget leaves room."""
    pair, sent = Pair().establish(), list[Output]()
    link = link_of(pair.b, KEY_A.public, sent.extend, config(egress=EgressSettings(coalesce_s=0.01)))
    refuse(link, command_long(ARM, 255))
    link.report_refusals(1.0)
    assert len(of(sent, Transmit)) == 1


def test_no_report_while_the_peer_is_lost() -> None:
    """It is sent when the peer is back."""
    pair, sent = Pair().establish(), list[Output]()
    link = link_of(pair.b, KEY_A.public, sent.extend, config())
    refuse(link, command_long(ARM, 255))
    pair.b.peer.is_up = False
    link.report_refusals(1.0)
    assert sent == []
    pair.b.peer.is_up = True
    link.report_refusals(2.0)
    assert len(of(sent, Transmit)) == 1


async def test_ground_station_sees_the_refused_command() -> None:
    """Real daemons: the aircraft's role refuses ARM, and the ground station's status has the aircraft's claim."""
    async with Stage() as stage:
        ground, drone = stage.daemon("ground"), stage.daemon("drone1")
        psk = stage.psk()
        ground.add_peer(drone, [drone.address], psk)
        drone.add_peer(ground, [ground.address], psk, role="swarm-member", system_ids=[255])
        into = ground.add_endpoint("qgc")
        await stage.start(ground, drone)
        pilot = await stage.client()

        pilot.send(command_long(ARM, 255), into)
        status = await ground.until(lambda status: bool(status["peers"]["drone1"]["refused_there"]))

        (claim,) = status["peers"]["drone1"]["refused_there"]
        assert (claim["message"], claim["command"]) == ("COMMAND_LONG", "MAV_CMD_COMPONENT_ARM_DISARM")
        assert (claim["reason"], claim["count"]) == ("message_not_allowed", 1)
        (finding,) = [entry for entry in status["findings"] if entry["cause"] == Cause.REFUSED_THERE]
        assert finding["severity"] == "warning"
        assert finding["text"].startswith("it reports that it refuses COMMAND_LONG COMPONENT_ARM_DISARM (")
        assert finding["remedy"] == "if these frames are needed, change the role or lists of ground in drone1's file"

        pilot.send(heartbeat(9), into)
        status = await ground.until(lambda status: len(status["peers"]["drone1"]["refused_there"]) == 2)

        (finding,) = [entry for entry in status["findings"] if entry["cause"] == Cause.REFUSED_THERE]
        assert finding["remedy"].startswith(
            "set SYSID_THISMAV, MAV_SYSID or MAV_SYS_ID of the client here to an id in system_ids for ground"
            " in drone1's file"
        )
