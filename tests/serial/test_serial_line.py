"""The device of a serial network: read in datagrams, paced, unplugged and plugged in again."""

from __future__ import annotations

import os
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from serialx import serial_for_url

from tests.io.test_serial import Autopilot
from tests.waiting import PATIENCE_S, until
from uavlinkd.io import serial
from uavlinkd.io.url import SerialUrl
from uavlinkd.serial import serial_line
from uavlinkd.serial.line_framing import LineDecoder, encode
from uavlinkd.serial.serial_line import LINE_FULL, SerialLine
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import StallWatch

FAST = 1e6
"""Bytes a second: pacing does not matter."""


class Other(Autopilot):
    """The other end of the line, with a decoder."""

    def __init__(self, device: Path) -> None:
        super().__init__(device)
        self.raw = b""

    def datagrams(self) -> list[bytes]:
        """All that arrived since it was plugged in."""
        self.raw += self.read()
        return LineDecoder().feed(self.raw)


class Received:
    """What a line delivered, and how often its state changed."""

    def __init__(self) -> None:
        self.datagrams: list[bytes] = []
        self.changes = 0

    def on_datagrams(self, datagrams: list[bytes], now: float, epoch: int) -> None:
        self.datagrams += datagrams

    def on_change(self) -> None:
        self.changes += 1


@pytest.fixture
def other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Other]:
    """Not plugged in yet."""
    monkeypatch.setattr(serial, "RETRY_S", 0.02)
    with closing(Other(tmp_path / "usb-modem")) as end:
        yield end


@pytest.fixture
def received() -> Received:
    """Of the line."""
    return Received()


@pytest.fixture
async def line(other: Other, received: Received) -> AsyncIterator[SerialLine]:
    """On the modem's device, started."""
    stall = StallWatch(monotonic(), lambda pause_s: None)
    url = SerialUrl(str(other.device), 57600)
    with closing(SerialLine("sik", url, FAST, received.on_datagrams, received.on_change, stall)) as made:
        made.start()
        yield made


async def plugged_in(other: Other, line: SerialLine) -> None:
    other.raw = b""
    other.plug_in()
    await until(lambda: line.is_open)


async def test_datagrams_go_in_both_directions(other: Other, line: SerialLine, received: Received) -> None:
    """Any bytes."""
    await plugged_in(other, line)
    sent = [bytes(range(256)), b"\x11\x13\x03\x04\r\n", b""]
    for datagram in sent:
        line.send(datagram)
    await until(lambda: other.datagrams() == sent)
    assert other.raw == b"".join(map(encode, sent))
    os.write(other.master, b"".join(map(encode, sent)))
    await until(lambda: received.datagrams == sent)
    assert (line.reason, received.changes) == ("", 1)


async def test_device_that_is_absent_unplugged_and_plugged_in(
    other: Other, line: SerialLine, received: Received
) -> None:
    """Sending fails meanwhile; half a datagram from before does not spoil the first one after."""
    await until(lambda: line.failures["ENOENT"] >= 2)
    with pytest.raises(OSError, match="not open"):
        line.send(b"nowhere")
    for number in range(3):
        await plugged_in(other, line)
        os.write(other.master, encode(b"whole") + encode(bytes(40))[:20])
        await until(lambda number=number: len(received.datagrams) == number + 1)  # type: ignore[misc]
        other.unplug()
        await until(lambda: not line.is_open)
        assert line.reason
    assert (line.decoder.line_noise, received.changes) == (0, 6)


async def test_line_is_written_at_the_rate_of_the_air(other: Other, line: SerialLine) -> None:
    """The modem gets a quarter of a second's worth at once, a bit waits here, the rest is dropped and counted."""
    await plugged_in(other, line)
    line.bytes_s = 400
    began = monotonic()
    for number in range(20):
        line.send(bytes([number + 1]) * 96)  # 100 bytes each on the line
    assert line.failures[LINE_FULL] == 15
    await until(lambda: len(other.datagrams()) == 5)
    assert monotonic() - began >= 0.7  # 500 bytes less those of the first quarter
    assert [datagram[0] for datagram in other.datagrams()] == [1, 2, 3, 4, 5]


HANGS = ("open", "reset_write_buffer", "close")


@pytest.mark.parametrize("call", HANGS)
async def test_adapter_that_hangs_does_not_stop_the_event_loop(
    other: Other, line: SerialLine, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    """While a call of the driver waits, the loop goes on; when the call returns, the line works."""
    hangs, may_go_on = threading.Event(), threading.Event()
    loop_thread = threading.get_ident()

    def hanging(real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            if not may_go_on.is_set():
                assert threading.get_ident() != loop_thread, "the event loop hangs"
                hangs.set()
                assert may_go_on.wait(PATIENCE_S)
            return real(*arguments)

        return call

    of: Any = type(serial_for_url("/dev/null", 57600))
    try:
        if call in ("reset_write_buffer", "close"):
            await plugged_in(other, line)
            monkeypatch.setattr(of, call, hanging(getattr(of, call)))
            other.unplug()
        else:
            monkeypatch.setattr(of, call, hanging(getattr(of, call)))
            if call == "open":  # a try that began before this must not open the device
                await until(hangs.is_set)
            other.plug_in()
        await until(hangs.is_set)  # in a turn of the loop
        assert not line.is_open
    finally:
        may_go_on.set()
    if call in ("reset_write_buffer", "close"):
        other.plug_in()
    await until(lambda: line.is_open)
    line.send(b"passes")
    await until(lambda: other.datagrams() == [b"passes"])


async def test_end_of_the_daemon_does_not_wait_for_an_adapter_that_hangs(
    other: Other, line: SerialLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What waits is written, then the device has a moment to close."""
    monkeypatch.setattr(serial_line, "CLOSE_S", 0.01)
    await plugged_in(other, line)
    device = line._device
    assert device is not None
    may_close, closed, close = threading.Event(), threading.Event(), device.close

    def hang() -> None:
        assert may_close.wait(PATIENCE_S)
        close()
        closed.set()

    monkeypatch.setattr(device, "close", hang)
    line.bytes_s = 1
    line.send(b"first")
    line.send(b"waits for the radio")
    line.close()
    assert not closed.is_set()
    await until(lambda: other.datagrams() == [b"first", b"waits for the radio"])
    may_close.set()
    await until(closed.is_set)
