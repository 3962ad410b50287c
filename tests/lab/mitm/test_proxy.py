"""The man in the middle with real sockets: listeners, strangers, control socket."""

from __future__ import annotations

import asyncio
import signal
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.processes.udp import Client, open_client
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.mitm.attack import Direction
from uavlinkd.lab.mitm.attacks import ATTACKS, parse_attack
from uavlinkd.lab.mitm.cli import main
from uavlinkd.lab.mitm.proxy import Proxy
from uavlinkd.lab.mitm.proxy_settings import MitmLink, MitmPeer, ProxySettings
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.ops.control import ask
from uavlinkd.system.addresses import Address

pytestmark = pytest.mark.usefixtures("undone_settings")

ANY = Address("127.0.0.1", 0)
ENVELOPE = b"\x40\x00\x01\x00\x07" + bytes(40)


@asynccontextmanager
async def _between(*attacks: str, **more: Any) -> AsyncIterator[tuple[Client, Client, Proxy]]:
    """Two clients, and a proxy between them."""
    a, b = await open_client(), await open_client()
    settings = ProxySettings(
        peers=(MitmPeer("a", Address(*a.address)), MitmPeer("b", Address(*b.address))),
        links=(MitmLink(("a", "b"), (ANY, ANY)),),
        attacks=tuple(map(parse_attack, attacks)),
        **more,
    )
    proxy = Proxy(settings)
    await proxy.start()
    try:
        yield a, b, proxy
    finally:
        await proxy.stop()
        a.close()
        b.close()


async def _until(condition: Callable[[], bool]) -> None:
    """Run the event loop until a condition holds."""
    async with asyncio.timeout(240):
        while not condition():  # noqa: ASYNC110  what is waited for happens in a callback of the proxy
            await asyncio.sleep(0)


async def test_each_path_has_its_own_addresses() -> None:
    """What is sent to one listener of the second path comes from the other. An attack moves it to the first path."""
    a, b = await open_client(), await open_client()
    links = (MitmLink(("a", "b"), (ANY, ANY)), MitmLink(("a", "b"), (ANY, ANY)))
    proxy = Proxy(ProxySettings((MitmPeer("a"), MitmPeer("b", Address(*b.address))), links))
    there, second = Direction("a", "b"), Direction("a", "b", 2)
    await proxy.start()
    try:
        a.send(ENVELOPE, proxy.listeners[second])
        await b.until(lambda: len(b.datagrams) == 1)
        assert b.sources == [proxy.listeners[second.reverse]]
        b.send(b"back", proxy.listeners[second.reverse])
        await a.until(lambda: a.datagrams == [b"back"])
        assert a.sources == [proxy.listeners[second]]
        b.send(b"unknown", proxy.listeners[there.reverse])  # along this path, a has not sent yet
        await _until(lambda: proxy.errors["unknown receiver"] == 1)

        proxy.change_attacks([parse_attack("move,direction=a>b/2,onto=1").make(proxy.context)])
        a.send(ENVELOPE, proxy.listeners[second])
        await b.until(lambda: len(b.datagrams) == 2)
        assert b.sources[1] == proxy.listeners[there.reverse]
        assert proxy.statistics()["sent"] == {"a>b": 1, "a>b/2": 1, "b>a/2": 1}
    finally:
        await proxy.stop()
        a.close()
        b.close()


async def test_strangers_have_addresses_of_their_own_and_hear_answers() -> None:
    """A flood comes from many addresses of the loopback network, and answers to them are counted."""
    async with _between("flood-garbage,rate_per_s=2000,sources=40,limit=300,direction=a>b") as (_, b, proxy):
        await b.until(lambda: len(b.datagrams) >= 295)
        hosts = {host for host, _ in b.sources}
        if sys.platform == "linux":
            assert len(hosts) > 30
        assert len(set(b.sources)) > 30
        assert not {proxy.listeners[Direction("b", "a")]} & set(b.sources)
        b.send(b"who is there", b.sources[0])
        await _until(lambda: bool(proxy.amplification.bytes_back))
        assert proxy.amplification.bytes_back == len(b"who is there")
        await _until(lambda: proxy.interventions["flood-garbage", "injected"] == 300)


