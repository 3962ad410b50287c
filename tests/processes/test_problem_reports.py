"""Real daemons: the station shows what a vehicle says about itself."""

from __future__ import annotations

from tests.processes.harness import Stage


async def test_a_vehicle_says_that_it_has_no_client() -> None:
    """As a fault in the findings of the other end, whose own endpoints are no cause for it."""
    async with Stage() as stage:
        vehicle, station = stage.pair()
        vehicle.add_endpoint("autopilot")
        await stage.start(vehicle, station)
        status = await station.until(lambda status: bool(status["peers"][vehicle.name]["problems_there"]))
        assert status["peers"][vehicle.name]["problems_there"] == ["cut_off"]
        (finding,) = (one for one in status["findings"] if one["cause"] == "problems_there")
        assert (finding["severity"], finding["name"]) == ("fault", vehicle.name)
        assert (status["frames_pass"], status["stopped_there"]) == (True, [vehicle.name]), (
            "a claim changes no exit status"
        )
        assert (await vehicle.status())["peers"][station.name]["problems_there"] == []
