"""Daemons with two networks each: real interfaces that are taken down, changed, removed and plugged in again."""

from __future__ import annotations

from time import monotonic

import pytest

from tests.compose.test_namespaces import can_make_namespaces
from tests.daemon.harness import Stage
from tests.daemon.two_networks import LTE, MESH, PORT, TwoNetworks, address_of, interface_of
from tests.faults.talk import CriticalVoice
from tests.needs import need


def need_namespaces() -> None:
    """Skip a test without them."""
    need(can_make_namespaces(), "root, and iproute2 with network namespaces")


async def test_both_networks_are_reported(stage: Stage) -> None:
    """With interface, addresses and ports: the port of `listen` for IPv4."""
    need_namespaces()
    async with TwoNetworks(stage) as networks:
        await networks.start()
        for network in (LTE, MESH):
            status = await networks.until_present(network)
            assert (status["interface"], status["address"]) == (interface_of(network), None)
            assert status["addresses"][0] == address_of(network, 1)
            assert PORT in status["ports"]
            appeared = await networks.vehicle.until_logged("network_appeared", network=network)
            assert appeared["addresses"][0] == address_of(network, 1)


async def test_interface_that_is_set_down_and_up(stage: Stage) -> None:
    """Its socket is opened again, and traffic goes on along the other network meanwhile."""
    need_namespaces()
    async with TwoNetworks(stage) as networks:
        await networks.start()
        await networks.ip("link", "set", interface_of(LTE), "down")
        status = await networks.until_present(LTE, is_present=False)
        assert status["absent_because"] == f"the interface {interface_of(LTE)} is down"
        assert (await networks.vehicle.until_logged("network_disappeared"))["network"] == LTE
        await networks.until_path(MESH)
        await networks.talk.back(monotonic())
        await networks.ip("link", "set", interface_of(LTE), "up")
        await networks.until_present(LTE)
        # Now the other one goes: the new socket carries the link.
        await networks.ip("link", "set", interface_of(MESH), "down")
        await networks.until_present(MESH, is_present=False)
        await networks.until_path(LTE)
        await networks.talk.back(monotonic())
        networks.talk.check_no_copies()


async def test_interface_that_is_removed_and_plugged_in_again(stage: Stage) -> None:
    """It has another number: a socket that is bound to the old one would stay mute."""
    need_namespaces()
    async with TwoNetworks(stage) as networks:
        await networks.start()
        before = await networks.vehicle.until_logged("network_appeared", network=MESH)
        await networks.ip("link", "delete", interface_of(MESH))
        status = await networks.until_present(MESH, is_present=False)
        assert status["absent_because"] == f"there is no interface {interface_of(MESH)}"
        await networks.plug_in(MESH)
        await networks.configure(MESH)
        await networks.until_present(MESH)
        seen = networks.vehicle.events("network_appeared", network=MESH)
        after = await networks.vehicle.until_logged("network_appeared", network=MESH)
        assert len(seen) <= 2
        assert after["interface_index"] != before["interface_index"]
        await networks.ip("link", "set", interface_of(LTE), "down")
        await networks.until_path(MESH)
        await networks.talk.back(monotonic())


async def test_address_that_changes(stage: Stage) -> None:
    """As after a new lease: the log has it, and the link of that network goes on with the new address."""
    need_namespaces()
    async with TwoNetworks(stage) as networks:
        await networks.start()
        await networks.ip("link", "set", interface_of(MESH), "down")
        await networks.until_present(MESH, is_present=False)
        await networks.ip("address", "flush", "dev", interface_of(LTE))
        await networks.configure(LTE, place=7)
        changed = await networks.vehicle.until(
            lambda status: address_of(LTE, 7) in status["networks"][LTE]["addresses"]
        )
        assert address_of(LTE, 1) not in changed["networks"][LTE]["addresses"]
        await networks.talk.back(monotonic())
        status = await networks.ground.until(
            lambda status: status["peers"]["drone0"]["path"] == f"{address_of(LTE, 7)}:{PORT}"
        )
        assert status["peers"]["drone0"]["state"] == "up"


