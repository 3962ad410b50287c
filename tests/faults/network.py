"""Faults of the network: each happens to one of two hosts with a cable between them."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Mapping
from time import monotonic
from typing import NamedTuple

from tests.faults.talk import Log, Outcome, grew, reported
from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess
from tests.processes.two_hosts import ONLY, PORT, TwoHosts, address_of, interface_of
from tests.waiting import PATIENCE_S
from uavlinkd.observe.drop_log import EVERYDAY_ERRORS

FAULT_S = float(os.environ.get("UAVLINKD_FAULT_S", "4"))
"""How long a fault lasts: longer than a peer may be silent (3 s)."""
_DEVICE, _PEER = interface_of(ONLY), address_of(ONLY, 2)
_NET = f"{address_of(ONLY, 0)}/24"


class NetworkFault(NamedTuple):
    what: str
    begin: str
    """Shell commands there."""
    end: str
    errors: tuple[str, ...]
    """Those that may be counted."""


NETWORK_FAULTS: Mapping[str, NetworkFault] = {
    "interface_down": NetworkFault(
        "the interface is down", f"ip link set {_DEVICE} down", f"ip link set {_DEVICE} up", ("ENETUNREACH", "EINVAL")
    ),
    "interface_gone": NetworkFault(
        "the interface and its address are deleted", f"ip link delete {_DEVICE}", "", ("ENETUNREACH", "EINVAL")
    ),
    "route_gone": NetworkFault(
        "network unreachable: the route is removed",
        f"ip route delete {_NET} dev {_DEVICE}",
        f"ip route add {_NET} dev {_DEVICE}",
        ("ENETUNREACH",),
    ),
    "route_prohibited": NetworkFault(
        "the route is prohibited (`EACCES`)",
        f"ip route add prohibit {_PEER}",
        f"ip route delete prohibit {_PEER}",
        ("EACCES",),
    ),
    "firewall": NetworkFault(
        "a firewall forbids sending (`EPERM`)",
        "nft 'add table inet fault; add chain inet fault out { type filter hook output priority 0; };"
        f" add rule inet fault out udp dport {PORT} drop'",
        "nft delete table inet fault",
        ("EPERM",),
    ),
    "buffers_full": NetworkFault(
        "no room in the socket's buffer (`EAGAIN`)",
        f"tc qdisc add dev {_DEVICE} root tbf rate 8kbit burst 2000 limit 50m",
        f"tc qdisc delete dev {_DEVICE} root",
        ("EAGAIN", "ENOBUFS"),
    ),
}


async def suffer(stage: Stage, name: str) -> Outcome:
    """Break the network of a talking daemon, and mend it. Every other fault befalls one on asyncio's own loop."""
    fault, names = NETWORK_FAULTS[name], ("drone0", "drone1")
    is_odd = list(NETWORK_FAULTS).index(name) % 2
    async with TwoHosts(stage, [ONLY], names[::-1] if is_odd else names) as hosts:
        await hosts.start()
        daemon = hosts.vehicle
        before, log = await daemon.status(), Log(daemon)
        hosts.run(fault.begin)
        if name == "buffers_full":
            await _fill(hosts)
        await asyncio.sleep(FAULT_S)
        during = await daemon.status()
        failures = grew(before, during, "send_failures")
        assert failures, "the fault did not come about"
        assert set(failures) <= set(fault.errors), failures
        state = during["peers"][hosts.ground.name]["state"]
        if fault.end:
            hosts.run(fault.end)
        else:
            hosts.plug_in(ONLY)
        recovered_s = await hosts.talk.back(monotonic())
        hosts.talk.check_no_copies()
        await _check_reported(daemon, *failures)
        return Outcome(f"sends failed: {reported(failures)}; peer {state}", recovered_s, log.count)


async def _fill(hosts: TwoHosts) -> None:
    """Send until the socket's buffer is full of what waits for the interface."""
    deadline = monotonic() + PATIENCE_S
    while not (await hosts.vehicle.status())["send_failures"]:
        assert monotonic() < deadline, "a buffer without end"
        for _ in range(200):
            hosts.talk.voices[0].shout()
        await asyncio.sleep(0.01)


async def _check_reported(daemon: DaemonProcess, *names: str) -> None:
    """Each error has a line in the log, under its name; and none more than a line each ten seconds.

    A full buffer is an everyday error: the log has it only if it persists for longer than this fault.
    """
    for name in names:
        if name not in EVERYDAY_ERRORS:
            await daemon.until_logged("sends_failed", reason=name)
        lines = daemon.events("sends_failed", reason=name)
        assert len(lines) <= 2 + FAULT_S / 10, (name, len(lines))
