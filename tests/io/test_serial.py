"""Serial endpoints: open whenever the device is present. Pseudo-terminals take the place of devices."""

from __future__ import annotations

import errno
import os
import select
import termios
from collections.abc import AsyncIterator, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from time import monotonic
from types import SimpleNamespace
from typing import cast

import pytest
from serialx import BaseSerial

from tests.io.clients import Recorder, frame, recorder, write
from tests.waiting import until
from uavlinkd.io import serial
from uavlinkd.io.serial import SerialChannel, SerialEndpoint
from uavlinkd.io.url import SerialUrl


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
        self.close()

    def close(self) -> None:
        if self.master >= 0:
            os.close(self.master)
        self.master = -1

    def read(self) -> bytes:
        got = b""
        while select.select([self.master], [], [], 0)[0]:
            try:
                got += os.read(self.master, 65536)
            except OSError:  # no process has the device open
                break
        return got


@contextmanager
def started(autopilot: Autopilot, name: str = "serial", baud: int = 57600) -> Iterator[SerialEndpoint]:
    """An endpoint on the autopilot's device."""
    with closing(SerialEndpoint(name, SerialUrl(str(autopilot.device), baud), Recorder())) as endpoint:
        endpoint.start()
        yield endpoint


@pytest.fixture
def autopilot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Autopilot]:
    """Not plugged in yet."""
    monkeypatch.setattr(serial, "RETRY_S", 0.02)
    with closing(Autopilot(tmp_path / "usb-Autopilot")) as other_end:
        yield other_end


@pytest.fixture
async def endpoint(autopilot: Autopilot) -> AsyncIterator[SerialEndpoint]:
    """On the autopilot's device, started."""
    with started(autopilot) as endpoint:
        yield endpoint


async def opened(endpoint: SerialEndpoint) -> None:
    await until(lambda: len(endpoint.ports) == 1)


async def test_frames_go_in_both_directions(autopilot: Autopilot, endpoint: SerialEndpoint) -> None:
    """Bytes are unchanged: the terminal does not process newlines, control characters or echo."""
    autopilot.plug_in()
    await opened(endpoint)
    assert endpoint.ports[0].name == str(autopilot.device)
    from_autopilot = [frame(number) for number in (10, 13, 0x03, 0x11, 0x13, 0x04, 0x1A, 0xFF)]
    os.write(autopilot.master, b"".join(from_autopilot))
    await until(lambda: recorder(endpoint).received == from_autopilot)
    assert endpoint.ports[0].received_at is not None
    assert autopilot.read() == b""
    write(endpoint.ports[0], from_autopilot, monotonic())
    await until(lambda: bool(select.select([autopilot.master], [], [], 0)[0]))
    assert autopilot.read() == b"".join(from_autopilot)


async def test_unplugged_device_is_opened_again(autopilot: Autopilot, endpoint: SerialEndpoint) -> None:
    """It is missing at first, and may return as another terminal. The endpoint opens its permanent name again."""
    await until(lambda: endpoint.failures["ENOENT"] >= 3)
    assert list(endpoint.ports) == []
    for number in range(3):
        autopilot.plug_in()
        await opened(endpoint)
        (port,) = endpoint.ports
        os.write(autopilot.master, frame(number))
        await until(lambda: len(recorder(endpoint).received) > len(recorder(endpoint).closed))
        autopilot.unplug()
        await until(lambda: recorder(endpoint).open == [])
        assert recorder(endpoint).closed[-1] is port
        write(port, [frame(99)], monotonic())
        assert list(endpoint.ports) == []
    assert recorder(endpoint).received == [frame(0), frame(1), frame(2)]
    assert endpoint.failures["unsent"] == 3


async def test_device_is_opened_exclusively(autopilot: Autopilot, endpoint: SerialEndpoint) -> None:
    """Two readers of one wire would get half of the bytes each: the second waits until the first has closed it."""
    autopilot.plug_in()
    await opened(endpoint)
    with started(autopilot, "second") as second:
        await until(lambda: second.failures["EBUSY"] >= 2)
        assert list(second.ports) == []
        endpoint.close()
        await opened(second)


