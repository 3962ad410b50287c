"""The run: two drones and a ground station, each pair linked through the emulated radio, and the measurements.

::

    client ─ drone0 ─ tap ─┐              ┌─ tap ─┐
                           ├ uavlink-mitm ┤       ├ ground ─ client
    client ─ drone1 ─ tap ─┘              └─ tap ─┘

Every daemon and the radio are separate processes; the clients and the taps are in this one.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any, TextIO

from tests.daemon.fleet import beat
from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess
from tests.daemon.relay import End, Relay
from tests.daemon.toml import to_toml
from tests.daemon.udp import Client, Sockaddr, open_socket, shown
from tests.soak.flows import SETTLED_S, Flow, frame, numbers_in
from tests.waiting import PATIENCE_S
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.ops.control import ControlError, ask

DRONES = ("drone0", "drone1")
GROUND = "ground"
SYSTEMS = {"drone0": 1, "drone1": 2, GROUND: 255}
RADIO: dict[str, Any] = {
    "loss": 0.01,
    "bursts": {"to_bad": 0.01, "to_good": 0.25},  # 4 % of datagrams, four at a time
    "duplication": 0.01,
    "delay_s": 0.03,
    "jitter_s": 0.03,  # more than between two frames: they overtake one another
    # Shorter than what is late (2 s): a link must come through without losing a frame of its own.
    "outages": [{"down_at_s": 8.0, "up_at_s": 8.8, "every_s": 47.0}],
}
RADIO_NAME = "radio"


@dataclass(frozen=True, slots=True)
class Plan:
    seconds: float
    rate: float = 50.0
    rekey_s: float = 2.0
    every_s: float = 5.0
    seed: int = 0


class Speaker(Client):
    """A client at a daemon's endpoint: sends numbered frames, and counts those of others that it receives."""

    def __init__(self, name: str, into: Sockaddr) -> None:
        super().__init__(open_socket("127.0.0.1"))
        self.name = name
        self.flows: dict[str, Flow] = {}
        self.expected: dict[int, Flow] = {}
        self._into = into
        self._number = 0

    async def open(self) -> None:
        await asyncio.get_running_loop().create_datagram_endpoint(lambda: self, sock=self._sock)

    def greet(self) -> None:
        """Send a frame without a number, so that the daemon learns the client's address."""
        self.send(frame(2**30, SYSTEMS[self.name]), self._into)

    def say(self) -> None:
        self._number += 1
        now = monotonic()
        for flow in self.flows.values():
            flow.on_sent(self._number, now)
        self.send(frame(self._number, SYSTEMS[self.name]), self._into)

    def datagram_received(self, data: bytes, addr: tuple[str | Any, int]) -> None:
        """Count it, and do not keep it: a run takes hours."""
        now = monotonic()
        for system, flow in self.expected.items():
            for number in numbers_in(data, system):
                if number < 2**30:
                    flow.on_delivered(number, now)


class Link:
    """A drone and the ground station, with a tap on either side of the radio between them."""

    def __init__(self, drone: str, near: Relay, far: Relay, there: Flow, back: Flow) -> None:
        self.drone = drone
        self.at_ground = f"{GROUND}-{drone}"
        """The radio's name for the ground station on this link."""
        self.near, self.far = near, far
        self.entered: Counter[str] = Counter()
        self.left: Counter[str] = Counter()
        self._there, self._back = there, back
        near.on_datagram = self._at_near
        far.on_datagram = self._at_far

    def _at_near(self, end: End, datagram: bytes) -> None:
        if end is End.B:
            self._enters(self._there, f"{self.drone}>{self.at_ground}", SYSTEMS[self.drone], datagram)
        else:
            self._leaves(self._back, f"{self.at_ground}>{self.drone}", SYSTEMS[GROUND], datagram)
        self.near.deliver(end, datagram)

    def _at_far(self, end: End, datagram: bytes) -> None:
        if end is End.A:
            self._enters(self._back, f"{self.at_ground}>{self.drone}", SYSTEMS[GROUND], datagram)
        else:
            self._leaves(self._there, f"{self.drone}>{self.at_ground}", SYSTEMS[self.drone], datagram)
        self.far.deliver(end, datagram)

    def _enters(self, flow: Flow, way: str, system: int, datagram: bytes) -> None:
        self.entered[way] += 1
        for number in numbers_in(datagram, system):
            flow.on_entered(number)

    def _leaves(self, flow: Flow, way: str, system: int, datagram: bytes) -> None:
        self.left[way] += 1
        for number in numbers_in(datagram, system):
            flow.on_left(number)