async def test_network_that_is_absent_at_the_start(stage: Stage) -> None:
    """The daemon starts without it, and uses it as soon as it is there."""
    need_namespaces()
    async with TwoNetworks(stage) as networks:
        await networks.ip("link", "delete", interface_of(MESH))
        await networks.start()
        waiting = await networks.vehicle.until_logged("network_not_here_yet")
        assert (waiting["network"], waiting["reason"]) == (MESH, f"there is no interface {interface_of(MESH)}")
        await networks.plug_in(MESH)
        await networks.configure(MESH)
        await networks.until_present(MESH)
        await networks.ip("link", "set", interface_of(LTE), "down")
        await networks.until_path(MESH)
        await networks.talk.back(monotonic())


async def test_two_networks_on_one_interface(stage: Stage) -> None:
    """Each with an address of its own; one address is taken away and returns."""
    need_namespaces()
    async with TwoNetworks(stage) as networks:
        await networks.ip("link", "delete", interface_of(MESH))
        await networks.ip("address", "add", f"{address_of(LTE, 11)}/24", "dev", interface_of(LTE))
        networks.vehicle.config["network"] = [
            {"name": "one", "address": address_of(LTE, 1)},
            {"name": "two", "address": address_of(LTE, 11)},
        ]
        networks.vehicle.config["peer"][0]["addresses"] = [f"{address_of(LTE, 2)}:{PORT}"]
        networks.ground.config["peer"][0]["addresses"] = []
        await networks.start()
        for network, place, other in (("one", 1, 11), ("two", 11, 1)):
            await networks.ip("address", "delete", f"{address_of(LTE, place)}/24", "dev", interface_of(LTE))
            # Deleting a first address takes the others of its subnet with it.
            await networks.ip("address", "replace", f"{address_of(LTE, other)}/24", "dev", interface_of(LTE))
            status = await networks.until_present(network, is_present=False)
            assert status["absent_because"] == f"no interface has {address_of(LTE, place)}"
            await networks.until_path(LTE, networks.ground, other)
            await networks.talk.back(monotonic())
            await networks.ip("address", "replace", f"{address_of(LTE, place)}/24", "dev", interface_of(LTE))
            await networks.until_present(network)


async def test_an_interface_and_an_address_of_it_share_a_port(stage: Stage) -> None:
    """Both sockets are open; another process cannot take the port from them."""
    need_namespaces()
    async with TwoNetworks(stage) as networks:
        networks.vehicle.config["network"] = [
            {"name": LTE, "interface": interface_of(LTE)},
            {"name": "exact", "address": address_of(LTE, 1)},
        ]
        networks.vehicle.config["peer"][0]["addresses"] = [f"{address_of(LTE, 2)}:{PORT}"]
        await networks.start()
        for network in (LTE, "exact"):
            assert PORT in (await networks.until_present(network))["ports"]
        thief = stage.daemon("thief", [f"0.0.0.0:{PORT}"])
        thief.config["network"] = [{"name": "exact", "address": address_of(LTE, 1)}]
        thief.add_peer(networks.ground, [])
        thief.launcher = networks.vehicle.launcher
        await thief.start()
        assert await thief.ended() == 1
        assert "network (exact)" in "\n".join(thief.lines)


@pytest.mark.long
async def test_no_critical_frame_is_lost_while_networks_come_and_go(stage: Stage) -> None:
    """Down and up, removed and plugged in again, another address: one at a time, 50 frames/s in both directions."""
    need_namespaces()
    async with TwoNetworks(stage) as networks:
        await networks.start(CriticalVoice)
        await networks.until_usable(LTE, MESH)
        began = monotonic()
        for network in (LTE, MESH):
            await networks.ip("link", "set", interface_of(network), "down")
            await networks.until_present(network, is_present=False)
            await networks.ip("link", "set", interface_of(network), "up")
            await networks.until_present(network)
            await networks.until_usable(network)
        await networks.ip("link", "delete", interface_of(LTE))
        await networks.until_present(LTE, is_present=False)
        await networks.plug_in(LTE)
        await networks.configure(LTE)
        await networks.until_usable(LTE)
        await networks.ip("address", "flush", "dev", interface_of(MESH))
        await networks.configure(MESH, place=7)
        await networks.vehicle.until(lambda status: status["networks"][MESH]["addresses"][0] == address_of(MESH, 7))
        ended = monotonic()
        await networks.talk.check_lost_none(began, ended, networks.vehicle, networks.ground)
        networks.talk.check_no_copies()
        sent = [len([at for at in voice.sent_at.values() if began <= at < ended]) for voice in networks.talk.voices]
        print(f"critical frames: {sent} sent in {ended - began:.1f} s, {networks.talk.lost(began, ended)} lost")


