"""The folder of recordings: whole records, bounded files, and deletion of our oldest files only."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.daemon.frames import frame
from uavlinkd.config.model import Recording
from uavlinkd.lab.sim.tlog import read_tlog
from uavlinkd.ops import tlog_files
from uavlinkd.ops.tlog_files import SYNC_INTERVAL_S, TlogFolder

DAY_S = 1_700_000_000


def record(number: int) -> bytes:
    """A genuine record of 34 bytes, one second after the record before."""
    return ((DAY_S + number) * 1_000_000).to_bytes(8) + frame(number)


SIZE = len(record(1))


@pytest.fixture(autouse=True)
def small_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """Records before the next file."""
    monkeypatch.setattr(tlog_files, "MAX_FILE_BYTES", 10 * SIZE)


@pytest.fixture
def single_records(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each record has a file of its own."""
    monkeypatch.setattr(tlog_files, "MAX_FILE_BYTES", SIZE)


def folder_at(path: Path, max_files: int = 100, min_free_bytes: int = 0) -> TlogFolder:
    """A folder with these settings."""
    return TlogFolder(Recording(path / "flights", max_files, min_free_bytes))


def kept(path: Path) -> dict[str, list[bytes]]:
    """The content of the files, in the order of their names."""
    return {
        file.name: [entry.time_us.to_bytes(8) + entry.frame for entry in read_tlog(file).records]
        for file in sorted((path / "flights").iterdir())
    }


def test_each_peer_has_a_private_file(tmp_path: Path) -> None:
    """Its name has number, time and peer; the folder is created."""
    folder = folder_at(tmp_path)
    assert folder.append("drone1", [record(1), record(2)], 0, 0.0) == 2 * SIZE
    folder.append("drone2", [record(3)], 0, 0.0)
    folder.append("drone1", [record(4)], 0, 1.0)
    folder.close()
    assert kept(tmp_path) == {
        "00000001-20231114T221321Z-drone1.tlog": [record(1), record(2), record(4)],
        "00000002-20231114T221323Z-drone2.tlog": [record(3)],
    }
    assert {file.stat().st_mode & 0o777 for file in (tmp_path / "flights").iterdir()} == {0o600}
    assert (tmp_path / "flights").stat().st_mode & 0o777 == 0o700


@given(batches=st.lists(st.integers(1, 40), min_size=1, max_size=12))
@settings(max_examples=30)
def test_batches_of_any_size_are_written_in_order(
    tmp_path_factory: pytest.TempPathFactory, batches: list[int]
) -> None:
    """Every record is written once, and no record is behind the limit of a file but those of its last batch."""
    path = tmp_path_factory.mktemp("any")
    folder = folder_at(path, max_files=1000)
    records = [record(number) for number in range(sum(batches))]
    at = 0
    for count in batches:
        folder.append("drone1", records[at : at + count], 0, 0.0)
        at += count
    folder.close()
    files = kept(path)
    assert [entry for file in files.values() for entry in file] == records
    assert all(len(entries) < 10 + max(batches) for entries in files.values())


@pytest.mark.usefixtures("single_records")
def test_oldest_are_deleted_for_the_newest_by_number(tmp_path: Path) -> None:
    """The time does not matter: a drone that boots in 1970 keeps today's flight."""
    folder = folder_at(tmp_path, max_files=3)
    for number in range(5):
        folder.append("drone1", [bytes(8) + frame(number)], 0, 0.0)
    folder.close()
    assert [name[:17] for name in kept(tmp_path)] == [f"0000000{number}-19700101" for number in (3, 4, 5)]


def test_numbers_continue_after_a_restart(tmp_path: Path) -> None:
    """The earlier recordings are ours too."""
    for number in range(3):
        folder = folder_at(tmp_path, max_files=2)
        folder.append("drone1", [record(number)], 0, 0.0)
        folder.close()
    assert [name[:8] for name in kept(tmp_path)] == ["00000002", "00000003"]


