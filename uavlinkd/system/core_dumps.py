"""No core dump of a process that holds keys, and no look into it by other programs of the same user."""

from __future__ import annotations

import ctypes
import resource
from contextlib import suppress

_PR_SET_DUMPABLE = 4  # linux/prctl.h, which Python does not name


def forbid_core_dumps() -> None:
    """Forbid them, as far as the system lets us.

    The limit alone does not do: it does not hold for dumps that go to a program such as systemd-coredump (core(5)).
    What is not dumpable cannot be traced either, nor its memory be read, but by root (ptrace(2)).
    """
    with suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with suppress(OSError, AttributeError):  # no such call: not Linux
        ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0)