class Soak:
    """All processes of a run. :meth:`sample` measures them."""

    def __init__(self, stage: Stage, plan: Plan) -> None:
        self.stage = stage
        self.plan = plan
        self.daemons: dict[str, DaemonProcess] = {}
        self.speakers: dict[str, Speaker] = {}
        self.links: list[Link] = []
        self.flows = {name: Flow() for drone in DRONES for name in (f"{drone}>{GROUND}", f"{GROUND}>{drone}")}
        self._radio: asyncio.subprocess.Process | None = None
        self._began_at = 0.0

    @property
    def radio_socket(self) -> Path:
        """The radio's control socket, for its statistics."""
        return self.stage.folder / "radio.sock"

    async def open(self) -> None:
        """Start everything, and wait until all are linked and every client is known."""
        link = {"rekey_after_s": self.plan.rekey_s, "reject_after_s": self.plan.rekey_s + 30.0}
        for name in (*DRONES, GROUND):
            daemon = self.daemons[name] = self.stage.daemon(name)
            daemon.config["link"] = dict(link)
            self.speakers[name] = Speaker(name, daemon.add_endpoint("client"))
            await self.speakers[name].open()
        radio: dict[str, Any] = {"seed": self.plan.seed, "control_socket": "radio.sock", "peer": [], "link": []}
        for drone in DRONES:
            await self._link(drone, radio)
        radio["radio"] = [{"direction": "both", **RADIO}]
        await self._start_radio(radio)
        await self.stage.start(*self.daemons.values())
        for name, speaker in self.speakers.items():
            speaker.greet()
            await self.daemons[name].until(lambda status: bool(status["endpoints"]["client"]["clients"]))

    async def _link(self, drone: str, radio: dict[str, Any]) -> None:
        near, far = await self.stage.relay(), await self.stage.relay()
        there, back = self.flows[f"{drone}>{GROUND}"], self.flows[f"{GROUND}>{drone}"]
        link = Link(drone, near, far, there, back)
        self.links.append(link)
        self.speakers[drone].flows[GROUND] = self.speakers[GROUND].expected[SYSTEMS[drone]] = there
        self.speakers[GROUND].flows[drone] = self.speakers[drone].expected[SYSTEMS[GROUND]] = back
        faces = [("127.0.0.1", free_port()) for _ in range(2)]
        near.attach(End.A, self.daemons[drone].sockaddr)
        near.attach(End.B, faces[0])
        far.attach(End.A, faces[1])
        far.attach(End.B, self.daemons[GROUND].sockaddr)
        psk = self.stage.psk()
        self.daemons[drone].add_peer(self.daemons[GROUND], [shown(near.address_for(End.A))], psk)
        self.daemons[GROUND].add_peer(self.daemons[drone], [shown(far.address_for(End.B))], psk)
        radio["peer"] += [
            {"name": drone, "address": shown(near.address_for(End.B))},
            {"name": link.at_ground, "address": shown(far.address_for(End.A))},
        ]
        radio["link"].append({"between": [drone, link.at_ground], "listen": [shown(face) for face in faces]})

    async def _start_radio(self, config: dict[str, Any]) -> None:
        path = self.stage.folder / "radio.toml"
        path.write_text(to_toml(config))
        self._radio = await asyncio.create_subprocess_exec(
            *end_with_parent(sys.executable, "-m", "uavlinkd.lab.mitm", "--config", str(path)),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.DEVNULL,
        )
        async with asyncio.timeout(PATIENCE_S):
            while True:
                with suppress(ControlError):
                    await self._ask_radio()
                    return
                await asyncio.sleep(0.02)

    async def _ask_radio(self) -> dict[str, Any]:
        return await asyncio.to_thread(ask, self.radio_socket, "statistics")

    async def close(self) -> None:
        if self._radio is not None and self._radio.returncode is None:
            self._radio.terminate()
            await self._radio.wait()
        for speaker in self.speakers.values():
            speaker.close()

    async def run(self, on_sample: Callable[[dict[str, Any]], None]) -> None:
        """Send frames for the planned time; then wait until every frame has arrived or is lost."""
        self._began_at = began = monotonic()
        speaking = [
            asyncio.create_task(beat(lambda _, speaker=speaker: speaker.say(), 1 / self.plan.rate))  # type: ignore[misc]
            for speaker in self.speakers.values()
        ]
        try:
            while monotonic() < began + self.plan.seconds:
                await asyncio.sleep(self.plan.every_s)
                on_sample(await self.sample())
                for task in speaking:
                    if task.done():
                        task.result()
        finally:
            for task in speaking:
                task.cancel()
        await asyncio.sleep(SETTLED_S)
        on_sample(await self.sample(at_rest=True))

    async def sample(self, *, at_rest: bool = False) -> dict[str, Any]:
        """Measure now, as plain data. ``at_rest``: wait until no frame is in flight."""
        processes = {
            name: _process(pid) for name, pid in self._pids()
        }  # before the status requests: they use a descriptor
        now = monotonic()
        flows: dict[str, dict[str, Any]] = {}
        for name, flow in self.flows.items():
            flow.settle(now)
            latencies = sorted(flow.take_latencies())
            flows[name] = {**flow.counts(), "p50_s": _part(latencies, 0.5), "p99_s": _part(latencies, 0.99)}
        statuses = {name: await daemon.status() for name, daemon in self.daemons.items()}
        for daemon in self.daemons.values():
            daemon.statuses.clear()  # hours of them would fill the memory
        taps = self._taps()
        radio = await self._ask_radio()
        while at_rest:  # rekeying continues: wait for a moment without datagrams in flight
            taps = self._taps()
            await asyncio.sleep(2 * (RADIO["delay_s"] + RADIO["jitter_s"]))
            radio = await self._ask_radio()
            if taps == self._taps():
                break
        return {
            "at_s": round(now - self._began_at, 3),
            "at_rest": at_rest,
            "processes": processes,
            "flows": flows,
            "taps": taps,
            "radio": radio["radios"],
            "radio_errors": radio["errors"],
            "peers": {
                f"{name}: {peer}": {
                    "generation": link["session"]["generation"] if link["session"] else None,
                    "state": link["state"],
                    "drops": link["drops"],
                }
                for name, status in statuses.items()
                for peer, link in status["peers"].items()
            },
            "lost_peers": {
                name: sum('"event": "peer_lost"' in line for line in daemon.lines)
                for name, daemon in self.daemons.items()
            },
        }

    def _taps(self) -> dict[str, dict[str, int]]:
        return {
            way: {"entered": link.entered[way], "left": link.left[way]}
            for link in self.links
            for way in sorted(link.entered | link.left)
        }

    def _pids(self) -> Iterator[tuple[str, int]]:
        for name, daemon in self.daemons.items():
            yield name, daemon.pid
        assert self._radio is not None
        yield RADIO_NAME, self._radio.pid


@asynccontextmanager
async def soaking(plan: Plan) -> Any:
    """A soak that is ready to :meth:`Soak.run`; the stage checks for tracebacks and secrets at the end."""
    async with Stage() as stage:
        soak = Soak(stage, plan)
        try:
            await soak.open()
            yield soak
        finally:
            await soak.close()


async def record(plan: Plan, samples: TextIO, say: Callable[[str], None]) -> None:
    def on_sample(sample: dict[str, Any]) -> None:
        samples.write(json.dumps(sample) + "\n")
        samples.flush()
        delivered = sum(flow["delivered"] for flow in sample["flows"].values())
        say(f"{sample['at_s']:.0f} s: {delivered} frames delivered")

    async with soaking(plan) as soak:
        await soak.run(on_sample)


def _process(pid: int) -> dict[str, int]:
    fields = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return {"rss_kb": int(fields["VmRSS"].split()[0]), "fds": len(os.listdir(f"/proc/{pid}/fd"))}


def _part(ordered: list[float], share: float) -> float | None:
    return round(ordered[min(len(ordered) - 1, int(share * len(ordered)))], 6) if ordered else None
