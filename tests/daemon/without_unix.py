"""Hides from a process, before it starts, what Python has on Unix only."""

from __future__ import annotations

import asyncio
import functools
import os
import select
import signal
import socket
import sys

MODULES = ("fcntl", "resource", "termios", "uvloop")
NAMES = {
    os: ("O_CLOEXEC", "O_NONBLOCK", "fchmod", "geteuid"),
    select: ("PIPE_BUF", "poll"),
    signal: ("SIGHUP",),
    socket: ("AF_UNIX",),
}


def hide() -> None:
    """Hide modules, sockets, flags and calls, and the loop's handlers of signals. Windows has none of them."""

    def refuse(*_: object) -> None:
        raise NotImplementedError

    socket.socketpair = functools.partial(socket.socketpair, socket.AF_UNIX)
    for name in MODULES:
        sys.modules[name] = None  # type: ignore[assignment]
    for module, names in NAMES.items():
        for name in names:
            delattr(module, name)
    asyncio.SelectorEventLoop.add_signal_handler = refuse  # type: ignore[assignment]


hide()
