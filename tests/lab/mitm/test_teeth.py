"""Attacks have teeth: a receiver that leaves out one check, here and nowhere else, falls to the attack on it.

With its checks the same receiver falls to none of them: see ``test_under_attack.py``.
"""

from __future__ import annotations

from typing import Any

import pytest

from tests.lab.mitm.middle import Middle
from tests.network.network import Drone, Flow, Network
from uavlinkd.core import handshake, session, wire
from uavlinkd.core.cookie import CookieJar, MacKeys
from uavlinkd.core.drops import DropReason as Reason
from uavlinkd.core.freshness import Questions, Verification
from uavlinkd.core.indices import Indices
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Path
from uavlinkd.core.peer import Peer
from uavlinkd.core.replay import ReplayWindow
from uavlinkd.core.settings import Link, Timers
from uavlinkd.lab.mitm.anatomy import Kind, kind_of
from uavlinkd.lab.mitm.attacks import parse_attack
from uavlinkd.lab.mitm.radio import RadioSettings

FAST = Link(timers=Timers(rekey_after_s=1.0, reject_after_s=6.0))


class Stage:
    """A linked pair, the man between them, and traffic both ways."""

    def __init__(self, network: Network, link: Link | None = None, *, knows_keys: bool = True) -> None:
        self.network = network
        self.a: Drone = network.add("a")
        self.b: Drone = network.add("b")
        self.middle = Middle(network, self.a, self.b, knows_keys=knows_keys)
        self.middle.introduce(link)
        self.flows: tuple[Flow, Flow] = network.flow(self.a, self.b), network.flow(self.b, self.a)

    def begin(self, *attacks: str, linked: bool = True) -> None:
        """Start both; attack from the first datagram on, or when they are linked."""
        if not linked:
            self._attack(*attacks)
        self.a.start()
        self.b.start()
        self.network.talk(self.a, self.b)
        if linked:
            self.network.run(1)
            self._attack(*attacks)

    def _attack(self, *attacks: str) -> None:
        now = self.network.now
        self.middle.attack(*(parse_attack(each).make(self.middle.surroundings, 1, now) for each in attacks))


def _stage(link: Link | None = None, *, knows_keys: bool = True) -> Stage:
    network = Network("teeth", RadioSettings(delay_s=0.01))
    network.checks_bounds = False
    return Stage(network, link, knows_keys=knows_keys)


