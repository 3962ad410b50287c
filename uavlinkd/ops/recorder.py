"""The recorder of ``uavlinkd record``: a local client of a daemon that writes the frames it receives to a file.

The file is a telemetry log (.tlog): for each frame, the microseconds since 1970 as 8 bytes, big-endian, and the frame
as received. The clock is read once, at the start. If it is set later, time does not jump within the file.

A `udpin` serves only clients that send. The recorder therefore sends a HEARTBEAT each second, as a logging component.
Autopilots do not take that for a ground station, whose HEARTBEAT silences a failsafe.
"""

from __future__ import annotations

import asyncio
import os
import signal
import struct
import time
from contextlib import closing, suppress
from pathlib import Path
from typing import BinaryIO, Final

from uavlinkd.io.ports import Endpoint, LocalPort
from uavlinkd.io.sockets import udp_socket
from uavlinkd.io.tcp import TcpClient
from uavlinkd.io.udp import UdpClient, UdpServer
from uavlinkd.io.url import EndpointKind, EndpointUrl, NetworkUrl
from uavlinkd.mavlink.dialect import SETUP_SIGNING
from uavlinkd.mavlink.frames import Frame, SplitCounters, pack, split_payload
from uavlinkd.mavlink.payloads import HEARTBEAT
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.delivery import Source
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import StallWatch
from uavlinkd.system.terminal import UsageError

INTERVAL_S: Final = 1.0
"""How often the recorder sends a HEARTBEAT and writes what it received."""
_COMPONENT_LOG: Final = 155
_PAYLOAD: Final = struct.pack("<IBBBBB", 0, 38, 8, 0, 4, 3)  # type LOG, autopilot INVALID, state ACTIVE, version 3


class Recorder:
    """Receives the reports of an endpoint, and keeps the records that are not written yet."""

    def __init__(self) -> None:
        self.stall = StallWatch(monotonic(), lambda _: None)
        self.records: list[bytes] = []
        self._offset_s = time.time() - monotonic()

    def on_frames(self, port: LocalPort, frames: list[Frame], now: float, epoch: int, waited_s: float = 0.0) -> None:
        """Keep the frames, also those from before a pause, but never SETUP_SIGNING: it holds a key."""
        stamp = int((self._offset_s + now) * 1_000_000).to_bytes(8)
        self.records += [stamp + frame.raw for frame in frames if frame.header.msgid != SETUP_SIGNING]

    def on_port_opened(self, port: LocalPort) -> None:
        """Do nothing: the endpoint knows its ports."""

    on_port_closed = on_port_silent = on_port_active = on_port_opened


async def record(url: EndpointUrl, path: Path, system_id: int) -> int:
    """Record into a new file until SIGINT or SIGTERM. Return the count of frames.

    Raises CommandError if the URL cannot be used; OSError if the file exists or cannot be written.
    """
    recorder, ended, count, seq = Recorder(), asyncio.Event(), 0, 0
    own = Source("recorder", Policy({}, is_local=True).incoming)
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, ended.set)
    with closing(_open(url, recorder)) as endpoint, _create(path) as file:
        endpoint.start()
        while not ended.is_set():
            now = monotonic()
            recorder.stall.turn(now)
            endpoint.do_housekeeping(now)
            heartbeat = split_payload(pack(HEARTBEAT, _PAYLOAD, seq, system_id, _COMPONENT_LOG), SplitCounters())
            seq += 1
            for port in endpoint.ports:
                port.send(heartbeat, own, now, 0.0)
            with suppress(TimeoutError):
                await asyncio.wait_for(ended.wait(), INTERVAL_S)
            records, recorder.records = recorder.records, []
            file.write(b"".join(records))
            file.flush()
            count += len(records)
    return count


def _create(path: Path) -> BinaryIO:
    return open(path, "xb", opener=lambda name, flags: os.open(name, flags, 0o600))


def _open(url: EndpointUrl, recorder: Recorder) -> Endpoint:
    match url:
        case NetworkUrl(EndpointKind.UDPIN, address):
            return UdpServer("recorder", udp_socket(address), recorder)
        case NetworkUrl(EndpointKind.UDPOUT, address):
            return UdpClient("recorder", address, recorder)
        case NetworkUrl(EndpointKind.TCP, address):
            return TcpClient("recorder", address, recorder)
    raise UsageError(f"{url}: write udpout: for a daemon's udpin, udpin: for its udpout, or tcp: for its tcpin")
