"""Connections to relays by TLS that a hostile proxy or relay ends, or keeps open for nothing."""

from __future__ import annotations

import asyncio
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.daemon.socket_states import SocketStateLog
from tests.observe.test_drop_log import Recorder
from tests.waiting import until
from uavlinkd.config.model import PeerAddress
from uavlinkd.protocol.path import Path
from uavlinkd.system.addresses import Address
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import StallWatch
from uavlinkd.tls import connect as web_connect
from uavlinkd.tls import relays as module
from uavlinkd.tls.relays import WebRelay

NUMBER = 3
PEER = cast(Any, SimpleNamespace(is_up=False, paths=SimpleNamespace(states=[])))
"""A relay that answers along no path."""


class Stream:
    """A connection that opens at once. ``ends``: and is lost at once."""

    made: list[Stream]
    ends = ""

    def __init__(self, *_: object) -> None:
        self.lost = ""
        self.dropped = 0
        self.handler: Any = None
        self.opened = asyncio.get_running_loop().create_future()
        self.made.append(self)

    def start(self, _: float) -> None:
        self.opened.set_result("")
        if self.ends:
            self.lose(self.ends)

    def finish(self) -> None:
        self.lose("closed")

    def lose(self, reason: str) -> None:
        if not self.lost:
            self.lost = reason
            if self.handler is not None:
                self.handler.on_lost(reason)


@pytest.fixture
def streams(monkeypatch: pytest.MonkeyPatch) -> list[Stream]:
    """All that are made, in place of real ones."""

    async def opened(*_: object) -> None:
        await asyncio.sleep(0)

    monkeypatch.setattr(Stream, "made", [], raising=False)
    monkeypatch.setattr(web_connect.Connector, "open", opened)
    monkeypatch.setattr(web_connect, "WebStream", Stream)
    return Stream.made


def relay(port: int = 443) -> tuple[WebRelay, Recorder]:
    log = Recorder()
    written = PeerAddress(Address("127.0.0.1", port, "/uavlink"))
    stall = StallWatch(monotonic(), lambda seconds: None)
    return WebRelay(written, lambda *_: NUMBER, SocketStateLog(), stall, cast(Any, log)), log


