"""The emulated modems on pseudo-terminals: the plug, and devices of the user."""

from __future__ import annotations

import errno
import os
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import pytest

from tests.waiting import until
from uavlinkd.lab.mitm.modem import Fate, ModemEnd, ModemSettings
from uavlinkd.lab.mitm.modem_ports import ModemPorts, PortSettings

pytestmark = pytest.mark.usefixtures("undone_settings")

LEFT, RIGHT = ModemEnd.LEFT, ModemEnd.RIGHT
FAST = ModemSettings(air_bits_s=1e6, line_baud=1e6, turn_around_s=0.001, queue_bytes=1 << 16)


def settings_in(folder: Path) -> PortSettings:
    """Devices and files in a folder."""
    return PortSettings(folder / "left", folder / "right", FAST)


@asynccontextmanager
async def running(settings: PortSettings) -> AsyncIterator[ModemPorts]:
    ports = ModemPorts(settings)
    await ports.start()
    try:
        yield ports
    finally:
        await ports.stop()


class Host:
    """A process with an open device."""

    def __init__(self, device: Path) -> None:
        self.fd = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        self.received = b""

    def has(self, data: bytes) -> Callable[[], bool]:

        def look() -> bool:
            with suppress(BlockingIOError):
                self.received += os.read(self.fd, 65536)
            return data in self.received

        return look

    def write(self, data: bytes) -> None:
        assert os.write(self.fd, data) == len(data)

    def close(self) -> None:
        os.close(self.fd)


async def test_pulled_modem_fails_and_comes_back(tmp_path: Path) -> None:
    """The device vanishes, a process that has it open gets an error, and the new device works."""
    async with running(settings_in(tmp_path)) as ports:
        left, right = Host(tmp_path / "left"), Host(tmp_path / "right")
        ports.pull(LEFT)
        ports.pull(LEFT)
        assert not (tmp_path / "left").is_symlink()
        with pytest.raises(OSError) as failure:  # noqa: PT011  the number matters
            os.write(left.fd, b"x")
        assert failure.value.errno == errno.EIO
        left.close()
        right.write(b"lost")
        await until(lambda: ports.link.bytes[LEFT][Fate.UNPLUGGED] == 4)
        ports.plug(LEFT)
        ports.plug(LEFT)
        left = Host(tmp_path / "left")
        right.write(b"again")
        await until(left.has(b"again"))
        assert left.received == b"again"
        left.close()
        right.close()


async def test_stale_link_is_replaced_but_no_other_file(tmp_path: Path) -> None:
    """A killed emulator leaves a link to a pseudo-terminal. A file of the user stays."""
    (tmp_path / "left").symlink_to("/dev/pts/1234567")
    (tmp_path / "right").write_text("mine")
    with pytest.raises(FileExistsError):
        await ModemPorts(settings_in(tmp_path)).start()
    assert (tmp_path / "right").read_text() == "mine"
    assert not (tmp_path / "left").is_symlink()
    (tmp_path / "right").unlink()
    async with running(settings_in(tmp_path)) as ports:
        assert ports.link.is_plugged(LEFT)
