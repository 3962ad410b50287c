"""What is wrong on serial networks: a modem's settings, or the line itself."""

from __future__ import annotations

from collections.abc import Iterator

from uavlinkd.link.down_causes import finding
from uavlinkd.link.serial_networks import RECENT_S, SerialNetworks
from uavlinkd.ops.causes import Cause
from uavlinkd.ops.findings import Finding, Subject


def line_findings(serial: SerialNetworks) -> Iterator[Finding]:
    """Findings about the modems. Anything here may be forged on the line: no remedy trusts it."""
    for network in serial.networks:
        start = f"on the serial network {network.name}"
        if reports := network.recent_reports:
            yield finding(
                Cause.MODEM_REPORTS,
                Subject.DAEMON,
                "",
                f"{start}, the modem sent {reports} RADIO_STATUS in {RECENT_S} s: it takes the line for MAVLink, and"
                " may cut datagrams",
                "set MAVLINK=0 on both modems: with mavproxy's or Mission Planner's radio settings, or by ATS6=0,"
                " AT&W and ATZ on a SiK modem",
            )
        if (noise := network.recent_noise) is not None:
            damaged, whole = noise
            yield finding(
                Cause.LINE_NOISE,
                Subject.DAEMON,
                "",
                f"{start}, {damaged} of {damaged + whole} pieces of the last {RECENT_S} s are damaged",
                f"compare the baud rate ({network.line.url.baud} here) with the modem's; set MAVLINK=0 on both SiK"
                " modems; let no other process and no autopilot use the line; else the radio is at its limit",
            )
