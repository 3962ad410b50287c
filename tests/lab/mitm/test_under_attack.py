"""Two nodes of the core under each attack, in virtual time: no false frame is delivered, and the link recovers.

The simulated network checks at every delivery that the frame was sent, is unaltered, and is delivered once.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import pytest

from tests.lab.mitm.middle import Middle
from tests.network.network import Drone, Network
from uavlinkd.lab.mitm.attack import Attack, Operation
from uavlinkd.lab.mitm.attacks import ATTACKS, parse_attack
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.protocol.drops import DropReason as Reason
from uavlinkd.protocol.settings import Link, Timers
from uavlinkd.protocol.suites import SUITES_BY_NAME

pytestmark = pytest.mark.long

FAST = Timers(rekey_after_s=1.0, reject_after_s=6.0)
"""A handshake per second, so that attacks on handshakes have targets."""
ATTACK_S = 8.0
RECOVERY_S = 2.0

# The expected counters of drops, and below those of link problems.
EXPECTED: dict[str, set[Reason]] = {
    "tamper-key": {Reason.BAD_HANDSHAKE},
    "replace-key": {Reason.BAD_HANDSHAKE},
    "random": {Reason.BAD_HANDSHAKE},
    "suite-downgrade": {Reason.BAD_HANDSHAKE},
    "certificate-length": {Reason.BAD_HANDSHAKE},
    "invalid-element": {Reason.INVALID_KEY_SHARE},
    "corrupt-share": {Reason.BAD_HANDSHAKE},
    "alter-indices": {Reason.HEADER_MISMATCH},
    "alter-macs": {Reason.BAD_MAC1},
    "replay-initiation": {Reason.DUPLICATE},  # at once: it looks like a copy along another path
    "replay-response": {Reason.DUPLICATE},
    "replay-cookie": {Reason.COOKIE_REQUIRED},
    "stolen-cookie": {Reason.DUPLICATE},
    "replay-data": {Reason.DUPLICATE},
    "duplicate": {Reason.DUPLICATE},
    "reflect": {Reason.UNKNOWN_INDEX, Reason.BAD_MAC1, Reason.UNEXPECTED_RESPONSE},
    "misroute": {Reason.UNKNOWN_INDEX, Reason.BAD_MAC1, Reason.UNEXPECTED_RESPONSE},
    "bit-flip": {Reason.BAD_TAG, Reason.UNKNOWN_INDEX, Reason.MALFORMED},
    "truncate": {Reason.BAD_TAG, Reason.MALFORMED},
    "extend": {Reason.BAD_TAG},
    "splice": {Reason.BAD_TAG},
    "counter-jump": {Reason.BAD_TAG},
    "alter-frame": {Reason.BAD_TAG},
    "tamper-tag": {Reason.BAD_TAG},
    "forge-data": {Reason.BAD_TAG},
    "flood-envelopes": {Reason.BAD_TAG},
    "raw-mavlink": {Reason.RAW_MAVLINK},
    "flood-initiations": {Reason.BAD_HANDSHAKE, Reason.COOKIE_REQUIRED},
    "flood-garbage": {Reason.MALFORMED, Reason.RAW_MAVLINK},
    "amplification-probe": {Reason.COOKIE_REQUIRED, Reason.REPLAYED},
    "forge-hints": {Reason.UNKNOWN_INDEX},
    "forge-cookie": {Reason.BAD_COOKIE},
    "roam": {Reason.DUPLICATE},
    "hold": {Reason.DELAYED},
    "move": {Reason.UNEXPECTED_ANSWER},
    "stretch": {Reason.DOUBTFUL},
    "stretch-one-way": {Reason.DOUBTFUL},
    "cross-initiations": {Reason.UNEXPECTED_RESPONSE},
}
DISTURBS: dict[str, str] = {
    "drop": "missing",
    "drop-heartbeats": "missing",
    "blackout": "handshakes_unanswered",
    "hold": "missing",
    "stretch": "echoes_unanswered",
    "stretch-one-way": "echoes_unanswered",
    "reorder": "out_of_order",
    "roam": "paths_unproven",
    "drop-message": "handshakes_unanswered",
    "block-rekey": "handshakes_unanswered",
    "stolen-cookie": "cookies_taken",
}
COSTS_NOTHING = {
    *("replay-initiation", "replay-response", "replay-data", "duplicate", "reflect", "misroute"),
    *(
        "counter-jump",
        "forge-data",
        "flood-envelopes",
        "raw-mavlink",
        "flood-initiations",
    ),
    *("flood-garbage", "amplification-probe", "forge-hints", "forge-cookie", "roam"),
    *("cross-initiations", "reorder", "move"),
}
"""Attacks that add datagrams and do not withhold any for long."""
VALIDATES = {"wander"}
"""It relays answers, so its strangers become validated addresses."""
OPTIONS = {
    "drop-heartbeats": ",size=45",  # the network's frames are not MAVLink: their size identifies them
    "drop": ",share=0.5",
    "hold": ",share=0.3,hold_s=2.6",  # longer, and the sessions expire
}


@dataclass
class Outcome:
    """The state after an attack."""

    attack: Attack
    middle: Middle
    drops: Counter[str]
    link_problems: Counter[str]
    lost: int
    recovery_s: float


def _attack(name: str, options: str = "") -> Outcome:
    """Run a linked pair (or three drones, if needed) under the attack, and three seconds after it."""
    suite = SUITES_BY_NAME["ffdhe2048" if name == "corrupt-share" else "x25519"]
    with Network(f"attack {name}", RadioSettings(delay_s=0.01)) as network:
        drones: list[Drone] = [network.add(letter) for letter in ("abc" if name == "misroute" else "ab")]
        middle = Middle(network, *drones, paths=2 if name == "move" else 1)
        middle.introduce(Link(suites=(suite,), timers=FAST))
        for drone in drones:
            drone.start()
        flows = network.talk(drones[0], drones[1])
        network.run(2)
        before: Counter[str] = Counter()
        for drone in drones:
            before += drone.drops
        attack = parse_attack(f"{name},seconds={ATTACK_S}{OPTIONS.get(name, '')}{options}").make(
            middle.context, 1, network.now
        )
        # Cookies are sent only under load.
        load = parse_attack(f"flood-initiations,rate_per_s=200,seconds={ATTACK_S}")
        loads = [load.make(middle.context, 1, network.now)] if "cookie" in name + options else []
        middle.attack(*loads, attack)
        begin = network.now
        network.run(ATTACK_S)
        end = network.now
        network.run(RECOVERY_S + 1)
        drops = _copies(drones)
        for drone in drones:
            drops += drone.drops
        return Outcome(
            attack,
            middle,
            drops - before,
            _link_problems(drones),
            sum(len(flow.lost(begin, end)) for flow in flows),
            max(flow.first_delivery(end) - end for flow in flows),
        )


def _copies(drones: list[Drone]) -> Counter[str]:
    """The copies of envelopes that the drones received. They cause no output."""
    counts: Counter[str] = Counter()
    for drone in drones:
        assert drone.node is not None
        for peer in drone.node.peers.values():
            for reason in (Reason.DUPLICATE, Reason.LATE_COPY):
                counts[reason] += peer.traffic.drops[reason]
    return +counts


def _link_problems(drones: list[Drone]) -> Counter[str]:
    result: Counter[str] = Counter()
    for drone in drones:
        assert drone.node is not None
        for peer in drone.node.peers.values():
            result["missing"] += peer.missing(drone.local_now)
            result["paths_unproven"] += peer.paths.unproven
            for name in set(DISTURBS.values()) - {"missing", "paths_unproven"}:
                result[name] += getattr(peer.traffic, name)
    return result


@pytest.mark.parametrize("name", ATTACKS)
def test_link_holds_against_the_attack_and_comes_back_after_it(name: str) -> None:
    """The attack had targets, left a counter, amplified nothing, and frames flow again within 2 s."""
    outcome = _attack(name)
    reported = [intervention for intervention in outcome.middle.interventions if intervention.attack == name]
    assert outcome.attack.attempts > 0
    assert reported
    assert outcome.recovery_s <= RECOVERY_S
    missing = EXPECTED.get(name, set()) - set(outcome.drops)
    assert not missing, f"not counted: {missing}; counted: {outcome.drops}"
    if name in DISTURBS:
        assert outcome.link_problems[DISTURBS[name]] > 0
    assert outcome.drops or +outcome.link_problems, "it left nothing that a person can find"
    if name in COSTS_NOTHING:
        assert outcome.lost == 0
    if name not in VALIDATES:
        assert not outcome.middle.amplification.excess


@pytest.mark.parametrize("message", ["initiation", "response", "confirmation", "cookie"])
def test_link_comes_back_whichever_message_is_dropped(message: str) -> None:
    """Exactly that message of every handshake, for eight seconds."""
    outcome = _attack("drop-message", f",message={message}")
    reported = [
        intervention for intervention in outcome.middle.interventions if intervention.attack == "drop-message"
    ]
    assert reported
    assert {note.operation for note in reported} == {Operation.DROPPED}
    assert outcome.recovery_s <= RECOVERY_S


def test_attacks_combine_with_one_another_and_with_a_bad_radio() -> None:
    """Five attacks at once over a link with 20 % loss: no false frame is delivered, and the link recovers."""
    names = ("replay-data", "bit-flip,share=0.2", "tamper-key,share=0.5", "reflect,share=0.3", "flood-garbage")
    with Network("many", RadioSettings(delay_s=0.02, loss=0.2)) as network:
        middle, a, b = Middle.between(network, Link(timers=FAST))
        flows = network.talk(a, b)
        network.run(3)
        attacks = [parse_attack(f"{name},seconds=10").make(middle.context, 1, network.now) for name in names]
        middle.attack(*attacks)
        network.run(10)
        end = network.now
        network.run(3)
        assert all(attack.attempts > 0 for attack in attacks)
        assert all(flow.first_delivery(end) - end <= RECOVERY_S for flow in flows)
        assert any(flow.first_delivery(end - 10) < end for flow in flows)
