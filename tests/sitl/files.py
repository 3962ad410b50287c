"""Transfers of files: logs by LOG_REQUEST_DATA, and any file by MAVFTP. What was lost is requested again."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from time import monotonic

from pymavlink.dialects.v20 import all as mavlink

from tests.sitl.station import AUTOPILOT, Inbox, RequestError, Station

LOG_BYTES = 90
"""In one LOG_DATA message."""
SILENCE_S = 1.0
FTP_BYTES = 239
_HEADER = struct.Struct("<HBBBBBBI")
_TERMINATE, _RESET, _OPEN_RO, _CREATE, _WRITE, _BURST = 1, 2, 4, 6, 7, 15
_NAK = 129


class FtpError(RequestError):
    """The vehicle answered with an error; ``code`` as in the MAVFTP specification."""

    def __init__(self, opcode: int, code: int) -> None:
        super().__init__(f"MAVFTP operation {opcode} was refused with error {code}")
        self.code = code


@dataclass(frozen=True, slots=True)
class Log:
    """An entry of the vehicle's list of logs."""

    number: int
    size_bytes: int


async def list_logs(station: Station, system: int, timeout_s: float = 60.0) -> list[Log]:
    """The logs on the vehicle, the oldest first.

    Raises:
        RequestError: no complete list arrived in time.
    """
    deadline = monotonic() + timeout_s
    with station.inbox(system, "LOG_ENTRY") as inbox:
        logs: dict[int, Log] = {}
        while monotonic() < deadline:
            station.send(mavlink.MAVLink_log_request_list_message(system, AUTOPILOT, 0, 0xFFFF))
            while (entry := await inbox.next(2 * SILENCE_S)) is not None:
                if entry.num_logs == 0:
                    return []
                logs[entry.id] = Log(entry.id, entry.size)
                if len(logs) == entry.num_logs:
                    return [logs[number] for number in sorted(logs)]
    raise RequestError(f"no list of logs within {timeout_s:.0f} s")


