"""A daemon, an honest peer with traffic in both directions, an attacker; the effect on the peer and the operator."""

from __future__ import annotations

import asyncio
import sys
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from time import monotonic

from tests.kernel_queues import cpu_s
from tests.pressure.attacks import Target
from tests.processes.frames import frame
from tests.processes.harness import Stage
from tests.processes.losses import lost_to_waiting
from tests.processes.members import CertifiedFleet
from tests.processes.process import DaemonProcess, Status
from tests.processes.udp import Client, Sockaddr
from tests.waiting import PATIENCE_S
from uavlinkd.authority.certificates import MemberRole
from uavlinkd.lab.child_processes import end_with_parent

INTERVAL_S = 0.05
LEAD_S = 1.0
"""Duration of the attack before the first frame is sent."""
FAIR_CPU_S = 0.1
"""An attacked daemon spends at most this CPU time on others before it handles a frame: thirty turns. A daemon without
turns would handle the whole queue first, which takes several times that."""
FAIR_SHARE = 0.25
"""The least share of the frames of which this is to be seen. While another process does not run, frames wait too."""
MORE_S = 30.0
ALLOWED_S = 5.0
ROUNDS = 8
"""How many times ``ALLOWED_S`` the measurement waits for frames that nothing explains as lost."""


@dataclass(frozen=True)
class Plan:
    """An attack by its name in :mod:`tests.pressure.attacks`, at a rate."""

    name: str
    attack: str
    per_s: float
    suite: str = "x25519"
    envelope_bytes: int = 1232
    role: str = "swarm-member"
    is_member: bool = False
    """Whether the daemon is a member of a fleet with an authority too."""
    with_latecomer: bool = False
    """Whether another peer, at its configured address, starts during the attack."""
    queue_bytes: int | None = None
    """How much of the daemon's receive buffer the attacker fills; None: it sends whether there is room or not."""


PLANS = {
    plan.name: plan
    for plan in (
        Plan("insider initiations", "initiations", 80, suite="ffdhe8192", with_latecomer=True),
        Plan("no attack", "silence", 0, is_member=True),
        Plan("strangers", "strangers", 200, is_member=True),
        Plan("bad certificates", "certificates", 200, is_member=True),
        Plan("spoofed initiations", "spoofed", 10_000, with_latecomer=True),
        Plan("64 kB envelopes", "envelopes", 40, envelope_bytes=64_000),
        Plan("agreed envelopes", "envelopes", 2_000),
        Plan("start bytes", "starts", 2_000, role="vehicle"),
    )
}


@dataclass
class Seen:
    """The measurement. Latencies are without lost frames."""

    plan: Plan
    sent: int = 0
    latencies_s: list[float] = field(default_factory=list)
    soon: int = 0
    """Frames for which the attacked daemon used less than ``FAIR_CPU_S`` while they travelled."""
    status_s: list[float] = field(default_factory=list)
    unanswered: int = 0
    linked_after_s: float | None = None
    cpu_share: float = 0.0
    drops: Counter[str] = field(default_factory=Counter)
    lost_to_waiting: int = 0
    """Honest frames that the kernel or the daemons dropped because a process had to wait for a processor."""

    @property
    def lost(self) -> int:
        """Honest frames that did not arrive."""
        return self.sent - len(self.latencies_s)


async def watch(stage: Stage, plan: Plan, seconds: float, launcher: tuple[str, ...] = ()) -> Seen:
    """Attack a daemon for ``seconds``, while it and an honest peer exchange 20 frames a second in each direction."""
    victim, honest, captured, late = (stage.daemon(name) for name in ("victim2", "honest4", "captured", "late6"))
    victim.launcher = launcher
    stage.introduce(victim, honest)
    if plan.is_member:
        CertifiedFleet().join(victim, MemberRole.OPERATOR, 255)
    psk, late_psk = stage.psk(), stage.psk()
    victim.add_peer(captured, [], psk, suites=[plan.suite], role=plan.role, system_ids=[2])
    # The daemon itself offers a cheap suite: the test is about its answer to the peer's own initiation.
    victim.add_peer(late, [late.address], late_psk, suites=list(dict.fromkeys(["x25519", plan.suite])))
    late.add_peer(victim, [victim.address], late_psk, suites=[plan.suite])
    clients = await stage.client(), await stage.client()
    ways = victim.add_endpoint("client"), honest.add_endpoint("client")
    await stage.start(victim, honest, linked=False)
    await honest.until_linked()
    for number, (client, way) in enumerate(zip(clients, ways, strict=True)):
        client.send(frame(0, number + 1), way)
        await (victim, honest)[number].until(lambda status: bool(status["endpoints"]["client"]["clients"]))
    seen = Seen(plan)
    keys = victim.public_key, captured.private_key, psk
    target = Target(victim.sockaddr[1], *keys, plan.per_s, plan.suite, plan.envelope_bytes, plan.queue_bytes)
    attacker = await asyncio.create_subprocess_exec(
        *end_with_parent(sys.executable, "-m", "tests.pressure.attacks", plan.attack), stdin=asyncio.subprocess.PIPE
    )
    assert attacker.stdin is not None
    try:
        attacker.stdin.write(target.to_json().encode() + b"\n")
        await victim.until(lambda status: _is_attacked(status, plan))
        await asyncio.sleep(LEAD_S)
        before, cpu_before_s, began = await victim.status(), cpu_s(victim.pid), monotonic()
        network = _Network(victim, honest)
        await network.begin()
        tasks = [
            asyncio.create_task(_talk((clients[one], ways[one], clients[1 - one]), one + 1, seconds, seen, network))
            for one in range(2)
        ]
        tasks.append(asyncio.create_task(_ask(victim, seconds, seen)))
        if plan.with_latecomer:
            tasks.append(asyncio.create_task(_link(late, victim, seconds, seen)))
        await asyncio.gather(*tasks)
        seen.cpu_share = (cpu_s(victim.pid) - cpu_before_s) / (monotonic() - began)
        seen.drops = _drops(await victim.status()) - _drops(before)
        seen.lost_to_waiting = await network.lost_to_waiting()
    finally:
        attacker.stdin.close()
        await attacker.wait()
    assert attacker.returncode == 0
    return seen


