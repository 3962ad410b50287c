"""Logs: set up once by the commands, and summed up where things repeat.

Event names are stable, ``snake_case`` and in the past tense; facts are fields. No key, tag or payload is ever one.
"""

from __future__ import annotations

import asyncio
import logging
import os
import select
import sys
from collections import Counter
from typing import Any, TextIO, cast

import structlog
from structlog.typing import EventDict, FilteringBoundLogger, Processor

from uavlinkd.system.clock import monotonic
from uavlinkd.core.constants import NEVER
from uavlinkd.core.drops import DropReason
from uavlinkd.endpoints.ports import failure_name
from uavlinkd.mavlink.dialect import name_of
from uavlinkd.mavlink.frames import Header
from uavlinkd.mavlink.policy.gate import Refusal

SUMMARY_INTERVAL_S = 10.0
"""What repeats is logged at once when it begins, then summed up this often."""

MEANINGS: dict[str, str] = {
    DropReason.MALFORMED: "datagrams that are no message of this protocol",
    DropReason.RAW_MAVLINK: "bare MAVLink at the port for peers: anyone could have sent it",
    DropReason.UNEXPECTED_RESPONSE: "responses to no handshake of ours",
    DropReason.BAD_MAC1: "handshake messages altered on the way, or from someone without our public key",
    DropReason.COOKIE_REQUIRED: "more handshakes than are answered at once: senders must prove their address",
    DropReason.RATE_LIMITED: "more handshakes than one source, or all sources together, may cause",
    DropReason.REPLAYED_INITIATION: "initiations that were read before: somebody replays them",
    DropReason.INVALID_KEY_SHARE: "handshakes with a public value that no honest peer sends",
    DropReason.BAD_HANDSHAKE: "handshakes altered on the way, or made with another key or PSK than configured here",
    DropReason.UNKNOWN_PEER: "initiations with a key that is not configured here",
    DropReason.SUITE_NOT_ACCEPTED: "initiations with a suite that is not in this peer's list",
    DropReason.HEADER_MISMATCH: "handshakes whose header was altered on the way",
    DropReason.BAD_PARAMETERS: "handshakes with parameters outside the protocol",
    DropReason.GROUP_BUDGET_SPENT: "handshakes with a costly suite, more than one peer or all may cause",
    DropReason.NO_FREE_INDEX: "no session index left",
    DropReason.UNEXPECTED_COOKIE: "cookies for no message of ours",
    DropReason.BAD_COOKIE: "cookies that do not open",
    DropReason.UNKNOWN_INDEX: "envelopes for sessions unknown here: this side or the other restarted, or garbage",
    DropReason.LATE: "envelopes for sessions that have ended",
    DropReason.OVER_SHARE: "this daemon is busy, and the sender has more waiting than its share",
    DropReason.TOO_LONG: "envelopes longer than agreed: no honest daemon sends them",
    DropReason.SESSION_EXPIRED: "envelopes under keys that are too old",
    DropReason.LONG_COUNTER: "envelopes with a counter in the wrong form",
    DropReason.REPLAYED: "replayed envelopes, or copies that the network made",
    DropReason.TOO_OLD: "envelopes far behind the newest: replayed, or held back",
    DropReason.DELAYED: "envelopes held back on the way for seconds",
    DropReason.DOUBTFUL: "frames after a silence, or commands while echoes stay unanswered: not confirmed to be new",
    DropReason.BAD_TAG: "envelopes altered or forged on the way",
    DropReason.BAD_CONTROL: "control records of an authentic peer that are none",
    DropReason.BAD_PATH_RESPONSE: "answers to no path challenge",
    DropReason.NO_SESSION: "frames for a peer with which there is no link now",
    DropReason.TOO_LARGE: "frames larger than the peer takes",
    "envelopes_missing": "envelopes that the peer sent and that never came: a bad radio, or somebody drops them",
    "envelopes_out_of_order": "envelopes that came after later ones: several paths, or somebody reorders them",
    "challenges_unanswered": "the peer's envelopes came from places where it is not: somebody forwards them",
    "echoes_unanswered": "questions that the peer did not answer: it does not hear, or somebody keeps the answers",
    "handshakes_unanswered": "calls for new keys repeated while the peer was up: a bad radio, or somebody drops them",
    "cookies_taken": "the peer asked to prove our address: it is under load, or somebody pretends to be it",
    "stale": "frames that waited in the system while this process stood still",
}
"""What a person should understand by a reason."""

REFUSALS: dict[str, str] = {
    Refusal.FOREIGN_SYSTEM: "frames of a system that is not in its system_ids",
    Refusal.MESSAGE_NOT_ALLOWED: "messages that its role, or its lists, do not let pass",
    Refusal.UNKNOWN_MESSAGE: "messages unknown to the dialect, or too long for it; a list may allow their numbers",
    Refusal.COMMAND_NOT_ALLOWED: "commands that its role, or its lists, do not let pass",
    Refusal.SETUP_SIGNING: "MAVLink signing keys in clear, which never cross a link",
    Refusal.MAVLINK1_NOT_ALLOWED: "MAVLink 1, which is switched off for it",
    Refusal.FILE_WRITE_NOT_ALLOWED: "file transfers that write, where only reading is allowed",
    Refusal.GROUND_STATION_NOT_ALLOWED: "heartbeats as a ground station, which its role is not",
    Refusal.HIDDEN_FRAME: "frames that hide one which it may not send: an attack, or a file with such frames",
    Refusal.RATE_LIMITED: "more of these messages than rate_in or rate_out lets pass",
}
"""The same for frames that a policy did not let pass: ``frames_refused`` came from a peer or endpoint, and
``frames_withheld`` would have gone to one."""


