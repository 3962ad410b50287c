"""Live reload between real daemons: what did not change goes on without losing a frame, what went is cut off."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from pathlib import Path
from time import monotonic

import pytest

from tests.processes.frames import frame, heartbeat
from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess
from tests.processes.toml import to_toml
from tests.processes.udp import Client, Sockaddr, assert_same
from tests.waiting import PATIENCE_S
from uavlinkd.ops.control import ask
from uavlinkd.protocol.constants import REKEY_AFTER_S

COUNT = 200
"""Frames in each direction between two reloads, and during each."""
IN_FLIGHT = 100
"""In each direction. Sockets have room for so many while a daemon waits for a processor."""


async def reload(daemon: DaemonProcess) -> list[str]:
    """Have it read what is in ``daemon.config`` now; the problems that it found."""
    daemon.write_config()
    answer = await asyncio.to_thread(ask, daemon.folder / "control.sock", "reload", PATIENCE_S)
    problems: list[str] = answer["problems"]
    return problems


async def client_at(stage: Stage, daemon: DaemonProcess, endpoint: str, into: Sockaddr) -> Client:
    """A client that the daemon knows at this endpoint."""
    client = await stage.client()
    client.send(heartbeat(), into)
    await daemon.until(lambda status: str(client) in status["endpoints"][endpoint]["clients"])
    return client


async def talk(a: Client, into_a: Sockaddr, b: Client, into_b: Sockaddr, stop: asyncio.Event) -> list[list[bytes]]:
    """Numbered frames in both directions in a steady rhythm, until cancelled; returns the sent frames."""
    said: list[list[bytes]] = [[], []]
    number = 0
    while not stop.is_set() or number < COUNT:
        for which, (client, into) in enumerate(((a, into_a), (b, into_b))):
            said[which].append(frame(number, which + 1))
            client.send(said[which][-1], into)
        number += 1
        await asyncio.sleep(0.001)
        if number > IN_FLIGHT:
            for frames, sink in zip(said, (b, a), strict=True):
                await sink.until_received(frames[-IN_FLIGHT])
    return said


async def test_untouched_peers_lose_no_frame(stage: Stage) -> None:
    """Peers come, change and go, a bad file is refused, while two others talk: all frames arrive once, in order."""
    a, b, c = (stage.daemon(f"drone{n}") for n in range(3))
    into_a, into_b = a.add_endpoint("one"), b.add_endpoint("one")
    stage.introduce(a, b)
    stage.introduce(a, c)
    with_c = list(a.config["peer"])
    a.config["peer"] = with_c[:1]
    await stage.start(a, b)
    await c.start()
    at_a, at_b = await client_at(stage, a, "one", into_a), await client_at(stage, b, "one", into_b)
    at_a.clear()
    at_b.clear()
    before, began = (await b.status())["peers"][a.name], monotonic()
    stop = asyncio.Event()
    talking = asyncio.create_task(talk(at_a, into_a, at_b, into_b, stop))

    a.config["peer"] = with_c
    assert await reload(a) == []
    await a.until_linked()
    with_c[1] |= {"role": "observer", "system_ids": [3]}
    assert await reload(a) == []
    a.config["peer"] = with_c[:1]
    assert await reload(a) == []
    a.config["colour"] = 1
    assert "colour: is not known here" in "\n".join(await reload(a))
    del a.config["colour"]
    for _ in range(3):
        a.write_config()
        await a.send_signal(signal.SIGHUP)
    a.config["peer"] = with_c
    assert await reload(a) == []
    await a.until_linked()

    stop.set()
    said_by_a, said_by_b = await talking
    assert len(said_by_a) >= COUNT
    await at_b.until_received(said_by_a[-1])
    await at_a.until_received(said_by_b[-1])
    assert_same(at_b.received, b"".join(said_by_a))
    received = bytes(at_a.received)
    assert_same(received, b"".join(said_by_b))
    after = (await b.status())["peers"][a.name]
    # On a slow machine the keys may be due for their regular change.
    assert after["handshakes"] - before["handshakes"] <= (monotonic() - began) / REKEY_AFTER_S
    print(f"{len(said_by_a)} frames each during {len(a.events('configuration_reloaded'))} reloads, none lost")


async def test_a_peer_that_is_taken_out_is_cut_off_at_once(stage: Stage) -> None:
    """From the answer to the reload on nothing of it is accepted, nothing goes to it; its calls are a stranger's."""
    a, b = stage.pair()
    into_a, into_b = a.add_endpoint("one"), b.add_endpoint("one")
    await stage.start(a, b)
    at_a, at_b = await client_at(stage, a, "one", into_a), await client_at(stage, b, "one", into_b)
    at_b.send(frame(1), into_b)
    await at_a.until_received(frame(1))
    peers, a.config["peer"] = a.config["peer"], []
    assert await reload(a) == []
    at_a.clear()
    at_b.clear()
    for number in range(2, 50):
        at_b.send(frame(number), into_b)
        at_a.send(frame(number, 2), into_a)
    await b.until(lambda status: status["peers"][a.name]["state"] != "up")
    await a.until(lambda status: status["drops"].get("unknown_peer", 0) > 0)
    assert not at_a.received
    assert not at_b.received
    assert (await a.status())["peers"] == {}
    a.config["peer"] = peers
    assert await reload(a) == []
    await a.until_linked()


