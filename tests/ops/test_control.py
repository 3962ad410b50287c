"""The control socket: one line asks, one line of JSON answers, and nobody but the owner may."""
# ruff: noqa: ASYNC240  (small local files; nothing else waits in this loop)

from __future__ import annotations

import asyncio
import json
import os
import socket
from collections.abc import AsyncIterator
from contextlib import suppress
from pathlib import Path

import pytest

from uavlinkd.ops import control
from uavlinkd.ops.control import MAX_CONNECTIONS, MAX_REQUEST_BYTES, ControlError, ControlServer, ask


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A path short enough for a socket, however deep the temporary folder is."""
    monkeypatch.chdir(tmp_path)
    return Path("control.sock")


@pytest.fixture
async def server(path: Path) -> AsyncIterator[ControlServer]:
    """Knows the request ``status``."""
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
    """What comes until the other side closes; a reset, where it closed with bytes of ours unread, is an end too."""
    try:
        return await asyncio.wait_for(reader.read(), 5)
    except ConnectionResetError:
        return b""


async def close(writer: asyncio.StreamWriter) -> None:
    """Close a connection, whatever the other side did to it."""
    writer.close()
    with suppress(OSError):
        await writer.wait_closed()


async def test_it_answers_what_it_knows(server: ControlServer, path: Path) -> None:
    """The client gives what the server's function returned."""
    assert await asyncio.to_thread(ask, path, "status") == {"name": "drone0"}


async def test_an_unknown_request_is_an_error(server: ControlServer, path: Path) -> None:
    """It is answered as such, and the client raises."""
    with pytest.raises(ControlError, match="does not know the request 'dance'"):
        await asyncio.to_thread(ask, path, "dance")


@pytest.mark.parametrize("data", [b"\n", b"\xff\xfe\x00\n", b"status extra\n", b'{"status": 1}\n'])
async def test_hostile_requests_get_an_error_and_nothing_more(server: ControlServer, path: Path, data: bytes) -> None:
    """Bytes that are no request are answered as unknown, and the next client is served."""
    assert json.loads(await request(path, data)) == {"error": "unknown request"}
    assert await asyncio.to_thread(ask, path, "status") == {"name": "drone0"}


async def test_a_request_without_end_is_cut_off(server: ControlServer, path: Path) -> None:
    """More bytes than a request has close the connection with an error."""
    reader, writer = await asyncio.open_unix_connection(path)
    writer.write(b"x" * (4 * MAX_REQUEST_BYTES))
    answer = await asyncio.wait_for(reader.readline(), 5)
    assert json.loads(answer) == {"error": f"the request is longer than {MAX_REQUEST_BYTES} bytes"}
    assert await read_to_end(reader) == b""
    await close(writer)
    assert await asyncio.to_thread(ask, path, "status") == {"name": "drone0"}


async def test_how_long_a_request_may_be_is_the_servers_to_say(path: Path) -> None:
    """To the byte; of a longer one the client says why it was refused, and does not repeat it."""
    server = ControlServer(path, lambda request: {"length": len(request)}, max_request_bytes=4096)
    await server.start()
    assert await asyncio.to_thread(ask, path, "x" * 4096) == {"length": 4096}
    with pytest.raises(ControlError, match="refuses the request: the request is longer than 4096 bytes"):
        await asyncio.to_thread(ask, path, "x" * 4097)
    await server.stop()


