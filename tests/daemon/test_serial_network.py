"""Real daemons on emulated SiK modems: alone and beside UDP, byte errors, pulled plugs, floods, and modem reports."""

from __future__ import annotations

from dataclasses import replace
from time import monotonic

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess
from tests.daemon.relay import End
from tests.daemon.serial_radio import INTERVAL_S, SIK, connect_modems, serial_radio
from tests.faults.talk import CriticalVoice, prepare
from tests.samples import pack
from tests.waiting import Stopwatch, until
from uavlinkd.lab.mitm.modem import Fate, ModemEnd

NOISY = replace(SIK, packet_loss=0.02, byte_error_rate=0.001, byte_loss_rate=0.0005)
FAST = replace(SIK, air_bits_s=200_000, line_baud=115_200)
"""For two clients that send 50 texts a second each."""
BACK_S = 1.0
"""Heartbeats and commands pass again this soon after the line is back, on a machine without other work."""


async def test_link_over_noisy_modems_and_a_pulled_plug(stage: Stage) -> None:
    """The handshake, heartbeats and commands pass, and again soon after the line is back. No frame is altered.

    After the return the noise may destroy a datagram or two, so the bound is twice that of a line without noise.
    """
    async with serial_radio(stage, NOISY) as radio:
        await radio.both_receive(10)
        status = await radio.ground.until(lambda status: status["peers"]["drone0"]["path"] == "serial")
        (path,) = status["peers"]["drone0"]["paths"]
        assert (path["network"], path["address"], path["is_configured"]) == ("sik", "serial", True)
        line = status["networks"]["sik"]
        assert (line["is_present"], line["addresses"], line["absent_because"]) == (True, ["serial"], None)
        assert (line["serial"]["uses_cts"], line["serial"]["air_bits_s"]) == (False, SIK.air_bits_s)
        statistics = radio.ports.link.bytes
        await until(lambda: all(statistics[end][Fate.ALTERED] for end in ModemEnd))
        await radio.ground.until(lambda status: status["networks"]["sik"]["serial"]["line_noise"] >= 1)
        for end, daemon in ((ModemEnd.LEFT, radio.vehicle), (ModemEnd.RIGHT, radio.ground)):
            radio.ports.pull(end)
            await daemon.until(lambda status: not status["networks"]["sik"]["is_present"])
            assert (await daemon.until_logged("network_disappeared"))["network"] == "sik"
            radio.ports.plug(end)
            watch = Stopwatch()
            await radio.both_receive()
            assert watch.calm_s < 2 * BACK_S + INTERVAL_S
        radio.check()


async def test_flood_of_states_does_not_fill_the_modem(stage: Stage) -> None:
    """The daemon thins them; the modem never drops a byte, and commands pass."""
    async with serial_radio(stage) as radio:
        await radio.both_receive()
        vehicle = radio.clients[0]
        for number in range(1000):
            state = pack(mavlink.MAVLink_attitude_message(number, 1.5, 0.5, 0.25, 0.1, 0.1, 0.1), 1, seq=number)
            vehicle.sent.append(state)
            vehicle.client.send(state, vehicle.into)
        await radio.vehicle.until(lambda status: status["peers"]["drone1"]["waiting_dropped"].get("thinned", 0) > 200)
        await radio.both_receive()
        radio.check()
        assert not any(radio.ports.link.bytes[end][Fate.QUEUE_FULL] for end in ModemEnd)


@pytest.mark.long
async def test_serial_radio_beside_udp(stage: Stage) -> None:
    """Either path dies; no critical frame is lost, and none arrives twice."""
    vehicle, ground = stage.pair()
    relay = await stage.relay()
    for end, daemon in ((End.A, vehicle), (End.B, ground)):
        relay.attach(end, daemon.sockaddr)
        host, port = relay.address_for(end)
        daemon.config["peer"][0]["addresses"] = [f"{host}:{port}"]
    ports = connect_modems(stage, vehicle, ground, FAST)
    talk = prepare(vehicle, ground, voice=CriticalVoice)
    await ports.start()
    try:
        await stage.start(vehicle, ground)
        await talk.start()
        await until_usable(vehicle, ground, 2)
        began = monotonic()
        ports.pull(ModemEnd.RIGHT)
        await ground.until(lambda status: not status["networks"]["sik"]["is_present"])
        await talk.back(monotonic())
        ports.plug(ModemEnd.RIGHT)
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
        await ports.stop()


async def until_usable(vehicle: DaemonProcess, ground: DaemonProcess, count: int) -> None:
    for daemon, peer in ((vehicle, "drone1"), (ground, "drone0")):
        await daemon.until(
            lambda status, peer=peer: (  # type: ignore[misc]
                [path["state"] for path in status["peers"][peer]["paths"]].count("usable") == count
            )
        )
