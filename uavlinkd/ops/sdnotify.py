"""What the service manager is told: that the daemon is ready, how it is, and that its loop still turns.

One datagram a message to the socket that ``NOTIFY_SOCKET`` names (sd_notify(3)); without it nothing is sent. Nothing
here raises or waits: a service manager that does not listen costs the link nothing.
"""

from __future__ import annotations

import socket
from collections import deque
from collections.abc import Mapping
from time import monotonic

from uavlinkd.core.constants import NEVER

UNSENT_MESSAGES = 16
"""Kept for a service manager that does not take them now; then the oldest are given up."""


class Supervisor:
    """The service manager. Times are monotonic seconds."""

    def __init__(self, environ: Mapping[str, str], process_id: int) -> None:
        self._address = _socket_address(environ.get("NOTIFY_SOCKET", ""))
        self._socket: socket.socket | None = None
        self._line = self._note = ""
        self._unsent: deque[str] = deque(maxlen=UNSENT_MESSAGES)
        self._ping_interval_s = _watchdog_s(environ, process_id) / 2
        self._ping_at = NEVER if self._ping_interval_s == NEVER else 0.0
        if self._address is not None:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)

    def ready(self, note: str = "") -> None:
        """Everything is bound, after the start or a reload: what waits for the service may go on.

        ``note`` stands behind the status from now on.
        """
        self._note = f"; {note}" if note else ""
        self._tell("READY=1")

    def reloading(self) -> None:
        """The configuration is being read again; :meth:`ready` ends it."""
        # systemd from 253 on compares the time with that of its signal, on the same clock.
        self._tell(f"RELOADING=1\nMONOTONIC_USEC={monotonic() * 1e6:.0f}")

    def stopping(self) -> None:
        """The end has begun; nothing is told after it."""
        self._tell("STOPPING=1")
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def turn(self, status: str, now: float) -> None:
        """Call this from the loop, a few times within the watchdog's time: it is the proof that the loop turns.

        ``status`` is one line for a person, which ``systemctl status`` shows.
        """
        if self._socket is None:
            return
        self._send_unsent()
        line = status + self._note
        if line != self._line and self._send(f"STATUS={line}"):
            self._line = line
        if now >= self._ping_at and self._send("WATCHDOG=1"):
            self._ping_at = now + self._ping_interval_s

    def _tell(self, message: str) -> None:
        """Send what must arrive in its order: where the socket is full, at the next turn."""
        if self._socket is not None:
            self._unsent.append(message)
            self._send_unsent()

    def _send_unsent(self) -> None:
        while self._unsent and self._send(self._unsent[0]):
            self._unsent.popleft()

    def _send(self, message: str) -> bool:
        assert self._socket is not None
        assert self._address is not None
        try:
            self._socket.sendto(message.encode(), self._address)
        except OSError:
            return False
        return True


def _socket_address(name: str) -> str | None:
    """The path of a Unix socket, or the name of an abstract one, which is written with ``@`` in place of a zero."""
    if name.startswith("@") and len(name) > 1:
        return "\0" + name[1:]
    return name if name.startswith("/") else None


def _watchdog_s(environ: Mapping[str, str], process_id: int) -> float:
    """How often the service manager wants to hear from this process; infinity where it does not."""
    usec, meant = environ.get("WATCHDOG_USEC", ""), environ.get("WATCHDOG_PID", str(process_id))
    if meant != str(process_id) or not (usec.isascii() and usec.isdigit()) or int(usec) == 0:
        return NEVER
    return int(usec) / 1e6
