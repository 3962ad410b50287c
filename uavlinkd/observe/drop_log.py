"""Dropped datagrams and frames in the log: a condition per kind of drop, reason, and peer or endpoint."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Final

from structlog.typing import FilteringBoundLogger

from uavlinkd.config.keys import encode_key
from uavlinkd.daemon.journal import DaemonJournal, Fact, Key
from uavlinkd.mavlink.dialect import name_of
from uavlinkd.mavlink.headers import Header
from uavlinkd.mavlink.policy.gate import WITHHELD
from uavlinkd.observe.conditions import Conditions, Limit, OpenCondition, Phase
from uavlinkd.ops.line_limits import LineLimits
from uavlinkd.ops.log import shown
from uavlinkd.protocol.constants import PROTOCOL_VERSION
from uavlinkd.protocol.drops import Attention, DropReason, Reason
from uavlinkd.system.error_meanings import meaning_of

PERSISTENT_S = 5
"""An everyday drop is logged if it occurs in this many different seconds within :data:`WINDOW_S`."""
WINDOW_S = 60.0

EVERYDAY_ERRORS: Final = ("EAGAIN", "ENOBUFS", "ECONNREFUSED")
"""Of the kernel: a short queue, or a peer that restarts, causes a few of them."""


def attention(event: str, reason: str) -> Attention:
    """When drops of this kind are logged."""
    if event == "frames_withheld" and reason in WITHHELD:
        return Attention.DESIGN
    if isinstance(reason, Reason):
        return reason.attention
    return Attention.EVERYDAY if reason in EVERYDAY_ERRORS else Attention.PROBLEM


@dataclass(slots=True)
class _Kind:
    """Drops of one key."""

    reason: str
    """With its meaning: an equal key may have a plain string."""
    attention: Attention
    last: Fact = ""
    seconds: deque[float] = field(default_factory=lambda: deque(maxlen=PERSISTENT_S))
    """In which an everyday drop occurred."""
    unlogged: int = 0
    is_said: bool = False
    """Whether what works as configured was logged."""

    def persists(self, now: float) -> bool:
        """Whether an everyday drop that occurs now is worth a line."""
        if not self.seconds or now - self.seconds[-1] >= 1.0:
            self.seconds.append(now)
        return len(self.seconds) == PERSISTENT_S and now - self.seconds[0] <= WINDOW_S


class DropLog:
    """Writes the conditions of drops. Memory is bounded: reasons are closed lists, names are configured."""

    def __init__(self, log: FilteringBoundLogger, journal: DaemonJournal, limits: LineLimits | None = None) -> None:
        self._log = log
        self._journal = journal
        self._limits = limits or LineLimits()
        self._kinds: dict[Key, _Kind] = {}
        self._conditions = Conditions[Key](
            self._limits,
            self._write,
            lambda key: Limit("drop", key[2], self._kinds[key].attention is Attention.SECURITY),
        )

    def plain_totals(self) -> dict[str, int]:
        """The totals with plain strings: a terminal's log shows members of an enumeration as code."""
        return {str(reason): count for reason, count in self._journal.totals.items()}

    def _read(self) -> None:
        """Note the drops since the last call."""
        for key, tally in self._journal.take().items():
            kind = self._kinds.get(key)
            if kind is None:
                kind = self._kinds[key] = _Kind(tally.reason, attention(key[0], tally.reason))
            kind.last = tally.last
            if kind.attention in (Attention.SECURITY, Attention.PROBLEM) or key in self._conditions:
                self._conditions.note(key, tally.at, tally.count)
            elif kind.attention is Attention.EVERYDAY:
                kind.unlogged += tally.count
                if kind.persists(tally.at):
                    self._conditions.note(key, tally.at, kind.unlogged)
                    kind.unlogged = 0
            elif (
                kind.attention is Attention.DESIGN
                and not kind.is_said
                and (omitted := self._limits.take("withheld", key[2], tally.at)) is not None
            ):
                kind.is_said = True
                self._log.info(key[0], **self._facts(key), **omitted)

    def check(self, now: float) -> None:
        """Read the drops, and write the lines that are due. Call it every second or two."""
        self._read()
        self._conditions.check(now)

    def close(self) -> None:
        """Write the ends of all conditions: the daemon stops."""
        self._read()
        self._conditions.close()

    def forget(self, peer: str) -> None:
        """Forget a peer that was removed or has other rules."""
        self._read()
        self._conditions.close(lambda key: key[2] == peer)
        self._kinds = {key: kind for key, kind in self._kinds.items() if key[2] != peer}

    def _write(self, key: Key, phase: Phase, condition: OpenCondition, omitted: dict[str, int]) -> None:
        if phase is Phase.BEGAN:
            self._log.warning(key[0], count=condition.count, **self._facts(key), **omitted)
            return
        counted = {"kind": key[0], "count": condition.count, "duration_s": condition.duration_s}
        facts = {**counted, **self._facts(key, with_meaning=False), **omitted}
        if phase is Phase.CONTINUED:
            self._log.warning("drops_continued", **facts)
        else:
            self._log.info("drops_ended", **facts)

    def _facts(self, key: Key, *, with_meaning: bool = True) -> dict[str, str]:
        kind = self._kinds[key]
        meaning = kind.reason.meaning if isinstance(kind.reason, Reason) else meaning_of(kind.reason)
        facts = {"reason": kind.reason, "who": key[2], "meaning": meaning if with_meaning else ""}
        facts["last"] = _describe(kind.last, kind.reason)
        return {field: fact for field, fact in facts.items() if fact}


def _describe(fact: Fact, reason: str) -> str:
    match fact:
        case str():
            return fact
        case Header():
            return f"{name_of(fact.msgid)} of system {fact.system}"
        case bytes(key), path:
            return f"key {encode_key(key)} from {shown(path.address)}"
        case int(version), path:
            age = f"{'older' if version < PROTOCOL_VERSION else 'newer'} than uavlink/{PROTOCOL_VERSION}"
            return f"uavlink/{version}, {age} of this daemon, from {shown(path.address)}"
        case detail, path:
            what = f"suite {detail}" if reason == DropReason.SUITE_NOT_ACCEPTED else detail
            return f"{what} from {shown(path.address)}" if detail else f"from {shown(path.address)}"
