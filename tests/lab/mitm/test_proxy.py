"""The man in the middle with real sockets: faces, strangers, the control socket, the log."""

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

from tests.daemon.harness import Program, free_port, open_program
from uavlinkd.system.addresses import Address
from uavlinkd.ops.control import ControlError, ask
from uavlinkd.endpoints.sockets import BindError
from uavlinkd.lab.mitm.attack import Way
from uavlinkd.lab.mitm.attacks import parse_attack
from uavlinkd.lab.mitm.cli import main
from uavlinkd.lab.mitm.proxy import Proxy
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.lab.mitm.proxy_settings import MitmLink, MitmPeer, ProxySettings

ANY = Address("127.0.0.1", 0)


@asynccontextmanager
async def _between(*attacks: str, **more: Any) -> AsyncIterator[tuple[Program, Program, Proxy]]:
    """Two programs, and a proxy between them."""
    a, b = await open_program(), await open_program()
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
    """Let the loop turn until a condition holds."""
    async with asyncio.timeout(5):
        while not condition():  # noqa: ASYNC110  what is waited for happens in a callback of the proxy
            await asyncio.sleep(0)


async def test_each_peer_hears_the_other_from_the_face_it_knows() -> None:
    """Both ways, byte for byte, empty datagrams too, many in one wake-up."""
    async with _between() as (a, b, proxy):
        said = [b"", b"one", bytes(1400), *(bytes([n]) * 10 for n in range(200))]
        for datagram in said:
            a.send(datagram, proxy.faces["a", "b"])
        await b.until(lambda: len(b.datagrams) == len(said))
        assert b.datagrams == said
        assert set(b.sources) == {proxy.faces["b", "a"]}
        b.send(b"back", proxy.faces["b", "a"])
        await a.until(lambda: a.datagrams == [b"back"])
        assert a.sources == [proxy.faces["a", "b"]]
        assert proxy.statistics()["sent"] == {"a>b": len(said), "b>a": 1}


async def test_others_who_speak_to_a_face_are_not_heard() -> None:
    """Only the peer itself is attacked; the others are counted."""
    async with _between() as (a, b, proxy):
        stranger = await open_program()
        stranger.send(b"hello", proxy.faces["a", "b"])
        a.send(b"genuine", proxy.faces["a", "b"])
        await b.until(lambda: b.datagrams == [b"genuine"])
        assert proxy.troubles["from nobody we know"] == 1
        stranger.close()


async def test_peer_without_an_address_is_where_it_was_heard_last() -> None:
    """A daemon that only calls, from any port."""
    async with _between() as (a, b, known):
        settings = replace(known.settings, peers=(MitmPeer("a"), known.settings.peers[1]))
        proxy = Proxy(settings)
        await proxy.start()
        b.send(b"too early", proxy.faces["b", "a"])
        a.send(b"here", proxy.faces["a", "b"])
        await b.until(lambda: b.datagrams == [b"here"])
        b.send(b"found", proxy.faces["b", "a"])
        await a.until(lambda: a.datagrams == [b"found"])
        assert proxy.troubles["to nobody we know"] == 1
        await proxy.stop()


async def test_strangers_have_addresses_of_their_own_and_hear_answers() -> None:
    """A flood comes from many hosts of the loopback network; what is sent back there is counted."""
    async with _between("flood-garbage,rate_per_s=2000,sources=40,limit=300,way=a>b") as (_, b, proxy):
        await b.until(lambda: len(b.datagrams) >= 295)
        hosts = {host for host, _ in b.sources}
        if sys.platform == "linux":
            assert len(hosts) > 30
        assert len(set(b.sources)) > 30
        assert not {proxy.faces["b", "a"]} & set(b.sources)
        b.send(b"who is there", b.sources[0])
        await _until(lambda: bool(proxy.stranger_bytes_back))
        assert proxy.stranger_bytes_back.total() == len(b"who is there")
        await _until(lambda: proxy.journal.counts["flood-garbage", "injected"] == 300)


async def test_held_datagrams_are_released_by_the_timer() -> None:
    """Nothing else has to happen for it."""
    async with _between("hold,kinds=any,hold_s=0.2") as (a, b, proxy):
        loop = asyncio.get_running_loop()
        begin = loop.time()
        a.send(b"later", proxy.faces["a", "b"])
        await b.until(lambda: b.datagrams == [b"later"])
        assert loop.time() - begin >= 0.2


async def test_radio_delays_real_datagrams() -> None:
    """The emulator, with one direction's settings."""
    async with _between(radios=(("a>b", RadioSettings(delay_s=0.15)),)) as (a, b, proxy):
        loop = asyncio.get_running_loop()
        begin = loop.time()
        a.send(b"slow", proxy.faces["a", "b"])
        b.send(b"fast", proxy.faces["b", "a"])
        await a.until(lambda: a.datagrams == [b"fast"])
        assert b.datagrams == []
        await b.until(lambda: b.datagrams == [b"slow"])
        assert loop.time() - begin >= 0.15