def _is_attacked(status: Status, plan: Plan) -> bool:
    return not plan.per_s or sum(_drops(status).values()) > 10 or status["peers"]["captured"]["state"] == "up"


def _drops(status: Status) -> Counter[str]:
    counts: Counter[str] = Counter(status["drops"])
    for peer in status["peers"].values():
        counts.update(peer["drops"])
    return counts


class _Network:
    def __init__(self, victim: DaemonProcess, honest: DaemonProcess) -> None:
        self.victim, self._honest = victim, honest
        self._before = 0

    async def begin(self) -> None:
        self._before = await self.lost_to_waiting()

    async def lost_to_waiting(self) -> int:
        """Frames that were lost because a process had to wait for a processor."""
        return (
            await lost_to_waiting(self.victim, self._honest)
            + await lost_to_waiting(self._honest, self.victim)
            - self._before
        )


async def _talk(
    way: tuple[Client, Sockaddr, Client], system: int, seconds: float, seen: Seen, network: _Network
) -> None:
    source, into, sink = way
    arrived: dict[bytes, tuple[float, float]] = {}
    sent: dict[bytes, tuple[float, float]] = {}
    received = len(sink.datagrams)
    end = monotonic() + seconds

    def note() -> bool:
        nonlocal received
        now = monotonic(), cpu_s(network.victim.pid)
        for datagram in sink.datagrams[received:]:
            for sent_frame in sent:
                if sent_frame not in arrived and sent_frame in datagram:
                    arrived[sent_frame] = now
        received = len(sink.datagrams)
        return len(arrived) == len(sent)

    noting = asyncio.create_task(_until_cancelled(sink, note))
    number, due = 0, monotonic()
    # A pause of one of the processes may delay each frame of a short time. Then more are sent.
    while due < end or (due < end + MORE_S and _soon(sent, arrived) < FAIR_SHARE * number):
        number += 1
        sent_frame = frame(number, system)
        sent[sent_frame] = monotonic(), cpu_s(network.victim.pid)
        source.send(sent_frame, into)
        due += INTERVAL_S
        await asyncio.sleep(max(0.0, due - monotonic()))
    for _ in range(ROUNDS):
        with suppress(TimeoutError):
            await sink.until(note, ALLOWED_S)
            break
        # They will not arrive any more if the kernel, or a daemon after a pause, dropped them.
        if len(sent) - len(arrived) <= await network.lost_to_waiting():
            break
    noting.cancel()
    seen.sent += len(sent)
    seen.soon += _soon(sent, arrived)
    seen.latencies_s += [at - sent[sent_frame][0] for sent_frame, (at, _) in arrived.items()]


def _soon(sent: dict[bytes, tuple[float, float]], arrived: dict[bytes, tuple[float, float]]) -> int:
    return sum(cpu_at_s - sent[sent_frame][1] < FAIR_CPU_S for sent_frame, (_, cpu_at_s) in arrived.items())


async def _until_cancelled(sink: Client, note: object) -> None:
    assert callable(note)
    await sink.until(lambda: note() and False, 1e6)


async def _ask(victim: DaemonProcess, seconds: float, seen: Seen) -> None:
    end = monotonic() + seconds
    while monotonic() < end:
        began = monotonic()
        try:
            await victim.status()
        except (TimeoutError, OSError):
            seen.unanswered += 1
        else:
            seen.status_s.append(monotonic() - began)
        await asyncio.sleep(0.5)


async def _link(late: DaemonProcess, victim: DaemonProcess, seconds: float, seen: Seen) -> None:
    await late.start()
    await late.ready()
    began = monotonic()
    with suppress(AssertionError):
        await late.until_linked(max(seconds, PATIENCE_S))
        seen.linked_after_s = monotonic() - began
