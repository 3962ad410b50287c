"""Members by certificate: what they learn of each other, and how they end."""

from __future__ import annotations

from tests.relay.certified import LINK, CertifiedRelay
from uavlinkd.authority.certificates import MemberRole
from uavlinkd.authority.constants import (
    CERTIFICATES,
    CERTIFICATES_PER_ANSWER,
    INTRODUCED_AGAIN_S,
    INTRODUCED_TRIES,
    WHO,
)
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.relay_records import Bind, Who, wrap
from uavlinkd.protocol.settings import PeerSettings

VEHICLE, OPERATOR, OBSERVER = MemberRole.VEHICLE, MemberRole.OPERATOR, MemberRole.OBSERVER
ELSEWHERE = Path(0, ("203.0.113.7", 4000))
DATA = b"\x40datagram"


# Questions.


def test_answer_has_members_that_are_up_by_role_ascending_by_serial() -> None:
    """Without the one that asks. The answer to the question after the last serial continues it."""
    relay = CertifiedRelay()
    vehicles = relay.join(*range(20, 0, -1))
    keys = [member.key for member in reversed(vehicles)]
    (operator,) = relay.join(30, role=OPERATOR)
    (observer,) = relay.join(31, role=OBSERVER)
    assert operator.ask(VEHICLE) == keys[:CERTIFICATES_PER_ANSWER]
    assert operator.ask(VEHICLE, after=8) == keys[8:16]
    assert operator.ask(VEHICLE, OBSERVER, after=16) == [*keys[16:], observer.key]
    assert operator.ask(VEHICLE, OPERATOR, after=2**32 - 1) == []
    assert operator.ask(OPERATOR) == []
    assert vehicles[-1].ask(VEHICLE) == keys[1 : 1 + CERTIFICATES_PER_ANSWER]
    assert observer.ask(MemberRole.RELAY) == []
    vehicles[-1].close()
    relay.node.remove_peer(vehicles[-2].at_relay, relay.now)
    relay.service.end(vehicles[-3].key, relay.now)
    assert keys[0] not in operator.ask(VEHICLE)
    assert keys[2] not in operator.ask(VEHICLE)


def test_newer_certificate_of_a_member_takes_the_place_of_the_one_before() -> None:
    """With other limits. The session continues."""
    relay = CertifiedRelay()
    one, operator = *relay.join(1), *relay.join(2, role=OPERATOR)
    session, held = one.at_relay.sessions.current, relay.trust.held[one.key]
    newer = held._replace(certificate=held.certificate._replace(serial=9))
    relay.most_peers = 1
    relay.service.admit(one.at_relay, relay.settings(one.at_relay.settings), newer, relay.now, is_own=True)
    assert operator.ask(VEHICLE, after=8) == [one.key]
    assert operator.ask(VEHICLE, after=9) == []
    relay.service.introductions.renew(
        {one.key: held._replace(certificate=held.certificate._replace(serial=11)), bytes(32): held}
    )
    assert operator.ask(VEHICLE, after=10) == [one.key]
    relay.service.introductions.renew({})
    assert operator.ask(VEHICLE, after=10) == [one.key]
    assert one.at_relay.sessions.current is session
    one.bind(operator, one)
    assert relay.service.bindings.refused(one.key) == 0
    one.send(Bind((bytes(32),)))
    assert relay.service.bindings.refused(one.key) == 1


def test_question_waits_for_its_path() -> None:
    """An address that a captured member names gets no answer. Its own does, as soon as it is proven."""
    relay = CertifiedRelay()
    one, _ = relay.join(1, 2)
    session = one.peer.sessions.current
    assert session is not None
    question = session.seal(session.sealed_record(Who(1 << VEHICLE).encode()), relay.now)
    relay.arrive(question, ELSEWHERE)
    relay.settle()
    assert sum(len(datagram) for datagram, _ in relay.outside) <= len(question)
    relay.outside.clear()
    relay.pass_time(c.QUESTION_LIFETIME_S + 1)
    assert relay.service.members[one.key].key == one.key
    assert not relay.service._questions
    assert not relay.service._asked
    assert [reason for reason, name, _ in relay.service.count_drops() if name == "m1"] == [
        DropReason.UNEXPECTED_RECORD
    ]
    relay.members[ELSEWHERE], one.home = relay.members.pop(one.home), ELSEWHERE  # it moved
    question = session.seal(session.sealed_record(Who(1 << VEHICLE).encode()), relay.now)
    relay.arrive(question, ELSEWHERE)
    assert one.learnt == []
    relay.settle()
    relay.pass_time(1.0)
    assert len(one.learnt) == 1


