"""Dropped datagrams and frames in the log: a condition per kind of drop, reason, and peer or endpoint."""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from enum import Enum
from typing import Any, Final

from structlog.typing import FilteringBoundLogger

from uavlinkd.config.keys import encode_key
from uavlinkd.core.drops import Detail, DropReason, Reason
from uavlinkd.core.outputs import Dropped
from uavlinkd.core.path import Path
from uavlinkd.endpoints.ports import failure_name
from uavlinkd.link.conditions import Conditions, LineLimits, OpenCondition, Phase
from uavlinkd.link.key_change import link_name
from uavlinkd.link.other_version import compared
from uavlinkd.link.shell_reasons import ShellReason
from uavlinkd.link.shown import shown
from uavlinkd.mavlink.dialect import name_of
from uavlinkd.mavlink.headers import Header
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.system.clock import monotonic
from uavlinkd.system.error_meanings import meaning_of

PERSISTENT_S = 5
"""An everyday drop is logged if it occurs in this many different seconds within :data:`WINDOW_S`."""
WINDOW_S = 60.0

Fact = str | Header | tuple[Detail, Path]
"""What identifies the last drop of a line. It is formatted when the line is written, not for each drop of a flood."""
Key = tuple[str, str, str]
"""Event, reason, name of the peer or endpoint."""


class Attention(Enum):
    """When a kind of drop is logged."""

    SECURITY = "at once, with limits of its own"
    PROBLEM = "at once"
    EVERYDAY = "if it persists"
    DESIGN = "once per start: the policy works as configured"
    EXPLAINED = "never: another event explains it"


SECURITY: Final = frozenset[str](
    {
        *(
            DropReason.BAD_MAC1,
            DropReason.REPLAYED_INITIATION,
            DropReason.INVALID_KEY_SHARE,
            DropReason.BAD_HANDSHAKE,
        ),
        *(DropReason.UNKNOWN_PEER, DropReason.HEADER_MISMATCH, DropReason.BAD_PARAMETERS, DropReason.BAD_COOKIE),
        *(DropReason.TOO_LONG, DropReason.LONG_COUNTER, DropReason.REPLAYED, DropReason.DELAYED),
        *(DropReason.BAD_TAG, DropReason.BAD_CONTROL, Refusal.HIDDEN_FRAME, Refusal.FOREIGN_SYSTEM),
        DropReason.FRAMES_NOT_ALLOWED,
    }
)
"""An attack, a captured member, or wrong keys. A healthy link causes none of them."""
EVERYDAY: Final = frozenset[str](
    {
        *(DropReason.UNEXPECTED_RESPONSE, DropReason.UNEXPECTED_COOKIE, DropReason.UNKNOWN_INDEX, DropReason.LATE),
        *(DropReason.SESSION_EXPIRED, DropReason.UNEXPECTED_ANSWER, DropReason.DOUBTFUL, DropReason.OVER_SHARE),
        *(DropReason.UNEXPECTED_RECORD, DropReason.OLD_RECORD),
        *("EAGAIN", "ENOBUFS", "ECONNREFUSED", DropReason.RELAY_UNKNOWN_HANDLE, ShellReason.RELAY_HANDLE_GONE),
        DropReason.RELAY_UNEXPECTED_TOKEN,
    }
)
"""A lost datagram, a rekey or a restarted peer causes a few of them."""

BY_PATHS: Final = frozenset[str](
    {
        *(ShellReason.SUPERSEDED, ShellReason.COPY_OVER_BUDGET, ShellReason.COPY_REPLACED),
        *(DropReason.DUPLICATE, DropReason.LATE_COPY),
    }
)
"""Several paths with different delays cause them all the time. The status counts them."""


def attention(event: str, reason: str) -> Attention:
    """When drops of this kind are logged."""
    if reason in SECURITY and (event != "frames_withheld" or reason == Refusal.HIDDEN_FRAME):
        return Attention.SECURITY
    if event == "frames_withheld":
        return Attention.DESIGN
    if reason in EVERYDAY:
        return Attention.EVERYDAY
    # The peer is lost, or does not answer: that is logged, and how long it lasts.
    return Attention.EXPLAINED if reason == DropReason.NO_SESSION or reason in BY_PATHS else Attention.PROBLEM


