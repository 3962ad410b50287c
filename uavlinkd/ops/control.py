"""The control socket: a Unix socket on which the daemon answers its owner, and the client for it.

One line of text asks, one line of JSON answers, and the connection is closed. Only the owner of the process may
connect: the socket's mode is 0600.
"""

from __future__ import annotations

import asyncio
import json
import os
import socket
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

MAX_REQUEST_BYTES = 256
"""Unless the server is told otherwise: the longest request is a word."""
UNKNOWN = "unknown request"
REQUEST_TIMEOUT_S = 5.0
"""For the request to come, and for the answer to be taken. To find the answer takes as long as it takes."""
MAX_CONNECTIONS = 8
RECEIVE_BYTES = 65536


Answer = dict[str, object] | None


class ControlError(Exception):
    """The daemon could not be asked, or did not answer. The message is for a person."""


class ControlServer:
    """Answers requests with what ``answer`` gives, at once or later; None for a request that it does not know."""

    def __init__(
        self,
        path: Path,
        answer: Callable[[str], Answer | Awaitable[Answer]],
        max_request_bytes: int = MAX_REQUEST_BYTES,
    ) -> None:
        self._path = path
        self._answer = answer
        self._max_request_bytes = max_request_bytes
        self._server: asyncio.Server | None = None
        self._connections = 0

    async def start(self) -> None:
        """Listen.

        Raises:
            ControlError: where the path cannot be used.
        """
        if self._is_served():
            raise ControlError(
                f"cannot listen on the control socket {self._path}: another daemon answers there: name another"
            )
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            if self._path.is_socket():
                self._path.unlink()  # of a daemon that was killed: a socket without a listener is no use to anyone
            mask = os.umask(0o177)
            try:
                sock.bind(str(self._path))
            finally:
                os.umask(mask)
            self._server = await asyncio.start_unix_server(self._serve, sock=sock, limit=self._max_request_bytes)
        except OSError as error:
            sock.close()
            raise ControlError(
                f"cannot listen on the control socket {self._path}: {error.strerror or error}: "
                f"its folder must be there and writable; of a service it is {_runtime_folder()}: write"
                f' control_socket = "{_runtime_folder()}/control.sock"'
            ) from None

    async def stop(self) -> None:
        """Close the socket and remove it."""
        if self._server is not None:
            self._server.close()
            with suppress(OSError):
                self._path.unlink()

    def _is_served(self) -> bool:
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
            sock.setblocking(False)  # a daemon that is busy has room in its queue, or says so at once
            with suppress(BlockingIOError):
                sock.connect(str(self._path))
            return True
        return False

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._connections += 1
        try:
            if self._connections <= MAX_CONNECTIONS:
                try:
                    async with asyncio.timeout(REQUEST_TIMEOUT_S):
                        line = await reader.readline()
                except ValueError:
                    answer = _line({"error": f"the request is longer than {self._max_request_bytes} bytes"})
                else:
                    answer = await self._respond(line)  # which takes as long as it takes
                async with asyncio.timeout(REQUEST_TIMEOUT_S):
                    writer.write(answer)
                    await writer.drain()
        except (OSError, TimeoutError):
            pass  # the client went away, or stalled: its loss
        finally:
            self._connections -= 1
            writer.close()

    async def _respond(self, line: bytes) -> bytes:
        answer = self._answer(line.decode("utf-8", "replace").strip())
        if isinstance(answer, Awaitable):
            answer = await answer
        return _line({"error": UNKNOWN} if answer is None else answer)


def _line(answer: dict[str, object]) -> bytes:
    return json.dumps(answer).encode() + b"\n"


def ask(
    path: Path, request: str, timeout_s: float = REQUEST_TIMEOUT_S, on_waiting: Callable[[], None] | None = None
) -> dict[str, Any]:
    """Ask the daemon that listens at ``path``, and wait for its answer.

    With ``on_waiting`` an answer may take longer: it is called after each ``timeout_s`` without one.

    Raises:
        ControlError: where there is no daemon, or no permission, or no answer but an error.
    """
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
            sock.settimeout(timeout_s)
            sock.connect(str(path))
            sock.sendall(request.encode() + b"\n")
            answer = json.loads(_read_answer(sock, on_waiting))
    except PermissionError:
        raise ControlError(
            f"not allowed to ask at {path}: only root and the daemon's own user may, use sudo"
        ) from None
    except OSError as error:
        raise ControlError(f"no daemon answers at {path}: {error.strerror or error}") from None
    except ValueError:
        raise ControlError(f"the daemon at {path} gave no answer that can be read") from None
    if not isinstance(answer, dict) or answer.get("error") == UNKNOWN:
        raise ControlError(f"the daemon at {path} does not know the request {request!r}")
    if "error" in answer:
        raise ControlError(f"the daemon at {path} refuses the request: {answer['error']}")
    return answer


def _runtime_folder() -> str:
    """Where a service may put its socket: systemd says so (RuntimeDirectory= in systemd.exec(5))."""
    return os.environ.get("RUNTIME_DIRECTORY", "/run/uavlinkd").partition(":")[0]


def _read_answer(sock: socket.socket, on_waiting: Callable[[], None] | None) -> bytes:
    """What comes until the daemon closes the connection.

    Raises:
        OSError: nothing came in time, and nobody wants to wait on.
    """
    answer = bytearray()
    while True:
        try:
            data = sock.recv(RECEIVE_BYTES)
        except TimeoutError:
            if on_waiting is None:
                raise
            on_waiting()
            continue
        if not data:
            return bytes(answer)
        answer += data
