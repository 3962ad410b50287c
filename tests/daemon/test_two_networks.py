"""Daemons with two networks each: real interfaces that are taken down, changed, removed and plugged in again."""

from __future__ import annotations

from time import monotonic

import pytest

from tests.daemon.harness import Stage
from tests.daemon.two_hosts import LTE, MESH, PORT, TwoHosts, address_of, interface_of
from tests.namespaces import need_namespaces

pytestmark = pytest.mark.long


async def test_interface_that_is_removed_and_plugged_in_again(stage: Stage) -> None:
    """Absent at the start, then there, then with another number: a socket bound to the old one would stay mute."""
    need_namespaces()
    async with TwoHosts(stage) as networks:
        networks.ip(f"link delete {interface_of(MESH)}")
        await networks.start()
        waiting = await networks.vehicle.until_logged("network_not_here_yet")
        assert (waiting["network"], waiting["reason"]) == (MESH, f"there is no interface {interface_of(MESH)}")
        networks.plug_in(MESH)
        before = await networks.vehicle.until_logged("network_appeared", network=MESH)
        networks.ip(f"link delete {interface_of(MESH)}")
        status = await networks.until_present(MESH, is_present=False)
        assert status["absent_because"] == f"there is no interface {interface_of(MESH)}"
        networks.plug_in(MESH)
        await networks.until_present(MESH)
        seen = networks.vehicle.events("network_appeared", network=MESH)
        after = await networks.vehicle.until_logged("network_appeared", network=MESH)
        assert len(seen) <= 2
        assert after["interface_index"] != before["interface_index"]
        networks.ip(f"link set {interface_of(LTE)} down")
        await networks.until_path(MESH)
        await networks.talk.back(monotonic())


async def test_check_shows_what_each_network_reaches(stage: Stage) -> None:
    """Addresses of peers, routes that are missing, strict filters, missing rules."""
    need_namespaces()
    elsewhere = "203.0.113.7:5790"
    async with TwoHosts(stage) as networks:
        peer = networks.vehicle.config["peer"][0]
        genuine = peer["addresses"]
        status, says = networks.check()
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
        status, says = networks.check()
        assert status == 1
        assert f'error: peer "drone1": no network reaches {elsewhere}: "lte", "mesh" have no route to it' in says

        # One has a route: a note about the other, and one about the filter there.
        networks.ip(f"route add default via {address_of(LTE, 2)}")
        status, says = networks.check()
        assert status == 0
        assert f"does not reach drone1 {elsewhere}" in says
        assert f'network "mesh": it has no route to drone1 {elsewhere}' in says
        networks.ip(f"route add default via {address_of(MESH, 2)} metric 100")
        networks.run(f"sysctl -qw net.ipv4.conf.{interface_of(MESH)}.rp_filter=1")
        status, says = networks.check()
        assert (status, "has no route" in says) == (0, False)
        assert f'network "mesh": rp_filter = 1 on {interface_of(MESH)}' in says
        assert 'network "lte": rp_filter' not in says

        # An address leaves by the interface that the routes select, unless there is a rule.
        networks.vehicle.config["network"][1] = {"name": MESH, "address": address_of(MESH, 1)}
        status, says = networks.check()
        assert f"datagrams from {address_of(MESH, 1)} to drone1 {elsewhere} leave by {interface_of(LTE)}" in says
        networks.ip(f"rule add from {address_of(MESH, 1)} table 100")
        networks.ip(f"route add default via {address_of(MESH, 2)} table 100")
        status, says = networks.check()
        assert "this machine: network" not in says

        networks.vehicle.config["network"].append({"name": "third", "interface": "absent0"})
        status, says = networks.check()
        assert 'network "third": there is no interface absent0 now' in says