async def test_network_that_carries_nothing_disturbs_no_traffic(stage: Stage) -> None:
    """A metered network is removed and plugged in again: the frames along the other one all arrive."""
    need_namespaces()
    async with TwoNetworks(stage) as networks:
        for daemon in (networks.vehicle, networks.ground):
            daemon.config["network"][1]["metered"] = True
        await networks.start()
        await networks.until_usable(LTE, MESH)
        await networks.until_path(LTE)
        await networks.until_path(LTE, networks.ground)
        began = monotonic()
        await networks.ip("link", "delete", interface_of(MESH))
        await networks.until_present(MESH, is_present=False)
        await networks.plug_in(MESH)
        await networks.configure(MESH)
        await networks.until_present(MESH)
        await networks.talk.check_lost_none(began, monotonic(), networks.vehicle, networks.ground)
        networks.talk.check_no_copies()


@pytest.mark.long
async def test_check_shows_what_each_network_reaches(stage: Stage) -> None:
    """Addresses of peers, routes that are missing, strict filters, missing rules."""
    need_namespaces()
    elsewhere = "203.0.113.7:5790"
    async with TwoNetworks(stage) as networks:
        peer = networks.vehicle.config["peer"][0]
        genuine = peer["addresses"]
        status, says = await networks.check()
        assert status == 0
        for network in (LTE, MESH):
            here = (
                f"{network} interface {interface_of(network)}, not metered, no budget; has {address_of(network, 1)}"
            )
            assert here in says
            assert f"reaches drone1 {address_of(network, 2)}:{PORT}" in says
        assert "this machine: network" not in says

        # No route leads there from either network: an error.
        peer["addresses"] = [*genuine, elsewhere]
        status, says = await networks.check()
        assert status == 1
        assert f'error: peer "drone1": no network reaches {elsewhere}: "lte", "mesh" have no route to it' in says

        # One has a route: a note about the other, and one about the filter there.
        await networks.ip("route", "add", "default", "via", address_of(LTE, 2))
        status, says = await networks.check()
        assert status == 0
        assert f"does not reach drone1 {elsewhere}" in says
        assert f'network "mesh": it has no route to drone1 {elsewhere}' in says
        await networks.ip("route", "add", "default", "via", address_of(MESH, 2), "metric", "100")
        await networks.run("sysctl", "-qw", f"net.ipv4.conf.{interface_of(MESH)}.rp_filter=1")
        status, says = await networks.check()
        assert (status, "has no route" in says) == (0, False)
        assert f'network "mesh": rp_filter = 1 on {interface_of(MESH)}' in says
        assert 'network "lte": rp_filter' not in says

        # An address leaves by the interface that the routes select, unless there is a rule.
        networks.vehicle.config["network"][1] = {"name": MESH, "address": address_of(MESH, 1)}
        status, says = await networks.check()
        assert f"datagrams from {address_of(MESH, 1)} to drone1 {elsewhere} leave by {interface_of(LTE)}" in says
        await networks.ip("rule", "add", "from", address_of(MESH, 1), "table", "100")
        await networks.ip("route", "add", "default", "via", address_of(MESH, 2), "table", "100")
        status, says = await networks.check()
        assert "this machine: network" not in says

        # An interface and its own address; an absent interface.
        networks.vehicle.config["network"][0] = {"name": LTE, "interface": interface_of(MESH)}
        networks.vehicle.config["network"].append({"name": "third", "interface": "absent0"})
        status, says = await networks.check()
        assert f'networks "lte" and "mesh" share {address_of(MESH, 1)}' in says
        assert 'network "third": there is no interface absent0 now' in says
