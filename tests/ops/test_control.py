"""The control socket: a line of text, an answer in JSON, for the owner only."""
# ruff: noqa: ASYNC240  (small local files; nothing else waits in this loop)

from __future__ import annotations

import asyncio
import json
import os
from collections.abc import AsyncIterator
from contextlib import suppress
from pathlib import Path

import pytest

from uavlinkd.ops import control
from uavlinkd.ops.control import MAX_CONNECTIONS, MAX_REQUEST_BYTES, ControlError, ControlServer, ask


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A path that is short enough for a socket."""
    monkeypatch.chdir(tmp_path)
    return Path("control.sock")


@pytest.fixture
async def server(path: Path) -> AsyncIterator[ControlServer]:
    """A server that knows the request ``status``."""
    server = ControlServer(path, lambda request: {"name": "drone0"} if request == "status" else None)
    await server.start()
    yield server
    await server.stop()


async def request(path: Path, data: bytes) -> bytes:
    """Send bytes and read until the server closes."""
    reader, writer = await asyncio.open_unix_connection(path)
    writer.write(data)
    answer = await read_to_end(reader)
    await close(writer)
    return answer


async def read_to_end(reader: asyncio.StreamReader) -> bytes:
    """Read until the server closes. A reset also ends the read: the server closed with unread bytes."""
    try:
        return await asyncio.wait_for(reader.read(), 5)
    except ConnectionResetError:
        return b""


async def close(writer: asyncio.StreamWriter) -> None:
    """Close a connection in any state."""
    writer.close()
    with suppress(OSError):
        await writer.wait_closed()


async def test_unknown_request_is_an_error(server: ControlServer, path: Path) -> None:
    """The answer says so, and the client raises."""
    with pytest.raises(ControlError, match="does not know the request 'dance'"):
        await asyncio.to_thread(ask, path, "dance")


async def test_daemon_that_ends_before_it_answered_is_named(path: Path) -> None:
    """It was killed, or had no place for another connection."""

    async def end(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readline()
        writer.close()

    async with await asyncio.start_unix_server(end, path):
        with pytest.raises(ControlError, match=r"the daemon at control\.sock ended, .* before it answered"):
            await asyncio.to_thread(ask, path, "status")


async def test_server_limits_the_request_exactly(path: Path) -> None:
    """The client reports why a longer request was refused, and does not repeat the request."""
    server = ControlServer(path, lambda request: {"length": len(request)})
    await server.start()
    assert await asyncio.to_thread(ask, path, "x" * MAX_REQUEST_BYTES) == {"length": MAX_REQUEST_BYTES}
    with pytest.raises(ControlError, match="refuses the request: the request is longer than 8192 bytes"):
        await asyncio.to_thread(ask, path, "x" * (MAX_REQUEST_BYTES + 1))
    await server.stop()


async def test_silent_clients_do_not_block_others_indefinitely(
    server: ControlServer, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While silent clients use all connections, others are refused, until the silent ones time out."""
    monkeypatch.setattr(control, "REQUEST_TIMEOUT_S", 2.0)
    mute = [await asyncio.open_unix_connection(path) for _ in range(MAX_CONNECTIONS)]
    assert await request(path, b"status\n") == b""
    for reader, writer in mute:
        assert await read_to_end(reader) == b""
        await close(writer)
    assert json.loads(await request(path, b"status\n")) == {"name": "drone0"}


async def test_only_the_owner_may_connect(server: ControlServer, path: Path) -> None:
    """The socket has mode 0600, and the umask of the process is unchanged."""
    assert path.stat().st_mode & 0o777 == 0o600
    mask = os.umask(0o022)
    os.umask(mask)
    assert mask != 0o177


async def test_stopped_server_leaves_no_socket(path: Path) -> None:
    """The client reports that no daemon answers."""
    server = ControlServer(path, lambda _: {})
    await server.start()
    await server.stop()
    assert not path.exists()
    with pytest.raises(ControlError, match=r"no daemon answers at control\.sock"):
        ask(path, "status")


async def test_socket_of_a_running_daemon_is_kept(server: ControlServer, path: Path) -> None:
    """A second server does not start, and the first one still answers."""
    with pytest.raises(ControlError, match="a daemon runs here already"):
        await ControlServer(path, lambda _: {}).start()
    assert await asyncio.to_thread(ask, path, "status") == {"name": "drone0"}


async def test_file_in_place_of_the_socket_is_kept(path: Path) -> None:
    """The server does not delete it, does not start, and reports the path."""
    path.write_text("precious")
    with pytest.raises(ControlError, match=r"cannot listen on the control socket control\.sock"):
        await ControlServer(path, lambda _: {}).start()
    assert path.read_text() == "precious"


async def test_fault_in_the_daemon_is_logged_and_answered(path: Path) -> None:
    """The client learns that the daemon has the reason, also of an error of the system."""
    logged: list[object] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: logged.append(context["exception"]))

    async def answer(request: str) -> control.Answer:
        raise {"reload": KeyError("drone1"), "status": OSError(5, "Input/output error")}[request]

    server = ControlServer(path, answer)
    await server.start()
    for request, name in (("reload", "KeyError"), ("status", "OSError")):
        with pytest.raises(ControlError, match=rf"fault in the daemon \({name}\), which its log has"):
            await asyncio.to_thread(ask, path, request)
    assert [type(error) for error in logged] == [KeyError, OSError]
    await server.stop()
