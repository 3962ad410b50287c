"""The simulated autopilot on real sockets: reports, frames, and the end of a flight."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.lab.sim.station import decode, of_type
from uavlinkd.lab.sim.autopilot import Autopilot, AutopilotSettings
from uavlinkd.lab.sim.flight import Flight, fly
from uavlinkd.lab.sim.links import Collector, LinkError


def encode(message: Any) -> bytes:
    """A frame of a ground station's."""
    return bytes(message.pack(mavlink.MAVLink(None, 255, 190)))


HEARTBEAT = encode(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 0, 3))
ARM = encode(mavlink.MAVLink_command_long_message(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0))


@pytest.mark.parametrize(("air", "ground"), [("udpout", "udpin"), ("tcp", "tcpin")])
async def test_callbacks_see_the_sent_frames(air: str, ground: str) -> None:
    """``on_sent`` gets each frame exactly as it arrives, and ``on_received`` each frame as it was sent."""
    sent: list[bytes] = []
    received: list[bytes] = []
    async with Collector(f"{ground}:127.0.0.1:0") as station:
        url = f"{air}:127.0.0.1:{station.address[1]}"
        async with Flight(
            url, AutopilotSettings(attitude_rate_hz=200), on_sent=sent.append, on_received=received.append
        ) as flight:
            await station.until(lambda: len(station.frames) >= 20)
            station.send(HEARTBEAT)
            station.send(ARM)
            await flight.until(lambda: flight.autopilot.vehicle.armed)
            assert received == [HEARTBEAT, ARM]
            report = flight.report()
            assert (report.frames_sent, report.bytes_sent) == (len(sent), sum(map(len, sent)))
            assert (report.frames_received, report.bytes_received) == (2, len(HEARTBEAT) + len(ARM))
            assert (report.stations, report.commands, report.events["armed"]) == ([(255, 190)], 1, 1)
        await station.until(lambda: len(station.frames) == len(sent))
        assert station.frames == sent
        assert len(of_type(decode(station.frames), "COMMAND_ACK")) == 1


async def test_a_listening_copter_answers_every_station() -> None:
    """Without a client no frame is sent; then each goes to all clients, and is reported once."""
    sent: list[bytes] = []
    async with Flight("udpin:127.0.0.1:0", on_sent=sent.append) as flight:
        assert flight.report().frames_unsent > 0
        assert sent == []
        url = f"udpout:127.0.0.1:{flight.address[1]}"
        async with Collector(url) as one, Collector(url) as two:
            one.send(HEARTBEAT)
            two.send(HEARTBEAT)
            await flight.until(lambda: flight.link.receivers == 2)
            from_here = len(sent)
            await one.until(lambda: set(sent[from_here:]) <= set(one.frames) and len(sent) > from_here + 5)
            await two.until(lambda: set(sent[from_here:]) <= set(two.frames) and len(sent) > from_here + 5)


async def test_noise_on_the_link_does_not_stop_it() -> None:
    """Bytes outside frames are counted, and the next command is executed."""
    async with Flight("udpin:127.0.0.1:0") as flight, Collector(f"udpout:127.0.0.1:{flight.address[1]}") as station:
        station.send(b"\xfd" * 50)
        station.send(ARM)
        await flight.until(lambda: flight.autopilot.vehicle.armed)
        assert flight.report().bad_bytes == 50


async def test_the_rate_asked_for_is_kept() -> None:
    """At 400 attitudes a second, so many arrive, or somewhat fewer on a busy machine."""
    async with Collector("udpin:127.0.0.1:0") as station:
        settings = AutopilotSettings(attitude_rate_hz=400)
        report = await fly(f"udpout:127.0.0.1:{station.address[1]}", settings, seconds=1.0)
        await station.until(lambda: len(station.frames) == report.frames_sent)
        assert 200 < len(of_type(decode(station.frames), "ATTITUDE")) < 420


async def test_it_ends_on_stop() -> None:
    """``stop`` ends a flight with its report, and the port is free again."""
    stop = asyncio.Event()
    async with Collector("udpin:127.0.0.1:0") as station:
        flying = asyncio.create_task(fly(f"udpout:127.0.0.1:{station.address[1]}", stop=stop))
        await station.until(lambda: bool(station.frames))
        stop.set()
        report = await asyncio.wait_for(flying, 240)
    assert report.frames_sent > 0


async def test_cancelling_closes_the_socket() -> None:
    """A cancelled flight leaves its address to the next one at once."""
    async with Flight("udpin:127.0.0.1:0") as first:
        url = first.url
    flying = asyncio.create_task(fly(url))
    await asyncio.sleep(0)
    while not flying.done():
        try:
            async with Collector(url):
                await asyncio.sleep(0)  # not bound yet
        except LinkError:
            flying.cancel()
            break
    with pytest.raises(asyncio.CancelledError):
        await flying
    async with Collector(url) as free:
        assert free.url == url


async def test_a_closed_connection_ends_the_flight() -> None:
    """The end of the TCP connection is the error."""
    async with Collector("tcpin:127.0.0.1:0") as station:
        flying = asyncio.create_task(fly(f"tcp:127.0.0.1:{station.address[1]}"))
        await station.until(lambda: bool(station.frames))
    with pytest.raises(LinkError, match="closed the connection"):
        await asyncio.wait_for(flying, 240)


async def test_a_fault_in_a_hook_ends_the_flight_where_it_is_awaited() -> None:
    """An exception out of ``on_sent`` is not lost in the event loop."""

    def broken(_frame: bytes) -> None:
        raise ZeroDivisionError

    async with Collector("udpin:127.0.0.1:0") as station:
        with pytest.raises(ZeroDivisionError):
            await fly(f"udpout:127.0.0.1:{station.address[1]}", seconds=30, on_sent=broken)


async def test_a_fault_of_the_model_is_not_swallowed(monkeypatch: pytest.MonkeyPatch) -> None:
    """An exception of the autopilot ends the flight even if ``run`` is not awaited."""

    def broken(_self: Autopilot, _now: float) -> list[bytes]:
        raise ZeroDivisionError

    monkeypatch.setattr(Autopilot, "advance", broken)
    with pytest.raises(ZeroDivisionError):
        async with Flight("udpin:127.0.0.1:0"):
            await asyncio.sleep(0)
