"""The error queue of a UDP socket in Linux: which sent datagrams could not be delivered, and why (ip(7))."""

from __future__ import annotations

import socket
import struct
import sys
from collections.abc import Callable, Iterator
from typing import Any

_RECVERR = {
    socket.AF_INET: (socket.IPPROTO_IP, 11),  # IP_RECVERR, which Python does not name: linux/in.h
    socket.AF_INET6: (socket.IPPROTO_IPV6, 25),  # IPV6_RECVERR: linux/in6.h
}
_ERROR = struct.Struct("=I")  # the first field of struct sock_extended_err: the error's number (linux/errqueue.h)
_CONTROL_BYTES = 256  # the error, and the address that reported it
SEND_ATTEMPTS = 4
"""How often a datagram is sent again while each attempt reports the error of an earlier one instead."""
REPORTS_PER_S = 20
"""Errors that the kernel reports of one socket in :class:`ErrorReports`: an initiator sends four a second at most."""
MOST_ERRORS = 128
"""Read at once. The kernel bounds the queue by the receive buffer."""


class ErrorReports:
    """The ICMP errors of a UDP socket whose datagrams they must not delay: at most :data:`REPORTS_PER_S`.

    Without IP_RECVERR an unconnected socket gets none. With it, any call on the socket may fail with the error of an
    earlier datagram. Beyond the limit the kernel reports none until the next :meth:`renew`, so that a flood of forged
    ICMP messages, or a client that is closed for hours, costs no work per datagram.
    """

    __slots__ = ("_left", "_sock")

    def __init__(self, sock: socket.socket) -> None:
        self._sock = sock
        self._left = 0
        self.renew()

    def renew(self) -> None:
        """Have the kernel report errors again. Call it about once a second."""
        if self._left <= 0:
            self._switch(is_on=True)
        self._left = REPORTS_PER_S

    def take(self) -> list[tuple[tuple[Any, ...], int]]:
        """The receiver's socket address and the error's number, of each datagram with an error."""
        reports = list(self._read())
        self._left -= len(reports)
        if reports and self._left <= 0:
            self._switch(is_on=False)
            reports += self._read()  # those that arrived meanwhile: none may stay
        return reports

    def _switch(self, *, is_on: bool) -> None:
        if sys.platform == "linux":
            self._sock.setsockopt(*_RECVERR[self._sock.family], int(is_on))

    def _read(self) -> Iterator[tuple[tuple[Any, ...], int]]:
        """Read the queue. Clears pending errors."""
        if sys.platform != "linux":
            return
        for _ in range(MOST_ERRORS):
            try:
                _, control, _, address = self._sock.recvmsg(0, _CONTROL_BYTES, socket.MSG_ERRQUEUE)
            except OSError:  # the queue is empty
                return
            for level, kind, data in control:
                if (level, kind) == _RECVERR[self._sock.family]:
                    yield address, _ERROR.unpack_from(data)[0]


def send_again(
    sock: socket.socket,
    datagram: bytes,
    address: tuple[Any, ...],
    error: OSError,
    take_errors: Callable[[], bool],
) -> OSError | None:
    """Send a datagram after this error of the first attempt. Returns the last error, or None if it was sent.

    The kernel may have reported the error of an earlier datagram, and not have sent this one. While the receive
    buffer is full, the kernel has no room for the record of that error and reports it all the same. So the first
    attempt needs no record. ``take_errors`` reads the records, and returns whether there were any.
    """
    for attempt in range(SEND_ATTEMPTS):
        if isinstance(error, BlockingIOError) or not (take_errors() or attempt == 0):
            return error
        try:
            sock.sendto(datagram, address)
        except OSError as next_error:
            error = next_error
        else:
            return None
    return error
