"""Two daemons of different versions of the protocol: the log and `status` name the older side, and what to do."""

from __future__ import annotations

from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess
from tests.link.found import findings, until_found
from uavlinkd.core.constants import PROTOCOL_VERSION
from uavlinkd.ops.causes import Cause

NEWER = PROTOCOL_VERSION + 1


async def remedy_shown(daemon: DaemonProcess, peer: DaemonProcess, name: str) -> str:
    """The remedy in the finding of a daemon about its peer. Its log has a line, and no key seems to be wrong."""
    finding = await until_found(daemon, Cause.OTHER_VERSION, name)
    line = await daemon.until_logged("datagrams_dropped", reason="other_version")
    assert "update the older side" in line["meaning"]
    status = await daemon.status()
    assert not {Cause.WRONG_KEY_HERE, Cause.WRONG_KEY_THERE} & set(findings(status, "peer", name))
    assert status["drops"].get("other_version", 0) >= 1
    assert "bad_mac1" not in status["drops"]
    assert peer.address in line["last"]
    assert peer.address in finding["text"]
    return str(finding["remedy"])


async def test_both_name_the_older_side_if_both_initiate() -> None:
    """Each receives the initiations of the other, and both give the same advice."""
    async with Stage() as stage:
        older, newer = stage.pair()
        newer.protocol_version = NEWER
        await stage.start(older, newer, linked=False)
        for daemon, peer in ((older, newer), (newer, older)):
            remedy = await remedy_shown(daemon, peer, peer.name)
            assert remedy.startswith(f"update uavlinkd at {older.name}")
        (line, *_) = older.events("datagrams_dropped", reason="other_version")
        assert f"uavlink/{NEWER}, newer than uavlink/{PROTOCOL_VERSION} of this daemon" in line["last"]


async def test_side_that_only_initiates_sees_silence() -> None:
    """It gets no answer, as from a daemon that is off. The side without its address names the version."""
    async with Stage() as stage:
        drone, ground = stage.daemon("drone0"), stage.daemon("ground")
        psk = stage.psk()
        drone.add_peer(ground, [ground.address], psk)
        ground.add_peer(drone, [], psk)
        ground.protocol_version = NEWER
        await stage.start(drone, ground, linked=False)
        assert (await remedy_shown(ground, drone, "drone0")).startswith("update uavlinkd at drone0")
        finding = await until_found(drone, Cause.NO_ANSWER, "ground")
        assert "versions differ" in finding["text"]
        assert "run `uavlinkd status` at ground" in finding["remedy"]
        assert (await drone.status())["drops"] == {}


async def test_side_that_waits_for_several_peers_names_the_address() -> None:
    """It cannot tell which of them it is, and says so: the finding is the daemon's."""
    async with Stage() as stage:
        drone, absent, ground = stage.daemon("drone0"), stage.daemon("drone1"), stage.daemon("ground")
        drone.add_peer(ground, [ground.address])
        for peer in (drone, absent):
            ground.add_peer(peer, [])
        drone.protocol_version = NEWER
        await stage.start(drone, ground, linked=False)
        remedy = await remedy_shown(ground, drone, "")
        assert remedy.startswith("update uavlinkd at ground, this machine")
