"""Serial ports: there when the device is, and no one's trouble when it is not. Pseudo-terminals stand for them."""

from __future__ import annotations

import asyncio
import os
import select
import socket
import termios
import threading
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from time import monotonic
from types import SimpleNamespace
from typing import Any, cast

import pytest
from serialx import BaseSerial

from tests.endpoints.clients import PATIENCE_S, Recorder, eventually, frame, large_frame, measure_udp_delivery, write
from uavlinkd.system.addresses import Address
from uavlinkd.endpoints import serial
from uavlinkd.endpoints.serial import SerialChannel, SerialEndpoint
from uavlinkd.endpoints.stream_endpoint import STALLED_S
from uavlinkd.endpoints.tcp import TcpServer, tcp_listener
from uavlinkd.endpoints.url import SerialUrl
from uavlinkd.mavlink.frames import StreamSplitter


class Autopilot:
    """The other end of a serial cable, and the device that it appears as, like those under /dev/serial/by-id."""

    def __init__(self, device: Path) -> None:
        self.device = device
        self.master = -1

    def plug_in(self) -> None:
        self.master, slave = os.openpty()
        os.set_blocking(self.master, False)
        self.device.symlink_to(os.ttyname(slave))
        os.close(slave)

    def unplug(self) -> None:
        self.device.unlink()
        os.close(self.master)
        self.master = -1

    def read(self) -> bytes:
        got = b""
        while select.select([self.master], [], [], 0)[0]:
            try:
                got += os.read(self.master, 65536)
            except OSError:  # nobody has the device open
                break
        return got


@pytest.fixture
def autopilot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Autopilot]:
    """Not plugged in yet."""
    monkeypatch.setattr(serial, "RETRY_S", 0.02)
    other_end = Autopilot(tmp_path / "usb-Autopilot")
    yield other_end
    if other_end.master >= 0:
        os.close(other_end.master)


@pytest.fixture
async def endpoint(autopilot: Autopilot) -> AsyncIterator[SerialEndpoint]:
    """On the autopilot's device, started."""
    port = SerialEndpoint("serial", SerialUrl(str(autopilot.device), 57600), Recorder())
    port.start()
    yield port
    port.close()


def recorder(endpoint: SerialEndpoint) -> Recorder:
    assert isinstance(endpoint.handler, Recorder)
    return endpoint.handler


async def opened(endpoint: SerialEndpoint) -> None:
    await eventually(lambda: len(endpoint.ports) == 1)


async def test_frames_go_both_ways(autopilot: Autopilot, endpoint: SerialEndpoint) -> None:
    """Every byte as it is: a terminal's own ideas about newlines, control characters and echo are off."""
    autopilot.plug_in()
    await opened(endpoint)
    assert endpoint.ports[0].name == str(autopilot.device)
    from_autopilot = [frame(number) for number in (10, 13, 0x03, 0x11, 0x13, 0x04, 0x1A, 0xFF)]
    os.write(autopilot.master, b"".join(from_autopilot))
    await eventually(lambda: recorder(endpoint).heard == from_autopilot)
    assert endpoint.ports[0].heard_at is not None
    assert autopilot.read() == b""
    write(endpoint, endpoint.ports[0], from_autopilot, monotonic())
    await eventually(lambda: bool(select.select([autopilot.master], [], [], 0)[0]))
    assert autopilot.read() == b"".join(from_autopilot)


async def test_device_that_is_not_there_yet_is_no_error(autopilot: Autopilot, endpoint: SerialEndpoint) -> None:
    """It is looked for again and again, and there is nothing to write to until it is found."""
    await eventually(lambda: endpoint.failures["ENOENT"] >= 3)
    assert list(endpoint.ports) == []
    autopilot.plug_in()
    await opened(endpoint)
    assert endpoint.failures.keys() == {"ENOENT"}


async def test_unplugged_device_is_gone_and_comes_back(autopilot: Autopilot, endpoint: SerialEndpoint) -> None:
    """It may come back as another terminal: its lasting name is opened anew."""
    for number in range(3):
        autopilot.plug_in()
        await opened(endpoint)
        (port,) = endpoint.ports
        os.write(autopilot.master, frame(number))
        await eventually(lambda: len(recorder(endpoint).heard) > len(recorder(endpoint).closed))
        autopilot.unplug()
        await eventually(lambda: recorder(endpoint).open == [])
        assert recorder(endpoint).closed[-1] is port
        write(endpoint, port, [frame(99)], monotonic())
        assert list(endpoint.ports) == []
    assert recorder(endpoint).heard == [frame(0), frame(1), frame(2)]
    assert endpoint.failures["unsent"] == 3


