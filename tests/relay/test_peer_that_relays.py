"""A ground station that runs the relay: its vehicles have it as a peer and as a relay, in one session."""

from __future__ import annotations

from typing import Any

import pytest

from tests.processes.fleet import AN_OPERATOR, a_member, a_vehicle
from tests.processes.frames import heartbeat
from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess, Status


class Fleet:
    """Two vehicles that cannot reach each other, and the ground station that both reach."""

    def __init__(self, stage: Stage) -> None:
        self.station, self.a, self.b = stage.daemon("station"), stage.daemon("drone1", []), stage.daemon("drone2", [])
        self.station.config["member"] = []
        for number, vehicle in enumerate((self.a, self.b), 1):
            psk = stage.psk()
            self.station.add_peer(vehicle, [], psk, **a_vehicle(number))
            self.station.config["member"].append({"name": vehicle.name, "public_key": vehicle.public_key})
            vehicle.add_peer(self.station, [self.station.address], psk, **AN_OPERATOR)
            vehicle.config["link"]["confidential"] = True
            vehicle.config["relay"] = [relay_section(self.station)]
        psk = stage.psk()
        self.a.add_peer(self.b, [], psk, **a_member(2))
        self.b.add_peer(self.a, [], psk, **a_member(1))

    @property
    def daemons(self) -> tuple[DaemonProcess, ...]:
        """All of them."""
        return self.station, self.a, self.b


def relay_section(station: DaemonProcess) -> dict[str, Any]:
    """The station as a relay: its addresses are in the section of the peer."""
    return {"name": "gcs", "public_key": station.public_key, "addresses": []}


def is_relayed(status: Status, peer: str) -> bool:
    """Whether frames for a peer go along the relay."""
    return any(path["relay"] == "gcs" and path["state"] == "usable" for path in status["peers"][peer]["paths"])


@pytest.fixture
def fleet(stage: Stage) -> Fleet:
    """The fleet, not started."""
    return Fleet(stage)


async def test_vehicles_reach_each_other_through_their_ground_station(stage: Stage, fleet: Fleet) -> None:
    """One session serves both roles. Frames go to the station and through it, and never to it through itself."""
    at_station, at_b = await stage.client(), await stage.client()
    into_a = fleet.a.add_endpoint("autopilot")
    fleet.station.add_endpoint("qgc", f"udpout:{at_station}")
    fleet.b.add_endpoint("autopilot", f"udpout:{at_b}")
    await stage.start(*fleet.daemons)
    autopilot = await stage.client()
    autopilot.send(heartbeat(1), into_a)
    for client in (at_station, at_b):
        await client.until_received(heartbeat(1))
    status = await fleet.a.until(lambda status: status["relays"]["gcs"]["peers"] == {"drone2": "bound"})
    relay, peer = status["relays"]["gcs"], status["peers"]["station"]
    assert (relay["state"], relay["peer"], peer["state"]) == ("up", "station", "up")
    assert [path["relay"] for path in peer["paths"]] == [None]
    assert peer["handshakes"] == 1
    station = await fleet.station.status()
    assert station["relay"]["connections"] == 1
    assert {member["is_up"] for member in station["relay"]["members"].values()} == {True}
    assert station["drops"] == {}
    await fleet.a.until_logged("relay_up", relay="gcs")
    await fleet.a.until_logged("peer_up", peer="station")
