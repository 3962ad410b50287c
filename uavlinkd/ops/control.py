"""The control socket: a Unix socket on which the daemon answers its owner, and the client for it.

A request is one line of text, the answer one line of JSON. Then the server closes the connection. Only the owner of
the process may connect: the socket has mode 0600.
"""

from __future__ import annotations

import asyncio
import json
import os
import socket
from collections.abc import Awaitable, Callable
from contextlib import suppress
from math import inf
from pathlib import Path
from typing import Any

from uavlinkd.system.guard import report
from uavlinkd.system.terminal import CommandError, printable

MAX_REQUEST_BYTES = 8192  # enough for the attacks of a man in the middle with all their parameters
UNKNOWN = "unknown request"
FAILED_INSIDE = (
    "it failed because of a fault in the daemon ({}), which its log has: restart the daemon, and send what"
    " `uavlinkd status --json` prints, and the log (`journalctl -u uavlinkd`), to the developers"
)
REQUEST_TIMEOUT_S = 5.0
"""Limit for sending the request, and for reading the answer. Making the answer has no limit."""
RELOAD_TIMEOUT_S = 60.0
"""Limit for the answer to a reload: the daemon reads its file, and names in it may be slow."""
MAX_CONNECTIONS = 8
RECEIVE_BYTES = 65536
MAX_ANSWER_BYTES = 64 << 20  # a status of 4,000 peers has 15 MB

Answer = dict[str, object] | None


class ControlError(CommandError):
    """The daemon did not get the request, or did not answer. The message says what to do."""


def _unix_socket() -> socket.socket:
    if not hasattr(socket, "AF_UNIX"):
        raise ControlError("Python has no Unix sockets here: delete control_socket from the configuration")
    return socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)


class ControlServer:
    """Answers requests with the result of ``answer``, which may be awaitable. None means an unknown request."""

    def __init__(self, path: Path, answer: Callable[[str], Answer | Awaitable[Answer]]) -> None:
        self._path = path
        self._answer = answer
        self._server: asyncio.Server | None = None
        self._connections = 0

    async def start(self) -> None:
        """Listen on the socket. Raises ControlError if the path cannot be used."""
        start = f"cannot listen on the control socket {self._path}"
        if _is_served(self._path):
            raise ControlError(f"{start}: a daemon runs here already, and answers there")
        sock = _unix_socket()
        try:
            if self._path.is_socket():
                self._path.unlink()  # left by a daemon that was killed: no process listens
            mask = os.umask(0o177)
            try:
                sock.bind(str(self._path))
            finally:
                os.umask(mask)
            self._server = await asyncio.start_unix_server(self._serve, sock=sock, limit=MAX_REQUEST_BYTES)
        except OSError as error:
            sock.close()
            raise ControlError(f"{start}: {error.strerror or error}: {_remedy(self._path)}") from None

    async def stop(self) -> None:
        if self._server is not None:
            self._server.close()
            with suppress(OSError):
                self._path.unlink()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._connections += 1
        try:
            if self._connections <= MAX_CONNECTIONS:
                try:
                    async with asyncio.timeout(REQUEST_TIMEOUT_S):
                        line = await reader.readline()
                except ValueError:
                    answer: dict[str, object] = {"error": f"the request is longer than {MAX_REQUEST_BYTES} bytes"}
                else:
                    answer = await self._respond(line)  # without a time limit
                async with asyncio.timeout(REQUEST_TIMEOUT_S):
                    writer.write(json.dumps(answer).encode() + b"\n")
                    await writer.drain()
        except (OSError, TimeoutError):
            pass  # the client disconnected or hangs
        finally:
            self._connections -= 1
            writer.close()

    async def _respond(self, line: bytes) -> dict[str, object]:
        try:
            answer = self._answer(line.decode("utf-8", "replace").strip())
            if isinstance(answer, Awaitable):
                answer = await answer
        except Exception as error:  # a fault of the daemon, whose links go on
            report(error, most=inf)
            return {"error": FAILED_INSIDE.format(type(error).__name__)}
        return {"error": UNKNOWN} if answer is None else answer


def _is_served(path: Path) -> bool:
    with suppress(OSError), _unix_socket() as sock:
        sock.setblocking(False)  # a busy daemon has room in its queue, or refuses at once
        with suppress(BlockingIOError):
            sock.connect(str(path))
        return True
    return False


def _remedy(path: Path) -> str:
    # The folder for the socket of a service is RuntimeDirectory= in systemd.exec(5).
    folder, of_service = path.parent, os.environ.get("RUNTIME_DIRECTORY", "/run/uavlinkd").partition(":")[0]
    if folder.is_relative_to(of_service):
        return f"run `mkdir -p {folder}`, or start the service, which makes it"
    make = "its folder must be writable" if folder.is_dir() else f"run `mkdir -p {folder}`"
    return f'{make}; for a service, write control_socket = "{of_service}/control.sock"'


def ask(
    path: Path,
    request: str,
    timeout_s: float = REQUEST_TIMEOUT_S,
    *,
    for_terminal: bool = True,
) -> dict[str, Any]:
    """Send a request to the daemon that listens at ``path``, and return its answer.

    ``for_terminal``: no text in the answer acts on a terminal.
    Raises ControlError if no daemon listens, it refuses the client or the request, or does not answer in time.
    """
    try:
        with _unix_socket() as sock:
            sock.settimeout(timeout_s)
            sock.connect(str(path))
            sock.sendall(request.encode() + b"\n")
            if not (text := _read_answer(sock)):
                raise ControlError(f"the daemon at {path} ended, or refused the connection, before it answered")
            answer = json.loads(text)
            if for_terminal:
                answer = _without_controls(answer)
    except PermissionError:
        raise ControlError(
            f"no permission to connect to {path}: only root and the daemon's user have it; use sudo"
        ) from None
    except (FileNotFoundError, ConnectionRefusedError):
        raise ControlError(
            f"no daemon answers at {path}: start it (`uavlinkd run --config FILE`, or `systemctl start uavlinkd`);"
            " if it runs, restart it, or its file has another control_socket"
        ) from None
    except OSError as error:
        raise ControlError(f"no daemon answers at {path}: {error.strerror or error}") from None
    except (ValueError, RecursionError):
        raise ControlError(f"the answer of the daemon at {path} is not valid JSON") from None
    if not isinstance(answer, dict) or answer.get("error") == UNKNOWN:
        word = request.partition(" ")[0]  # the rest may have a key
        raise ControlError(f"the daemon at {path} does not know the request {word!r}")
    if "error" in answer:
        raise ControlError(f"the daemon at {path} refuses the request: {answer['error']}")
    return answer


def _without_controls(value: Any) -> Any:
    """An answer in which no text acts on the terminal: a captured daemon may have written it."""
    if isinstance(value, str):
        return printable(value, keep="\n")
    if isinstance(value, dict):
        return {printable(key, keep="\n"): _without_controls(one) for key, one in value.items()}
    return [_without_controls(one) for one in value] if isinstance(value, list) else value


def _read_answer(sock: socket.socket) -> bytes:
    """Read until the daemon closes the connection. Raises OSError if none arrives in time."""
    answer = bytearray()
    while data := sock.recv(RECEIVE_BYTES):
        answer += data
        if len(answer) > MAX_ANSWER_BYTES:
            raise ValueError
    return bytes(answer)