def test_flood_of_questions_costs_only_its_sender() -> None:
    """Above its budget, questions have no effect. Another one is answered."""
    relay = CertifiedRelay()
    one, other, *_ = relay.join(*range(1, 20))
    for _ in range(200):
        one.send(Who(1 << VEHICLE))
    assert len(one.learnt) == CERTIFICATES.burst < WHO.burst * CERTIFICATES_PER_ANSWER
    assert relay.dropped == [DropReason.RECORD_OVER_LIMIT] * (200 - WHO.burst)
    assert len(other.ask(VEHICLE)) == CERTIFICATES_PER_ANSWER
    relay.pass_time(1.0)
    for _ in range(20):
        one.send(Who(1 << VEHICLE))
    assert len(one.learnt) == CERTIFICATES.burst + CERTIFICATES.per_s


# Introductions.


def test_member_that_is_sought_learns_who_seeks_it() -> None:
    """It gets the certificate, and binds back; then a renewed bind causes no other one."""
    relay = CertifiedRelay()
    vehicle, operator = *relay.join(1), *relay.join(2, role=OPERATOR)
    vehicle.bind(operator)
    assert operator.learnt == [vehicle.key]
    vehicle.bind(operator)
    assert operator.learnt == [vehicle.key], "binds along several paths"
    operator.bind(vehicle)
    assert any(operator.handles[vehicle.key])
    relay.pass_time(c.BIND_WAITING_S)
    vehicle.bind(operator)
    assert operator.learnt == [vehicle.key]
    assert vehicle.learnt == []


def test_introduction_is_repeated() -> None:
    """While the other one does not bind: a record may be lost. Later only with renewed binds."""
    relay = CertifiedRelay()
    vehicle, operator = *relay.join(1), *relay.join(2, role=OPERATOR)
    vehicle.bind(operator)
    relay.pass_time(INTRODUCED_AGAIN_S + 0.2)
    assert operator.learnt == [vehicle.key] * 2
    relay.pass_time(c.BIND_WAITING_S)
    assert operator.learnt == [vehicle.key] * INTRODUCED_TRIES
    vehicle.bind(operator)
    relay.pass_time(c.BIND_WAITING_S)
    assert operator.learnt == [vehicle.key] * (INTRODUCED_TRIES + 1)


def test_introduction_is_not_repeated_to_one_that_bound_or_about_one_that_left() -> None:
    relay = CertifiedRelay()
    one, other = relay.join(1, 2)
    (operator,) = relay.join(9, role=OPERATOR)
    one.bind(operator)
    other.bind(operator)
    operator.bind(one)
    relay.service.end(other.key, relay.now)
    relay.members.pop(other.home)
    relay.pass_time(c.BIND_WAITING_S)
    assert operator.learnt == [one.key, other.key]


def test_member_that_comes_up_is_introduced_to_its_seekers() -> None:
    """Whether it was known before or not. It gets no certificate of those that it binds soon."""
    relay = CertifiedRelay()
    seekers = relay.join(*range(1, 6))
    (operator,) = relay.join(9, role=OPERATOR)
    operator.close()
    for seeker in seekers:
        seeker.bind(operator)
    assert operator.learnt == []
    operator.restart()
    relay.pass_time(0.8)
    assert operator.learnt == [seeker.key for seeker in seekers]
    operator.bind(*seekers[:3])
    operator.restart()  # without a close: its wishes of before are still there
    relay.pass_time(0.2)
    operator.bind(*seekers[2:4])
    relay.pass_time(0.8)
    assert operator.learnt == [seekers[0].key, seekers[1].key, seekers[4].key]


def test_members_that_are_back_after_a_restart_of_the_relay_cause_no_introduction() -> None:
    """They know each other, and bind within the time that the relay waits. One that is forgotten is introduced."""
    relay = CertifiedRelay()
    vehicles = relay.join(1, 2, 3)
    (operator,) = relay.join(9, role=OPERATOR)
    relay.start()
    for member in (*vehicles, operator):
        learnt = member.learnt
        member.restart()
        member.learnt = learnt
    relay.pass_time(0.3)
    for vehicle in vehicles:
        vehicle.bind(operator)
    operator.bind(*vehicles[:2])
    relay.pass_time(0.6)
    assert operator.learnt == [vehicles[2].key]


def test_seekers_that_share_a_victim_share_its_budget() -> None:
    """One member that binds without end causes one introduction each time; another one gets through."""
    relay = CertifiedRelay()
    vehicle, other = relay.join(1, 2)
    (operator,) = relay.join(9, role=OPERATOR)
    for _ in range(200):
        vehicle.bind(operator)
    assert operator.learnt == [vehicle.key]
    other.bind(operator)
    assert operator.learnt == [vehicle.key, other.key]


