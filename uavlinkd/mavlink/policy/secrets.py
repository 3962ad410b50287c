"""Files of an autopilot that hold secrets: no policy passes a MAVFTP request that names one.

A signing key never crosses a link. SETUP_SIGNING carries it in clear; these files have it too:

* PX4 keeps it in ``mavlink/mavlink-signing-key.bin`` on its card
  (https://docs.px4.io/main/en/mavlink/message_signing.html).
* ArduPilot keeps it in its parameter storage: ``@SYS/storage.bin``, and where that is flash, ``@SYS/flash.bin``.
  ``@SYS/crash_dump.bin`` is a copy of the memory (libraries/AP_Filesystem/AP_Filesystem_Sys.cpp).
* PX4 reaches its memories as files below ``/dev`` and ``/fs/mtd``.

The card has a FAT file system: names are compared without regard to case, and each long name has a short one with a
tilde, such as ``MAVLIN~1.BIN``. So any name with a tilde is refused.
"""

from __future__ import annotations

import re
from typing import Final

OPCODES_WITHOUT_PATH: Final = frozenset((0, 1, 2, 5, 7, 15, 128, 129))
"""None, TerminateSession, ResetSessions, ReadFile, WriteFile, BurstReadFile, ACK and NAK: their data is not a path.
A number that MAVLink does not define may be a request with one."""

_SECRETS: Final = re.compile(r"SIGNING|STORAGE\.BIN|FLASH\.BIN|CRASH_DUMP|~|/DEV(/|$)|/MTD|^DEV/")


def names_secrets(path: bytes) -> bool:
    """Whether a path, or one of two paths with a zero between them, names a file with secrets."""
    text = path.decode("utf-8", "replace")
    folded = text.casefold().upper()  # a file system may fold some letters beyond ASCII too
    return any(_SECRETS.search(re.sub(r"/+(\./+)*", "/", one)) is not None for one in folded.split("\0"))