async def download_log(station: Station, system: int, log: Log, timeout_s: float = 600.0) -> bytes:
    """Request a whole log, then each run of parts that did not arrive.

    Raises:
        RequestError: not all parts arrived in time.
    """
    deadline = monotonic() + timeout_s
    count = -(-log.size_bytes // LOG_BYTES)
    parts: list[bytes | None] = [None] * count
    first = 0
    with station.inbox(system, "LOG_DATA") as inbox:
        while first < count and monotonic() < deadline:
            end = next((part for part in range(first, count) if parts[part] is not None), count)
            station.retries["log"] += (first, end) != (0, count)
            wanted_bytes = min(end * LOG_BYTES, log.size_bytes) - first * LOG_BYTES
            station.send(
                mavlink.MAVLink_log_request_data_message(
                    system, AUTOPILOT, log.number, first * LOG_BYTES, wanted_bytes
                )
            )
            while None in parts[first:end] and (data := await inbox.next(SILENCE_S)) is not None:
                if data.id == log.number and data.ofs % LOG_BYTES == 0 and data.ofs // LOG_BYTES < count:
                    parts[data.ofs // LOG_BYTES] = bytes(data.data[: data.count])
                    if data.ofs // LOG_BYTES == end - 1:
                        break  # the last part of the run: what is missing now was lost
            first = next((part for part in range(first, count) if parts[part] is None), count)
    station.send(mavlink.MAVLink_log_request_end_message(system, AUTOPILOT))
    if first < count:
        raise RequestError(f"part {first} of {count} of a log is missing after {timeout_s:.0f} s")
    return b"".join(part for part in parts if part is not None)


class Ftp:
    """MAVFTP with one vehicle."""

    def __init__(self, station: Station, system: int) -> None:
        self._station = station
        self._system = system
        self._sequence = 0

    async def read(self, path: str, timeout_s: float = 600.0) -> bytes:
        """Read a file in bursts; each gap is read again.

        Raises:
            RequestError: the vehicle refused it, or the file was incomplete after ``timeout_s``.
        """
        deadline = monotonic() + timeout_s
        await self._request(_RESET)
        session, opened = await self._request(_OPEN_RO, data=path.encode())
        size = struct.unpack("<I", opened[:4])[0]
        parts: dict[int, bytes] = {}
        with self._station.inbox(self._system, "FILE_TRANSFER_PROTOCOL") as inbox:
            while (offset := self._first_gap(parts, size)) < size:
                if monotonic() > deadline:
                    raise RequestError(f"byte {offset} of {size} of {path} is missing after {timeout_s:.0f} s")
                self._send(_BURST, session, offset, FTP_BYTES, b"")
                await self._receive_burst(inbox, parts, offset, size)
        await self._request(_TERMINATE, session=session)
        return b"".join(parts[offset] for offset in sorted(parts))

    async def write(self, path: str, content: bytes, timeout_s: float = 600.0) -> None:
        """Create a file and write it, part by part.

        Raises:
            RequestError: the vehicle refused it, or did not answer.
        """
        deadline = monotonic() + timeout_s
        await self._request(_RESET)
        session, _ = await self._request(_CREATE, data=path.encode())
        for offset in range(0, len(content), FTP_BYTES):
            if monotonic() > deadline:
                raise RequestError(f"{offset} of {len(content)} bytes were written within {timeout_s:.0f} s")
            await self._request(_WRITE, session=session, offset=offset, data=content[offset : offset + FTP_BYTES])
        await self._request(_TERMINATE, session=session)

    async def _receive_burst(self, inbox: Inbox, parts: dict[int, bytes], offset: int, size: int) -> None:
        """Store what arrives until the burst is complete, the vehicle is silent, or the end was reached."""
        while (message := await inbox.next(SILENCE_S)) is not None:
            _, _, opcode, length, of, is_complete, _, at = _HEADER.unpack(bytes(message.payload[:12]))
            if of != _BURST:
                continue
            if opcode == _NAK:
                return
            parts[at] = bytes(message.payload[12 : 12 + length])
            if is_complete or at + length >= size:
                return
        self._station.retries["MAVFTP burst"] += 1

    @staticmethod
    def _first_gap(parts: dict[int, bytes], size: int) -> int:
        offset = 0
        while offset < size and offset in parts:
            offset += len(parts[offset])
        return offset

    def _send(self, opcode: int, session: int, offset: int, size: int, data: bytes) -> int:
        self._sequence = (self._sequence + 1) % 65536
        header = _HEADER.pack(self._sequence, session, opcode, size, 0, 0, 0, offset)
        payload = (header + data).ljust(251, b"\0")
        self._station.send(mavlink.MAVLink_file_transfer_protocol_message(0, self._system, AUTOPILOT, payload))
        return self._sequence

    async def _request(
        self, opcode: int, *, session: int = 0, offset: int = 0, data: bytes = b"", tries: int = 40
    ) -> tuple[int, bytes]:
        """Send a request until it is answered; session and data of the answer.

        A vehicle answers a repeated request as the first one if the sequence number is the same.
        """
        with self._station.inbox(self._system, "FILE_TRANSFER_PROTOCOL") as inbox:
            for attempt in range(tries):
                self._sequence -= attempt > 0
                sequence = self._send(opcode, session, offset, len(data), data)
                self._station.retries["MAVFTP"] += attempt > 0
                ends_at = monotonic() + SILENCE_S
                while (left_s := ends_at - monotonic()) > 0 and (message := await inbox.next(left_s)) is not None:
                    number, of_session, answer, length, of, *_ = _HEADER.unpack(bytes(message.payload[:12]))
                    content = bytes(message.payload[12 : 12 + length])
                    if of != opcode or number != (sequence + 1) % 65536:
                        continue
                    if answer == _NAK:
                        raise FtpError(opcode, content[0])
                    return of_session, content
        raise RequestError(f"MAVFTP operation {opcode}: no answer")