async def test_mute_clients_do_not_keep_others_out_for_ever(
    server: ControlServer, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All places taken by clients that say nothing: others are turned away, until the mute ones have timed out."""
    monkeypatch.setattr(control, "REQUEST_TIMEOUT_S", 0.2)
    mute = [await asyncio.open_unix_connection(path) for _ in range(MAX_CONNECTIONS)]
    assert await request(path, b"status\n") == b""
    for reader, writer in mute:
        assert await read_to_end(reader) == b""
        await close(writer)
    assert json.loads(await request(path, b"status\n")) == {"name": "drone0"}


async def test_only_the_owner_may_connect(server: ControlServer, path: Path) -> None:
    """The socket's mode is 0600, and the process's umask is as before."""
    assert path.stat().st_mode & 0o777 == 0o600
    mask = os.umask(0o022)
    os.umask(mask)
    assert mask != 0o177


async def test_it_is_gone_afterwards(path: Path) -> None:
    """A server that stopped leaves no socket, and a client says that nobody answers."""
    server = ControlServer(path, lambda _: {})
    await server.start()
    await server.stop()
    assert not path.exists()
    with pytest.raises(ControlError, match=r"no daemon answers at control\.sock"):
        ask(path, "status")


async def test_the_socket_of_a_dead_daemon_is_replaced(path: Path) -> None:
    """A socket in which nobody listens any more is in nobody's way."""
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    server = ControlServer(path, lambda _: {"name": "new"})
    await server.start()
    assert await asyncio.to_thread(ask, path, "status") == {"name": "new"}
    await server.stop()


async def test_the_socket_of_a_living_daemon_is_left_alone(server: ControlServer, path: Path) -> None:
    """Where one answers, a second server does not start, and the first goes on."""
    with pytest.raises(ControlError, match="another daemon answers there"):
        await ControlServer(path, lambda _: {}).start()
    assert await asyncio.to_thread(ask, path, "status") == {"name": "drone0"}


async def test_a_file_in_its_place_is_left_alone(path: Path) -> None:
    """What is no socket is not deleted: the server does not start, and says where it could not."""
    path.write_text("precious")
    with pytest.raises(ControlError, match=r"cannot listen on the control socket control\.sock"):
        await ControlServer(path, lambda _: {}).start()
    assert path.read_text() == "precious"


@pytest.mark.parametrize("where", [Path("no-such-folder/control.sock"), Path("x" * 200)])
async def test_a_place_that_cannot_be_is_told(path: Path, where: Path) -> None:
    """A folder that is absent, a name too long for a socket: one line that names the path."""
    with pytest.raises(ControlError, match="cannot listen on the control socket"):
        await ControlServer(where, lambda _: {}).start()


@pytest.mark.parametrize("answer", [b"", b"nonsense\n", b"[1]\n", b'{"error": "no"}\n'])
async def test_the_client_believes_no_nonsense(path: Path, answer: bytes) -> None:
    """Whatever answers that is no daemon gives an error of one line."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readline()
        writer.write(answer)
        await close(writer)

    other = await asyncio.start_unix_server(serve, path)
    async with other:
        with pytest.raises(ControlError, match=r"control\.sock"):
            await asyncio.to_thread(ask, path, "status")


async def test_the_client_does_not_wait_for_ever(path: Path) -> None:
    """A daemon that hangs is told as one that does not answer."""
    with socket.socket(socket.AF_UNIX) as mute:
        mute.bind(str(path))
        mute.listen()
        with pytest.raises(ControlError, match="no daemon answers"):
            await asyncio.to_thread(ask, path, "status", 0.05)


async def test_an_answer_takes_as_long_as_it_takes(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither side gives up where the client waits on; it is told each time that it has waited."""
    monkeypatch.setattr(control, "REQUEST_TIMEOUT_S", 0.05)
    waited = 0
    release = asyncio.Event()
    loop = asyncio.get_running_loop()

    async def answer(_: str) -> control.Answer:
        await release.wait()
        return {"problems": []}

    def on_waiting() -> None:
        nonlocal waited
        waited += 1
        if waited == 5:
            loop.call_soon_threadsafe(release.set)

    server = ControlServer(path, answer)
    await server.start()
    assert await asyncio.to_thread(ask, path, "reload", 0.05, on_waiting) == {"problems": []}
    assert waited >= 5
    await server.stop()


async def test_an_answer_may_be_long(path: Path) -> None:
    """Longer than a read, or a buffer of the kernel."""
    long = {"problems": ["x" * 1000] * 1000}
    server = ControlServer(path, lambda _: long)  # type: ignore[arg-type,return-value]
    await server.start()
    assert await asyncio.to_thread(ask, path, "reload") == long
    await server.stop()
