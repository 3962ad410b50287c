"""The file with the newest bulletin, for the next start. README.md, "Start and state".

A text: what it is, the bulletin in base64, a line with the key and certificate of each member of the roster, and a
checksum of the lines before.
"""

from __future__ import annotations

import asyncio
from base64 import b64decode, b64encode
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from stat import S_ISREG
from typing import Final, NamedTuple

from uavlinkd.authority.constants import HAVE_INTERVAL_S
from uavlinkd.authority.trust import BulletinVerdict, Trust
from uavlinkd.protocol.constants import NEVER
from uavlinkd.protocol.crypto import sha256
from uavlinkd.protocol.drops import Drop
from uavlinkd.system.clock import monotonic
from uavlinkd.system.folders import replace_file
from uavlinkd.system.guard import report
from uavlinkd.system.tasks import Threads

STOP_WAIT_S: Final = 2.0
"""A disk that hangs delays the end of the daemon by this time at most."""
_THREAD = Threads(1, "fleet state")
_TITLE = b"uavlinkd fleet state 2"
_MOST_BYTES = 65536  # of the file. The longest one has 260 members of 182 bytes.


class FleetState(NamedTuple):
    """The content of a file."""

    bulletin: bytes
    members: tuple[tuple[bytes, bytes], ...] = ()
    """The key and the certificate of each member of the roster."""


def read(path: Path, trust: Trust) -> str:
    """Let a daemon that starts know what the file has.

    Returns the cause in words if it cannot be used, and nothing if it is used or absent.
    """
    try:
        if not S_ISREG(path.stat().st_mode):  # opening a FIFO would wait for its writer
            return f"{path} is not a file"
        with path.open("rb") as file:
            data = file.read(_MOST_BYTES)
    except FileNotFoundError:
        return ""
    except OSError as error:
        return f"{path} cannot be read: {error.strerror}"
    if (state := _parse(data)) is None:
        return f"{path} is incomplete, or was not written by uavlinkd"
    verdict, _ = trust.receive_bulletin(state.bulletin)
    if verdict not in (BulletinVerdict.NEWER, BulletinVerdict.KNOWN):
        return f"{path} has a bulletin of another fleet, or one that contradicts the configuration ({verdict.value})"
    for key, certificate in state.members:
        with suppress(Drop):
            trust.note(key, certificate)
    return ""


def write(path: Path, state: FleetState) -> None:
    """Write the file as :func:`~uavlinkd.system.folders.replace_file` does."""
    replace_file(path, _encode(state))


def _encode(state: FleetState) -> bytes:
    members = (b" ".join(map(b64encode, member)) for member in state.members)
    lines = b"\n".join((_TITLE, b64encode(state.bulletin), *members, b""))
    return lines + sha256(lines).hex().encode() + b"\n"


def _parse(data: bytes) -> FleetState | None:
    try:
        _, bulletin, *members, _, _ = data.split(b"\n")
        pairs = [[b64decode(part) for part in member.split(b" ")] for member in members]
        state = FleetState(b64decode(bulletin), tuple((key, held) for key, held in pairs))
    except ValueError:
        return None
    return state if _encode(state) == data else None


class FleetDisk:
    """The file of one daemon, written in a thread: nothing waits for it.

    ``state`` returns what it is to have, ``on_written`` is called with what it has.
    """

    def __init__(self, path: Path, state: Callable[[], FleetState], on_written: Callable[[FleetState], None]) -> None:
        self._path = path
        self._state = state
        self._on_written = on_written
        self._writing: asyncio.Task[None] | None = None
        self.problem = ""
        """Why the file could not be written; empty if it was."""
        self.again_at = NEVER
        """When it is to be written again: monotonic seconds."""

    def write(self) -> None:
        """Write the present state. A later change during that is written too."""
        self.again_at = NEVER
        if self._writing is None:
            self._writing = asyncio.get_running_loop().create_task(self._write())

    async def stop(self) -> None:
        """Wait for a write that has begun, for at most :data:`STOP_WAIT_S`."""
        if self._writing is not None:
            await asyncio.wait([self._writing], timeout=STOP_WAIT_S)

    async def _write(self) -> None:
        state = None
        try:
            while state != self._state():
                state = self._state()
                await _THREAD.run(write, self._path, state)
                self.problem = ""
                self._on_written(state)
        except Exception as error:
            if not isinstance(error, OSError):
                report(error)
            reason = (isinstance(error, OSError) and error.strerror) or f"{type(error).__name__}, a fault inside"
            self.problem = f"{self._path} cannot be written: {reason}"
            self.again_at = monotonic() + HAVE_INTERVAL_S
        finally:
            self._writing = None
