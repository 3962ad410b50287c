"""A captured member against a real daemon: allowed frames hide forbidden ones. Does a client receive one?

The attackers are peers with their own keys and the policies of the attacks. A client at the daemon's UDP endpoint
records every byte. :mod:`.every_offset` judges them.
"""

from __future__ import annotations

import asyncio
import json
import os
import socket
from collections import Counter
from collections.abc import Awaitable, Callable, Mapping
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any, Final, Self, cast

from uavlinkd.config.keys import decode_key, generate_private_key, generate_psk, public_key_text
from uavlinkd.core.crypto import Secret
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Output, Transmit
from uavlinkd.core.path import Path as PeerPath
from uavlinkd.core.settings import PeerSettings
from uavlinkd.lab.evaluation.captured_member import MemberAttack, attacks, heartbeat_of
from uavlinkd.lab.evaluation.every_offset import forbidden_frames
from uavlinkd.lab.evaluation.hidden_frames import frame
from uavlinkd.lab.evaluation.stage import StageError
from uavlinkd.lab.evaluation.tampering_plan import KEYS
from uavlinkd.lab.evaluation.tampering_records import OURS, Trial
from uavlinkd.lab.sim.drone_process import DroneProcess
from uavlinkd.lab.sim.loopback_ports import free_ports
from uavlinkd.mavlink.dialect import ids_by_name
from uavlinkd.mavlink.policy.compilation import compile_policy
from uavlinkd.mavlink.policy.gate import Gate

NAME: Final = "captured member"
VICTIM: Final = "drone0"
WITNESS: Final = "witness"
WITNESS_SYSTEM: Final = 77
PATIENCE_S: Final = 120.0
_TICK_S: Final = 0.01

# Messages that pymavlink's largest dialect lacks. Receivers with smaller dialects lack them too.
_ATTACKS: Final = attacks(
    ids_by_name()["REQUEST_EVENT"],
    ids_by_name()["LINK_NODE_STATUS"],
    ids_by_name()["REQUEST_EVENT"],
    ids_by_name()["LINK_NODE_STATUS"],
)


@dataclass(frozen=True, slots=True)
class MemberResult:
    """The result of one attack."""

    attack: str
    sent: int
    delivered: int
    separators: int
    """Bytes that the daemon inserted between frames."""
    forbidden: tuple[bytes, ...]
    """Frames in the client's stream that a parser could accept and the policy refuses."""


@dataclass(slots=True)
class Results:
    """The results of all attacks."""

    outcomes: list[MemberResult] = field(default_factory=list)
    refused: Counter[str] = field(default_factory=Counter)
    """Frames that the daemon did not deliver, by reason."""
    sessions: int = 0
    witness_sent: int = 0
    witness_delivered: int = 0
    last_wait_s: float = 0.0
    """From the end of the last attack until a frame of another peer was delivered."""


class _Member(asyncio.DatagramProtocol):
    """An attacker with the keys of a peer: its envelopes are genuine."""

    def __init__(self, private_key: str, victim: DroneProcess, psk: str) -> None:
        now = monotonic()
        self._node = Node(Secret(decode_key(private_key)), os.urandom, now)
        self._peer = self._node.add_peer(
            PeerSettings(VICTIM, decode_key(victim.public_key), Secret(decode_key(psk))), now
        )
        self._victim = victim
        self._transport: asyncio.DatagramTransport
        self._ticking: asyncio.Task[None] | None = None

    @property
    def is_up(self) -> bool:
        """Whether the victim has confirmed a session."""
        return self._peer.is_up

    def send(self, raw: bytes) -> None:
        """Send one frame in its own envelope."""
        self._perform(self._node.send(self._peer, [raw], monotonic()))

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        await loop.create_datagram_endpoint(lambda: self, local_addr=("127.0.0.1", 0))
        self._node.set_paths(self._peer, [PeerPath(0, ("127.0.0.1", self._victim.port))], monotonic())
        self._ticking = asyncio.create_task(self._tick())
        return self

    async def __aexit__(self, *_: object) -> None:
        if self._ticking is not None:
            self._ticking.cancel()
            await asyncio.gather(self._ticking, return_exceptions=True)
        self._perform(self._node.close(monotonic()))
        self._transport.close()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.DatagramTransport", transport)

    def datagram_received(self, data: bytes, addr: tuple[str | Any, int]) -> None:
        self._perform(self._node.receive(data, PeerPath(0, (addr[0], addr[1])), monotonic()))

    async def _tick(self) -> None:
        while True:
            self._perform(self._node.handle_timeout(monotonic()))
            await asyncio.sleep(_TICK_S)

    def _perform(self, outputs: list[Output]) -> None:
        for output in outputs:
            if isinstance(output, Transmit):
                self._transport.sendto(output.datagram, ("127.0.0.1", self._victim.port))


class _Client:
    """A client at the daemon's endpoint that records every byte."""

    def __init__(self, endpoint_port: int) -> None:
        self.received = bytearray()
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sock.setblocking(False)
        self._sock.connect(("127.0.0.1", endpoint_port))

    def greet(self) -> None:
        """Send a heartbeat like an autopilot."""
        self._sock.send(heartbeat_of(1))

    def read(self) -> None:
        """Read the received bytes."""
        try:
            while True:
                self.received += self._sock.recv(1 << 16)
        except OSError:  # nothing more
            return

    def close(self) -> None:
        """Close the socket."""
        self._sock.close()


