"""Trials of attackers with keys (own, stolen, of a captured drone), and of the relay against the paper's protocol."""

from __future__ import annotations

import os
from collections.abc import Callable
from time import monotonic
from typing import Any

from uavlinkd.config.keys import decode_key
from uavlinkd.core.crypto import KeyPair
from uavlinkd.core.suites import X25519
from uavlinkd.lab.evaluation.impostors import Disguise, Impostor, SealedCookies, StolenIdentity
from uavlinkd.lab.evaluation.ledger import numbered_frame
from uavlinkd.lab.evaluation.paper_attacks import PaperRelay
from uavlinkd.lab.evaluation.stage import DaemonStage
from uavlinkd.lab.evaluation.tampering_bench import Bench
from uavlinkd.lab.evaluation.tampering_plan import HANDSHAKE, KEYS, TrialPlan
from uavlinkd.lab.evaluation.tampering_records import RELAY
from uavlinkd.lab.mitm.attack import AttackObject

AS_ITSELF = "captured drone, as itself"

Make = Callable[[float], Impostor]


def key_attacks(stage: DaemonStage) -> list[tuple[TrialPlan, Make]]:
    """The attacks with own or stolen keys on the first two drones of three."""
    (a, b, c), keys, suites = stage.names, stage.public_keys, (X25519,)
    private = {name: drone.private_key for name, drone in stage.drones.items()}
    psk = {pair: decode_key(text) for pair, text in stage.psks.items()}
    own = KeyPair(os.urandom(32))
    of_b = (numbered_frame(stage.names.index(b) + 1, 2**31), numbered_frame(stage.names.index(b) + 1, 0))

    def disguise(victim: str, pose: str, identity: KeyPair, shared: frozenset[str] | None = None) -> Disguise:
        return Disguise(victim, keys[victim], pose, identity, None if shared is None else psk[shared])

    pair, with_c = frozenset((a, b)), frozenset((a, c))
    thief = StolenIdentity(keys[b], own, KeyPair(private[a]))
    captured = KeyPair(private[c])
    tries: list[tuple[str, list[Disguise], bool, str]] = [
        (RELAY, [disguise(a, b, own), disguise(b, a, own)], True, "handshakes with its own keys, with both sides"),
        ("impostor, unknown key", [disguise(a, b, own), disguise(b, a, own)], False, "genuine traffic continues"),
        (
            "impostor, stolen PSK",
            [disguise(a, b, own, pair), disguise(b, a, own, pair)],
            False,
            "the pair's PSK, but no static key",
        ),
        (
            "key compromise impersonation",
            [disguise(a, b, thief, pair)],
            False,
            f"holds the static key of {a} and the PSK, and poses as {b} to {a}",
        ),
        (
            "captured drone, as another",
            [disguise(a, b, StolenIdentity(keys[b], captured, None), with_c)],
            False,
            f"holds all keys of {c}, and claims the identity of {b}",
        ),
        (
            AS_ITSELF,
            [disguise(a, b, captured, with_c)],
            False,
            f"holds all keys of {c}, has a session as {c}, sends frames that only {b} may send, and reports invented"
            " refusals",
        ),
    ]
    attacks: list[tuple[TrialPlan, Make]] = []
    for name, disguises, relays, notes in tries:
        plan = TrialPlan(name, KEYS, (), restarts=relays, least_s=2.0 if relays else 0.5, notes=notes)
        frames = of_b if name == AS_ITSELF else ()
        attacks.append(
            (
                plan,
                lambda now, name=name, disguises=disguises, relays=relays, frames=frames: Impostor(  # type: ignore[misc]
                    name, disguises, suites, now, relays=relays, frames=frames, claims=bool(frames)
                ),
            )
        )
    return attacks


async def run_impostor(bench: Bench, plan: TrialPlan, make: Make) -> None:
    """Run one of them, and record its results."""
    impostor: list[Impostor] = []

    def objects() -> list[AttackObject]:
        impostor.append(make(monotonic()))
        return [impostor[0]]

    def sessions() -> int:
        # As itself, a captured drone has a genuine session: only its frames matter.
        if plan.attack == AS_ITSELF:
            return 0
        return sum(victim.sessions for victim in impostor[0].achieved.values())

    def achieved() -> dict[str, Any]:
        return {
            victim: {
                "initiations": results.initiations,
                "answers": results.answers,
                "sessions": results.sessions,
                "frames_read": results.frames_read,
                "frames_sent": results.frames_sent,
                "own_drops": dict(results.drops),
            }
            for victim, results in impostor[0].achieved.items()
        }

    await bench.run(plan, objects=objects, sessions=sessions, achieved=achieved)


async def run_paper_relay(bench: Bench) -> None:
    """Run the full relay between the two ends of the paper's protocol."""
    relay = PaperRelay()
    plan = TrialPlan(RELAY, KEYS, (), least_s=1.0, notes="a key exchange with each side; every second frame altered")
    await bench.run(
        plan,
        objects=lambda: [relay],
        sessions=lambda: relay.exchanges,
        achieved=lambda: {"frames_read": relay.read, "frames_altered": relay.altered},
    )


async def run_sealed_cookies(bench: Bench, public_keys: dict[str, bytes]) -> None:
    """Run the attacker with the public keys that sends valid cookie replies."""
    plan = TrialPlan("sealed-cookies", HANDSHAKE, (), least_s=1.0)
    await bench.run(plan, objects=lambda: [SealedCookies(public_keys, monotonic())])