async def test_unplugged_device_is_noticed_by_writing(autopilot: Autopilot, endpoint: SerialEndpoint) -> None:
    """An error of a write is one of the device, and nothing is raised or reported from within it."""
    autopilot.plug_in()
    await opened(endpoint)
    (port,) = endpoint.ports
    autopilot.unplug()
    write(endpoint, port, [frame(1)], monotonic())
    assert recorder(endpoint).closed == []
    await eventually(lambda: recorder(endpoint).closed == [port])
    assert (endpoint.failures["EIO"], endpoint.failures["unsent"]) == (1, 1)


async def test_device_is_ours_alone(autopilot: Autopilot, endpoint: SerialEndpoint) -> None:
    """Two programs that read one wire would each get half of it: the second waits until the first is gone."""
    autopilot.plug_in()
    await opened(endpoint)
    second = SerialEndpoint("second", SerialUrl(str(autopilot.device), 57600), Recorder())
    second.start()
    try:
        await eventually(lambda: second.failures["EBUSY"] >= 2)
        assert list(second.ports) == []
        endpoint.close()
        await opened(second)
    finally:
        second.close()


@pytest.mark.parametrize(
    ("baud", "constant"), [(57600, termios.B57600), (921600, termios.B921600), (420000, None), (1_870_000, None)]
)
async def test_baud_rate_is_set(autopilot: Autopilot, baud: int, constant: int | None) -> None:
    """Those with a name of their own in the system, and any other."""
    autopilot.plug_in()
    endpoint = SerialEndpoint("serial", SerialUrl(str(autopilot.device), baud), Recorder())
    endpoint.start()
    try:
        await opened(endpoint)
        (connection,) = endpoint._connections.values()
        speed = termios.tcgetattr(connection.channel.fileno())[5]
        named = {getattr(termios, name) for name in dir(termios) if name[:1] == "B" and name[1:].isdigit()}
        assert speed == constant if constant is not None else speed not in named
    finally:
        endpoint.close()


@pytest.mark.parametrize("what", ["/dev/null", "a file", "a folder"])
async def test_what_is_no_serial_port_is_never_opened(
    autopilot: Autopilot, endpoint: SerialEndpoint, tmp_path: Path, what: str
) -> None:
    """A mistaken path is counted under what the kernel says, and does no harm."""
    place = Path(what) if what.startswith("/") else tmp_path / "mistake"
    if what == "a file":
        place.write_text("precious")
    elif what == "a folder":
        place.mkdir()
    autopilot.device.symlink_to(place)
    reason = "EISDIR" if what == "a folder" else "ENOTTY"
    await eventually(lambda: endpoint.failures[reason] >= 2)
    assert recorder(endpoint).open == []
    if what == "a file":
        assert place.read_text() == "precious"


async def test_boot_text_and_noise_are_survived(autopilot: Autopilot, endpoint: SerialEndpoint) -> None:
    """An autopilot that boots writes text, and a wrong baud rate makes noise: frames after it are heard."""
    autopilot.plug_in()
    await opened(endpoint)
    noise = b"\r\nInit ArduCopter V4.6\r\nFree RAM: 21345\r\n" + bytes(range(256)) * 4 + b"GET / HTTP/1.1"
    os.write(autopilot.master, noise + b"".join(map(frame, range(20))))
    await eventually(lambda: recorder(endpoint).heard[-1:] == [frame(19)])
    assert endpoint.counters.garbage_bytes >= len(noise) - 1
    assert recorder(endpoint).closed == []


# A device that does not take what is written.


