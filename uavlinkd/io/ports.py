"""The interface of local endpoints. A port is one client of an endpoint: an autopilot, a ground station.

An endpoint reports its clients and their frames to the daemon, and sends frames to them. It never blocks, raises no
exception because of what a client does, and queues a bounded count of bytes.
"""

from __future__ import annotations

import asyncio
import errno
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Protocol

from uavlinkd.mavlink.frames import Frame, SplitCounters
from uavlinkd.mavlink.policy.delivery import DeliveredStreams, Source
from uavlinkd.system.stall import StallWatch

if TYPE_CHECKING:
    from uavlinkd.mavlink.signing.endpoint_signing import EndpointSigning

CLIENTS_PER_ENDPOINT = 32  # most clients of one `udpin` or `tcpin` endpoint
CLIENT_SILENT_S = 5.0
"""While all places are taken, the client that has been silent longest loses its place to a new client, if it has been
silent for this long. ``udpin`` sends such a client no broadcast frames of other clients."""


class LocalPort:
    """One client of an endpoint. Compared by identity."""

    is_genuine = False
    """Whether a frame with a valid signature came from it, where the endpoint signs: anybody may be a client."""

    def __init__(self, endpoint: Endpoint, name: str, received_at: float | None) -> None:
        self.endpoint = endpoint
        self.name = name  # its address, for people: `127.0.0.1:14550`, `/dev/ttyACM0`
        self.received_at = received_at
        """When its last frame was received, in monotonic seconds; None before the first frame."""
        self.delivered = endpoint.delivered.of(name)
        """The byte stream that it reads. It decides which bytes a frame becomes, in the order of delivery."""

    def signed(self, frames: Sequence[Frame], source: Source) -> Sequence[Frame]:
        """The frames for it: with signatures where the autopilot wants them, without those that get none."""
        signing = self.endpoint.signing
        return frames if signing is None else signing.sign(frames, source.name, is_genuine=self.is_genuine)

    def send(self, frames: Sequence[Frame], source: Source, now: float, waited_s: float) -> None:
        """Send frames that arrived together, all from one source, to the client, or drop and count them.

        Returns at once and reports no event.
        """
        raise NotImplementedError


class PortHandler(Protocol):
    """Receives the reports of an endpoint. ``now`` is monotonic seconds."""

    stall: StallWatch  # endpoints report their reads to it

    def on_port_opened(self, port: LocalPort) -> None:
        """A client connected."""

    def on_port_closed(self, port: LocalPort) -> None:
        """A client disconnected, or was silent for too long."""

    def on_port_silent(self, port: LocalPort) -> None:
        """A client that may have gone is silent. It needs no broadcast frames of other clients until it is active."""

    def on_port_active(self, port: LocalPort) -> None:
        """A silent client sent a frame, which follows."""

    def on_frames(self, port: LocalPort, frames: list[Frame], now: float, epoch: int, waited_s: float = 0.0) -> None:
        """Everything that a client sent since the last read, in order. The first frame has waited for ``waited_s``.

        ``epoch``: when it was read (:mod:`uavlinkd.system.stall`). The handler drops the frames of earlier epochs.
        """


class Endpoint(ABC):
    """A local MAVLink endpoint of the daemon, with no, one or many clients."""

    is_station = False
    """Whether its clients are those of a person elsewhere: their frames are for vehicles alone."""

    def __init__(self, name: str, handler: PortHandler) -> None:
        self.name = name
        self.handler = handler
        self.on_frames: Callable[..., None] = handler.on_frames
        """Receives what a client sent, as :meth:`PortHandler.on_frames`. Signing stands before the daemon here."""
        self.signing: EndpointSigning | None = None
        """Signs what clients get: see :meth:`LocalPort.signed`."""
        self.counters = SplitCounters()  # frames and garbage in the received bytes
        self.failures: Counter[str] = Counter()
        """Errors by name: the kernel's (``ECONNREFUSED``), and the endpoint's own reasons."""
        self.bytes_received = self.bytes_sent = self.frames_sent = 0
        self.delivered = DeliveredStreams()
        self._task: asyncio.Task[None] | None = None  # connects, opens or resolves

    @property
    @abstractmethod
    def ports(self) -> Sequence[LocalPort]:
        """The present clients."""

    def gather(self, seconds: float) -> None:  # noqa: B027
        """From now on, frames may wait this long before they are read. The bytes of a stream gather anyway."""

    @abstractmethod
    def start(self) -> None:
        """Begin to work, in the running event loop. Sockets that listen are bound already."""

    @abstractmethod
    def do_housekeeping(self, now: float) -> None:
        """Forget clients that have gone. The daemon calls this each second."""

    def close(self) -> None:
        """Stop and close everything. Reports no port as closed any more."""
        if self._task is not None:
            self._task.cancel()
            self._task = None  # it may hold a lost device, and freeing that closes it


def failure_name(error: OSError) -> str:
    """A short stable name for an error of the kernel, such as ``ECONNREFUSED``."""
    return errno.errorcode.get(error.errno or 0, type(error).__name__)