async def test_control_socket_changes_pauses_and_tells(tmp_path: Path) -> None:
    """Another attack while it runs; a bad one is refused and changes nothing."""
    path = tmp_path / "control"

    async def tell(request: str) -> dict[str, Any]:
        return await asyncio.to_thread(ask, path, request)

    async with _between(control_socket=path) as (a, b, proxy):
        assert (await tell("attack drop,way=a>b extend"))["attacks"] == ["drop", "extend"]
        a.send(b"lost", proxy.faces["a", "b"])
        b.send(b"long", proxy.faces["b", "a"])
        await a.until(lambda: len(a.datagrams) == 1)
        assert (await tell("attack drop,colour=red"))["refused"].startswith("drop: has no such parameter")
        assert "three peers" in (await tell("attack misroute"))["refused"]
        assert (await tell("statistics"))["attacks"] == ["drop", "extend"]
        await tell("pause")
        a.send(b"passes", proxy.faces["a", "b"])
        await b.until(lambda: b.datagrams == [b"passes"])
        await tell("resume")
        assert (await tell("attack none"))["attacks"] == []
        a.send(b"passes too", proxy.faces["a", "b"])
        await b.until(lambda: len(b.datagrams) == 2)
        with pytest.raises(ControlError):
            await tell("nonsense")
        with pytest.raises(ControlError):
            await tell("")
        await tell("stop")
        assert proxy.stopping.is_set()
    assert not path.exists()


async def test_log_of_a_run_begins_and_ends(tmp_path: Path) -> None:
    """Seed and attacks first, every intervention, the statistics last."""
    path = tmp_path / "run.jsonl"
    async with _between("bit-flip,kinds=any,way=a>b", log=path, seed=5) as (a, b, proxy):
        a.send(b"\x40 something", proxy.faces["a", "b"])
        await b.until(lambda: len(b.datagrams) == 1)
        assert b.datagrams != [b"\x40 something"]
    first, middle, last = map(json.loads, path.read_text().splitlines())
    assert (first["event"], first["seed"], first["attacks"]) == ("mitm_started", 5, ["bit-flip"])
    assert (middle["what"], middle["way"], middle["number"]) == ("altered", "a>b", 1)
    assert (last["event"], last["interventions"]) == ("mitm_stopped", {"bit-flip: altered": 1})


async def test_address_in_use_is_told_and_nothing_stays_open() -> None:
    """And the first face can be bound again."""
    taken = await open_program()
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


async def test_attacks_given_as_objects_stand_in_the_way() -> None:
    """Those of the settings do not, then."""
    async with _between() as (a, b, known):
        attack = parse_attack("drop").make(known.surroundings)
        proxy = Proxy(known.settings, [attack])
        await proxy.start()
        a.send(b"x", proxy.faces["a", "b"])
        await _until(lambda: attack.strikes > 0)
        assert proxy.journal.counts["drop", "dropped"] == 1
        proxy.change_attacks([])
        a.send(b"y", proxy.faces["a", "b"])
        await b.until(lambda: b.datagrams == [b"y"])
        assert proxy.received[Way("a", "b")] == 2
        await proxy.stop()


async def test_command_runs_until_it_is_told_to_stop(tmp_path: Path) -> None:
    """As a process: it forwards, answers on its control socket, and ends on SIGTERM with status 0 and a whole log."""
    a, b = await open_program(), await open_program()
    ports = free_port(), free_port()
    arguments = [
        f"--peer=a=127.0.0.1:{a.address[1]}",
        f"--peer=b=127.0.0.1:{b.address[1]}",
        f"--link=a@127.0.0.1:{ports[0]},b@127.0.0.1:{ports[1]}",
        f"--log={tmp_path / 'log'}",
        f"--control-socket={tmp_path / 'control'}",
        "--attack=extend,kinds=any,way=a>b",
        "--seed=3",
    ]
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "uavlinkd.lab.mitm", *arguments, stderr=asyncio.subprocess.PIPE
    )
    try:
        async with asyncio.timeout(20):
            while not b.datagrams:  # until the process listens
                a.send(b"hello", ("127.0.0.1", ports[0]))
                await asyncio.sleep(0.05)
        assert b.datagrams[0].startswith(b"hello")
        assert len(b.datagrams[0]) == 6
        status = await asyncio.to_thread(main, [f"--control-socket={tmp_path / 'control'}", "--ask=statistics"])
        assert status == 0
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
