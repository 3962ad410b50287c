"""The state on the disk: files that are damaged, foreign or cannot be written, and a power cut at every step."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.authority.signing import AUTHORITY, bulletin, published, signed, vehicle
from uavlinkd.authority import state_file
from uavlinkd.authority.certificates import MOST_REVOKED, Bulletin
from uavlinkd.authority.state_file import FleetState
from uavlinkd.authority.trust import Trust

OWN = bytes((1,)) * 32
KEY = bytes((2,)) * 32
BEFORE = FleetState(bulletin(2), ((KEY, signed(vehicle(2), KEY)),))
AFTER = FleetState(bulletin(3, 9), ((KEY, signed(vehicle(2, 3), KEY)),))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "fleet.state"


def start(path: Path) -> tuple[FleetState, str]:
    """What a daemon knows after its start, and what it reports. Its configuration has the bulletin 1."""
    trust = Trust(AUTHORITY, OWN, signed(vehicle(1), OWN), bulletin(1))
    problem = state_file.read(path, trust)
    members = tuple((key, held.data) for key, held in trust.roster.values())
    return FleetState(trust.bulletin_bytes, members), problem


CONFIGURED = FleetState(bulletin(1))


@pytest.mark.parametrize(
    "state", [BEFORE, FleetState(bulletin(2, *range(3, 3 + MOST_REVOKED)))], ids=["usual", "longest"]
)
def test_state_is_read_back(path: Path, state: FleetState) -> None:
    """Without a file, what the configuration has counts. Beside the file, nothing is left."""
    assert start(path) == (CONFIGURED, "")
    state_file.write(path, state)
    assert start(path) == (state, "")
    assert os.listdir(path.parent) == [path.name]
    assert path.stat().st_size < state_file._MOST_BYTES


def variants(data: bytes) -> Iterator[bytes]:
    """Files that are torn, have one other bit, or something behind."""
    yield from (data[:size] for size in range(len(data)))
    yield from (data[:at] + bytes((data[at] ^ 1,)) + data[at + 1 :] for at in range(len(data)))
    yield data + b"\n"
    yield data.replace(b"\n", b"\r\n")
    yield data + bytes(5000)


def test_damaged_file_counts_as_absent(path: Path) -> None:
    """The cause is reported."""
    state_file.write(path, BEFORE)
    trust = Trust(AUTHORITY, OWN, b"", CONFIGURED.bulletin)
    for data in variants(path.read_bytes()):
        path.write_bytes(data)
        assert state_file.read(path, trust) == f"{path} is incomplete, or was not written by uavlinkd"
    assert trust.bulletin_bytes == CONFIGURED.bulletin


@pytest.mark.parametrize(
    ("data", "verdict"),
    [
        pytest.param(published(Bulletin(b"none", 2, 1, ())), "invalid", id="another fleet"),
        pytest.param(bulletin(2)[:-1] + b"\0", "invalid", id="not signed"),
        pytest.param(bulletin(1, 7), "bulletin_conflict", id="the same number"),
        pytest.param(bulletin(2, least=0), "bulletin_shrinks", id="it shrinks"),
    ],
)
def test_foreign_file_counts_as_absent(path: Path, data: bytes, verdict: str) -> None:
    """Its members are not used either."""
    state_file.write(path, FleetState(data, AFTER.members))
    state, problem = start(path)
    assert state == CONFIGURED
    assert problem.endswith(f"contradicts the configuration ({verdict})")


def test_what_is_not_a_file(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A FIFO does not stop the start."""
    os.mkfifo(path)
    assert start(path) == (CONFIGURED, f"{path} is not a file")
    assert start(path / "below") == (CONFIGURED, f"{path / 'below'} cannot be read: Not a directory")