@pytest.mark.usefixtures("single_records")
def test_other_files_are_never_deleted(tmp_path: Path) -> None:
    """They stay on a full disk too."""
    (tmp_path / "flights").mkdir()
    others = [
        "flight.tlog",
        "00000000-notes.txt",
        "1-20231114T221321Z-drone1.tlog",
        "x00000001-20231114T221321Z-a.tlog",
    ]
    for name in others:
        (tmp_path / "flights" / name).write_text("precious")
    folder = folder_at(tmp_path, max_files=2)
    for number in range(9):
        folder.append("drone1", [record(number)], 0, 0.0)
    folder.close()
    assert all((tmp_path / "flights" / name).read_text() == "precious" for name in others)
    assert len(list((tmp_path / "flights").iterdir())) == len(others) + 2


def test_open_file_is_not_deleted(tmp_path: Path) -> None:
    """With more peers than files, each peer keeps its open file."""
    folder = folder_at(tmp_path, max_files=2)
    for number in range(4):
        folder.append(f"drone{number}", [record(number)], 0, 0.0)
    folder.append("drone0", [record(9)], 0, 0.0)
    folder.close()
    assert [len(records) for records in kept(tmp_path).values()] == [2, 1, 1, 1]


@pytest.mark.usefixtures("single_records")
def test_reserved_space_stays_free(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The oldest files are deleted, then writing stops, and resumes with free space."""
    folder = folder_at(tmp_path, min_free_bytes=1000)
    for number in range(3):
        folder.append("drone1", [record(number)], 0, 0.0)
    extra = [0]  # what the disk has left beside the files that were deleted

    def disk(_: int) -> SimpleNamespace:
        there = len(list((tmp_path / "flights").iterdir()))
        return SimpleNamespace(f_bavail=1001 + SIZE - SIZE * there + extra[0], f_frsize=1)

    monkeypatch.setattr(os, "fstatvfs", disk)
    extra[0] = SIZE
    folder.append("drone1", [record(3)], 0, 0.0)
    assert [name[:8] for name in kept(tmp_path)] == ["00000003", "00000004"]
    extra[0] = -1
    with pytest.raises(OSError) as caught:  # noqa: PT011  the number is looked at
        folder.append("drone1", [record(4)], 0, 0.0)
    assert caught.value.errno == errno.ENOSPC
    folder.close()
    assert kept(tmp_path) == {}
    extra[0] = SIZE
    folder.append("drone1", [record(5)], 0, 0.0)
    folder.close()
    assert list(kept(tmp_path).values()) == [[record(5)]]


@pytest.mark.parametrize("fault", ["error", "short"])
def test_partial_record_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: str) -> None:
    """After a short write or an error, the file ends with a whole record. An empty file is deleted."""
    folder = folder_at(tmp_path)
    folder.append("drone1", [record(1)], 0, 0.0)
    write = os.write

    def failing(descriptor: int, data: bytes) -> int:
        write(descriptor, data[:5])
        if fault == "error":
            raise OSError(errno.EIO, "broken")
        return 5

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", failing)
        for peer in ("drone1", "drone2"):
            with pytest.raises(OSError):  # noqa: PT011
                folder.append(peer, [record(2)], 0, 0.0)
    folder.append("drone1", [record(3)], 0, 0.0)
    folder.close()
    assert list(kept(tmp_path).values()) == [[record(1)], [record(3)]]


def test_symbolic_link_is_not_followed(tmp_path: Path) -> None:
    """An attacker who predicts a name cannot redirect the file."""
    (tmp_path / "flights").mkdir()
    (tmp_path / "elsewhere").write_text("precious")
    folder = folder_at(tmp_path)
    folder.append("drone1", [record(0)], 0, 0.0)
    (tmp_path / "flights" / "00000002-20231114T221321Z-drone2.tlog").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(FileExistsError):
        folder.append("drone2", [record(1)], 0, 0.0)
    folder.close()
    assert (tmp_path / "elsewhere").read_text() == "precious"


def test_files_are_synced_for_a_power_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every few seconds, written records are flushed to the disk."""
    folder = folder_at(tmp_path)
    synced: list[int] = []
    monkeypatch.setattr(os, "fdatasync", synced.append)
    folder.append("drone1", [record(1)], 0, 100.0)
    folder.append("drone1", [record(2)], 0, 100.0 + SYNC_INTERVAL_S - 0.001)
    assert len(synced) == 1
    folder.append("drone1", [record(3)], 0, 100.0 + SYNC_INTERVAL_S)
    assert len(synced) == 2
    folder.close()
