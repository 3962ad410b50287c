"""Real daemons on a serial line with a slow radio: alone, and beside UDP."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from time import monotonic

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess
from tests.daemon.relay import End
from tests.daemon.serial_pair import SerialPair, without_ip
from tests.daemon.udp import Client
from tests.endpoints.test_line_framing import report
from tests.faults.talk import CriticalVoice, prepare

SIK_BITS_S = 24_000
FAST_BITS_S = 200_000
"""Two clients that say 50 texts a second each."""
Connect = Callable[[float], SerialPair]


@pytest.fixture
def pair(stage: Stage) -> Iterator[Connect]:
    """Makes a pair of modems whose radio carries so many bits a second. It is stopped at the end."""
    made: list[SerialPair] = []

    def make(air_bits_s: float) -> SerialPair:
        made.append(SerialPair(stage.folder, air_bits_s))
        return made[-1]

    yield make
    for modems in made:
        modems.stop()


def heartbeat(system: int, number: int) -> bytes:
    """Numbered by its custom mode."""
    codec = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
    return bytes(mavlink.MAVLink_heartbeat_message(2, 3, 0, number, 4, 3).pack(codec))


def command(number: int) -> bytes:
    """A command to system 1."""
    codec = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    return bytes(mavlink.MAVLink_command_long_message(1, 1, 400, 0, number, 0, 0, 0, 0, 0, 0).pack(codec))


def has_all(client: Client, *frames: bytes) -> bool:
    """Whether a client received these frames, which may share datagrams."""
    return all(frame in client.received for frame in frames)


async def test_link_over_a_serial_radio_alone(stage: Stage, pair: Connect) -> None:
    """Handshake, heartbeats and commands pass; the status shows the line; the plug is pulled and put back."""
    vehicle, ground = stage.pair()
    without_ip(vehicle, ground)
    modems = pair(SIK_BITS_S)
    modems.connect(vehicle, ground)
    modems.start()
    autopilot, pilot = await stage.client(), await stage.client()
    vehicle.add_endpoint("autopilot", f"udpout:{autopilot}")
    into_ground = ground.add_endpoint("pilot")
    began = monotonic()
    await stage.start(vehicle, ground)
    print(f"linked after {monotonic() - began:.1f} s")
    pilot.send(heartbeat(255, 1), into_ground)
    await autopilot.until(lambda: has_all(autopilot, heartbeat(255, 1)))
    for number in range(5):
        pilot.send(command(number), into_ground)
    await autopilot.until(lambda: has_all(autopilot, *map(command, range(5))))

    status = await ground.until(lambda status: status["peers"]["drone0"]["path"] == "serial")
    (path,) = status["peers"]["drone0"]["paths"]
    assert (path["network"], path["address"], path["is_configured"]) == ("sik", "serial", True)
    line = status["networks"]["sik"]
    assert (line["is_present"], line["addresses"], line["absent_because"]) == (True, ["serial"], None)
    assert line["serial"]["line_noise"] <= 1  # opening the device may cut the other end's first datagram in two
    assert line["serial"]["uses_cts"] is False
    assert line["serial"]["air_bits_s"] == SIK_BITS_S

    modems.a.pull()
    await vehicle.until(lambda status: not status["networks"]["sik"]["is_present"])
    assert (await vehicle.until_logged("network_disappeared"))["network"] == "sik"
    modems.a.plug_in()
    await vehicle.until(lambda status: status["networks"]["sik"]["is_present"])
    back = monotonic()

    async def repeat() -> None:  # as a ground station does. On a busy machine the pull may have lasted for seconds
        while True:
            pilot.send(command(77), into_ground)
            pilot.send(heartbeat(255, 77), into_ground)
            await asyncio.sleep(0.3)

    repeating = asyncio.create_task(repeat())
    await autopilot.until(lambda: has_all(autopilot, command(77), heartbeat(255, 77)))
    repeating.cancel()
    print(f"a command arrives {monotonic() - back:.2f} s after the line returned")


async def test_noise_and_reports_of_the_modem(stage: Stage, pair: Connect) -> None:
    """Noise is counted, RADIO_STATUS of the modem is shown with the remedy, and the link goes on."""
    vehicle, ground = stage.pair()
    without_ip(vehicle, ground)
    modems = pair(SIK_BITS_S)
    modems.connect(vehicle, ground)
    modems.start()
    autopilot, pilot = await stage.client(), await stage.client()
    into_vehicle = vehicle.add_endpoint("autopilot")
    ground.add_endpoint("pilot", f"udpout:{pilot}")
    await stage.start(vehicle, ground)
    modems.injected = b"noise" * 10 + b"\0"
    await ground.until(lambda status: status["networks"]["sik"]["serial"]["line_noise"] >= 1)
    modems.injected = b"\0" + report() + report(2)
    status = await ground.until(lambda status: status["networks"]["sik"]["serial"]["reports"] == 2)
    assert status["networks"]["sik"]["serial"]["radio"]["rssi"] == 200
    status = await ground.until(
        lambda status: any(finding["cause"] == "modem_reports" for finding in status["findings"])
    )
    (finding,) = [finding for finding in status["findings"] if finding["cause"] == "modem_reports"]
    assert "MAVLINK=0" in finding["remedy"]
    autopilot.send(heartbeat(1, 5), into_vehicle)
    await pilot.until(lambda: has_all(pilot, heartbeat(1, 5)))
    assert await ground.stop() == 0
    assert ground.events("daemon_stopped")[0]["counted"]["line_noise"] >= 1


async def test_flood_of_states_does_not_fill_the_modem(stage: Stage, pair: Connect) -> None:
    """The daemon thins them; the modem never holds more than a moment of them, and a command passes."""
    vehicle, ground = stage.pair()
    without_ip(vehicle, ground)
    modems = pair(SIK_BITS_S)
    modems.connect(vehicle, ground)
    modems.start()
    autopilot, pilot = await stage.client(), await stage.client()
    into_vehicle, into_ground = vehicle.add_endpoint("autopilot"), ground.add_endpoint("pilot")
    ground.config["endpoint"].append({"name": "screen", "url": f"udpout:{pilot}"})
    vehicle.config["endpoint"].append({"name": "listener", "url": f"udpout:{autopilot}"})
    await stage.start(vehicle, ground)
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    for number in range(1000):
        state = mavlink.MAVLink_attitude_message(number, 1.5, 0.5, 0.25, 0.1, 0.1, 0.1)
        autopilot.send(bytes(state.pack(codec)), into_vehicle)
    await vehicle.until(lambda status: status["peers"]["drone1"]["waiting_dropped"].get("thinned", 0) > 200)
    pilot.send(command(3), into_ground)
    await autopilot.until(lambda: has_all(autopilot, command(3)))
    # What each end may send at once, and a datagram more.
    assert max(modems.a.most_held, modems.b.most_held) <= 0.25 * SIK_BITS_S / 8 + 512


@pytest.mark.long
async def test_serial_radio_beside_udp(stage: Stage, pair: Connect) -> None:
    """Either path dies; no critical frame is lost, and none arrives twice."""
    vehicle, ground = stage.pair()
    relay = await stage.relay()
    for end, daemon in ((End.A, vehicle), (End.B, ground)):
        relay.attach(end, daemon.sockaddr)
        host, port = relay.address_for(end)
        daemon.config["peer"][0]["addresses"] = [f"{host}:{port}"]
    modems = pair(FAST_BITS_S)
    modems.connect(vehicle, ground, baud=115200, air_bits_s=FAST_BITS_S)
    modems.start()
    talk = prepare(vehicle, ground, voice=CriticalVoice)
    await stage.start(vehicle, ground)
    await talk.start()
    try:
        await until_usable(vehicle, ground, 2)
        began = monotonic()
        modems.b.pull()
        await ground.until(lambda status: not status["networks"]["sik"]["is_present"])
        await talk.back(monotonic())
        modems.b.plug_in()
        await ground.until(lambda status: status["networks"]["sik"]["is_present"])
        await until_usable(vehicle, ground, 2)
        relay.on_datagram = lambda end, datagram: None
        await until_usable(vehicle, ground, 1)
        await talk.back(monotonic())
        relay.on_datagram = relay.deliver
        await until_usable(vehicle, ground, 2)
        await talk.check_lost_none(began, monotonic(), vehicle, ground)
        talk.check_no_copies()
    finally:
        talk.stop()


async def until_usable(vehicle: DaemonProcess, ground: DaemonProcess, count: int) -> None:
    """Wait until both ends have so many usable paths."""
    for daemon, peer in ((vehicle, "drone1"), (ground, "drone0")):
        await daemon.until(
            lambda status, peer=peer: (  # type: ignore[misc]
                [path["state"] for path in status["peers"][peer]["paths"]].count("usable") == count
            )
        )
