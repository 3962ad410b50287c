"""The device of a serial network: read in datagrams, paced, unplugged and plugged in again."""

from __future__ import annotations

import os
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

from tests.endpoints.test_serial import Autopilot
from tests.waiting import until
from uavlinkd.endpoints import serial_line
from uavlinkd.endpoints.line_framing import DELIMITER, LineDecoder, encode
from uavlinkd.endpoints.serial_line import LINE_FULL, TOO_LONG, SerialLine
from uavlinkd.endpoints.url import SerialUrl
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
    monkeypatch.setattr(serial_line, "RETRY_S", 0.02)
    end = Other(tmp_path / "usb-modem")
    yield end
    if end.master >= 0:
        os.close(end.master)


@pytest.fixture
def received() -> Received:
    """Of the line."""
    return Received()


@pytest.fixture
async def line(other: Other, received: Received) -> AsyncIterator[SerialLine]:
    """On the modem's device, started."""
    stall = StallWatch(monotonic(), lambda pause_s: None)
    url = SerialUrl(str(other.device), 57600)
    made = SerialLine("sik", url, FAST, received.on_datagrams, received.on_change, stall)
    made.start()
    yield made
    made.close()


async def plugged_in(other: Other, line: SerialLine) -> None:
    other.raw = b""
    other.plug_in()
    await until(lambda: line.is_open)


async def test_datagrams_go_in_both_directions(other: Other, line: SerialLine, received: Received) -> None:
    """Any bytes; after a silence a delimiter comes first."""
    await plugged_in(other, line)
    sent = [bytes(range(256)), b"\x11\x13\x03\x04\r\n", b""]
    for datagram in sent:
        line.send(datagram)
    await until(lambda: other.datagrams() == sent)
    assert other.raw == DELIMITER + b"".join(map(encode, sent))
    os.write(other.master, b"".join(map(encode, sent)))
    await until(lambda: received.datagrams == sent)
    assert (line.reason, line.uses_cts, received.changes) == ("", False, 1)


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
    line.set_rate(400)
    began = monotonic()
    for number in range(20):
        line.send(bytes([number + 1]) * 96)  # 100 bytes each on the line
    assert line.failures[LINE_FULL] == 15
    await until(lambda: len(other.datagrams()) == 5)
    assert monotonic() - began >= 0.7  # 500 bytes less those of the first quarter
    assert [datagram[0] for datagram in other.datagrams()] == [1, 2, 3, 4, 5]


async def test_datagram_that_is_longer_than_a_moment_of_the_air_passes(other: Other, line: SerialLine) -> None:
    """Alone: a handshake on a very slow radio. One above the limit of framing is dropped and counted."""
    await plugged_in(other, line)
    line.set_rate(100)
    line.send(bytes(147))
    await until(lambda: other.datagrams() == [bytes(147)])
    line.send(bytes(3000))
    assert line.failures[TOO_LONG] == 1


async def test_modem_that_withholds_cts_for_good_is_ignored(
    other: Other, line: SerialLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its wire is not connected after all."""
    monkeypatch.setattr(serial_line, "STUCK_S", 0.05)
    await plugged_in(other, line)
    device = line._device
    assert device is not None
    line._use_cts(device, on=True)
    assert [line.uses_cts] == [True]
    held = [7]
    monkeypatch.setattr(device, "num_unwritten_bytes", lambda: held[0])
    line.set_rate(50)
    for number in range(3):
        line.send(bytes([number + 1]) * 30)
    await until(lambda: line.failures["CTS_STUCK"] == 1)
    assert [line.uses_cts] == [False]
    held[0] = 0
    await until(lambda: len(other.datagrams()) == 3)