def test_memory_of_introductions_is_that_of_the_wishes() -> None:
    """When a wish ends, or its member, nothing is left."""
    relay = CertifiedRelay()
    one, other, third = relay.join(1, 2, 3)
    one.bind(third)
    other.bind(third)
    of_third = relay.service.introductions._members[third.key]
    assert of_third.seekers.keys() == {one.key, other.key}
    relay.service.end(one.key, relay.now)
    relay.members.pop(one.home)
    relay.pass_time(0.2)
    assert of_third.seekers.keys() == {other.key}
    relay.pass_time(c.BIND_LIFETIME_S + 1)
    assert of_third.seekers == {}
    other.bind(third)
    relay.service.end(third.key, relay.now)
    assert third.key not in relay.service.introductions
    assert relay.service.bindings.wished_at(third.key, other.key) == -c.NEVER


def test_limit_of_peers_holds_for_introductions() -> None:
    """A wish that the relay ignores causes no introduction."""
    relay = CertifiedRelay()
    relay.most_peers = 1
    vehicle, one, other = relay.join(1, 2, 3)
    vehicle.bind(one, other)
    assert one.learnt == [vehicle.key]
    assert other.learnt == []


# Blindness.


def test_only_members_by_certificate_take_part() -> None:
    """A member of the configuration gets and is no certificate. Binds of any key have the same answer."""
    relay = CertifiedRelay()
    vehicle, pinned = relay.join(1, 2)
    key, peer = pinned.key, pinned.at_relay
    pinned.close()
    relay.service.release({}, {key}, relay.now)
    assert peer.name not in relay.node.peers
    settings = {key: relay.settings(PeerSettings("pinned", key, None, LINK))}
    relay.service.set_members(settings, {}, relay.now)
    pinned.restart()
    relay.pass_time(1.0)
    assert relay.service.members[key].settings.name == "pinned"
    assert pinned.ask(VEHICLE) == []
    assert relay.dropped == [DropReason.UNEXPECTED_RECORD]
    assert vehicle.ask(VEHICLE) == []
    pinned.bind(vehicle)
    vehicle.bind(pinned)
    assert vehicle.learnt == pinned.learnt == []
    assert any(vehicle.handles[key])
    held = relay.trust.held[vehicle.key]
    relay.service.admit(pinned.at_relay, settings[key], held, relay.now, is_own=True)
    relay.service.end(key, relay.now)
    assert key not in relay.service.introductions
    assert key in relay.service.members


# Ends.


def test_revoked_member_ends_in_the_same_call() -> None:
    """Its handles, wishes, session and place; what waits to be sent about it too. It gets no close."""
    relay = CertifiedRelay()
    one, other, third = relay.join(1, 2, 3)
    one.bind(other, third)
    other.bind(one)
    third.send(Who(1 << VEHICLE))
    (handle,) = one.handles[other.key]
    (back,) = other.handles[one.key]
    assert len(relay.service.forwarding) == 2
    relay.pass_time(c.BIND_WAITING_S)
    learnt = list(third.learnt)
    session = one.peer.sessions.current
    assert session is not None
    for record in (Bind((third.key,)), Who(1 << VEHICLE)):
        relay._perform(
            relay.node.receive(session.seal(session.sealed_record(record.encode()), relay.now), one.home, relay.now)
        )
    relay.revoke(1)
    assert not relay.sent
    assert len(relay.service.forwarding) == 0
    assert "m1" not in relay.node.peers
    assert one.key not in relay.service.members
    dropped = relay.service.forwarding.dropped[DropReason.RELAY_UNKNOWN_HANDLE]
    for number, member in ((handle, one), (back, other)):
        relay.service.forwarding.take(0, wrap(number, DATA), member.home.address)
    assert relay.service.forwarding.dropped[DropReason.RELAY_UNKNOWN_HANDLE] == dropped + 2
    relay.service.settle(relay.now)
    relay.settle()
    assert third.learnt == learnt
    assert other.handles[one.key] == [0]
    assert third.ask(VEHICLE) == [other.key]
    one.restart()
    relay.pass_time(2.0)
    assert "m1" not in relay.node.peers


def test_member_that_carries_frames_keeps_its_peer() -> None:
    """The daemon has that one. The relay gives up the membership only, also if another peer has the key later."""
    relay = CertifiedRelay()
    one, other = relay.join(1, 2)
    peer, held = one.at_relay, relay.trust.held[one.key]
    relay.service._remove(relay.service.members[one.key], relay.now)
    settings = relay.settings(peer.settings)
    peer = relay.node.add_peer(peer.settings, relay.now)
    relay.service.admit(peer, settings, held, relay.now, is_own=False)
    relay.service.set_members({}, {one.key: peer}, relay.now)
    assert relay.service.members.keys() == {one.key, other.key}, "those of the configuration are others"
    relay.service.end(one.key, relay.now)
    relay.service.end(one.key, relay.now)
    assert relay.service.members.keys() == {other.key}
    assert relay.node.peers["m1"] is peer
    relay.service.admit(peer, settings, held, relay.now, is_own=False)
    relay.node.remove_peer(peer, relay.now)
    again = relay.node.add_peer(peer.settings, relay.now)
    relay.service.admit(again, settings, held, relay.now, is_own=False)
    assert relay.service.members[one.key].peer is again