async def test_control_socket_changes_and_tells(tmp_path: Path) -> None:
    """The attacks can change at run time; a refused request changes nothing."""
    path = tmp_path / "control"

    async def tell(request: str) -> dict[str, Any]:
        return await asyncio.to_thread(ask, path, request)

    async with _between(control_socket=path) as (a, b, proxy):
        assert (await tell("attack drop,direction=a>b extend"))["attacks"] == ["drop", "extend"]
        a.send(b"lost", proxy.listeners[Direction("a", "b")])
        b.send(b"long", proxy.listeners[Direction("b", "a")])
        await a.until(lambda: len(a.datagrams) == 1)
        assert (await tell("attack drop,colour=red"))["refused"].startswith("drop: has no such parameter")
        assert "three peers" in (await tell("attack misroute"))["refused"]
        assert (await tell("statistics"))["attacks"] == ["drop", "extend"]
        assert (await tell("attack none"))["attacks"] == []
        a.send(b"passes too", proxy.listeners[Direction("a", "b")])
        await b.until(lambda: len(b.datagrams) == 1)
        for nonsense in ("nonsense", "", "attack", "stop now"):
            refused = (await tell(nonsense))["refused"]
            assert refused.startswith(f"there is no request {nonsense!r}: write")
            assert '"statistics", "stop"' in refused
        refused = (await tell("attack bogus"))["refused"]
        assert all(name in refused for name in ATTACKS), "the list"
        await tell("stop")
        assert proxy.stopping.is_set()
    assert not path.exists()


async def test_command_runs_until_a_stop_request(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As a process: it forwards, answers on its control socket, and ends on SIGTERM with status 0."""
    a, b = await open_client(), await open_client()
    ports = free_port(), free_port()
    config = tmp_path / "mitm.toml"
    config.write_text(pair_between(a.address[1], b.address[1], *ports))
    arguments = [
        *(f"--config={config}", f"--control-socket={tmp_path / 'control'}"),
        *("--attack=extend,kinds=any,direction=a>b", "--seed=3"),
    ]
    process = await asyncio.create_subprocess_exec(
        *end_with_parent(sys.executable, "-m", "uavlinkd.lab.mitm", *arguments), stderr=asyncio.subprocess.PIPE
    )
    try:
        async with asyncio.timeout(240):
            while not b.datagrams:  # until the process listens
                a.send(b"hello", ("127.0.0.1", ports[0]))
                await asyncio.sleep(0.05)
        assert b.datagrams[0].startswith(b"hello")
        assert len(b.datagrams[0]) == 6
        status = await asyncio.to_thread(main, [f"--control-socket={tmp_path / 'control'}", "--ask=statistics"])
        assert status == 0
        status = await asyncio.to_thread(main, [f"--control-socket={tmp_path / 'control'}", "--ask=bogus"])
        assert status == 1
        assert "there is no request 'bogus': write \"statistics\"" in capsys.readouterr().err
    finally:
        process.send_signal(signal.SIGTERM)
        _, errors = await process.communicate()
    assert process.returncode == 0
    assert b"Traceback" not in errors
    assert b"mitm_stopped" in errors
    a.close()
    b.close()


def pair_between(a: int, b: int, for_a: int, for_b: int) -> str:
    """A file with two peers at these ports, and the ports for each of them."""
    ends = (("a", a), ("b", b))
    peers = "".join(f'[[peer]]\nname = "{name}"\naddress = "127.0.0.1:{port}"\n' for name, port in ends)
    return f'{peers}[[link]]\nbetween = ["a", "b"]\nlisten = ["127.0.0.1:{for_a}", "127.0.0.1:{for_b}"]\n'
