"""Bulletins handed to a daemon, which is the control socket and the rules of one here."""

from __future__ import annotations

import asyncio
import shutil
from base64 import b64decode, b64encode
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from tests.fleet.folders import create, loaded, unasked
from uavlinkd.authority.certificates import parse_bulletin
from uavlinkd.authority.enrolment import FleetError
from uavlinkd.authority.trust import Trust
from uavlinkd.cli import main
from uavlinkd.fleet import operations
from uavlinkd.fleet.manifest import read_manifest
from uavlinkd.ops import commands
from uavlinkd.ops.control import MAX_REQUEST_BYTES, Answer, ControlServer
from uavlinkd.system.addresses import Address

RELAYS = (Address("relay.example.org", 5790),)


class Daemon:
    """A relay's trust behind its control socket."""

    def __init__(self, folder: Path) -> None:
        self.socket = folder / "control.sock"
        fleet = loaded(folder / "fleet", "relay").fleet
        assert fleet is not None
        relay = read_manifest(folder / "fleet").member("relay")
        self.trust = Trust(fleet.authority, relay.public_key, relay.signed, relay_bulletin(folder))
        self.certificates: list[str] = []

    def answer(self, request: str) -> Answer:
        """As the daemon's own."""
        assert len(request) < MAX_REQUEST_BYTES
        words = request.split()
        if words == ["bulletin"]:
            return {"bulletin": b64encode(self.trust.bulletin_bytes).decode()}
        self.certificates += words[2:]
        verdict, _ = self.trust.receive_bulletin(b64decode(words[1]))
        return {"verdict": verdict.value, "number": self.trust.bulletin.number}


def relay_bulletin(folder: Path) -> bytes:
    return read_manifest(folder / "fleet").published


@pytest.fixture
async def daemon(tmp_path: Path) -> AsyncIterator[Daemon]:
    """The relay of a fleet with forty drones."""
    create(tmp_path / "fleet", drones=40, relays=RELAYS)
    daemon = Daemon(tmp_path)
    server = ControlServer(daemon.socket, daemon.answer)
    await server.start()
    yield daemon
    await server.stop()


async def published(daemon: Daemon, folder: str = "fleet", **options: bool) -> int:
    """The number that the folder has afterwards."""
    place = daemon.socket.parent / folder
    fleet = await asyncio.to_thread(operations.publish, place, daemon.socket, unasked, **options)
    assert fleet == read_manifest(place)
    assert daemon.trust.bulletin == fleet.bulletin
    return fleet.bulletin.number


async def test_bulletin_reaches_the_daemon(daemon: Daemon) -> None:
    """Once more changes nothing. `remove` revokes and publishes. All members are named, also before they come."""
    assert await published(daemon) == 1
    operations.revoke(daemon.socket.parent / "fleet", "drone7", unasked)
    assert await published(daemon) == 2
    assert await published(daemon) == 2
    command = [
        "fleet",
        "remove",
        "drone8",
        "--out",
        str(daemon.socket.parent / "fleet"),
        "--socket",
        str(daemon.socket),
    ]
    assert await asyncio.to_thread(main, command) == 0
    assert daemon.trust.bulletin.revoked == (8, 9)
    assert len(daemon.certificates) == 41 + 40 + 40 + 39


def test_removal_without_a_service_revokes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """No daemon runs on the laptop: the bulletin is signed all the same. A wrong name is named."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(commands, "RUNTIME_FOLDER", tmp_path / "none")
    create(tmp_path / "fleet", drones=2, relays=RELAYS)
    assert main(["fleet", "remove", "nosuch"]) == 2
    assert 'this fleet has no "nosuch": its members are relay, drone1, drone2' in capsys.readouterr().err
    assert main(["fleet", "remove", "drone2"]) == 1
    assert "drone2 is revoked, by bulletin 2." in capsys.readouterr().out
    assert read_manifest(tmp_path / "fleet").former("drone2") is not None


async def test_older_folder_is_refused_unless_it_is_merged(daemon: Daemon) -> None:
    """A copy of the folder does not know what the newer one revoked."""
    folder = daemon.socket.parent
    shutil.copytree(folder / "fleet", folder / "old")
    operations.revoke(folder / "fleet", "drone7", unasked)
    await published(daemon)
    with pytest.raises(FleetError, match="the fleet has bulletin 2, this folder 1"):
        await published(daemon, "old")
    assert await published(daemon, "old", merges=True) == 3
    assert daemon.trust.bulletin.revoked == (8,)


async def test_two_bulletins_of_one_number_are_merged(daemon: Daemon) -> None:
    """Two copies of the folder revoked different members."""
    folder = daemon.socket.parent
    shutil.copytree(folder / "fleet", folder / "copy")
    operations.revoke(folder / "fleet", "drone7", unasked)
    operations.revoke(folder / "copy", "drone8", unasked)
    await published(daemon)
    assert await published(daemon, "copy") == 3
    assert daemon.trust.bulletin.revoked == (8, 9)
    assert parse_bulletin(relay_bulletin(folder)) != daemon.trust.bulletin
    with pytest.raises(FleetError, match="the fleet has bulletin 3, this folder 2"):
        await published(daemon)


async def test_daemon_of_another_fleet_is_refused(daemon: Daemon) -> None:
    """Nothing is handed to it."""
    folder = daemon.socket.parent
    create(folder / "other", relays=RELAYS)
    with pytest.raises(FleetError, match="member of another one"):
        await published(daemon, "other")


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        ({}, "refused bulletin 1: None"),
        ({"verdict": "bulletin_shrinks"}, "refused bulletin 1: bulletin_shrinks"),
        ({"bulletin": "é"}, "has no bulletin of this fleet"),
        ({"bulletin": None}, "has no bulletin of this fleet"),
    ],
)
async def test_daemon_that_refuses_a_bulletin(
    daemon: Daemon, tmp_path: Path, answer: dict[str, object], reason: str
) -> None:
    """Its verdict is in the error, and an answer of another form is one too."""
    answer = {"bulletin": b64encode(relay_bulletin(tmp_path)).decode(), **answer}
    daemon.socket = tmp_path / "other.sock"
    server = ControlServer(daemon.socket, lambda _: answer)
    await server.start()
    with pytest.raises(FleetError, match=reason):
        await published(daemon)
    await server.stop()
