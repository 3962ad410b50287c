"""All that watches a daemon. It reads counters each second, and looks for findings every four. No frame calls it."""

from __future__ import annotations

from math import inf

from structlog.typing import FilteringBoundLogger

from uavlinkd.daemon.parts import DaemonParts
from uavlinkd.observe.drop_log import DropLog
from uavlinkd.observe.event_log import EventLog
from uavlinkd.observe.finding import Finding
from uavlinkd.observe.findings import find, has_no_client, own_codes
from uavlinkd.observe.history import History
from uavlinkd.ops.line_limits import LineLimits
from uavlinkd.protocol.outputs import Event
from uavlinkd.system.guard import run


class Observer:
    """The log, the recent past and the findings of one daemon. Times are monotonic seconds."""

    def __init__(self, parts: DaemonParts, log: FilteringBoundLogger, now: float) -> None:
        self.parts = parts
        self.history = History(now)
        self.findings: list[Finding] = []
        """The findings of the last look, at most four seconds ago."""
        limits = LineLimits()
        self.drops = DropLog(log, parts.journal, limits)
        self.events = EventLog(log, limits, parts.peer_sockets.network_name)
        parts.journal.watcher = self

    # Rare events, as :class:`uavlinkd.daemon.journal.JournalReader`.

    def write(self, event: Event, now: float) -> None:
        self.events.write(event, now)

    def write_client(self, event: str, endpoint: str, client: str, now: float) -> None:
        self.events.write_client(event, endpoint, client, now)

    def write_pause(self, pause_s: float, now: float) -> None:
        self.events.write_pause(pause_s, now)

    def forget(self, name: str, *, is_removed: bool) -> None:
        self.drops.forget(name)
        if is_removed:
            self.events.forget(name)

    # Once a second.

    def sample(self, now: float) -> None:
        """Read the counters of peers and endpoints."""
        links, local = list(self.parts.links.values()), self.parts.local
        endpoints = [(one, local.policies[one.name]) for one in local.endpoints]
        run(self.history.sample, links, endpoints, now, most=inf)

    def report(self, now: float) -> list[int]:
        """Look for findings, and write the lines that are due. Returns the codes of problems that peers get."""
        run(self._find, now, most=inf)
        run(self.drops.check, now, most=inf)
        run(self.events.check, now, most=inf)
        return own_codes(self.findings, is_cut_off=has_no_client(self.findings, self.parts.local.endpoints))

    def _find(self, now: float) -> None:
        self.findings = find(self.parts, self.history, now)
        self.events.write_findings(self.findings, now)

    def close(self) -> dict[str, int]:
        """Write the ends of all conditions: the daemon stops. Returns all drops since the start by reason."""
        self.drops.close()
        self.events.close()
        return self.drops.plain_totals()
