"""The log of a process: the format of its lines, and the file that gets them.

Event names are stable, in ``snake_case`` and past tense; facts are fields. A field never contains a private key, PSK,
tag or payload. ``README.md`` has the list.
"""

from __future__ import annotations

import logging
import os
import select
import sys
from collections.abc import Mapping, Sequence
from typing import Final, TextIO, cast

import structlog
from structlog.typing import EventDict, Processor

from uavlinkd.protocol.path import SocketAddress, relay_name
from uavlinkd.system.addresses import Address

PRIORITIES: Final = {"critical": 2, "error": 3, "warning": 4, "info": 6, "debug": 7}
"""The syslog priority of each level (sd-daemon(3))."""
_PIPE_BUF: Final = getattr(select, "PIPE_BUF", 512)  # POSIX's lower bound, where Python does not know the system's
_FIRST: Final = ("event", "level")
_LAST: Final = ("daemon", "timestamp")


def shown(address: SocketAddress) -> str:
    """An address of a path as text. That of a relayed one has no handle, which means nothing to a person."""
    relay = relay_name(address)
    return str(Address.of(address)) if relay is None else f"relayed via {relay}"


def titled(kind: str, name: str) -> str:
    """A name behind its kind, unless it says that already: ``relay vps``, ``relay1``."""
    return name if name.startswith(kind) else f"{kind} {name}"


def order_fields(_: object, __: str, event: EventDict) -> EventDict:
    """Put the event and its level first, and the daemon and the time last, as a processor of structlog."""
    first = {field: event.pop(field) for field in _FIRST if field in event}
    last = {field: event.pop(field) for field in _LAST if field in event}
    return {**first, **event, **last}


def is_journal(stream: TextIO, environ: Mapping[str, str]) -> bool:
    """Whether the stream goes to systemd's journal: JOURNAL_STREAM names its device and inode (systemd.exec(5))."""
    try:
        status = os.fstat(stream.fileno())
    except (OSError, ValueError):  # not a file
        return False
    return environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


def _prefixed(render: Sequence[Processor]) -> Processor:
    """Renders a line behind its priority, which the journal removes and stores."""

    def process(logger: object, method: str, event: EventDict) -> str:
        prefix = f"<{PRIORITIES.get(str(event.get('level')), PRIORITIES['info'])}>"
        line: object = event
        for processor in render:
            line = processor(logger, method, cast(EventDict, line))
        return f"{prefix}{line}".replace("\n", f"\n{prefix}")

    return process


class LogFile:
    """The file or pipe for the log of a daemon. It may be full, slow or closed, and the daemon never waits for it.

    A line that cannot be written is lost and counted. The next written line has the count.
    """

    def __init__(self, descriptor: int) -> None:
        self.lost = 0
        self._descriptor = descriptor
        self._is_cut = False
        self._room = select.poll() if hasattr(select, "poll") else None  # Windows: wait for a slow reader
        if self._room is not None:
            self._room.register(descriptor, select.POLLOUT)

    def write(self, line: str) -> None:
        data = line.encode("utf-8", "backslashreplace")
        rest = memoryview(b"\n" + data if self._is_cut else data)
        try:
            # The reader of a pipe may hang. A writable pipe accepts PIPE_BUF bytes without blocking.
            while rest and (self._room is None or self._room.poll(0)):
                rest = rest[os.write(self._descriptor, rest[:_PIPE_BUF]) :]
                self._is_cut = True
        except OSError:  # the disk is full, or the reader closed the pipe
            pass
        if rest:
            self.lost += 1
        else:
            self.lost, self._is_cut = 0, False

    def flush(self) -> None:
        """Do nothing: no line is buffered."""

    def add_lost(self, _: object, __: str, event: EventDict) -> EventDict:
        """Add the count of lost lines to an event, as a processor of structlog."""
        if self.lost:
            event["lines_lost_before"] = self.lost
        return event


def set_up_logging(level: str, fmt: str, stream: TextIO = sys.stderr) -> None:
    """Configure structlog for this process. ``fmt`` is ``console``, ``json``, or ``auto``: console on a terminal."""
    console = fmt == "console" or (fmt == "auto" and stream.isatty())
    in_journal = is_journal(stream, os.environ)
    file = LogFile(stream.fileno()) if stream is sys.__stderr__ else None
    stamp: list[Processor] = [
        *([] if file is None else [file.add_lost]),
        structlog.processors.add_log_level,
        structlog.processors.TimeStamper(fmt="%H:%M:%S.%f" if console else "iso", utc=not console),
    ]
    render: list[Processor]
    if console:
        render = [structlog.dev.ConsoleRenderer(colors=stream.isatty(), pad_event_to=24)]
    else:
        render = [structlog.processors.format_exc_info, order_fields, structlog.processors.JSONRenderer()]
    if in_journal:
        render = [_prefixed(render)]
    structlog.configure(
        processors=[*stamp, *render],
        wrapper_class=structlog.make_filtering_bound_logger(getattr(logging, level.upper())),
        logger_factory=structlog.WriteLoggerFactory(file=stream if file is None else cast(TextIO, file)),
        cache_logger_on_first_use=True,
    )
