"""The attacks are effective: each succeeds against a receiver without the check that prevents it.

With all checks, they fail against the same receiver: see ``test_under_attack.py``.
"""

from __future__ import annotations

from typing import Any

import pytest

from tests.lab.mitm.middle import Middle
from tests.network.network import Drone, Flow, Network
from uavlinkd.lab.mitm.anatomy import DatagramKind, kind_of
from uavlinkd.lab.mitm.attacks import parse_attack
from uavlinkd.lab.mitm.radio import RadioSettings
from uavlinkd.protocol import handshake, probing, session, wire
from uavlinkd.protocol.cookie import CookieJar, MacKeys
from uavlinkd.protocol.counters import ReplayWindow
from uavlinkd.protocol.drops import DropReason as Reason
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.path_state import PathState
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.receive_handshake import HandshakeReceiver
from uavlinkd.protocol.sessions import EchoRequests, Indices
from uavlinkd.protocol.settings import Link, Timers
from uavlinkd.protocol.verification import Verification

FAST = Link(timers=Timers(rekey_after_s=1.0, reject_after_s=6.0))


class Stage:
    """A linked pair, the man in the middle, and traffic in both directions."""

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
        self.middle.attack(*(parse_attack(attack).make(self.middle.context, 1, now) for attack in attacks))


def _stage(link: Link | None = None, *, knows_keys: bool = True) -> Stage:
    network = Network("teeth", RadioSettings(delay_s=0.01))
    network.checks_bounds = False
    return Stage(network, link, knows_keys=knows_keys)


