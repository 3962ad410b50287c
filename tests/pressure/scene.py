"""A daemon, an honest peer with traffic both ways, an attacker; what the honest peer and the operator notice."""

from __future__ import annotations

import asyncio
import os
import sys
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from statistics import quantiles
from time import monotonic

from tests.daemon.harness import PATIENCE_S, DaemonProcess, Program, Sockaddr, Stage, Status, frame
from tests.pressure.attacks import Target

INTERVAL_S = 0.05
"""Between two frames of one direction."""
LEAD_S = 1.0
"""So long the attack has lasted when the first frame is sent."""
ALLOWED_S = 5.0
"""A frame or an answer that takes longer does not count as arrived."""
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Plan:
    """An attack by its name in :mod:`tests.pressure.attacks`, at a rate."""

    name: str
    attack: str
    per_s: float
    suite: str = "x25519"
    envelope_bytes: int = 1232
    role: str = "swarm-member"
    """Of the captured peer."""
    with_latecomer: bool = False
    """Whether another peer, at its configured address, starts during the attack."""


@dataclass
class Seen:
    """What was measured. Latencies are seconds; those of frames that never came are left out."""

    plan: Plan
    sent: int = 0
    latencies_s: list[float] = field(default_factory=list)
    status_s: list[float] = field(default_factory=list)
    unanswered: int = 0
    linked_after_s: float | None = None
    cpu_share: float = 0.0
    """CPU time of the daemon, by the time that passed."""
    drops: Counter[str] = field(default_factory=Counter)

    def percentile_s(self, percent: int) -> float:
        """Of the latencies."""
        # What is still under way when the measurement ends took longer than any that arrived.
        latencies_s = [*self.latencies_s, *[ALLOWED_S] * (self.sent - len(self.latencies_s))]
        return quantiles(latencies_s, n=100, method="inclusive")[percent - 1]

    def line(self) -> str:
        """A row of a Markdown table."""
        p50, p95 = (f"{self.percentile_s(each) * 1e3:.0f} ms" for each in (50, 95))
        status = f"{max(self.status_s) * 1e3:.0f} ms" if not self.unanswered else f"{self.unanswered} unanswered"
        linked = (
            ""
            if not self.plan.with_latecomer
            else "no"
            if self.linked_after_s is None
            else f"{self.linked_after_s:.2f} s"
        )
        worst = ", ".join(f"{name} {amount}" for name, amount in self.drops.most_common(3))
        cells = (
            self.plan.name,
            f"{len(self.latencies_s)} of {self.sent}",
            p50,
            p95,
            status,
            linked,
            f"{self.cpu_share:.0%}",
            worst,
        )
        return f"| {' | '.join(cells)} |"


HEADER = (
    "| attack | frames that arrived | p50 | p95 | slowest `status` | a known peer links in | CPU | dropped |\n"
    "|---|--:|--:|--:|--:|--:|--:|---|"
)


async def watch(stage: Stage, plan: Plan, seconds: float, launcher: tuple[str, ...] = ()) -> Seen:
    """Attack a daemon for ``seconds``, while 20 frames a second go each way between it and an honest peer."""
    victim, honest, captured, late = (stage.daemon(name) for name in ("victim2", "honest4", "captured", "late6"))
    victim.launcher = launcher
    stage.introduce(victim, honest)
    psk, late_psk = stage.psk(), stage.psk()
    victim.add_peer(captured, [], psk, suites=[plan.suite], role=plan.role, system_ids=[2])
    # The daemon offers what costs it nothing: the answer to the peer's own initiation is what this is about.
    victim.add_peer(late, [late.address], late_psk, suites=list(dict.fromkeys(["x25519", plan.suite])))
    late.add_peer(victim, [victim.address], late_psk, suites=[plan.suite])
    programs = await stage.program(), await stage.program()
    ways = victim.add_endpoint("program"), honest.add_endpoint("program")
    await stage.start(victim, honest, linked=False)
    await honest.until_linked()
    for number, (program, way) in enumerate(zip(programs, ways, strict=True)):
        program.send(frame(0, number + 1), way)
        await (victim, honest)[number].until(lambda status: bool(status["endpoints"]["program"]["programs"]))
    seen = Seen(plan)
    target = Target(
        victim.sockaddr[1], victim.public_key, captured.private_key, psk, plan.per_s, plan.suite, plan.envelope_bytes
    )
    attacker = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "tests.pressure.attacks", plan.attack, stdin=asyncio.subprocess.PIPE
    )
    assert attacker.stdin is not None
    try:
        attacker.stdin.write(target.to_json().encode() + b"\n")
        await victim.until(lambda status: _is_attacked(status, plan))
        await asyncio.sleep(LEAD_S)
        before, cpu_s, began = await victim.status(), _cpu_s(victim.pid), monotonic()
        tasks = [
            asyncio.create_task(
                _talk(programs[number], ways[number], programs[1 - number], number + 1, seconds, seen)
            )
            for number in range(2)
        ]
        tasks.append(asyncio.create_task(_ask(victim, seconds, seen)))
        if plan.with_latecomer:
            tasks.append(asyncio.create_task(_link(late, victim, seconds, seen)))
        await asyncio.sleep(seconds)
        seen.cpu_share = (_cpu_s(victim.pid) - cpu_s) / (monotonic() - began)
        await asyncio.gather(*tasks)
        seen.drops = _drops(await victim.status()) - _drops(before)
    finally:
        attacker.stdin.close()
        await attacker.wait()
    assert attacker.returncode == 0
    return seen


def _is_attacked(status: Status, plan: Plan) -> bool:
    return sum(_drops(status).values()) > 10 or status["peers"]["captured"]["state"] == "up"


def _drops(status: Status) -> Counter[str]:
    counts: Counter[str] = Counter(status["drops"])
    for peer in status["peers"].values():
        counts.update(peer["drops"])
    return counts


async def _talk(source: Program, into: Sockaddr, sink: Program, system: int, seconds: float, seen: Seen) -> None:
    arrived: dict[bytes, float] = {}
    sent: dict[bytes, float] = {}
    heard = len(sink.datagrams)
    end = monotonic() + seconds

    def note() -> bool:
        nonlocal heard
        now = monotonic()
        for datagram in sink.datagrams[heard:]:
            for each in sent:
                if each not in arrived and each in datagram:
                    arrived[each] = now
        heard = len(sink.datagrams)
        return len(arrived) == len(sent)

    noting = asyncio.create_task(_forever(sink, note))
    number, due = 0, monotonic()
    while due < end:
        number += 1
        each = frame(number, system)
        sent[each] = monotonic()
        source.send(each, into)
        due += INTERVAL_S
        await asyncio.sleep(max(0.0, due - monotonic()))
    with suppress(TimeoutError):
        await sink.until(note, ALLOWED_S)
    noting.cancel()
    seen.sent += len(sent)
    seen.latencies_s += [arrived[each] - sent[each] for each in arrived]


async def _forever(sink: Program, note: object) -> None:
    assert callable(note)
    await sink.until(lambda: note() and False, 1e6)


async def _ask(victim: DaemonProcess, seconds: float, seen: Seen) -> None:
    end = monotonic() + seconds
    while monotonic() < end:
        began = monotonic()
        try:
            await asyncio.wait_for(victim.status(), ALLOWED_S)
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


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS_PER_S
