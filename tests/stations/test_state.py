"""The file that stays over restarts: numbers that only grow, and addresses."""

from __future__ import annotations

import base64
from pathlib import Path

import pytest

from tests import waiting
from uavlinkd.io.sockets import BindError
from uavlinkd.protocol.crypto import x25519_public_key
from uavlinkd.protocol.path import SocketAddress
from uavlinkd.stations.state import BLOCK, StationDisk

KEY = x25519_public_key(bytes(range(32)))
THERE: SocketAddress = ("203.0.113.7", 40001)
SIX: SocketAddress = ("2001:db8::7", 40001, 0, 0)


def opened(path: Path) -> StationDisk:
    disk = StationDisk(path)
    disk.open()
    return disk


@pytest.mark.parametrize("address", [THERE, SIX])
async def test_addresses_stay(tmp_path: Path, address: SocketAddress) -> None:
    path = tmp_path / "state"
    opened(path).follow({KEY: address})
    await waiting.until(lambda: address[0] in path.read_text())
    assert StationDisk(path).open() == {KEY: address}


def test_timestamps_grow_over_restarts(tmp_path: Path) -> None:
    """Also if the daemon was killed in the middle of a block; and each is one of TAI64N."""
    stamps = []
    for _ in range(3):
        disk = opened(tmp_path / "state")
        stamps += [disk.timestamp() for _ in range(5)]
    assert stamps == sorted(set(stamps))
    assert all(len(stamp) == 12 and stamp[0] == 0x40 and stamp[8:] == bytes(4) for stamp in stamps)


async def test_disk_that_takes_nothing_stops_no_handshake(tmp_path: Path) -> None:
    """The numbers go on, and are written when the disk takes them again."""
    folder = tmp_path / "folder"
    folder.mkdir()
    disk = opened(folder / "state")
    folder.rename(tmp_path / "away")
    stamps = [disk.timestamp() for _ in range(BLOCK + 10)]
    assert stamps == sorted(set(stamps))
    (tmp_path / "away").rename(folder)
    disk.follow({})
    await waiting.until(lambda: disk.left > 0)
    assert opened(folder / "state").timestamp() > stamps[-1]


@pytest.mark.parametrize(
    "content",
    [
        "",
        "other\n5\n",
        *(f"uavlinkd stations 1\n{number}\n" for number in ("many", "9" * 19, "9" * 9999)),
        "\0" * 100,
    ],
    ids=["empty", "another title", "text", "19 digits", "9,999 digits", "zeros"],
)
def test_file_of_another_kind_begins_anew(tmp_path: Path, content: str) -> None:
    (tmp_path / "state").write_text(content)
    assert StationDisk(tmp_path / "state").open() == {}


def test_lines_that_are_wrong_are_left_out(tmp_path: Path) -> None:
    places = ("1.2.3.4 65536", "1.2.3.4 0", "1.2.3.4 -1", "1.2.3.4 x", "host.example 5", "1.2.3 5")
    lines = ["uavlinkd stations 1", "7", "short 1.2.3.4 5", "x y", f"{'A' * 43}= 1.2.3.4 5"]
    lines += [f"{base64.b64encode(KEY).decode()} {place}" for place in places]
    (tmp_path / "state").write_text("\n".join(lines))
    disk = StationDisk(tmp_path / "state")
    assert disk.open() == {}
    assert int.from_bytes(disk.timestamp()[:8], "big") == 2**62 + 8


def test_folder_that_cannot_be_written_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(BindError, match="cannot be written"):
        StationDisk(tmp_path / "absent" / "state").open()
