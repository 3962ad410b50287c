"""How many lines a healthy fleet of four writes in a day of virtual time, and that problems are still in its logs.

The nodes, their handshakes, losses and timers are real, and so are the classes that write the daemon's log. A day has
to take seconds: frames are rare (one each 10 s for each pair and direction), and housekeeping is done every 2 s.
"""

from __future__ import annotations

import logging
import os
from collections import Counter
from collections.abc import MutableMapping
from functools import partial
from itertools import combinations, permutations
from typing import Any

import pytest
import structlog
from structlog.testing import LogCapture

from tests.network.network import Drone, Network
from tests.policies import TRUSTED
from uavlinkd.config.model import PeerConfig
from uavlinkd.core.outputs import CertificateShown, Deliver, Dropped, Output, RecordReceived, Transmit
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.link.conditions import HOUR_S, LineLimits
from uavlinkd.link.drop_summary import DropSummary
from uavlinkd.link.event_log import EventLog
from uavlinkd.link.peer_link import Carriage, PeerLink
from uavlinkd.mavlink.headers import Header
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.ops.findings import Finding, Severity, Subject

HEALTHY = RadioSettings(delay_s=0.02, jitter_s=0.005, loss=0.01, reordering=0.001)
NAMES = ("station", "drone1", "drone2", "drone3")
STEP_S = 2.0
FRAME_INTERVAL_S = 10.0
RESTART_INTERVAL_S = 4 * HOUR_S
HOURS = int(os.environ.get("UAVLINKD_QUIET_HOURS", "2"))
ATTITUDE = Header(30, 1, 1)


class LoggedDaemon:
    """The log of one daemon: what the network's node reports, and the housekeeping of a daemon."""

    def __init__(self, drone: Drone, now: float) -> None:
        assert drone.node is not None
        limits, self.captured = LineLimits(), LogCapture()
        log = structlog.wrap_logger(
            None, processors=[self.captured], wrapper_class=structlog.make_filtering_bound_logger(logging.DEBUG)
        )
        self.drops, self.events = DropSummary(log, limits), EventLog(log, limits)
        carriage = Carriage(drone.node, lambda _: None)
        self.links = [
            PeerLink(PeerConfig(one.settings, (), TRUSTED), one, carriage, now) for one in drone.node.peers.values()
        ]

    @property
    def lines(self) -> list[MutableMapping[str, Any]]:
        return [line for line in self.captured.entries if line["log_level"] != "debug"]

    def note(self, outputs: list[Output], now: float) -> None:
        for output in outputs:
            if isinstance(output, Dropped):
                self.drops.add_dropped(output, now)
            elif not isinstance(output, Transmit | Deliver | RecordReceived | CertificateShown):
                self.events.write(output, now)

    def tick(self, now: float) -> None:
        """What a daemon does each second, while its autopilot sends frames that roles withhold."""
        findings: list[Finding] = []
        for link in self.links:
            self.drops.add("frames_withheld", Refusal.MESSAGE_NOT_ALLOWED, link.name, 100, now, ATTITUDE)
            self.drops.add("frames_withheld", Refusal.RATE_LIMITED, link.name, 10, now, ATTITUDE)
            self.events.check_link(link, now)
            if link.peer.unverified_since is not None:
                findings.append(Finding("freshness_unverified", Severity.FAULT, Subject.PEER, link.name, "", ""))
        self.events.write_findings(findings, now)
        self.drops.check(now)
        self.events.check(now)

    def restart_client(self, number: int, now: float) -> None:
        for event, port in (("client_disconnected", number), ("client_connected", number + 1)):
            self.events.write_client(event, "autopilot", f"127.0.0.1:{port}", now)


class LoggedNetwork(Network):
    """A network of four drones that know each other, with logs and all traffic."""

    def __init__(self, seed: str) -> None:
        super().__init__(seed, HEALTHY)
        self.checks_bounds = False
        self.logs: dict[str, LoggedDaemon] = {}
        drones = [self.add(name) for name in NAMES]
        for one, other in permutations(drones, 2):
            one.knows(other, other.addresses)
        for drone in drones:
            drone.start()
            self.logs[drone.name] = LoggedDaemon(drone, self.now)
        for one, other in combinations(drones, 2):
            self.talk(one, other, FRAME_INTERVAL_S)
        self.at(0.0, self._tick)
        self.at(RESTART_INTERVAL_S, partial(self._restart_clients, 40000))

    def perform(self, drone: Drone, outputs: list[Output]) -> None:
        if drone.name in self.logs:
            self.logs[drone.name].note(outputs, self.now)
        super().perform(drone, outputs)

    def _tick(self) -> None:
        for log in self.logs.values():
            log.tick(self.now)
        self.at(self.now + STEP_S, self._tick)

    def _restart_clients(self, number: int) -> None:
        for name in ("station", "drone1"):
            self.logs[name].restart_client(number, self.now)
        self.at(self.now + RESTART_INTERVAL_S, partial(self._restart_clients, number + 1))

    def counts(self) -> dict[str, int]:
        return {name: len(log.lines) for name, log in self.logs.items()}


@pytest.mark.long
def test_healthy_fleet_writes_less_than_a_line_an_hour() -> None:
    """With 1 % loss, rekeys each 120 s, roles that withhold, reordered envelopes and restarted clients."""
    with LoggedNetwork("quiet log") as network:
        network.run(60)
        start = network.counts()
        network.run(HOURS * HOUR_S - 60)
        counts = {name: count - start[name] for name, count in network.counts().items()}
        rekeys = {name: len(log.captured.entries) - len(log.lines) for name, log in network.logs.items()}
        print(f"{HOURS} h: {start} lines at the start, then {counts}; debug (rekeys): {rekeys}")
        for name, log in network.logs.items():
            print(name, dict(Counter(line["event"] for line in log.lines)), log.drops.totals, log.events.totals)
            assert [line for line in log.lines if line["log_level"] != "info"] == []
            assert start[name] <= 3 * 4, "two for each session, and two for what each role withholds"
            assert counts[name] <= HOURS
            assert log.drops.totals["message_not_allowed"] >= 3 * 100 * (HOURS * HOUR_S / STEP_S - 1)
            assert log.events.totals["envelopes_missing"] > 0


@pytest.mark.long
def test_problem_on_a_quiet_link_is_logged() -> None:
    """A link that loses a third, and one that is cut: a line at the beginning, and one at the end."""
    with LoggedNetwork("quiet log, problems") as network:
        network.run(HOUR_S / 2)
        before = network.counts()
        station, drone1, drone2 = (network.drones[name] for name in ("station", "drone1", "drone2"))
        network.talk(station, drone1, 0.2, until=network.now + 200)
        network.set_radio(RadioSettings(delay_s=0.02, loss=0.33))
        network.run(200)
        network.set_radio(HEALTHY)
        network.run(400)
        lines = network.logs["station"].lines[before["station"] :]
        lossy = [line for line in lines if line.get("problem") == "envelopes_missing" and line["peer"] == "drone1"]
        assert [line["event"] for line in lossy] == ["link_problem_began", "link_problem_ended"]
        assert lossy[0]["share"] > 0.05
        assert lossy[1]["count"] > 100
        network.cut(station, drone2)
        network.run(100)
        lines = [line for line in network.logs["station"].lines if line.get("peer") == "drone2"]
        assert (lines[-1]["event"], lines[-1]["log_level"]) == ("peer_lost", "warning")
        network.cuts.clear()
        network.run(100)
        assert network.logs["station"].lines[-1]["event"] == "peer_up"
