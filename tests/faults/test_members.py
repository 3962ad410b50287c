"""Members by certificate whose clocks are wrong by decades: no effect, and no time on the disk."""

from __future__ import annotations

from pathlib import Path

from tests.faults.clocks import faked_clock
from tests.processes.harness import Stage
from tests.processes.members import CertifiedFleet
from uavlinkd.authority import state_file
from uavlinkd.authority.certificates import MemberRole
from uavlinkd.authority.state_file import FleetState


async def test_clocks_have_no_effect(tmp_path: Path) -> None:
    """A vehicle in 1970 and one in 2106, when 32 bits of seconds are used up. Their links pass a revocation on."""
    fleet = CertifiedFleet()
    async with Stage() as stage:
        ground, past, future = stage.daemon("ground"), stage.daemon("v1", []), stage.daemon("v2", [])
        fleet.join(ground, MemberRole.OPERATOR, 255)
        years = {past: "1970-01-01", future: "2106-02-08"}
        for system_id, (vehicle, day) in enumerate(years.items(), 1):
            vehicle.environ = faked_clock(f"{day} 00:00:00")
            fleet.join(vehicle, MemberRole.VEHICLE, system_id, ground)
        fleet.join(absent := stage.daemon("absent"), MemberRole.VEHICLE, 3)
        await stage.start(ground, linked=False)
        await stage.start(past, future)
        await ground.ask(fleet.revoke(absent.name))
        for vehicle, day in years.items():
            (started,) = vehicle.events("daemon_started")
            assert started["timestamp"].startswith(day)
            state_file.write(tmp_path / "state", FleetState(fleet.bulletin))
            name = vehicle.name
            await ground.until(lambda status, name=name: status["fleet"]["bulletins"][name] == fleet.number)  # type: ignore[misc]
            await vehicle.stop()
            state = vehicle.config_file.with_name(f"{vehicle.name}.fleet-state")
            assert state.read_bytes() == (tmp_path / "state").read_bytes()
            await vehicle.start()
            status = await vehicle.until_linked()
            assert status["fleet"]["number"] == fleet.number
            assert status["fleet"]["problem"] == ""