@pytest.mark.parametrize("attack", ["alter-frame", "bit-flip", "splice", "forge-data", "extend", "truncate"])
def test_receiver_without_tag_check_delivers_forged_frames(attack: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The network's own check at delivery finds the false frame."""
    monkeypatch.setattr(session, "equal", lambda _one, _other: True)
    stage = _stage()
    stage.begin(f"{attack},begin_s=0.1")
    with pytest.raises(AssertionError) as caught:
        stage.network.run(5)
    assert caught.traceback[-1].name in ("deliver", "perform"), "the delivered payload was never sent"


@pytest.mark.parametrize("attack", ["hold,share=0.2,hold_s=5,seconds=2", "hold,hold_s=5,seconds=5,kinds=any"])
def test_receiver_without_a_sense_of_time_delivers_what_was_held(
    attack: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The frame is authentic and 5 s old, with or without other frames meanwhile."""
    genuine = session.Session.__init__

    def trusts_indefinitely(self: session.Session, *facts: Any, **named: Any) -> None:
        genuine(self, *facts, **named)
        self.trusted_until = float("inf")

    monkeypatch.setattr("uavlinkd.protocol.peer.c.LATE_AFTER_S", float("inf"))
    monkeypatch.setattr(session.Session, "__init__", trusts_indefinitely)
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
    monkeypatch.setattr(EchoRequests, "is_late", lambda _self, _token: False)
    stage = _stage()
    stage.begin(f"{attack},direction=a>b")
    stage.network.run(30)
    assert stage.flows[0].oldest_s > 20.0


def test_receiver_with_one_key_for_both_directions_takes_its_own_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """If neither key nor index depends on the direction, a reflected envelope looks like the peer's."""
    genuine = session.envelope_keys

    class OneKey(session.Session):
        def __init__(self, *facts: Any, **named: Any) -> None:
            super().__init__(*facts, **named)
            self._receive = self._send if self.is_initiator else self._receive
            self._send = self._receive

    monkeypatch.setattr(session, "envelope_keys", lambda keys: 2 * genuine(keys)[:1])
    monkeypatch.setattr("uavlinkd.protocol.establish.Session", OneKey)
    monkeypatch.setattr(Indices, "pick", lambda _self, _now: 7)
    monkeypatch.setattr(ReplayWindow, "is_used", lambda _self, _counter: False)
    stage = _stage()
    stage.b.acquaintances["a"] = (stage.b.acquaintances["a"][0], ())  # it is called, so there is one session
    stage.begin("reflect,kinds=envelope")
    with pytest.raises(AssertionError, match=r"altered|never sent"):
        stage.network.run(3)


def test_receiver_that_takes_the_header_as_it_is_never_hears_its_peer(monkeypatch: pytest.MonkeyPatch) -> None:
    """An altered index leaves two ends that agree on keys and speak past one another."""

    def open_payload(payload: bytes, header: bytes) -> tuple[wire.Parameters, bytes]:
        return wire.parse_parameters(payload[len(header) - 1 :]), b""

    monkeypatch.setattr(handshake, "_open_payload", open_payload)
    stage = _stage()
    stage.begin("alter-indices,message=response,field=sender", linked=False)
    stage.network.run(4)
    assert stage.a.drops[Reason.HEADER_MISMATCH] + stage.b.drops[Reason.HEADER_MISMATCH] == 0
    assert any(True for _ in stage.a.established())
    assert not stage.flows[0].delivered
    assert stage.b.drops[Reason.UNKNOWN_INDEX] > 5


def test_receiver_without_mac1_check_answers_strangers(monkeypatch: pytest.MonkeyPatch) -> None:
    """A sender under load gets a cookie reply, which shows that a daemon listens."""
    monkeypatch.setattr(MacKeys, "has_valid_mac1", lambda _self, _datagram: True)
    stage = _stage(knows_keys=False)
    stage.begin("flood-initiations,mac1=bad")
    stage.network.run(2)
    assert len(stage.middle.to_strangers) > 50


@pytest.mark.parametrize("origin", ["sender", "stranger"])
def test_receiver_without_memory_of_initiations_answers_replays(origin: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each replay costs a handshake and an index, but the session in use continues."""
    monkeypatch.setattr(HandshakeReceiver, "remember", lambda *_: None)
    stage = _stage(FAST)
    answered: list[bytes] = []

    class Listener:
        def overhear(self, datagram: bytes, source: object, destination: object) -> None:
            answered.append(datagram)

        def receive(self, datagram: bytes, source: object, destination: object) -> None:
            """It receives no datagrams."""

    stage.network.listeners.append(Listener())
    stage.begin(f"replay-initiation,copies=3,origin={origin},limit=5")
    stage.network.run(6)
    initiations = [datagram for datagram in answered if kind_of(datagram) is DatagramKind.INITIATION]
    responses = [datagram for datagram in answered if kind_of(datagram) is DatagramKind.RESPONSE]
    assert stage.a.drops[Reason.REPLAYED_INITIATION] + stage.b.drops[Reason.REPLAYED_INITIATION] == 0
    assert len(responses) >= len(initiations) + 5  # a burst, then two a second while the link is up


def test_receiver_that_follows_every_address_loses_its_traffic(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a question one forwarded envelope pulls the frames to the attacker, who then stops."""
    genuine_learn = probing.learn

    def follow(peer: Peer, path: Path, now: float) -> PathState:
        state = peer.paths.best = genuine_learn(peer, path, now)
        state.is_proven = True
        state.set_usable(now)
        peer.paths.update(peer, now)
        return state

    monkeypatch.setattr(probing, "learn", follow)
    stage = _stage()
    stage.begin("roam,mode=race")
    stage.network.run(3)
    stolen = [datagram for _, _, datagram in stage.middle.to_strangers if len(datagram) == 5 + 24 + 16]
    assert len(stolen) > 10
    assert stage.flows[0].lost(1.5, 2.5) or stage.flows[1].lost(1.5, 2.5)


@pytest.mark.long
def test_receiver_with_long_cookie_replies_is_found_by_the_probe(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stranger received more bytes than it sent."""
    monkeypatch.setattr(CookieJar, "reply", lambda *_: b"\x03" + bytes(2000))
    stage = _stage()
    stage.begin("amplification-probe,rate_per_s=1000")
    stage.network.run(3)
    assert stage.middle.amplification.excess