@pytest.mark.parametrize("cause", ["disk full", "read-only"])
def test_state_that_cannot_be_written(path: Path, cause: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The error says why, and the old state is there."""
    state_file.write(path, BEFORE)

    def fail(*arguments: Any) -> Any:
        raise OSError(28 if cause == "disk full" else 30, cause)

    monkeypatch.setattr(os if cause == "disk full" else Path, "fsync" if cause == "disk full" else "open", fail)
    with pytest.raises(OSError, match=cause):
        state_file.write(path, AFTER)
    monkeypatch.undo()
    assert start(path) == (BEFORE, "")
    assert os.listdir(path.parent) == [path.name]


def test_a_link_under_the_name_of_the_new_file_is_not_followed(path: Path) -> None:
    """Another user of the folder points it at a file that only the daemon may write."""
    other = path.with_name("other")
    other.write_text("kept")
    path.with_name(f".{path.name}.new").symlink_to(other)
    state_file.write(path, AFTER)
    assert other.read_text() == "kept"
    assert start(path) == (AFTER, "")
    assert not path.is_symlink()


class PowerCut(BaseException):
    """No code runs after it."""


class Disk:
    """A folder whose files and names are on the disk only after they were synced. The power is cut at one step.

    Steps are to open a file for writing, to sync it, to rename it, and to sync the folder.
    """

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch, cut_at: int) -> None:
        self.folder, self.cut_at, self.steps = folder, cut_at, 0
        self.synced: dict[int, bytes] = {}
        """By inode."""
        self.names = {path.name: path.stat().st_ino for path in folder.iterdir()}
        """What the synced folder has."""
        self.synced |= {path.stat().st_ino: path.read_bytes() for path in folder.iterdir()}
        open_file, replace = Path.open, Path.replace

        def opened(path: Path, mode: str) -> Any:
            if mode == "xb":
                self._step()
            return open_file(path, mode)

        def renamed(path: Path, to: Path) -> Path:
            self._step()
            return replace(path, to)

        monkeypatch.setattr(Path, "open", opened)
        monkeypatch.setattr(Path, "replace", renamed)
        monkeypatch.setattr(os, "fsync", self._sync)

    def _step(self) -> None:
        if self.steps == self.cut_at:
            raise PowerCut
        self.steps += 1

    def _sync(self, descriptor: int) -> None:
        self._step()
        state = os.fstat(descriptor)
        if stat.S_ISDIR(state.st_mode):
            self.names = {path.name: path.stat().st_ino for path in self.folder.iterdir()}
        else:
            (path,) = (path for path in self.folder.iterdir() if path.stat().st_ino == state.st_ino)
            self.synced[state.st_ino] = path.read_bytes()

    def after_the_cut(self) -> Iterator[dict[str, bytes]]:
        """Everything that may be there: any part of what was not synced, under the old names or the new ones."""
        present = {path.name: path.stat().st_ino for path in self.folder.iterdir()}
        contents = {path.stat().st_ino: path.read_bytes() for path in self.folder.iterdir()}
        for names in (self.names, present):
            for part in (0.0, 0.5, 1.0):
                yield {
                    name: self.synced.get(
                        inode, contents.get(inode, b"")[: int(part * len(contents.get(inode, b"")))]
                    )
                    for name, inode in names.items()
                }


@pytest.mark.parametrize("is_first", [False, True])
def test_power_cut_at_every_step(tmp_path: Path, is_first: bool) -> None:
    """The state is the old one or the new one, never a mixture; the new one as soon as the write has returned."""
    outcomes = list[set[FleetState]]()
    for cut_at in range(20):
        folder = tmp_path / f"{cut_at}"
        folder.mkdir()
        path = folder / "fleet.state"
        if not is_first:
            state_file.write(path, BEFORE)
        has_returned = False
        with pytest.MonkeyPatch.context() as monkeypatch:
            disk = Disk(folder, monkeypatch, cut_at)
            try:
                state_file.write(path, AFTER)
                has_returned = True
            except PowerCut:
                pass
        outcomes.append(set())
        for number, files in enumerate(list(disk.after_the_cut())):
            restarted = tmp_path / f"{cut_at}-{number}"
            restarted.mkdir()
            for name, data in files.items():
                (restarted / name).write_bytes(data)
            state, problem = start(restarted / path.name)
            assert problem == ""
            outcomes[-1].add(state)
            state_file.write(restarted / path.name, AFTER)
            assert start(restarted / path.name) == (AFTER, "")
        if has_returned:
            break
    before = CONFIGURED if is_first else BEFORE
    assert outcomes == [{before}, {before}, {before}, {before, AFTER}, {AFTER}]