async def test_a_change_of_an_endpoint_needs_a_restart(stage: Stage) -> None:
    """The message names the key and the remedy. The peers of the same file do not change either."""
    a, b = stage.pair()
    into_a = a.add_endpoint("one")
    await stage.start(a, b)
    a.add_endpoint("two")
    a.config["peer"] = []
    (problem,) = await reload(a)
    assert problem.startswith(f"{a.config_file}: endpoint: has changed")
    assert problem.endswith("restart the daemon")
    status = await a.status()
    assert set(status["endpoints"]) == {"one"}
    assert set(status["peers"]) == {b.name}
    a.config["endpoint"].pop()
    a.config["endpoint"][0]["rate_in"] = {"HEARTBEAT": 0}
    assert await reload(a) == []
    client = await stage.client()
    client.send(heartbeat(), into_a)
    await a.until(lambda status: status["endpoints"]["one"]["refused"] != {})


async def test_reloads_are_made_one_after_the_other(stage: Stage) -> None:
    """The second waits until the first has read its file, and what it reads stays. Each takes as long as it takes."""
    a, b = stage.pair()
    await stage.start(a, b)
    peers = a.config["peer"]
    a.config_file.unlink()
    os.mkfifo(a.config_file)
    socket = a.folder / "control.sock"
    first = asyncio.create_task(asyncio.to_thread(ask, socket, "reload", PATIENCE_S))
    await write_to(a.config_file, to_toml({**a.config, "peer": []}), before_the_end=a)
    second = asyncio.create_task(asyncio.to_thread(ask, socket, "reload", PATIENCE_S))
    assert await first == {"problems": [], "name": a.name}
    assert (await a.status())["peers"] == {}
    await write_to(a.config_file, to_toml({**a.config, "peer": peers}))
    assert await second == {"problems": [], "name": a.name}
    await a.until_linked()
    assert [event.get("peers_removed") for event in a.events("configuration_reloaded")] == [[b.name], None]
    a.config_file.unlink()


async def write_to(fifo: Path, text: str, before_the_end: DaemonProcess | None = None) -> None:
    """Give a file that is read: the daemon answers while it waits for it."""
    writer = await asyncio.to_thread(os.open, fifo, os.O_WRONLY)  # which waits for the reader
    if before_the_end is not None:
        assert (await before_the_end.status())["peers"]
    await asyncio.to_thread(os.write, writer, text.encode())
    os.close(writer)


STUCK = """
import os, socket, time
genuine = {each: getattr(module, each) for module, each in ((socket, "getaddrinfo"), (os, "open"))}
def hang(name, *arguments, **options):
    if str(name).endswith("far.test"):
        open(__file__ + ".asked", "w").close()
        time.sleep(600)
    return None
def getaddrinfo(host, *arguments, **options):
    return hang(os.fsdecode(host)) or genuine["getaddrinfo"](host, *arguments, **options)
def open_file(path, *arguments, **options):
    return hang(path) or genuine["open"](path, *arguments, **options)
socket.getaddrinfo, os.open = getaddrinfo, open_file
"""


@pytest.mark.parametrize("where", ["peer", "serial"])
async def test_the_end_does_not_wait_for_a_name_server_or_a_device(stage: Stage, where: str) -> None:
    """A name that does not resolve, or a device that does not open, holds up neither the other peer nor the end."""
    a, b = stage.pair()
    if where == "peer":
        a.config["peer"].append({**a.config["peer"][0], "name": "far", "addresses": ["far.test:5790"]})
        a.config["peer"][-1]["public_key"] = stage.daemon("far").public_key
    else:
        a.add_endpoint("far", "serial:/dev/far.test:57600")
        a.add_endpoint("tcp", "tcp:far.test:14550")
    hook = stage.folder / "hook" / "sitecustomize.py"
    hook.parent.mkdir()
    hook.write_text(STUCK)
    await a.start({"PYTHONPATH": os.pathsep.join([str(hook.parent), *sys.path])})
    await b.start()
    await a.until(lambda status: status["peers"][b.name]["state"] == "up" and Path(f"{hook}.asked").exists())
    assert await a.stop() == 0  # within the harness's patience: the name server and the device take ten minutes