class DropSummary:
    """Counts drops and writes their conditions. Memory is bounded: reasons are closed lists, names are configured."""

    def __init__(self, log: FilteringBoundLogger, limits: LineLimits | None = None) -> None:
        self.totals: Counter[str] = Counter()
        """All drops by reason since the start, logged or not."""
        self._log = log
        self._limits = limits or LineLimits()
        self._last: dict[Key, Fact] = {}
        self._reasons: dict[Key, str] = {}  # with their meanings: equal keys may have plain strings
        self._attention: dict[Key, Attention] = {}
        self._seconds: dict[Key, deque[float]] = {}  # in which an everyday drop occurred
        self._unlogged: Counter[Key] = Counter()
        self._said: set[Key] = set()  # what works as configured, and was logged
        self._conditions = Conditions[Key](
            "drop",
            self._limits,
            self._write,
            name_of=lambda key: key[2],
            is_security=lambda key: self._attention[key] is Attention.SECURITY,
            counts_events=True,
        )

    def plain_totals(self) -> dict[str, int]:
        """The totals with plain strings: a terminal's log shows members of an enumeration as code."""
        return {str(reason): count for reason, count in self.totals.items()}

    def add(self, event: str, reason: str, name: str, count: int, now: float, last: Fact = "") -> None:
        """Count drops of a peer or endpoint. ``name`` is empty if the sender is unknown."""
        self.totals[reason] += count
        key = event, reason, name
        self._last[key] = last
        kind = self._attention.get(key)
        if kind is None:
            kind = self._attention[key] = attention(event, reason)
            self._reasons[key] = reason
        if kind is Attention.SECURITY or kind is Attention.PROBLEM or key in self._conditions:
            self._conditions.note(key, now, count)
        elif kind is Attention.EVERYDAY:
            self._unlogged[key] += count
            if self._persists(key, now):
                self._conditions.note(key, now, self._unlogged.pop(key))
        elif (
            kind is Attention.DESIGN
            and key not in self._said
            and (omitted := self._limits.take("withheld", name, now)) is not None
        ):
            self._said.add(key)
            self._log.info(event, **self._facts(key), **omitted)

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

    def check(self, now: float) -> None:
        """Write the lines that are due. Call it about once a second."""
        self._conditions.check(now)

    def close(self) -> None:
        """Write the ends of all conditions: the daemon stops."""
        self._conditions.close()

    def forget(self, peer: str) -> None:
        """Forget a peer that was removed or has other rules, under its previous keys too."""
        self._conditions.close(lambda key: link_name(key[2]) == peer)
        for key in [key for key in self._attention if link_name(key[2]) == peer]:
            del self._attention[key], self._reasons[key], self._last[key]
            self._seconds.pop(key, None)
            self._unlogged.pop(key, None)
            self._said.discard(key)

    def _persists(self, key: Key, now: float) -> bool:
        seconds = self._seconds.get(key)
        if seconds is None:
            seconds = self._seconds[key] = deque(maxlen=PERSISTENT_S)
        if not seconds or now - seconds[-1] >= 1.0:
            seconds.append(now)
        return len(seconds) == PERSISTENT_S and now - seconds[0] <= WINDOW_S

    def _write(self, key: Key, phase: Phase, condition: OpenCondition, omitted: dict[str, int]) -> None:
        if phase is Phase.BEGAN:
            self._log.warning(key[0], count=condition.count, **self._facts(key), **omitted)
            return
        write, event = (
            (self._log.warning, "drops_continued") if phase is Phase.CONTINUED else (self._log.info, "drops_ended")
        )
        write(
            event,
            kind=key[0],
            count=condition.count,
            duration_s=condition.duration_s,
            **self._facts(key, with_meaning=False),
            **omitted,
        )

    def _facts(self, key: Key, *, with_meaning: bool = True) -> dict[str, str]:
        reason = self._reasons[key]
        facts = {
            "reason": reason,
            "who": key[2],
            "meaning": _meaning(reason) if with_meaning else "",
            "last": _describe(self._last[key]),
        }
        return {field: fact for field, fact in facts.items() if fact}

    def on_loop_failure(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Handle an error that asyncio reports to the loop only."""
        error = context.get("exception")
        if isinstance(error, OSError):  # such as: no file descriptor is left for a new connection
            self.add("connections_failed", failure_name(error), "", 1, monotonic(), str(context["message"]))
        else:
            loop.default_exception_handler(context)


def _meaning(reason: str) -> str:
    return reason.meaning if isinstance(reason, Reason) else meaning_of(reason)


def _describe(fact: Fact) -> str:
    match fact:
        case str():
            return fact
        case Header():
            return f"{name_of(fact.msgid)} of system {fact.system}"
        case detail, path:
            return f"{_about(detail)} from {shown(path.address)}".strip()


def _about(detail: Detail) -> str:
    match detail:
        case bytes():
            return f"key {encode_key(detail)}"
        case int():
            return compared(detail)
        case _:
            return detail and f"suite {detail}"
