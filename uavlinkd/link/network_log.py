"""What the log says about a network: that it is not here yet, appeared, changed or disappeared."""

from __future__ import annotations

from structlog.typing import FilteringBoundLogger

from uavlinkd.endpoints.presence import Presence
from uavlinkd.link.conditions import LineLimits


class NetworkLog:
    """Writes a line about one network when what the machine has of it changes."""

    __slots__ = ("_limits", "_log", "_name", "written")

    def __init__(self, name: str, limits: LineLimits, log: FilteringBoundLogger) -> None:
        self.written: Presence | None = None
        """What the log says about it."""
        self._name = name
        self._limits = limits
        self._log = log.bind(network=name)

    def note(self, presence: Presence, now: float) -> None:
        """Write what changed since the last line. If there were too many lines, the next call tries again."""
        before = self.written
        if presence == before:
            return
        is_worth_a_line = before is None or presence.hosts or before.hosts  # not another reason of absence
        if not is_worth_a_line:
            self.written = presence
            return
        omitted = self._limits.take("network", self._name, now)
        if omitted is None:
            return
        self.written = presence
        log = self._log.bind(**omitted)
        if before is None and not presence.hosts:
            log.warning("network_not_here_yet", reason=presence.reason)
        elif not presence.hosts:
            log.warning("network_disappeared", reason=presence.reason)
        elif before is None or not before.hosts:
            log.info("network_appeared", addresses=list(presence.hosts), interface_index=presence.ifindex)
        else:
            log.info("network_changed", addresses=list(presence.hosts), interface_index=presence.ifindex)