async def test_device_that_takes_nothing_gets_stale_frames_never(
    autopilot: Autopilot, endpoint: SerialEndpoint
) -> None:
    """When it takes bytes again, what waited too long is not among them, and no frame is half."""
    autopilot.plug_in()
    await opened(endpoint)
    (port,) = endpoint.ports
    (connection,) = endpoint._connections.values()
    before = monotonic() - 60
    count = 0
    while not connection._awaits_writable:
        write(endpoint, port, [large_frame(count)], before)
        count += 1
    write(endpoint, port, [large_frame(200)] * 50, before)
    write(endpoint, port, [frame(1), frame(2)], monotonic())
    got = b""
    while connection.outgoing:
        got += autopilot.read()
        await asyncio.sleep(0)
    await eventually(lambda: bool(select.select([autopilot.master], [], [], 0)[0]))
    got += autopilot.read()
    frames = [each.raw for each in StreamSplitter().feed(got, 0.0)]
    assert b"".join(frames) == got
    assert frames[-2:] == [frame(1), frame(2)]
    assert large_frame(200) not in frames
    assert endpoint.failures["stale"] == count + 52 - len(frames)


async def test_device_that_takes_nothing_for_long_is_opened_anew(
    autopilot: Autopilot, endpoint: SerialEndpoint
) -> None:
    """What hangs may not hang any more when it has been closed, and what the kernel held is forgotten."""
    autopilot.plug_in()
    await opened(endpoint)
    (port,) = endpoint.ports
    (connection,) = endpoint._connections.values()
    began = monotonic()
    while not connection._awaits_writable:
        write(endpoint, port, [large_frame(0)], began)
    endpoint.do_housekeeping(began + STALLED_S - 0.01)
    assert endpoint.failures["stalled"] == 0
    endpoint.do_housekeeping(began + STALLED_S)
    assert endpoint.failures["stalled"] == 1
    await eventually(lambda: recorder(endpoint).closed == [port] and len(endpoint.ports) == 1)


# How much the kernel is given.


def device_with(in_kernel: int) -> BaseSerial:
    """A device whose kernel queue holds so many bytes."""
    return cast(BaseSerial, SimpleNamespace(fileno=lambda: -1, num_unwritten_bytes=lambda: in_kernel))


@pytest.mark.parametrize(("baud", "limit"), [(57600, 115), (921600, 1843), (300, 1)])
def test_kernel_holds_no_more_than_20_ms_of_line_time(baud: int, limit: int) -> None:
    """A byte is ten bits on the line; what the kernel reports counts at once."""
    channel = SerialChannel(device_with(100), baud)
    assert channel.limit_bytes == limit
    assert channel.held(now=0.0) == 100


class HiddenBuffer(SerialChannel):
    """A USB adapter that takes all bytes into a buffer of its own: the kernel counts none of them."""

    def hand_over(self, data: bytes) -> int:
        return len(data)


def test_bytes_that_the_line_cannot_have_carried_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """An adapter's own buffer is bounded too: the baud rate says when the line has carried what was written."""
    now = 50.0
    monkeypatch.setattr(serial, "monotonic", lambda: now)
    channel = HiddenBuffer(device_with(0), 57600)
    assert (channel.held(now), channel.drain_s(0, now)) == (0, serial.LATE_S)
    channel.write(bytes(115))
    assert channel.held(now) in {114, 115}
    assert channel.held(now + 0.010) in {57, 58}
    assert channel.drain_s(0, now) == pytest.approx(115 / 5760 + serial.LATE_S, abs=0.0003)
    now += 0.010
    channel.write(bytes(40))
    assert channel.held(now) in {97, 98}
    assert channel.held(now + 98 / 5760) == 0


def test_timer_waits_until_a_quarter_of_the_limit_is_free() -> None:
    """At a high rate the next small frame would fit in less than a millisecond."""
    channel = SerialChannel(device_with(1843), 921600)
    assert channel.drain_s(1843 - 21, now=0.0) == pytest.approx(0.005 + serial.LATE_S, abs=0.0003)


def test_device_without_line_rate_is_bounded_in_bytes() -> None:
    """Its baud rate says nothing: only the kernel's own count does."""
    channel = SerialChannel(device_with(4000), None)
    assert (channel.held(now=0.0), channel.limit_bytes) == (4000, serial.IN_FLIGHT_BYTES)
    assert channel.drain_s(0, now=0.0) == serial.POLL_S


