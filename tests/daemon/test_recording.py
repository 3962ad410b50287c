"""Recordings and metrics of real daemons: what crossed the link, and what is told of it."""

from __future__ import annotations

import asyncio
import os
import socket
import urllib.request
from pathlib import Path

from pymavlink import mavutil

from tests.daemon.harness import DaemonProcess, Stage, frame, free_port
from tests.ops.test_metrics import samples
from tests.waiting import until
from uavlinkd.lab.sim.tlog import read_tlog

FROM_PEER, TO_PEER = 0, 1


def record(daemon: DaemonProcess) -> None:
    """Have it record, on whatever disk there is."""
    daemon.config["recording"] = {"folder": "flights", "min_free_bytes": 100_000}


def recorded(daemon: DaemonProcess) -> list[tuple[int, bytes]]:
    """Which way, and what, of its only file."""
    (path,) = (daemon.folder / "flights").iterdir()
    return [(each.time_us & 3, each.frame) for each in read_tlog(path).records]


async def test_what_crossed_the_link_is_recorded_at_both_ends(stage: Stage) -> None:
    """The same frames, in order, each as it was; of what waited for a link before there was one, nothing."""
    a, b = stage.pair()
    record(a)
    record(b)
    into_a, into_b = a.add_endpoint("autopilot"), b.add_endpoint("autopilot")
    await stage.start(a, linked=False)
    one, other = await stage.program(), await stage.program()
    one.send(frame(99), into_a)
    await a.until(lambda status: status["endpoints"]["autopilot"]["frames_received"] == 1)
    await stage.start(b)
    await a.until_linked()
    for number in range(20):
        one.send(frame(number), into_a)
        await b.until(lambda status, n=number: status["peers"]["drone0"]["frames_received"] == n + 1)  # type: ignore[misc]
    other.send(frame(50, 2), into_b)
    await one.until_heard(frame(50, 2))
    await a.until(lambda status: status["recording"]["frames"] == 21)
    await a.stop()
    await b.stop()
    there = [frame(number) for number in range(20)]
    assert recorded(a) == [*((TO_PEER, each) for each in there), (FROM_PEER, frame(50, 2))]
    assert recorded(b) == [*((FROM_PEER, each) for each in there), (TO_PEER, frame(50, 2))]


async def test_what_a_policy_refuses_is_recorded_as_it_came(stage: Stage) -> None:
    """It crossed the link: of a captured peer one wants to know what it tried."""
    a, b = stage.pair()
    record(b)
    into_a = a.add_endpoint("autopilot")
    b.config["peer"][0] |= {"system_ids": [7], "role": "vehicle"}
    await stage.start(a, b)
    program = await stage.program()
    program.send(frame(1), into_a)
    await b.until(lambda status: bool(status["peers"]["drone0"]["refused"]["in"]))
    await b.until(lambda status: status["recording"]["frames"] == 1)
    await b.stop()
    assert recorded(b) == [(FROM_PEER, frame(1))]


async def test_what_is_there_at_the_end_is_not_lost(stage: Stage) -> None:
    """A daemon that ends right after a frame has recorded it, and pymavlink reads it."""
    a, b = stage.pair()
    record(a)
    into = a.add_endpoint("autopilot")
    await stage.start(a, b)
    program = await stage.program()
    program.send(frame(7), into)
    await b.until(lambda status: status["peers"]["drone0"]["frames_received"] == 1)
    await a.stop()
    (path,) = (a.folder / "flights").iterdir()
    log = mavutil.mavlink_connection(str(path))
    message = log.recv_msg()
    log.close()
    assert (message.get_type(), message.value) == ("NAMED_VALUE_INT", 7)


async def test_a_folder_that_cannot_be_written_costs_the_link_nothing(stage: Stage) -> None:
    """Frames pass; the status and the log say that they are not recorded."""
    a, b = stage.pair()
    record(a)
    (a.folder / "flights").write_text("a file is in the way")
    into_a, into_b = a.add_endpoint("autopilot"), b.add_endpoint("autopilot")
    await stage.start(a, b)
    one, other = await stage.program(), await stage.program()
    other.send(frame(1, 2), into_b)  # so that b knows the program
    await b.until(lambda status: bool(status["endpoints"]["autopilot"]["programs"]))
    one.send(frame(2), into_a)
    await other.until_heard(frame(2))
    status = await a.until(lambda status: not status["recording"]["is_recording"])
    assert status["recording"]["failures"] == {"ENOTDIR": 1}
    assert [each["reason"] for each in a.events("recording_stopped")] == ["ENOTDIR"]


async def test_prometheus_is_told_what_the_status_tells(stage: Stage) -> None:
    """Over HTTP, of a link that is up."""
    a, b = stage.pair()
    port = free_port()
    a.config["metrics"] = {"listen": f"127.0.0.1:{port}"}
    record(a)
    into = a.add_endpoint("autopilot")
    await stage.start(a, b)
    program = await stage.program()
    program.send(frame(1), into)
    await b.until(lambda status: status["peers"]["drone0"]["frames_received"] == 1)

    def scrape() -> bytes:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10) as response:
            assert response.headers["Content-Type"] == "text/plain; version=0.0.4; charset=utf-8"
            return bytes(response.read())

    found = samples(await asyncio.to_thread(scrape))
    assert found["uavlinkd_peer_up", frozenset({("peer", "drone1")})] == 1
    assert found["uavlinkd_endpoint_receive_frames_total", frozenset({("endpoint", "autopilot")})] == 1
    assert found["uavlinkd_recording_up", frozenset()] == 1


async def test_without_an_address_nothing_listens(stage: Stage) -> None:
    """No TCP socket is opened by a daemon that was told of none."""
    a, b = stage.pair()
    await stage.start(a, b)
    opened = sockets_of(a.pid)
    assert opened
    assert not opened & listening_sockets()


def sockets_of(pid: int) -> set[str]:
    """Of a process, by the system's numbers."""
    opened = [os.readlink(each) for each in Path(f"/proc/{pid}/fd").iterdir()]
    return {each[len("socket:[") : -1] for each in opened if each.startswith("socket:[")}


def listening_sockets() -> set[str]:
    """TCP sockets that listen."""
    lines = [line.split() for name in ("tcp", "tcp6") for line in Path(f"/proc/net/{name}").read_text().splitlines()]
    return {line[9] for line in lines if line[3] == "0A"}


async def test_a_taken_address_for_metrics_is_told(stage: Stage) -> None:
    """One line, status 1: as for every address."""
    a, _ = stage.pair()
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        a.config["metrics"] = {"listen": address}
        await a.start()
        assert await a.ended() == 1
    await until(lambda: bool(a.lines))
    (line,) = a.lines
    assert line.startswith(
        f"{a.config_file}: metrics.listen: cannot listen on {address}: Address already in use: end"
    )
