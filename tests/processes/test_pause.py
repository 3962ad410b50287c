"""A daemon that stood still delivers nothing that gathered meanwhile as if it were new.

``tests/faults`` stops a daemon while clients talk in both directions.
"""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import tty
from collections.abc import Callable
from contextlib import suppress

from tests.kernel_queues import cpu_s
from tests.limited_cpu import limited_cpu
from tests.processes.frames import frame
from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess
from tests.processes.udp import Client
from tests.waiting import PATIENCE_S, Stopwatch
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.mavlink.frames import MAX_GAP_S
from uavlinkd.system.stall import STALL_S

PAUSED_S = STALL_S + 0.5
FRESH = 10_000
"""Frames from this number on are sent after the pause."""


async def until_fresh(send: Callable[[bytes], object], sink: Client, system: int = 1) -> None:
    """Send new frames until one arrives."""
    number = FRESH
    async with asyncio.timeout(PATIENCE_S):
        while not any(frame(fresh, system) in sink.received for fresh in range(FRESH, number)):
            send(frame(number, system))
            number += 1
            await asyncio.sleep(0.05)


async def stop(daemon: DaemonProcess) -> None:
    """Stop the process, and wait until the kernel has."""
    await daemon.send_signal(signal.SIGSTOP)
    while (state := _state(daemon.pid)) != "T":
        assert state in "RSD"
        await asyncio.sleep(0.001)


def _state(pid: int) -> str:
    with open(f"/proc/{pid}/stat") as file:
        return file.read().rpartition(")")[2].split()[0]


async def test_slow_computer_does_not_deliver_a_long_backlog() -> None:
    """At a fiftieth of a core it takes a second to read a full socket: the last datagram is as old as the first."""
    backlog = range(2, 2000)
    with limited_cpu(0.02) as limit:
        async with Stage() as stage:
            a, _, into, sink = await stage.one_way()
            source = await stage.client()
            source.send(frame(1), into)
            await sink.until_received(frame(1))

            await stop(a)
            for number in backlog:
                source.send(frame(number), into)
            await asyncio.sleep(PAUSED_S)
            limit.add(a.pid)
            before_s, watch = cpu_s(a.pid), Stopwatch()
            await a.send_signal(signal.SIGCONT)
            await a.until_logged("daemon_paused")
            await until_fresh(lambda data: source.send(data, into), sink)
            limit.release(a.pid)

            assert cpu_s(a.pid) - before_s < 0.1 * watch.elapsed_s  # it was slow
            assert [number for number in backlog if frame(number) in sink.received] == []


async def test_each_kind_of_endpoint_drops_what_waited(stage: Stage) -> None:
    """UDP, TCP and serial clients speak during the pause; a frame that one of them was amid is not cut in two."""
    a, b = stage.pair()
    udp = a.add_endpoint("udp")
    tcp = a.add_endpoint("tcp", f"tcpin:127.0.0.1:{free_port()}")
    master, slave = os.openpty()
    tty.setraw(slave)
    device = a.folder / "ttyACM0"
    device.symlink_to(os.ttyname(slave))
    a.add_endpoint("serial", f"serial:{device}:57600")
    sink = await stage.client()
    b.add_endpoint("ground", f"udpout:{sink}")
    await stage.start(a, b)
    source = await stage.client()
    with socket.create_connection(tcp) as client:
        await a.until(lambda status: all(status["endpoints"][name]["clients"] for name in ("tcp", "serial")))
        send: dict[int, Callable[[bytes], object]] = {
            1: lambda data: source.send(data, udp),
            2: client.send,
            3: lambda data: os.write(master, data),
        }
        for system, write in send.items():
            await until_fresh(write, sink, system)
        sink.clear()

        await stop(a)
        for system, write in send.items():
            write(frame(1, system) + frame(2, system))
            if system != 1:
                write(frame(3, system)[:9])
        await asyncio.sleep(PAUSED_S)
        await a.send_signal(signal.SIGCONT)
        watch = Stopwatch()
        await a.until(lambda status: status["stale"] == {"udp": 2, "tcp": 2, "serial": 2})
        for system in (3, 2):
            send[system](frame(3, system)[9:])
        is_in_time = watch.elapsed_s < MAX_GAP_S  # later, a serial device counts as silent inside a frame
        for system, write in send.items():
            await until_fresh(write, sink, system)
        late = [(system, number) for system in send for number in (1, 2, 3) if frame(number, system) in sink.received]
        assert late == []
        status = await a.until(lambda status: all(status["stale"][name] >= 3 for name in ("tcp", "serial")))
        if is_in_time:
            assert [status["endpoints"][name]["garbage_bytes"] for name in ("tcp", "serial")] == [0, 0]
        with suppress(OSError):
            os.close(slave)
        os.close(master)
