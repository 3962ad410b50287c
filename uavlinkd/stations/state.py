"""The file that stays over restarts: a number that only grows, and where each station was.

The number is the timestamp of this daemon's initiations: a station refuses one that is not greater than all before.
A clock would do too, but many vehicles have none, and one that was set to the future once would silence the daemon.
The file has the end of a block of numbers, so that it is written before the first of them is used, and rarely.

::

    uavlinkd stations 1
    20000
    eZPBKM+9Oztdms1v2yiR+byync+zZsR87etuOX4heHE= 203.0.113.7 40001
"""

from __future__ import annotations

import asyncio
import re
from base64 import b64decode, b64encode
from collections.abc import Mapping
from contextlib import suppress
from ipaddress import ip_address
from pathlib import Path
from struct import Struct
from typing import Final

from uavlinkd.io.sockets import BindError
from uavlinkd.protocol.crypto import is_usable_public_key
from uavlinkd.protocol.path import SocketAddress
from uavlinkd.system.addresses import numeric_host
from uavlinkd.system.folders import replace_file
from uavlinkd.system.guard import report
from uavlinkd.system.tasks import Threads

BLOCK: Final = 10_000
"""Numbers that one write reserves: with a handshake every two seconds, those of five hours."""
_TITLE: Final = "uavlinkd stations 1"
_THREAD: Final = Threads(1, "stations state")
_TIMESTAMP: Final = Struct(">QI")
_TAI64: Final = 2**62
"""The first second of a TAI64N label (whitepaper, section 5.1)."""
_NUMBER: Final = re.compile(r"[0-9]{1,18}")


class StationDisk:
    """The file of one daemon. :meth:`open` it before the first timestamp."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._number = self._end = 0
        self._written: Mapping[bytes, SocketAddress] = {}
        self._writing: asyncio.Task[None] | None = None

    def open(self) -> Mapping[bytes, SocketAddress]:
        """Where each station was, by its key. Reserves numbers.

        Raises BindError: without the file, stations would refuse what this daemon sends after a restart.
        """
        try:
            text = self._path.read_bytes().decode("ascii", "replace") if self._path.exists() else ""
            self._number, self._written = _parse(text)
            self._end = self._number + BLOCK
            replace_file(self._path, self._encode(self._written))
        except OSError as error:
            raise BindError(
                f"stations: {self._path} cannot be written: {error.strerror}: stations refuse a daemon that forgets"
                " its last timestamp. Let the daemon's user write in this folder"
            ) from None
        return self._written

    @property
    def left(self) -> int:
        """How many timestamps are reserved."""
        return self._end - self._number

    def timestamp(self) -> bytes:
        """A greater one than all before.

        If the disk takes none for hours, a restart repeats some: then only stations themselves make new keys a while.
        """
        self._number += 1
        return _TIMESTAMP.pack(_TAI64 + self._number, 0)

    def follow(self, addresses: Mapping[bytes, SocketAddress]) -> None:
        """Write what changed, in a thread. Call it once a second."""
        is_short = self.left < BLOCK // 2
        if self._writing is None and (is_short or addresses != self._written):
            end = self._number + BLOCK if is_short else self._end
            self._writing = asyncio.get_running_loop().create_task(self._write(dict(addresses), end))

    async def _write(self, addresses: Mapping[bytes, SocketAddress], end: int) -> None:
        try:
            await _THREAD.run(replace_file, self._path, self._encode(addresses, end))
            self._written, self._end = addresses, end
        except OSError:
            pass  # the numbers last for hours, and the next second tries again
        except Exception as error:
            report(error)
        finally:
            self._writing = None

    def _encode(self, addresses: Mapping[bytes, SocketAddress], end: int | None = None) -> bytes:
        lines = [f"{b64encode(key).decode()} {numeric_host(at)} {at[1]}" for key, at in addresses.items()]
        return "\n".join([_TITLE, str(self._end if end is None else end), *lines, ""]).encode()


def _parse(text: str) -> tuple[int, dict[bytes, SocketAddress]]:
    """The number and the addresses; none of a file that this daemon did not write."""
    title, _, rest = text.partition("\n")
    number, *lines = rest.split("\n")
    if title != _TITLE or not _NUMBER.fullmatch(number):
        return 0, {}
    addresses: dict[bytes, SocketAddress] = {}
    for key, host, port in (fields for line in lines if len(fields := line.split(" ")) == 3):
        with suppress(ValueError):
            decoded, numeric, at = b64decode(key, validate=True), str(ip_address(host)), int(port)
            if is_usable_public_key(decoded) and 0 < at < 65536:
                addresses[decoded] = (numeric, at, 0, 0) if ":" in numeric else (numeric, at)
    return int(number), addresses
