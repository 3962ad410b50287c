"""Fleets with relays: their files, and daemons that meet at the relay after a change of keys."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from tests.fleet.vehicles import NAMES, RELAY, Vehicles, flying, loaded
from tests.waiting import until
from uavlinkd.fleet import operations
from uavlinkd.fleet.manifest import NO_PLAN, FleetError, FleetSettings, MemberKind, read_manifest
from uavlinkd.fleet.transaction import check_members
from uavlinkd.system.addresses import Address

AT = Address("relay.example.org", 5790)


def check_fleet(folder: Path) -> None:
    """Every daemon accepts its files, and each end of a link to a relay has the keys that the other one has."""
    fleet = read_manifest(folder)
    check_members(folder, fleet.members)
    configs = {member.name: loaded(folder, member.name) for member in fleet.members}
    public = {config.public_key: name for name, config in configs.items()}
    for relay in fleet.relays:
        server = configs[relay.name].relay_server
        assert server is not None
        members = {member.peer.public_key: member.peer.psk for member in server.members}
        users = [member.name for member in fleet.members if not member.is_relay]
        assert {public[key] for key in members if key in public} == set(users)
        for name in users:
            config = configs[name]
            own = {public[one.settings.public_key]: one.settings for one in config.relays}
            assert own[relay.name].psk == members[config.public_key]
            assert (own[relay.name].psk is not None) == fleet.settings.psk
            assert all(peer.settings.link.confidential for peer in config.peers)
            assert not config.warnings


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A fleet that meets at two relays."""
    folder = tmp_path / "fleet"
    other = Address("198.51.100.7", 6000)
    operations.init(folder, FleetSettings(address_plan=NO_PLAN, psk=True), 2, 1, 1, [AT, other])
    return folder


def test_fleet_meets_at_its_relays(folder: Path) -> None:
    """Members need no addresses and no open port. The relays listen in both families."""
    check_fleet(folder)
    drone, relay = loaded(folder, "drone1"), loaded(folder, "relay2")
    assert drone.listen == ()
    assert [peer.addresses for peer in drone.peers] == [()] * 3
    assert [peer.relays for peer in drone.peers] == [("relay1", "relay2")] * 3
    assert relay.is_only_relay
    assert list(map(str, relay.listen)) == ["0.0.0.0:6000", "[::]:6000"]
    assert [str(one) for one in drone.relays[1].addresses] == ["198.51.100.7:6000"]


def test_commands_keep_relays_and_members_in_step(folder: Path) -> None:
    """Each command changes the files of both."""
    operations.add(folder, "scout", MemberKind.DRONE)
    check_fleet(folder)
    operations.remove(folder, "drone2")
    operations.remove(folder, "relay2")
    check_fleet(folder)
    for name in ("drone1", "relay1"):
        operations.rotate(folder, name)
        check_fleet(folder)


def test_relay_comes_to_a_fleet_that_flies(tmp_path: Path) -> None:
    """Links that may go along it are encrypted from then on; edits stay."""
    folder = tmp_path / "fleet"
    operations.init(folder, FleetSettings(), 2, 0, 0)
    path = folder / "drone1" / "drone1.toml"
    text = path.read_text().replace("[link]\nsuites", "[link]  # ours\nconfidential = false\nsuites")
    path.write_text(text)
    bare = folder / "drone2" / "drone2.toml"
    bare.write_text(bare.read_text().replace('[link]\nsuites = ["x25519"]\n', ""))
    operations.add(folder, "relay", MemberKind.RELAY, address=AT)
    check_fleet(folder)
    assert "[link]  # ours\nconfidential = true\n" in path.read_text()
    assert [peer.addresses != () for peer in loaded(folder, "drone1").peers] == [True]


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        pytest.param({}, "needs --address", id="without-address"),
        pytest.param({"address": AT, "system_id": 7}, "has no system id", id="with-id"),
        pytest.param({"address": Address("198.51.100.8", 5790)}, "at most 3 relays", id="too-many"),
        pytest.param({"address": AT}, "the address of relay1", id="same-address"),
    ],
)
def test_impossible_relays_are_refused(folder: Path, options: dict[str, object], reason: str) -> None:
    """With the reason, and without a change."""
    if "at most" in reason:
        operations.add(folder, "relay3", MemberKind.RELAY, address=Address("198.51.100.9", 5790))
    before = read_manifest(folder)
    with pytest.raises(FleetError, match=reason):
        operations.add(folder, "another", MemberKind.RELAY, **options)  # type: ignore[arg-type]
    assert read_manifest(folder) == before


@pytest.fixture
async def vehicles() -> AsyncIterator[Vehicles]:
    """Three drones that meet at their relay."""
    async with flying(with_relay=True) as vehicles:
        yield vehicles


def is_met(vehicles: Vehicles) -> bool:
    """Whether the relay connects all pairs, and each drone has a path along it to each other one."""
    relay = vehicles.status(RELAY).get("relay", {})
    return relay.get("connections") == 3 and all(
        any(path["relay"] == RELAY for path in peer["paths"])
        for name in NAMES
        for peer in vehicles.peers(name).values()
    )


@pytest.mark.long
@pytest.mark.parametrize("rotated", ["drone1", RELAY])
async def test_key_changes_while_the_fleet_flies(vehicles: Vehicles, rotated: str) -> None:
    """All meet at the relay with the new key once they have their files."""
    operations.rotate(vehicles.fleet, rotated)
    for name in (*NAMES, RELAY):
        await vehicles.renew(name, restart=name == rotated)
    await vehicles.until_linked()
    await until(lambda: is_met(vehicles))
    members = vehicles.status(RELAY)["relay"]["members"]
    assert {name: member["is_up"] for name, member in members.items()} == dict.fromkeys(NAMES, True)