@pytest.mark.parametrize("attack", ["alter-frame", "bit-flip", "splice", "forge-data", "extend", "truncate"])
def test_receiver_without_tag_check_delivers_what_nobody_sent(attack: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The network's own check at delivery finds the false frame."""
    monkeypatch.setattr(session, "equal", lambda _one, _other: True)
    stage = _stage()
    stage.begin(f"{attack},begin_s=0.1")
    with pytest.raises(AssertionError) as caught:
        stage.network.run(5)
    assert caught.traceback[-1].name in ("deliver", "perform"), "the payload that came out is no frame that was sent"


def test_receiver_without_tag_check_accepts_a_false_tag(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tag of zeros is as good as any."""
    monkeypatch.setattr(session, "equal", lambda _one, _other: True)
    stage = _stage()
    stage.begin("tamper-tag,tag=zero")
    stage.network.run(3)
    assert [each for each in stage.middle.interventions if each.attack == "tamper-tag"]
    assert stage.a.drops[Reason.BAD_TAG] == stage.b.drops[Reason.BAD_TAG] == 0
    assert not stage.flows[0].lost(1.0, stage.network.now - 0.1)


def test_receiver_that_marks_before_it_verifies_loses_the_link_to_one_counter(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One forged envelope with the last counter there is, and every genuine one is too old."""

    def marks_at_once(self: ReplayWindow, counter: int) -> None:
        genuine_check(self, counter)
        self.mark(counter)

    genuine_check = ReplayWindow.check
    monkeypatch.setattr(ReplayWindow, "check", marks_at_once)
    stage = _stage()
    stage.begin("counter-jump,to=last,limit=2")
    stage.network.run(0.5)
    assert stage.flows[0].lost(1.1, 1.4)
    assert stage.b.drops[Reason.TOO_OLD] + stage.a.drops[Reason.TOO_OLD] > 5


@pytest.mark.parametrize("attack", ["replay-data", "duplicate", "replay-data,when=later,delay_s=2"])
def test_receiver_without_replay_check_delivers_twice(attack: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same frame comes out again."""
    monkeypatch.setattr(ReplayWindow, "check", lambda _self, _counter: None)
    stage = _stage()
    stage.begin(attack)
    with pytest.raises(AssertionError, match="delivered twice"):
        stage.network.run(5)


@pytest.mark.parametrize("attack", ["hold,share=0.2,hold_s=5,seconds=2", "hold,hold_s=5,seconds=5,kinds=any"])
def test_receiver_without_a_sense_of_time_delivers_what_was_held(
    attack: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Authentic and five seconds old, whether others came through meanwhile or nothing did."""
    genuine = session.Session.__init__

    def trusts_for_ever(self: session.Session, *facts: Any, **named: Any) -> None:
        genuine(self, *facts, **named)
        self.trusted_until = float("inf")

    monkeypatch.setattr("uavlinkd.core.peer.c.LATE_AFTER_S", float("inf"))
    monkeypatch.setattr(session.Session, "__init__", trusts_for_ever)
    stage = _stage()
    stage.begin(attack)
    stage.network.run(12)
    assert max(at - flow.sent_at[n] for flow in stage.flows for n, at in flow.delivered.items()) > 4.9


@pytest.mark.parametrize("attack", ["stretch", "stretch-one-way"])
def test_receiver_that_needs_no_answers_delivers_stretched_frames(
    attack: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without verification and without late answers, each frame is older than the one before."""
    genuine = Verification.__init__

    def lasts(self: Verification, now: float, interval_s: float) -> None:
        genuine(self, now, interval_s)
        self.until = self.look_at = float("inf")

    monkeypatch.setattr(Verification, "__init__", lasts)
    monkeypatch.setattr(Questions, "is_issued", lambda _self, _token: False)
    stage = _stage()
    stage.begin(f"{attack},way=a>b")
    stage.network.run(30)
    assert stage.flows[0].oldest_s > 25.0


def test_receiver_with_one_key_for_both_directions_takes_its_own_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where neither the key nor the index tells the direction, a reflected envelope is the peer's."""

    def derive(*facts: Any, from_initiator: bool) -> session.Protection:
        return genuine_derive(facts[0], facts[1], facts[2], from_initiator=from_initiator or True)

    genuine_derive = session.derive

    class OneKey(session.Session):
        def __init__(self, *facts: Any, **named: Any) -> None:
            super().__init__(*facts, **named)
            self._receive = self._send if self.is_initiator else self._receive
            self._send = self._receive

    monkeypatch.setattr(session, "derive", derive)
    monkeypatch.setattr("uavlinkd.core.peer.Session", OneKey)
    monkeypatch.setattr(Indices, "pick", lambda _self, _now: 7)
    monkeypatch.setattr(ReplayWindow, "check", lambda _self, _counter: None)
    stage = _stage()
    stage.b.acquaintances["a"] = (stage.b.acquaintances["a"][0], ())  # it is called, so there is one session
    stage.begin("reflect,kinds=envelope")
    with pytest.raises(AssertionError, match=r"altered|never sent"):
        stage.network.run(3)


def test_receiver_that_takes_the_header_as_it_is_never_hears_its_peer(monkeypatch: pytest.MonkeyPatch) -> None:
    """An altered index leaves two ends that agree on keys and speak past one another."""

    def open_payload(payload: bytes, header: bytes) -> wire.Parameters:
        return wire.parse_parameters(payload[len(header) - 1 :])

    monkeypatch.setattr(handshake, "_open_payload", open_payload)
    stage = _stage()
    stage.begin("alter-indices,message=response,field=sender", linked=False)
    stage.network.run(4)
    assert stage.a.drops[Reason.HEADER_MISMATCH] + stage.b.drops[Reason.HEADER_MISMATCH] == 0
    assert any(True for _ in stage.a.established())
    assert not stage.flows[0].delivered
    assert stage.b.drops[Reason.UNKNOWN_INDEX] > 5


def test_receiver_without_mac1_check_answers_strangers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever sends enough gets a cookie, and knows that somebody is there."""
    monkeypatch.setattr(MacKeys, "check_mac1", lambda _self, _datagram: None)
    stage = _stage(knows_keys=False)
    stage.begin("flood-initiations,mac1=bad")
    stage.network.run(2)
    assert len(stage.middle.to_strangers) > 50


@pytest.mark.parametrize("origin", ["sender", "stranger"])
def test_receiver_without_memory_of_initiations_answers_replays(origin: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each replay costs it a handshake and a place for a session; even then the session in use goes on."""
    monkeypatch.setattr(Node, "_remember", lambda *_: None)
    stage = _stage(FAST)
    answered: list[bytes] = []

    class Listener:
        def overhear(self, datagram: bytes, source: object, destination: object) -> None:
            answered.append(datagram)

        def receive(self, datagram: bytes, source: object, destination: object) -> None:
            """Nothing is sent to it."""

    stage.network.listeners.append(Listener())
    stage.begin(f"replay-initiation,copies=3,origin={origin},limit=5")
    stage.network.run(6)
    initiations = [each for each in answered if kind_of(each) is Kind.INITIATION]
    responses = [each for each in answered if kind_of(each) is Kind.RESPONSE]
    assert stage.a.drops[Reason.REPLAYED_INITIATION] + stage.b.drops[Reason.REPLAYED_INITIATION] == 0
    assert len(responses) >= len(initiations) + 5  # a burst, then two a second while the link is up


def test_receiver_that_follows_every_address_loses_its_traffic(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a path challenge one forwarded envelope pulls the frames to the attacker, who then stops."""

    def follow(self: Peer, _session: object, path: Path, *_rest: object) -> None:
        self.path = path

    monkeypatch.setattr(Peer, "_challenge_path", follow)
    stage = _stage()
    stage.begin("roam,mode=race")
    stage.network.run(3)
    stolen = [datagram for _, _, datagram in stage.middle.to_strangers if len(datagram) == 5 + 24 + 16]
    assert len(stolen) > 10
    assert stage.flows[0].lost(1.5, 2.5) or stage.flows[1].lost(1.5, 2.5)


def test_receiver_with_long_cookie_replies_is_found_by_the_probe(monkeypatch: pytest.MonkeyPatch) -> None:
    """More bytes back than were sent there: the probe says so."""
    monkeypatch.setattr(CookieJar, "reply", lambda *_: b"\x03" + bytes(2000))
    stage = _stage()
    stage.begin("amplification-probe,rate_per_s=1000")
    stage.network.run(3)
    assert any("amplified" in each.detail for each in stage.middle.interventions)
