"""What a process asks of the system for itself: no core dumps, and no more memory than it needs."""

from __future__ import annotations

import ctypes
from contextlib import suppress

_PR_SET_DUMPABLE = 4  # linux/prctl.h, which Python does not name


def forbid_core_dumps() -> None:
    """Forbid core dumps, where the system allows it.

    The limit does not apply to dumps that the kernel pipes to a process such as systemd-coredump (core(5)). Therefore
    the process is marked as not dumpable. Only root can trace such a process or read its memory (ptrace(2)).
    """
    with suppress(ImportError, OSError, ValueError):  # Windows has no such module
        import resource  # noqa: PLC0415

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with suppress(OSError, AttributeError, TypeError):  # no such call, or no such library: not Linux
        ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0)


def return_free_memory() -> None:
    """Return the memory to the system that the start needed, and the process does not: malloc_trim(3) of glibc."""
    with suppress(OSError, AttributeError, TypeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)
