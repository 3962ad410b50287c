"""What all local endpoints share. A port is one program behind an endpoint: an autopilot, a ground station.

An endpoint reports to its daemon which ports are there and what they say, and sends them what it is given. It never
blocks, never raises for what the other side does, and holds a bounded amount back.
"""

from __future__ import annotations

import errno
from collections import Counter
from collections.abc import Sequence
from typing import Protocol

from uavlinkd.mavlink.policy.delivery import DeliveredStream, Source
from uavlinkd.mavlink.frames import Frame, SplitCounters
from uavlinkd.system.stall import StallWatch


class LocalPort:
    """One program behind an endpoint. Compared by identity."""

    __slots__ = ("delivered", "endpoint", "heard_at", "name")

    def __init__(
        self, endpoint: Endpoint, name: str, heard_at: float | None, delivered: DeliveredStream | None = None
    ) -> None:
        self.endpoint = endpoint
        self.name = name
        """Where it is, for people: ``127.0.0.1:14550``, ``/dev/ttyACM0``."""
        self.heard_at = heard_at
        """Monotonic seconds; None for one that is there by configuration and has not been heard."""
        self.delivered = delivered or DeliveredStream()
        """The stream that it reads. Its endpoint asks it for the bytes of each frame, in the order of delivery."""

    def __repr__(self) -> str:
        return f"LocalPort({self.endpoint.name}, {self.name})"

    def send(self, frames: Sequence[Frame], source: Source, now: float, waited_s: float) -> None:
        """Send frames that arrived together, all from one source, to the client."""
        self.endpoint.write(self, frames, source, now)


class PortHandler(Protocol):
    """What an endpoint reports to. ``now`` is monotonic seconds."""

    stall: StallWatch
    """Endpoints report their reads to it."""

    def on_port_opened(self, port: LocalPort) -> None:
        """A program is there."""

    def on_port_closed(self, port: LocalPort) -> None:
        """It is gone."""

    def on_frames(self, port: LocalPort, frames: list[Frame], now: float, epoch: int, waited_s: float = 0.0) -> None:
        """What it sent, all that was there at once, in order; the first of it has waited so long already.

        ``epoch``: when it was read (:mod:`uavlinkd.system.stall`). The handler drops frames of any but the present one.
        """


class Endpoint(Protocol):
    """A local MAVLink port of the daemon, with no, one or many programs behind it."""

    name: str
    counters: SplitCounters
    """What was found in the bytes that came."""
    failures: Counter[str]
    """What went wrong, by name: errors of the kernel (``ECONNREFUSED``), and the endpoint's own reasons."""
    bytes_received: int
    bytes_sent: int
    frames_sent: int

    @property
    def ports(self) -> Sequence[LocalPort]:
        """Who is there now."""

    def gather(self, seconds: float) -> None:
        """From now on frames may wait unread for so long: whoever they are for makes them wait anyway."""

    def start(self) -> None:
        """Begin to work, in the running event loop. The daemon has bound what listens already."""

    def write(self, port: LocalPort, frames: Sequence[Frame], source: Source, now: float) -> None:
        """Send frames of one source to one port, or drop and count them. Returns at once."""

    def do_housekeeping(self, now: float) -> None:
        """Called each second: forget who is gone."""

    def close(self) -> None:
        """Stop and close everything. Reports no port as closed any more."""


def failure_name(error: OSError) -> str:
    """A short stable name for what the kernel said: ``ECONNREFUSED`` and so on."""
    return errno.errorcode.get(error.errno or 0, type(error).__name__)
