"""Real daemons on emulated SiK modems, with byte errors and pulled plugs."""

from __future__ import annotations

from dataclasses import replace

from tests.daemon.harness import Stage
from tests.daemon.serial_radio import INTERVAL_S, SIK, serial_radio
from tests.waiting import Stopwatch, until
from uavlinkd.lab.mitm.modem import Fate, ModemEnd

NOISY = replace(SIK, packet_loss=0.02, byte_error_rate=0.001, byte_loss_rate=0.0005)
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
