"""The man in the middle with real sockets: listeners, strangers, control socket, log."""

from __future__ import annotations

import asyncio
import json
import signal
import socket
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.daemon.udp import Client, open_client
from uavlinkd.endpoints.sockets import BindError
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.mitm.attack import Direction
from uavlinkd.lab.mitm.attacks import ATTACKS, parse_attack
from uavlinkd.lab.mitm.cli import main
from uavlinkd.lab.mitm.proxy import Proxy
from uavlinkd.lab.mitm.proxy_settings import MitmLink, MitmPeer, ProxySettings
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.ops.control import ask
from uavlinkd.system.addresses import Address

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


async def test_each_peer_hears_the_other_from_the_face_it_knows() -> None:
    """In both directions, byte for byte, empty datagrams too, many in one wake-up."""
    async with _between() as (a, b, proxy):
        said = [b"", b"one", bytes(1400), *(bytes([n]) * 10 for n in range(200))]
        for datagram in said:
            a.send(datagram, proxy.listeners[Direction("a", "b")])
        await b.until(lambda: len(b.datagrams) == len(said))
        assert b.datagrams == said
        assert set(b.sources) == {proxy.listeners[Direction("b", "a")]}
        b.send(b"back", proxy.listeners[Direction("b", "a")])
        await a.until(lambda: a.datagrams == [b"back"])
        assert a.sources == [proxy.listeners[Direction("a", "b")]]
        assert proxy.statistics()["sent"] == {"a>b": len(said), "b>a": 1}


async def test_other_senders_at_a_listener_are_ignored() -> None:
    """Only the peer itself is attacked; the others are counted."""
    async with _between() as (a, b, proxy):
        stranger = await open_client()
        stranger.send(b"hello", proxy.listeners[Direction("a", "b")])
        a.send(b"genuine", proxy.listeners[Direction("a", "b")])
        await b.until(lambda: b.datagrams == [b"genuine"])
        assert proxy.errors["unknown sender"] == 1
        stranger.close()


async def test_peer_without_an_address_is_learned_from_its_datagrams() -> None:
    """A daemon with an unknown address initiates from any port."""
    async with _between() as (a, b, known):
        settings = replace(known.settings, peers=(MitmPeer("a"), known.settings.peers[1]))
        proxy = Proxy(settings)
        await proxy.start()
        b.send(b"too early", proxy.listeners[Direction("b", "a")])
        a.send(b"here", proxy.listeners[Direction("a", "b")])
        await b.until(lambda: b.datagrams == [b"here"])
        b.send(b"found", proxy.listeners[Direction("b", "a")])
        await a.until(lambda: a.datagrams == [b"found"])
        assert proxy.errors["unknown receiver"] == 1
        await proxy.stop()


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
        await _until(lambda: bool(proxy.stranger_bytes_back))
        assert proxy.stranger_bytes_back.total() == len(b"who is there")
        await _until(lambda: proxy.journal.counts["flood-garbage", "injected"] == 300)


async def test_held_datagrams_are_released_by_the_timer() -> None:
    """The timer needs no other event."""
    async with _between("hold,kinds=any,hold_s=0.2") as (a, b, proxy):
        loop = asyncio.get_running_loop()
        begin = loop.time()
        a.send(b"later", proxy.listeners[Direction("a", "b")])
        await b.until(lambda: b.datagrams == [b"later"])
        assert loop.time() - begin >= 0.2


async def test_radio_changes_while_it_carries_datagrams() -> None:
    """A stall ends when other settings replace it: what it held arrives at once, in order."""
    async with _between(radios=(("a>b", RadioSettings(is_stalled=True)),)) as (a, b, proxy):
        said = [b"one", b"two"]
        for datagram in said:
            a.send(datagram, proxy.listeners[Direction("a", "b")])
        await _until(lambda: proxy.received[Direction("a", "b")] == 2)
        assert b.datagrams == []
        proxy.change_radio("a>b", RadioSettings())
        await b.until(lambda: b.datagrams == said)