async def run_attacks(folder: Path) -> Results:
    """Try every attack once. ``folder`` is for the daemon's files.

    Raises:
        StageError, DroneError: the daemon failed.
    """
    port, endpoint_port = free_ports(2)
    victim = DroneProcess(VICTIM, folder / VICTIM, port, endpoint_port)
    members_of_all = [policy for attack in _ATTACKS for policy in attack.members]
    policies: dict[str, Mapping[str, object]] = {_key(policy): policy for policy in members_of_all}
    policies[WITNESS] = {"role": "swarm-member", "system_ids": [WITNESS_SYSTEM]}
    members: dict[str, _Member] = {}
    peers = []
    for number, (key, policy) in enumerate(policies.items()):
        private, psk, file = generate_private_key(), generate_psk(), f"{number}.psk"
        victim.share_psk(psk, file)
        peer = {"name": f"member{number}", "public_key": public_key_text(private), "psk_file": file}
        peers.append({**peer, **policy})
        members[key] = _Member(private, victim, psk)
    victim.configure({}, peers)
    results = Results()
    async with AsyncExitStack() as stack:
        client = _Client(endpoint_port)
        stack.callback(client.close)
        stack.push_async_callback(victim.stop)
        await victim.start()
        await _until(victim.ask, "the daemon does not answer")
        for member in members.values():
            await stack.enter_async_context(member)
        client.greet()
        await _until(lambda: _is_linked(victim, members), "the members have no sessions")
        gates = {key: compile_policy(policy).incoming for key, policy in policies.items()}
        for number, attack in enumerate(_ATTACKS):
            results.outcomes.append(await _try(attack, number, members, gates, client, results))
        status = await victim.ask()
    for item in status["peers"].values():
        results.sessions += item["handshakes"]
        for reasons in item["refused"]["in"].values():
            results.refused.update(reasons)
    return results


async def _try(
    attack: MemberAttack,
    number: int,
    members: Mapping[str, _Member],
    gates: Mapping[str, Gate],
    client: _Client,
    results: Results,
) -> MemberResult:
    client.received.clear()
    keys = [_key(policy) for policy in attack.members]
    for member, raw in attack.frames:
        members[keys[member]].send(raw)
    stream = bytes(client.received[: await _witness(number, members[WITNESS], client, results)])
    return _look(attack, stream, [gates[key] for key in keys])


async def _witness(number: int, witness: _Member, client: _Client, results: Results) -> int:
    """Send another peer's frame after the attack's, and wait for it. Return its offset in the client's bytes."""
    began = monotonic()
    marker = frame(ids_by_name()["ATTITUDE"], number.to_bytes(4, "little") + bytes(23) + b"\1", WITNESS_SYSTEM)
    results.witness_sent += 1
    witness.send(marker)

    async def has_come() -> bool:
        client.read()
        return marker in client.received

    await _until(has_come, "a frame of another peer was not delivered")
    results.witness_delivered += 1
    results.last_wait_s = monotonic() - began
    return client.received.index(marker)


def _look(attack: MemberAttack, stream: bytes, gates: list[Gate]) -> MemberResult:
    """Find the attack's frames in the client's stream, then the forbidden frames."""
    delivered = []
    at = 0
    for member, raw in attack.frames:
        begin = stream.find(raw, at)
        if begin >= 0:
            delivered.append((begin, raw, gates[member]))
            at = begin + len(raw)
    carried = sum(len(raw) for _, raw, _ in delivered)
    forbidden = tuple(forbidden_frames(stream, delivered))
    return MemberResult(attack.name, len(attack.frames), len(delivered), len(stream) - carried, forbidden)


async def _is_linked(victim: DroneProcess, members: Mapping[str, _Member]) -> bool:
    await victim.ask()
    return victim.is_ready() and all(member.is_up for member in members.values())


async def _until(condition: Callable[[], Awaitable[object]], problem: str) -> None:
    until = monotonic() + PATIENCE_S
    while not await condition():
        if monotonic() > until:
            raise StageError(f"{problem} within {PATIENCE_S:g} s")
        await asyncio.sleep(_TICK_S)


def _key(policy: Mapping[str, object]) -> str:
    return json.dumps(policy, sort_keys=True)


def as_trial(results: Results, begin_s: float, duration_s: float, seed: int) -> Trial:
    """The results as a trial of the tampering evaluation."""
    sent = sum(outcome.sent for outcome in results.outcomes)
    forbidden = sum(len(outcome.forbidden) for outcome in results.outcomes)
    names = ", ".join(outcome.attack for outcome in results.outcomes if outcome.forbidden)
    facts = {"initiations": results.sessions, "answers": results.sessions, "sessions": results.sessions}
    return Trial(
        system=OURS,
        attack=NAME,
        group=KEYS,
        seed=seed,
        parameters=tuple(outcome.attack for outcome in results.outcomes),
        begin_s=begin_s,
        duration_s=duration_s,
        attempts=sent,
        interventions={f"{NAME}: injected": sent},
        target=0,
        faults={"hidden in allowed ones": forbidden} if forbidden else {},
        sessions=0,
        achieved={VICTIM: {**facts, "frames_read": 0, "frames_sent": sent, "own_drops": {}}},
        bytes_to_strangers=0,
        must_be_silent=False,
        amplified=(),
        frames_sent=results.witness_sent,
        frames_delivered=results.witness_delivered,
        noticed={VICTIM: {f"refused_{reason}": count for reason, count in results.refused.items()}},
        events={},
        recovery_s=results.last_wait_s,
        notes=f"holds all keys of a member, and hides forbidden frames in allowed ones{': ' if names else ''}{names}",
        observed_s=duration_s,
    )
