"""Daemons with two networks each: real interfaces that are taken down, changed, removed and plugged in again."""

from __future__ import annotations

from time import monotonic

from tests.namespaces import need_namespaces
from tests.processes.harness import Stage
from tests.processes.two_hosts import LTE, MESH, TwoHosts, interface_of


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
