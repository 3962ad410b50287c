"""``python -m tests.pressure.line``: a captured peer floods a real endpoint on a serial line of 57,600 baud.

The line is an emulated wire between two pseudo-terminals. Delay of an operator's commands, from its client's send to
the last byte at the autopilot, without the flood and with it.
"""

from __future__ import annotations

import asyncio
import os
import random
from itertools import cycle
from statistics import quantiles
from time import monotonic

from tests.daemon.harness import Stage
from tests.daemon.udp import Client, Sockaddr
from tests.endpoints.test_flooded_line import mixed
from tests.samples import command, heartbeat
from tests.waiting import until
from uavlinkd.lab.mitm.modem import ModemEnd, ModemSettings
from uavlinkd.lab.mitm.modem_ports import ModemPorts, PortSettings
from uavlinkd.mavlink.frames import SplitCounters, StreamSplitter

AS_UART = (
    "import sys; from uavlinkd.endpoints import serial; serial._PSEUDO_TERMINALS = 'none';"
    " from uavlinkd.cli import main; sys.exit(main())"
)
"""A pseudo-terminal has no rate, and holds 12 kB unseen. The daemon has to send at the rate of the line."""
WIRE = ModemSettings(air_bits_s=1e7, line_baud=64_000, turn_around_s=0.0, gather_s=0.0, queue_bytes=1 << 16)
"""A little faster than the endpoint's 57,600 baud, so that the endpoint sets the pace, as on a UART."""
SECONDS, INTERVAL_S = 12.0, 0.1
FLOOD_BITS_S = 2_000_000
POLICIES: dict[str, dict[str, object] | None] = {
    "none": None,
    "role swarm-member, with its rates": {"role": "swarm-member"},
    "role all, which has no rates": {},
}
"""The floods, by the policy of the captured peer at the daemon with the line."""


async def delays_s(policy: dict[str, object] | None) -> list[float]:
    """Of the commands that arrived; infinite for the others."""
    async with Stage() as stage:
        drone, operator, captured = (stage.daemon(name) for name in ("drone2", "operator", "captured"))
        setattr(drone, "_executable", lambda: ("-c", AS_UART))  # noqa: B010
        stage.introduce(drone, operator)
        psk = stage.psk()
        drone.add_peer(captured, [captured.address], psk, **(policy or {}))
        captured.add_peer(drone, [drone.address], psk)
        ports = ModemPorts(PortSettings(stage.folder / "left", stage.folder / "right", WIRE, seed=1))
        drone.add_endpoint("autopilot", f"serial:{ports.settings.device(ModemEnd.LEFT)}:57600")
        ways = operator.add_endpoint("client"), captured.add_endpoint("client")
        clients = await stage.client(), await stage.client()
        await ports.start()
        autopilot = os.open(ports.settings.device(ModemEnd.RIGHT), os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        arrived: dict[bytes, float] = {}
        splitter = StreamSplitter(SplitCounters())

        def read() -> None:
            now = monotonic()
            arrived.update((frame.raw, now) for frame in splitter.feed(os.read(autopilot, 4096), now))

        loop = asyncio.get_running_loop()
        loop.add_reader(autopilot, read)
        flooding: asyncio.Task[None] | None = None
        try:
            await stage.start(drone, operator, captured, linked=False)
            for daemon in (drone, operator, captured):
                await daemon.until_linked()
            os.write(autopilot, heartbeat(0, 1).raw)
            first = command(10_000).raw
            clients[0].send(first, ways[0])
            await until(lambda: first in arrived)
            if policy is not None:
                flooding = asyncio.create_task(_flood(clients[1], ways[1]))
                await asyncio.sleep(2.0)
            sent: dict[bytes, float] = {}
            for number in range(int(SECONDS / INTERVAL_S)):
                raw = command(number).raw
                sent[raw] = monotonic()
                clients[0].send(raw, ways[0])
                await asyncio.sleep(INTERVAL_S * random.uniform(0.5, 1.5))
            await asyncio.sleep(3.0)
            return [arrived.get(raw, float("inf")) - at for raw, at in sent.items()]
        finally:
            if flooding is not None:
                flooding.cancel()
            loop.remove_reader(autopilot)
            os.close(autopilot)
            await ports.stop()


async def _flood(client: Client, into: Sockaddr) -> None:
    """Mixed messages of 12 invented components."""
    frames = cycle([mixed(number).raw for number in range(1000)])
    began, sent = monotonic(), 0
    while True:
        while sent < FLOOD_BITS_S / 8 * (monotonic() - began):
            datagram = b""
            while len(datagram) < 1200:
                datagram += next(frames)
            client.send(datagram, into)
            sent += len(datagram)
        await asyncio.sleep(0.003)


if __name__ == "__main__":
    print("| flood | commands that arrived | p50 | p95 | longest |\n|---|--:|--:|--:|--:|")
    for name, policy in POLICIES.items():
        delays = asyncio.run(delays_s(policy))
        came = sorted(delay for delay in delays if delay < float("inf"))
        marks = quantiles(came, n=100, method="inclusive")
        figures = (f"{1000 * mark:.0f} ms" for mark in (marks[49], marks[94], came[-1]))
        print(f"| {name} | {len(came)} of {len(delays)} |", " | ".join(figures), "|", flush=True)
