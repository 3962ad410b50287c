"""What other software reads has the declared names and types. For log and metrics, see `tests.test_quality`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest

from tests.ops.schema import golden
from tests.processes.frames import frame
from tests.processes.harness import Stage
from tests.processes.members import CertifiedFleet
from tests.processes.tls import listen_for_tls
from tests.test_readmes import ROOT, names_in_table
from uavlinkd.authority.certificates import MemberRole
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.observe.finding import Finding, Severity, Subject
from uavlinkd.ops import NETCHECK_SCHEMA, STATUS_SCHEMA
from uavlinkd.serial.line_framing import RADIO_FIGURES

MAPS = (
    *(
        "peers",
        "relays",
        "relays.*.peers",
        "relays.*.tls",
        "endpoints",
        "endpoints.*.clients",
        "networks",
        "relay.members",
    ),
    *("fleet.absent", "fleet.held", "fleet.bulletins", "fleet.events"),
)
"""Objects whose keys are names of the configuration or addresses."""
COUNTS: Mapping[str, int] = {
    "drops": 1,
    "faults": 1,
    "stale": 1,
    "unrouted": 1,
    "send_failures": 1,
    "relay.dropped": 1,
    "relay.https.refused": 1,
    "relay.https.lost": 1,
    "peers.*.drops": 1,
    "relays.*.drops": 1,
    "peers.*.malformed": 1,
    "peers.*.waiting_dropped": 1,
    "peers.*.copies_dropped": 1,
    "networks.*.serial.failures": 1,
    "peers.*.refused": 3,
    "peers.*.refused_commands": 3,
    "endpoints.*.faults": 1,
    "endpoints.*.failures": 1,
    "endpoints.*.refused": 3,
    "endpoints.*.refused_commands": 3,
}
"""Objects that count by reason, or by direction, message and reason: how many keys lead to a count."""
ALSO = {
    "peers.*.freshness_unverified_s": "number",
    "peers.*.role": "null",
    "peers.*.problems_there[]": "string",
    "peers.*.vehicles[]": "object",
    "peers.*.vehicles[].system": "integer",
    "peers.*.vehicles[].heartbeat_s": "number",
    "peers.*.vehicles[].type": "integer",
    "peers.*.vehicles[].autopilot": "integer",
    "peers.*.vehicles[].is_armed": "boolean",
    "peers.*.vehicles[].custom_mode": "integer",
    "peers.*.vehicles[].battery_v": "null|number",
    "peers.*.vehicles[].battery_percent": "integer|null",
    "contested[]": "string",
    "stopped_there[]": "string",
    "peers.*.paths[].network": "string",
    "peers.*.paths[].relay": "string",
    "peers.*.paths[].relay_address": "string",
    "relays.*.paths[].network": "string",
    "endpoints.*.clients.*.last_received_s": "null",
    "endpoints.*.signing": "object",
    "endpoints.*.signing.is_verified": "boolean",
    "endpoints.*.signing.link_id": "integer",
    "relay.https": "null",
    "process.resident_bytes": "null",
    "fleet.events.*": "number",
    "networks.*.serial.radio": "object",
    **{f"networks.*.serial.radio.{name}": "integer" for name in RADIO_FIGURES},
}
"""Types that the daemons here do not show."""


async def observed() -> tuple[dict[str, str], dict[str, str]]:
    """Every name of ``status`` and of ``netcheck``, with its types.

    Of a daemon, then its peer, with a frame to each; with networks, and relays.
    """
    statuses: list[dict[str, Any]] = []
    async with Stage() as stage:
        a, b = stage.pair()
        a.config["peer"][0]["system_ids"] = [9]
        into_a, into_b = a.add_endpoint("autopilot"), b.add_endpoint("autopilot")
        await stage.start(a, linked=False)
        statuses.append(await a.status())
        await stage.start(b)
        clients = await stage.client(), await stage.client()

        def is_complete(status: dict[str, Any]) -> bool:
            clients[0].send(frame(1, 7), into_a)  # again each time: what was refused 10 s ago is not shown
            clients[1].send(frame(1, 2), into_b)
            is_measured = status["peers"]["drone1"]["round_trip_s"] is not None
            return is_measured and bool(status["blocked"]) and bool(status["endpoints"]["autopilot"]["clients"])

        statuses.append(await a.until(is_complete))
        roaming = stage.daemon("roaming", [f"0.0.0.0:{free_port()}"])
        roaming.config["network"] = [
            {"name": "present", "address": "127.0.0.1"},
            {"name": "absent", "interface": "absent0"},
            {"name": "line", "serial": f"{stage.folder}/absent:57600"},
        ]
        roaming.add_peer(a, [])
        roaming.config["peer"][0]["addresses"] = [{"network": "line"}]
        await stage.start(roaming, linked=False)
        statuses.append(await roaming.status())
        relay = stage.daemon("relay0")
        far = stage.daemon("far", [])
        urls = [relay.address, f"wss://127.0.0.1:{free_port()}"]
        far.config["relay"] = [{"name": "vps", "public_key": relay.public_key, "addresses": urls}]
        far.add_peer(a, [])
        relay.config["member"] = [
            {"name": "drone1", "public_key": b.public_key},
            {"name": "far", "public_key": far.public_key},
        ]
        listen_for_tls(relay)
        relay.add_peer(b, [b.address])
        b.add_peer(relay, [relay.address])
        b.config["relay"] = [{"name": "station", "public_key": relay.public_key, "addresses": []}]
        await b.stop()
        await stage.start(far, linked=False)
        statuses.append(await far.status())
        await stage.start(relay, b, linked=False)
        statuses.append(await far.until(lambda status: bool(status["relays"]["vps"]["seen_as"])))
        netcheck = await far.ask("netcheck")
        statuses.append(await relay.until(lambda status: bool(status["relay"]["members"]["drone1"]["addresses"])))

        def is_refused_there(status: dict[str, Any]) -> bool:
            clients[1].send(frame(1, 2), into_b)  # what was refused before its restart may be reported no more
            return bool(status["peers"][a.name]["refused_there"])

        statuses.append(await b.until(is_refused_there))
        station, vehicle, fleet = stage.daemon("station"), stage.daemon("v1"), CertifiedFleet()
        fleet.revoked = [77]
        fleet.join(station, MemberRole.OPERATOR, 255)
        fleet.join(vehicle, MemberRole.VEHICLE, 1, station)
        fleet.join(absent := stage.daemon("absent"), MemberRole.OPERATOR, 254)
        await stage.start(vehicle, linked=False)
        await vehicle.ask(fleet.renew(absent))
        statuses.append(await vehicle.status())
        await station.start()
        statuses.append(await vehicle.until(lambda status: status["fleet"]["bulletins"] == {"station": 1}))
    findings = [Finding("cause", Severity.FAULT, Subject.PEER, "name", "text", "remedy").as_json()]
    names = golden.names_of(
        *(status | {"findings": findings} for status in statuses), maps=MAPS, counts=COUNTS, also=ALSO
    )
    del netcheck["relays"]  # that of the status
    return names, golden.names_of(netcheck, maps=["web"])


@pytest.mark.long
async def test_status_and_netcheck_have_the_declared_names() -> None:
    """Of real daemons: one alone, and one with a peer and clients."""
    status, netcheck = await observed()
    problems = golden.differences("status", STATUS_SCHEMA, golden.load("status"), status)
    problems += golden.differences("netcheck", NETCHECK_SCHEMA, golden.load("netcheck"), netcheck)
    assert not problems, "\n".join(problems)


def test_every_event_is_documented() -> None:
    """In the table of README.md."""
    events = {name for name in golden.load("log")["names"] if "." not in name}
    assert len(events) > 40
    assert events <= names_in_table(ROOT / "uavlinkd/ops/README.md", "Logs")
