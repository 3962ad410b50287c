"""Reports to the service manager: ready, reloading or stopping, a status line, and the watchdog.

Each message is one datagram to the socket in ``NOTIFY_SOCKET`` (sd_notify(3)). No call raises or waits, so a service
manager that does not read costs the links nothing. This is why it is our own: the libraries block on a full socket,
or need libsystemd.
"""

from __future__ import annotations

import socket
from collections import deque
from collections.abc import Mapping
from time import monotonic

from uavlinkd.protocol.constants import NEVER

UNSENT_MESSAGES = 16
"""Limit of messages that wait for the service manager. Beyond it, the oldest is dropped."""


class Supervisor:
    """The service manager. Times are monotonic seconds."""

    def __init__(self, environ: Mapping[str, str], process_id: int) -> None:
        name = environ.get("NOTIFY_SOCKET", "")
        # The path of a Unix socket, or the name of an abstract one, where @ stands for the first zero byte.
        self._address = f"\0{name[1:]}" if name.startswith("@") else name
        self._socket: socket.socket | None = None
        self._line = self._note = ""
        self._unsent: deque[str] = deque(maxlen=UNSENT_MESSAGES)
        self._ping_interval_s = _watchdog_s(environ, process_id) / 2
        self._ping_at = NEVER if self._ping_interval_s == NEVER else 0.0
        if len(name) > 1 and name[0] in "@/":
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)

    def ready(self, note: str = "") -> None:
        """Report that all sockets are bound, after the start or a reload. Units that wait for the service may start.

        ``note`` is appended to the status line from now on.
        """
        self._note = f"; {note}" if note else ""
        self._send_in_order("READY=1")

    def reloading(self) -> None:
        """Report that a reload begins. :meth:`ready` reports its end."""
        # systemd 253 and later compares this time with the time of its signal, on the same clock.
        self._send_in_order(f"RELOADING=1\nMONOTONIC_USEC={monotonic() * 1e6:.0f}")

    def stopping(self) -> None:
        """Report that the daemon stops. No report follows."""
        self._send_in_order("STOPPING=1")
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def turn(self, status: str, now: float, *, work_moves: bool = True) -> None:
        """Feed the watchdog, if work moves, and report the status line. Call it several times per watchdog interval.

        ``systemctl status`` shows ``status``.
        """
        self._send_unsent()
        line = status + self._note
        if line != self._line and self._send(f"STATUS={line}"):
            self._line = line
        if work_moves and now >= self._ping_at and self._send("WATCHDOG=1"):
            self._ping_at = now + self._ping_interval_s

    def _send_in_order(self, message: str) -> None:
        """Send a message that must arrive in order. If the socket is full, it waits for the next turn."""
        self._unsent.append(message)
        self._send_unsent()

    def _send_unsent(self) -> None:
        while self._unsent and self._send(self._unsent[0]):
            self._unsent.popleft()

    def _send(self, message: str) -> bool:
        """Send a message to the service manager, if there is one. Returns False if its socket is full."""
        try:
            if self._socket is not None:
                self._socket.sendto(message.encode(), self._address)
        except OSError:
            return False
        return True


def _watchdog_s(environ: Mapping[str, str], process_id: int) -> float:
    """The watchdog interval of this process in seconds; infinity without a watchdog."""
    usec, pid = environ.get("WATCHDOG_USEC", ""), environ.get("WATCHDOG_PID", str(process_id))
    if pid != str(process_id) or not (usec.isascii() and usec.isdigit()) or int(usec) == 0:
        return NEVER
    return int(usec) / 1e6
