"""What a daemon leaves behind for those that watch it: counted drops, pauses, a refused file, and rare events.

The path of a frame counts here and calls no watcher. A watcher takes the counts at its own pace.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from dataclasses import dataclass
from typing import Any, Protocol

from uavlinkd.io.ports import failure_name
from uavlinkd.mavlink.headers import Header
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.protocol.drops import Attention, Detail, Reason
from uavlinkd.protocol.outputs import Dropped, Event
from uavlinkd.protocol.path import Path
from uavlinkd.system.clock import monotonic

Fact = str | Header | tuple[Detail, Path]
"""What identifies the last drop of a kind. A watcher formats it for a line, not for each drop of a flood."""
Key = tuple[str, str, str]
"""Event, reason, name of the peer or endpoint."""


class ShellReason(Reason):
    """Why the daemon drops frames and datagrams outside the core and the policies."""

    STALE = ("stale", "the frames waited while the daemon was stopped or suspended")
    SUPERSEDED = ("superseded", "newer states arrived first along another path of the peer", "", Attention.EXPLAINED)
    COPY_OVER_BUDGET = ("copy_over_budget", "copies waited too long for a budget", "", Attention.EXPLAINED)
    COPY_REPLACED = ("copy_replaced", "newer states replaced copies that waited", "", Attention.EXPLAINED)
    RELAY_HANDLE_GONE = (
        "relay_handle_gone",
        "a datagram for a relay has a handle that the relay assigns no more",
        "",
        Attention.EVERYDAY,
    )


@dataclass(slots=True)
class Tally:
    """New drops of one kind."""

    reason: str
    """With its meaning: an equal key may have a plain string."""
    count: int = 0
    at: float = 0.0
    """When the last one occurred, in monotonic seconds."""
    last: Fact = ""


class JournalReader(Protocol):
    """What is called about rare events."""

    def write(self, event: Event, now: float) -> None:
        """A peer or a relay changed its state, or a session or a path."""

    def write_client(self, event: str, endpoint: str, client: str, now: float) -> None:
        """A local client connected or disconnected."""

    def write_pause(self, pause_s: float, now: float) -> None:
        """The process was paused."""

    def forget(self, name: str, *, is_removed: bool) -> None:
        """A peer was removed, or has other rules."""


class DaemonJournal:
    """Memory is bounded: reasons are closed lists, names are configured."""

    def __init__(self) -> None:
        self.watcher: JournalReader | None = None
        self.totals: Counter[str] = Counter()
        """All drops by reason since the start."""
        self.refused_file: list[str] = []
        """The problems of the file at the last reload, if it was refused."""
        self._fresh: dict[Key, Tally] = {}

    def add(self, event: str, reason: str, name: str, count: int, now: float, last: Fact = "") -> None:
        """Count drops of a peer or endpoint. ``name`` is empty if the sender is unknown."""
        self.totals[reason] += count
        key = event, reason, name
        tally = self._fresh.get(key)
        if tally is None:
            tally = self._fresh[key] = Tally(reason)
        tally.count += count
        tally.at, tally.last = now, last

    def add_dropped(self, dropped: Dropped, now: float) -> None:
        """Count what the core dropped: a datagram, or outgoing frames."""
        reason, peer, path, count, detail = dropped
        name = "" if peer is None else peer.name
        if path is None:
            self.add("frames_dropped", reason, name, count, now)
        else:
            self.add("datagrams_dropped", reason, name, count, now, (detail, path))

    def add_refused(self, name: str, header: Header, refusal: Refusal, now: float, *, to_them: bool) -> None:
        """Count a frame that a policy refused: from the port of this name, or ``to_them``."""
        self.add("frames_withheld" if to_them else "frames_refused", refusal, name, 1, now, header)

    def take(self) -> dict[Key, Tally]:
        """The drops since the last call."""
        fresh, self._fresh = self._fresh, {}
        return fresh

    def on_loop_failure(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Handle an error that asyncio reports to the loop only."""
        error = context.get("exception")
        if isinstance(error, OSError):  # such as: no file descriptor is left for a new connection
            self.add("connections_failed", failure_name(error), "", 1, monotonic(), str(context["message"]))
        else:
            loop.default_exception_handler(context)

    # Rare events.

    def write(self, event: Event, now: float) -> None:
        """Pass on an event of a link."""
        if self.watcher is not None:
            self.watcher.write(event, now)

    def write_client(self, event: str, endpoint: str, client: str) -> None:
        """Pass on that a local client connected or disconnected."""
        if self.watcher is not None:
            self.watcher.write_client(event, endpoint, client, monotonic())

    def on_pause(self, pause_s: float) -> None:
        """Pass on that the process was paused."""
        if self.watcher is not None:
            self.watcher.write_pause(pause_s, monotonic())

    def forget(self, name: str, *, is_removed: bool) -> None:
        """Pass on that a peer was removed, or has other rules: its new policy may withhold other frames."""
        if self.watcher is not None:
            self.watcher.forget(name, is_removed=is_removed)
