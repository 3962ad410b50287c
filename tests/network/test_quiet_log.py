"""How many lines a healthy fleet of four writes in a day of virtual time, and that problems are still in its logs.

And that nothing honest is an alarm: restarts, lost, late and reordered datagrams on two paths, and addresses that
change.

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
from random import Random
from typing import Any

import pytest
import structlog
from structlog.testing import LogCapture

from tests.network.network import Drone, Network
from tests.network.vehicle import add_vehicle, hop
from tests.observe.daemon_parts import parts_of
from tests.policies import TRUSTED
from uavlinkd.config.model import PeerConfig
from uavlinkd.daemon.evidence import Evidence
from uavlinkd.daemon.journal import DaemonJournal
from uavlinkd.daemon.peer_link import Carriage, PeerLink
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.mavlink.headers import Header
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.observe.conditions import HOUR_S
from uavlinkd.observe.drop_log import DropLog
from uavlinkd.observe.event_log import EventLog
from uavlinkd.observe.findings import find
from uavlinkd.observe.history import History
from uavlinkd.ops.line_limits import LineLimits
from uavlinkd.protocol.drops import Attention, DropReason
from uavlinkd.protocol.outputs import CertificateShown, Deliver, Dropped, Output, RecordReceived, Transmit
from uavlinkd.protocol.settings import Class

HEALTHY = RadioSettings(delay_s=0.02, jitter_s=0.005, loss=0.01, reordering=0.001)
NAMES = ("station", "drone1", "drone2", "drone3")
STEP_S = 2.0
FRAME_INTERVAL_S = 10.0
RESTART_INTERVAL_S = 4 * HOUR_S
HOURS = int(os.environ.get("UAVLINKD_QUIET_HOURS", "2"))
ATTITUDE = Header(30, 1, 1)


class LoggedDaemon:
    """The log and the findings of one daemon: what its node reports, and the housekeeping of a daemon."""

    def __init__(self, drone: Drone) -> None:
        assert drone.node is not None
        now, self._drone = drone.local_now, drone
        limits, self.captured = LineLimits(), LogCapture()
        log = structlog.wrap_logger(
            None, processors=[self.captured], wrapper_class=structlog.make_filtering_bound_logger(logging.DEBUG)
        )
        self.journal = DaemonJournal()
        self.drops, self.events = DropLog(log, self.journal, limits), EventLog(log, limits)
        carriage = Carriage(drone.node, lambda _: None)
        self.links = {
            one.name: PeerLink(PeerConfig(one.settings, (), TRUSTED), one, carriage, now)
            for one in drone.node.peers.values()
        }
        self._evidence, self._history = Evidence(self.links, drone.public_key), History(now)
        self._parts = parts_of(drone.node, self.links, self._evidence)

    @property
    def lines(self) -> list[MutableMapping[str, Any]]:
        return [line for line in self.captured.entries if line["log_level"] != "debug"]

    def note(self, outputs: list[Output]) -> None:
        now = self._drone.local_now
        for output in outputs:
            if isinstance(output, Dropped):
                self.journal.add_dropped(output, now)
                self._evidence.add_dropped(output, now)
            elif not isinstance(output, Transmit | Deliver | RecordReceived | CertificateShown):
                self.events.write(output, now)

    def tick(self) -> None:
        """What a daemon does each second, while its autopilot sends frames that roles withhold."""
        now = self._drone.local_now
        self._history.sample(self.links.values(), [], now)
        for link in self.links.values():
            self.journal.add("frames_withheld", Refusal.MESSAGE_NOT_ALLOWED, link.name, 100, now, ATTITUDE)
            self.journal.add("frames_withheld", Refusal.RATE_LIMITED, link.name, 10, now, ATTITUDE)
            link.measure(now)
        self.events.write_findings(find(self._parts, self._history, now), now)
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
            self.logs[drone.name] = LoggedDaemon(drone)
        for one, other in combinations(drones, 2):
            self.talk(one, other, FRAME_INTERVAL_S)
        self.at(0.0, self._tick)
        self.at(RESTART_INTERVAL_S, partial(self._restart_clients, 40000))

    def perform(self, drone: Drone, outputs: list[Output]) -> None:
        if drone.name in self.logs:
            self.logs[drone.name].note(outputs)
        super().perform(drone, outputs)

    def _tick(self) -> None:
        for log in self.logs.values():
            log.tick()
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
            print(name, dict(Counter(line["event"] for line in log.lines)), log.journal.totals)
            assert [line for line in log.lines if line["log_level"] != "info"] == []
            assert start[name] <= 3 * 4, "two for each session, and two for what each role withholds"
            assert counts[name] <= HOURS
            assert log.journal.totals["message_not_allowed"] >= 3 * 100 * (HOURS * HOUR_S / STEP_S - 1)


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
        lossy = [line for line in lines if line.get("cause") == "high_loss" and line["name"] == "drone1"]
        assert (lossy[0]["event"], lossy[-1]["event"]) == ("problem_began", "problem_ended")
        assert len(lossy) <= 4, "the loss of rare frames varies"
        assert "% from it to here" in lossy[0]["text"]
        network.cut(station, drone2)
        network.run(100)
        lines = [line for line in network.logs["station"].lines if line.get("peer") == "drone2"]
        assert (lines[-1]["event"], lines[-1]["log_level"]) == ("peer_lost", "warning")
        network.cuts.clear()
        network.run(100)
        ends = [line["event"] for line in network.logs["station"].lines[-2:]]
        assert ends == ["peer_up", "problem_ended"], "and the finding about its silence ends"


HONEST_S = 240.0
ADDRESS, OUTAGE, RESTART, STALL = "address", "outage", "restart", "stall"
TRUE_WARNINGS = {
    ("peer_lost", ""),  # until it is started again
    ("problem_began", "no_answer"),
    ("path_down", "unanswered"),
    ("datagrams_dropped", "delayed"),  # by a network that holds them back
}
TRUE_OF_A_LOSSY_RADIO = {("problem_began", "high_loss")}


class HonestPair(Network):
    """A vehicle with a fast and a slow path to its station, where everything that happens is honest."""

    def __init__(self, seed: str, loss: float) -> None:
        super().__init__(seed)
        self.checks_bounds = False
        radios = [
            RadioSettings(delay_s=delay_s, jitter_s=0.3 * delay_s, loss=loss, reordering=0.01)
            for delay_s in (0.005, 0.05)
        ]
        self.vehicle, self.station = add_vehicle(self, radios)
        self.logs: dict[Drone, LoggedDaemon] = {}
        self.warnings: set[tuple[str, str]] = set()
        for drone in (self.vehicle, self.station):
            self.start(drone)
        self.talk(self.vehicle, self.station, 0.1)
        self.talk(self.vehicle, self.station, 0.5, cls=Class.CRITICAL)
        self.at(0.5, self._tick)

    def perform(self, drone: Drone, outputs: list[Output]) -> None:
        if drone in self.logs:
            self.logs[drone].note(outputs)
        super().perform(drone, outputs)

    def start(self, drone: Drone) -> None:
        drone.start()
        self.logs[drone] = LoggedDaemon(drone)

    def live(self, event: str, rng: Random) -> None:
        """Some seconds, and then what may happen to an honest pair."""
        self.run(rng.uniform(5, 30))
        number = rng.randrange(2)
        path = hop(self.vehicle, self.station, number)
        match event:
            case "address":
                self.vehicle.move_socket(number, (f"10.{rng.randrange(2, 250)}.1.1", rng.randrange(1024, 60000)))
            case "outage":
                self.cut_path(path)
                self.run(rng.uniform(1, 15))
                self.heal_path(path)
            case "stall":
                self.stall_path(path, rng.uniform(1, 15))
            case "restart":
                drone = rng.choice((self.vehicle, self.station))
                drone.stop()
                self.read(self.logs.pop(drone))
                self.run(rng.uniform(0.4, 4))
                self.start(drone)

    def read(self, log: LoggedDaemon) -> None:
        for line in log.lines:
            if line["log_level"] != "info":
                what = next((line[field] for field in ("reason", "problem", "cause") if field in line), "")
                self.warnings.add((line["event"], str(what)))

    def _tick(self) -> None:
        for log in self.logs.values():
            log.tick()
        self.at(self.now + 1.0, self._tick)


@pytest.mark.long
@pytest.mark.parametrize(
    ("loss", "events"),
    [
        (0.0, (ADDRESS, RESTART)),
        (0.02, (OUTAGE, STALL)),
        (0.1, (ADDRESS, OUTAGE, RESTART, STALL)),
    ],
)
def test_nothing_honest_is_an_alarm(loss: float, events: tuple[str, ...]) -> None:
    """Nothing is security, and each warning is true. A slow copy of an initiation is no replay."""
    name = f"honest {loss} {events}"
    with HonestPair(name, loss) as network:
        rng = Random(name)
        while network.now < HONEST_S:
            network.live(rng.choice(events), rng)
        for log in network.logs.values():
            network.read(log)
        assert network.warnings <= TRUE_WARNINGS | (TRUE_OF_A_LOSSY_RADIO if loss >= 0.05 else set())
        for drone, other in ((network.vehicle, network.station), (network.station, network.vehicle)):
            assert not {
                reason for reason in drone.drops if DropReason[reason.upper()].attention is Attention.SECURITY
            }
            assert not drone.peer(other).sessions.twins