@pytest.mark.parametrize(
    ("device", "is_uart"),
    [
        ("ttyS0", True),
        ("ttyAMA0", True),
        ("ttyUSB0", True),
        ("ttyTHS1", True),
        ("ttyACM0", False),
        ("rfcomm0", False),
    ],
)
def test_line_rate_is_that_of_the_device_behind_a_link(tmp_path: Path, device: str, is_uart: bool) -> None:
    """Names under /dev/serial/by-id are links, and say nothing about the kind."""
    link = tmp_path / "usb-Autopilot"
    link.symlink_to(tmp_path / device)
    assert serial.has_line_rate(str(link)) is serial.has_line_rate(str(tmp_path / device)) is is_uart


async def test_pseudo_terminal_is_not_paced(autopilot: Autopilot, endpoint: SerialEndpoint) -> None:
    """It has no line: a second of line time at 57,600 baud goes at once."""
    autopilot.plug_in()
    await opened(endpoint)
    write(endpoint, endpoint.ports[0], [frame(number) for number in range(100)], monotonic())
    assert endpoint.frames_sent == 100


async def test_dead_endpoints_hold_nobody_up(autopilot: Autopilot, endpoint: SerialEndpoint, tmp_path: Path) -> None:
    """With a device unplugged, one that takes nothing and a TCP client that never reads, others get all in time."""
    alone = await measure_udp_delivery()
    autopilot.plug_in()
    await opened(endpoint)
    unplugged = SerialEndpoint("unplugged", SerialUrl(str(tmp_path / "absent"), 57600), Recorder())
    server = TcpServer("server", tcp_listener(Address("127.0.0.1", 0)), Recorder())
    with socket.create_connection(server.address) as never_reads:
        never_reads.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        for each in (unplugged, server):
            each.start()
        try:
            await eventually(lambda: len(server.ports) == 1 and unplugged.failures["ENOENT"] > 0)
            beside = await measure_udp_delivery(endpoint, unplugged, server)
        finally:
            for each in (unplugged, server):
                each.close()
    assert endpoint.failures["outgoing_full"] > 0
    assert server.failures["outgoing_full"] > 0
    assert beside.frames == alone.frames
    assert len(beside.frames) == beside.sent
    assert beside.slowest_s < alone.slowest_s + 0.1


async def test_device_that_hangs_on_opening_holds_nobody_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Opening waits for the hardware: not here, and one device's trouble is not another's."""
    pipe_read, pipe_write = os.pipe()

    def hang(*_: Any, **__: Any) -> BaseSerial:
        os.read(pipe_read, 1)
        raise OSError(5, "at last")

    monkeypatch.setattr(serial, "serial_for_url", hang)
    hanging = [SerialEndpoint(f"hangs-{n}", SerialUrl("/dev/x", 57600), Recorder()) for n in range(10)]
    for each in hanging:
        each.start()
    try:
        beside = await measure_udp_delivery(*hanging, batches=20)
        assert len(beside.frames) == beside.sent
    finally:
        os.close(pipe_write)
        await eventually(lambda: all(each.failures["EIO"] for each in hanging))
        for each in hanging:
            each.close()
        os.close(pipe_read)


async def test_closed_endpoint_leaves_the_device_to_others(autopilot: Autopilot, endpoint: SerialEndpoint) -> None:
    """Closed while open, while opening or while waiting: nothing is reported, and the device is not held."""
    autopilot.plug_in()
    await opened(endpoint)
    endpoint.close()
    opening = SerialEndpoint("opening", SerialUrl(str(autopilot.device), 57600), Recorder())
    opening.start()
    await asyncio.sleep(0)
    opening.close()
    last = SerialEndpoint("last", SerialUrl(str(autopilot.device), 57600), Recorder())
    last.start()
    try:
        await opened(last)
    finally:
        last.close()
    assert recorder(endpoint).closed == recorder(opening).open == []


async def test_device_that_opens_after_all_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    """An endpoint closed while its device is being opened does not keep the device."""
    may_open, done = threading.Event(), threading.Event()
    device = SimpleNamespace(open=lambda: may_open.wait(PATIENCE_S), close=done.set)
    monkeypatch.setattr(serial, "serial_for_url", lambda *_, **__: device)
    endpoint = SerialEndpoint("serial", SerialUrl("/dev/x", 57600), Recorder())
    endpoint.start()
    await asyncio.sleep(0)
    endpoint.close()
    may_open.set()
    await eventually(done.is_set)
    assert recorder(endpoint).open == []
