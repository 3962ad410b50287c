"""Inside a machine: an autopilot at ``/dev/ttyACM0``, for the interpreter of the machine alone.

Arguments: the frames that it sends ten times a second, in hexadecimal digits, and the file for what it receives.
"""

from __future__ import annotations

import grp
import os
import pty
import select
import sys
import time
import tty
from contextlib import suppress

PERIOD_S = 0.1


def main(frames: bytes, path: str) -> None:
    """Run until a signal."""
    port, device = pty.openpty()
    tty.setraw(port)
    os.set_blocking(port, False)
    os.chown(os.ttyname(device), 0, grp.getgrnam("dialout").gr_gid)
    os.chmod(os.ttyname(device), 0o660)
    os.symlink(os.ttyname(device), "/dev/ttyACM0")
    with open(path, "wb", buffering=0) as received:
        while True:
            with suppress(BlockingIOError):  # the daemon does not read yet
                os.write(port, frames)
            next_s = time.monotonic() + PERIOD_S
            while (left_s := next_s - time.monotonic()) > 0 and select.select([port], [], [], left_s)[0]:
                received.write(os.read(port, 4096))


if __name__ == "__main__":
    main(bytes.fromhex(sys.argv[1]), sys.argv[2])