UNVERIFIED = (
    "the peer's frames arrive, its echo replies do not: the direction back is blocked, or an attacker delays frames."
    " Commands, missions, parameters and manual control are held and dropped; reports pass and may be old"
)
"""What a person should understand by unverified freshness."""

DISTURBANCES = (
    "envelopes_missing",
    "envelopes_out_of_order",
    "challenges_unanswered",
    "echoes_unanswered",
    "handshakes_unanswered",
    "cookies_taken",
)
"""What is counted of a peer where no datagram is to blame, by its name in the status."""


class LogFile:
    """Where the lines of a daemon go: it may be full, slow or gone, and nobody waits for it.

    A line that it does not take is lost, and counted; the next one that it takes says how many were.
    """

    def __init__(self, descriptor: int) -> None:
        self.lost = 0
        self._descriptor = descriptor
        self._is_cut = False
        self._room = select.poll()
        self._room.register(descriptor, select.POLLOUT)

    def write(self, line: str) -> None:
        """Write a line, or lose it."""
        data = line.encode("utf-8", "backslashreplace")
        rest = memoryview(b"\n" + data if self._is_cut else data)
        try:
            # Whoever reads a pipe may have stopped. One that is writable takes PIPE_BUF bytes without waiting.
            while rest and self._room.poll(0):
                rest = rest[os.write(self._descriptor, rest[: select.PIPE_BUF]) :]
                self._is_cut = True
        except OSError:  # a full disk; a reader that has gone
            pass
        if rest:
            self.lost += 1
        else:
            self.lost, self._is_cut = 0, False

    def flush(self) -> None:
        """Nothing: no line waits."""

    def tell_lost(self, _: object, __: str, event: EventDict) -> EventDict:
        """For structlog: how many lines before this one were lost."""
        if self.lost:
            event["lines_lost_before"] = self.lost
        return event


def set_up_logging(level: str, fmt: str, stream: TextIO = sys.stderr) -> None:
    """Configure structlog for this process: a console on a terminal, JSON lines elsewhere (``fmt`` ``auto``)."""
    console = fmt == "console" or (fmt == "auto" and stream.isatty())
    file = LogFile(stream.fileno()) if stream is sys.__stderr__ else None
    stamp: list[Processor] = [
        *([] if file is None else [file.tell_lost]),
        structlog.processors.add_log_level,
        structlog.processors.TimeStamper(fmt="%H:%M:%S.%f" if console else "iso", utc=not console),
    ]
    render: list[Processor]
    if console:
        render = [structlog.dev.ConsoleRenderer(colors=stream.isatty(), pad_event_to=24)]
    else:
        render = [structlog.processors.format_exc_info, structlog.processors.JSONRenderer()]
    structlog.configure(
        processors=[*stamp, *render],
        wrapper_class=structlog.make_filtering_bound_logger(getattr(logging, level.upper())),
        logger_factory=structlog.WriteLoggerFactory(file=stream if file is None else cast(TextIO, file)),
        cache_logger_on_first_use=True,
    )


class DropSummary:
    """Turns floods of drops into a line a reason: one when it begins, then one each :data:`SUMMARY_INTERVAL_S`.

    Bounded: reasons are a closed list, peers and endpoints those of the configuration.
    """

    def __init__(self, log: FilteringBoundLogger) -> None:
        self._log = log
        self._waiting: Counter[tuple[str, str, str]] = Counter()
        self._quiet_until: dict[tuple[str, str, str], float] = {}
        self._last: dict[tuple[str, str, str], str] = {}
        self.next_flush = NEVER
        """When :meth:`flush` has something to write; infinity for never."""

    def add(self, event: str, reason: str, where: str, amount: int, now: float, last: str = "") -> None:
        """Count ``amount`` drops; ``where`` names the peer or endpoint, empty for neither.

        ``last`` is what a person wants to know of one of them, such as whence it came.
        """
        key = (event, reason, where)
        self._waiting[key] += amount
        self._last[key] = last
        if now >= self._quiet_until.get(key, now):
            self._write(key, now)
        else:
            self.next_flush = min(self.next_flush, self._quiet_until[key])

    def add_refused(self, who: str, header: Header, refusal: Refusal, now: float, *, to_them: bool) -> None:
        """Count a frame that a policy did not let pass: of ``who``, or ``to_them``."""
        last = f"{name_of(header.msgid)} of system {header.system}"
        self.add("frames_withheld" if to_them else "frames_refused", refusal, who, 1, now, last)

    def flush(self, now: float) -> None:
        """Write what has gathered since its last line, where that is long enough ago."""
        for key in [each for each in self._waiting if now >= self._quiet_until[each]]:
            self._write(key, now)
        self.next_flush = min((self._quiet_until[key] for key in self._waiting), default=NEVER)

    def _write(self, key: tuple[str, str, str], now: float) -> None:
        event, reason, where = key
        meanings = REFUSALS if event in ("frames_refused", "frames_withheld") else MEANINGS
        facts = {"count": self._waiting.pop(key), "meaning": meanings.get(reason, reason.replace("_", " "))}
        self._quiet_until[key] = now + SUMMARY_INTERVAL_S
        last = self._last.pop(key, "")
        named = {"who": where} if where else {}
        # What our own policy keeps from somebody is as it should be, and nobody's fault.
        write = self._log.info if event == "frames_withheld" else self._log.warning
        write(event, reason=reason, **named, **facts, **({"last": last} if last else {}))

    def on_loop_failure(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """For an event loop: what it could not do, and nobody else could be told."""
        error = context.get("exception")
        if isinstance(error, OSError):  # no descriptor left for who wants to connect, and the like
            self.add("calls_failed", failure_name(error), "", 1, monotonic(), str(context["message"]))
        else:
            loop.default_exception_handler(context)