async def test_connection_that_carries_nothing_is_replaced(
    streams: list[Stream], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A proxy keeps it open, and drops all. It stays until there is another one."""
    monkeypatch.setattr(module, "ANSWER_S", 0.05)
    monkeypatch.setattr(module, "RETRY_S", 0.01)
    web, _ = relay()
    web.start(PEER, lambda *_: None, lambda: None)
    await until(lambda: len(streams) > 3)
    web.stop()
    assert [stream.lost for stream in streams[:2]] == ["silent", "silent"]


async def test_connection_that_works_stays(streams: list[Stream], monkeypatch: pytest.MonkeyPatch) -> None:
    """For as long as the relay answers along it. A relay that is lost is not asked along any path."""
    monkeypatch.setattr(module, "ANSWER_S", 0.05)
    monkeypatch.setattr(module, "LOOK_S", 0.01)
    monkeypatch.setattr(module, "RETRY_S", 0.1)
    web, _ = relay()
    state = SimpleNamespace(works=True, path=web.path)
    peer = SimpleNamespace(is_up=False, paths=SimpleNamespace(states=[state]))
    web.start(cast(Any, peer), lambda *_: None, lambda: None)
    await until(lambda: len(streams) == 1)
    peer.is_up = True
    await asyncio.sleep(0.2)
    assert [stream.lost for stream in streams] == [""]
    peer.is_up = False
    await until(lambda: streams[0].lost == "silent")
    web.stop()


async def attempts_in(seconds: float, web: WebRelay, monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """When the attempts of one relay's member begin, in virtual time."""
    clock = [monotonic()]
    began, beginnings = clock[0], list[float]()
    connect = web_connect.Connector.open

    async def pause(_: WebRelay, seconds: float) -> None:
        clock[0] += seconds
        await asyncio.sleep(0)

    async def counted(connector: web_connect.Connector) -> Any:
        beginnings.append(clock[0] - began)
        return await connect(connector)

    monkeypatch.setattr(module, "monotonic", lambda: clock[0])
    monkeypatch.setattr(WebRelay, "_pause", pause)
    monkeypatch.setattr(web_connect.Connector, "open", counted)
    web.start(PEER, lambda *_: None, lambda: None)
    await until(lambda: clock[0] >= began + seconds)
    web.stop()
    return beginnings


async def test_attempts_while_nothing_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    """At most 0.5 s apart, each time a little less, and after a minute 4 s."""

    async def refused(*_: object) -> None:
        raise ConnectionRefusedError(111, "refused")

    monkeypatch.setattr(web_connect.Connector, "open", refused)
    began = await attempts_in(module.AWAY_S + 100, relay()[0], monkeypatch)
    soon, late = (
        [after - at for at, after in pairwise(began) if is_late == (at > module.AWAY_S)] for is_late in (False, True)
    )
    assert 0.4 <= min(soon) < max(soon) <= 0.5 + 1e-6
    assert 3.2 <= min(late) < max(late) <= 4.0 + 1e-6


def udp(*, works: bool = True, is_silent: bool = False) -> Any:
    """A relay with one path by UDP."""
    state = SimpleNamespace(works=works, is_silent=is_silent, path=Path(0, ("192.0.2.1", 5790)))
    return cast(Any, SimpleNamespace(is_up=True, paths=SimpleNamespace(states=[state])))


async def test_connects_soon_after_udp_became_silent(streams: list[Stream], monkeypatch: pytest.MonkeyPatch) -> None:
    """Not only when the path is down: critical frames are sent again for 2 s."""
    monkeypatch.setattr(module, "LOOK_S", 0.01)
    monkeypatch.setattr(module, "UDP_SILENT_S", 0.1)
    monkeypatch.setattr(module, "UDP_FIRST_S", 0.1)
    web, _ = relay()
    peer = udp()
    web.start(peer, lambda *_: None, lambda: None, has_udp=True)
    await asyncio.sleep(0.3)
    assert streams == []
    peer.paths.states[0].is_silent = True
    await until(lambda: bool(streams))
    web.stop()


async def test_connection_only_receives_before_it_ends(
    streams: list[Stream], monkeypatch: pytest.MonkeyPatch
) -> None:
    """UDP works again. Peers notice that nothing comes along it, and no datagram to this member is lost."""
    monkeypatch.setattr(module, "LOOK_S", 0.01)
    monkeypatch.setattr(module, "UDP_BACK_S", 0.05)
    monkeypatch.setattr(module, "LEAVE_S", 0.2)
    web, _ = relay()
    peer, sent = udp(works=False), list[bytes]()
    monkeypatch.setattr(module, "UDP_FIRST_S", 0.0)
    monkeypatch.setattr(Stream, "send", lambda _, datagram: sent.append(datagram), raising=False)
    states = cast(Any, web)._node.states
    web.start(peer, lambda *_: None, lambda: None)
    await until(lambda: states[-1:] == [(NUMBER, True)])
    web.send(b"1", web.path.address)
    peer.paths.states[0].works = True
    await until(lambda: states[-1:] == [(NUMBER, False)])
    web.send(b"2", web.path.address)
    assert (sent, streams[0].lost) == ([b"1"], "")
    await until(lambda: streams[0].lost == module.UDP_WORKS)
    web.stop()


async def test_stop_ends_a_connection_that_is_not_open_yet() -> None:
    """Otherwise the other end could open it later."""
    ended: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
    begun = asyncio.Event()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read(1)
        begun.set()
        while await reader.read(4096):
            pass
        ended.set_result(b"")
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    web, log = relay(server.sockets[0].getsockname()[1])
    web.start(PEER, lambda *_: None, lambda: None)
    await begun.wait()
    web.stop()
    async with asyncio.timeout(10):
        await ended
    server.close()
    assert log.lines == []