async def test_radio_delays_real_datagrams() -> None:
    """The emulator, with one direction's settings."""
    async with _between(radios=(("a>b", RadioSettings(delay_s=0.15)),)) as (a, b, proxy):
        loop = asyncio.get_running_loop()
        begin = loop.time()
        a.send(b"slow", proxy.listeners[Direction("a", "b")])
        b.send(b"fast", proxy.listeners[Direction("b", "a")])
        await a.until(lambda: a.datagrams == [b"fast"])
        assert b.datagrams == []
        await b.until(lambda: b.datagrams == [b"slow"])
        assert loop.time() - begin >= 0.15


async def test_control_socket_changes_pauses_and_tells(tmp_path: Path) -> None:
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
        await tell("pause")
        a.send(b"passes", proxy.listeners[Direction("a", "b")])
        await b.until(lambda: b.datagrams == [b"passes"])
        await tell("resume")
        assert (await tell("attack none"))["attacks"] == []
        a.send(b"passes too", proxy.listeners[Direction("a", "b")])
        await b.until(lambda: len(b.datagrams) == 2)
        for nonsense in ("nonsense", "", "attack", "pause now"):
            refused = (await tell(nonsense))["refused"]
            assert refused.startswith(f"there is no request {nonsense!r}: write")
            assert '"statistics", "pause"' in refused
        refused = (await tell("attack bogus"))["refused"]
        assert all(name in refused for name in ATTACKS), "the list"
        await tell("stop")
        assert proxy.stopping.is_set()
    assert not path.exists()


async def test_log_of_a_run_begins_and_ends(tmp_path: Path) -> None:
    """Seed and attacks first, every intervention, the statistics last."""
    path = tmp_path / "run.jsonl"
    async with _between("bit-flip,kinds=any,direction=a>b", log=path, seed=5) as (a, b, proxy):
        a.send(b"\x40 something", proxy.listeners[Direction("a", "b")])
        await b.until(lambda: len(b.datagrams) == 1)
        assert b.datagrams != [b"\x40 something"]
    first, middle, last = map(json.loads, path.read_text().splitlines())
    assert (first["event"], first["seed"], first["attacks"]) == ("mitm_started", 5, ["bit-flip"])
    assert (middle["operation"], middle["direction"], middle["number"]) == ("altered", "a>b", 1)
    assert (last["event"], last["interventions"]) == ("mitm_stopped", {"bit-flip: altered": 1})


async def test_address_in_use_is_reported_and_no_socket_stays_open() -> None:
    """The first listener can be bound again."""
    taken = await open_client()
    port = free_port()
    settings = ProxySettings(
        peers=(MitmPeer("a", ANY), MitmPeer("b", ANY)),
        links=(MitmLink(("a", "b"), (Address("127.0.0.1", port), Address(*taken.address))),),
    )
    with pytest.raises(BindError, match="cannot listen"):
        await Proxy(settings).start()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", port))
    taken.close()


async def test_attacks_can_be_objects() -> None:
    """They replace the attacks of the settings."""
    async with _between() as (a, b, known):
        attack = parse_attack("drop").make(known.context)
        proxy = Proxy(known.settings, [attack])
        await proxy.start()
        a.send(b"x", proxy.listeners[Direction("a", "b")])
        await _until(lambda: attack.attempts > 0)
        assert proxy.journal.counts["drop", "dropped"] == 1
        proxy.change_attacks([])
        a.send(b"y", proxy.listeners[Direction("a", "b")])
        await b.until(lambda: b.datagrams == [b"y"])
        assert proxy.received[Direction("a", "b")] == 2
        await proxy.stop()


async def test_command_runs_until_a_stop_request(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As a process: it forwards, answers on its control socket, and ends on SIGTERM with status 0 and a whole log."""
    a, b = await open_client(), await open_client()
    ports = free_port(), free_port()
    arguments = [
        *(f"--peer=a=127.0.0.1:{a.address[1]}", f"--peer=b=127.0.0.1:{b.address[1]}"),
        *(f"--link=a@127.0.0.1:{ports[0]},b@127.0.0.1:{ports[1]}", f"--log={tmp_path / 'log'}"),
        *(f"--control-socket={tmp_path / 'control'}", "--attack=extend,kinds=any,direction=a>b", "--seed=3"),
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
    lines = [json.loads(line) for line in (tmp_path / "log").read_text().splitlines()]
    assert lines[0]["seed"] == 3
    assert lines[-1]["event"] == "mitm_stopped"
    a.close()
    b.close()