def test_terminal_is_locked_also_through_another_device_file(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of two containers has a file of its own for one terminal, so a lock of the file does not count."""
    monkeypatch.setattr(serial, "_PSEUDO_TERMINALS", "none here")
    terminal, slave = os.openpty()
    try:
        device = cast(BaseSerial, SimpleNamespace(fileno=lambda: slave))
        serial.lock(device, "/dev/ttyUSB0")
        with pytest.raises(OSError, match="another process") as refused:
            serial.lock(device, "/dev/another")
        assert refused.value.errno == errno.EBUSY
    finally:
        os.close(terminal)
        os.close(slave)


@pytest.mark.parametrize(
    ("baud", "constant"), [(57600, termios.B57600), (921600, termios.B921600), (420000, None), (1_870_000, None)]
)
async def test_baud_rate_is_set(autopilot: Autopilot, baud: int, constant: int | None) -> None:
    """Standard rates, which have a constant in termios, and others."""
    autopilot.plug_in()
    with started(autopilot, baud=baud) as endpoint:
        await opened(endpoint)
        (connection,) = endpoint.ports
        speed = termios.tcgetattr(connection.channel.fileno())[5]
        named = {getattr(termios, name) for name in dir(termios) if name[:1] == "B" and name[1:].isdigit()}
        assert speed == constant if constant is not None else speed not in named


@pytest.mark.parametrize("what", ["/dev/null", "a file", "a folder"])
async def test_only_serial_devices_are_opened(
    autopilot: Autopilot, endpoint: SerialEndpoint, tmp_path: Path, what: str
) -> None:
    """A wrong path is counted under the kernel's error, and does no harm."""
    place = Path(what) if what.startswith("/") else tmp_path / "mistake"
    if what == "a file":
        place.write_text("precious")
    elif what == "a folder":
        place.mkdir()
    autopilot.device.symlink_to(place)
    reason = "EISDIR" if what == "a folder" else "ENOTTY"
    await until(lambda: endpoint.failures[reason] >= 2)
    assert recorder(endpoint).open == []
    if what == "a file":
        assert place.read_text() == "precious"


def device_with(in_kernel: int) -> BaseSerial:
    """A device whose kernel queue holds so many bytes."""
    return cast(BaseSerial, SimpleNamespace(fileno=lambda: -1, num_unwritten_bytes=lambda: in_kernel))


@pytest.mark.parametrize(("baud", "limit"), [(57600, 115), (921600, 1843), (300, 1)])
def test_kernel_holds_no_more_than_20_ms_of_line_time(baud: int, limit: int) -> None:
    """A byte is ten bits on the line. The kernel's count is used at once."""
    channel = SerialChannel(device_with(100), baud)
    assert channel.limit_bytes == limit
    assert channel.held(now=0.0) == 100


def test_bytes_that_the_line_cannot_have_carried_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """A USB adapter's buffer accepts all bytes. The baud rate says when the line has carried them."""
    now = 50.0
    monkeypatch.setattr(os, "write", lambda fd, data: len(data))
    monkeypatch.setattr(serial, "monotonic", lambda: now)
    channel = SerialChannel(device_with(0), 57600)
    assert (channel.held(now), channel.drain_s(0, now)) == (0, serial.LATE_S)
    channel.write(bytes(115))
    assert channel.held(now) in {114, 115}
    assert channel.held(now + 0.010) in {57, 58}
    assert channel.drain_s(0, now) == pytest.approx(115 / 5760 + serial.LATE_S, abs=0.0003)
    now += 0.010
    channel.write(bytes(40))
    assert channel.held(now) in {97, 98}
    assert channel.held(now + 98 / 5760) == 0


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
    """Names under /dev/serial/by-id are links and do not show the type."""
    link = tmp_path / "usb-Autopilot"
    link.symlink_to(tmp_path / device)
    assert serial.has_line_rate(str(link)) is serial.has_line_rate(str(tmp_path / device)) is is_uart
