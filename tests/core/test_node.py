"""What a node does with datagrams: of strangers, forgers, floods and peers. Every drop has its reason."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.core.harness import (
    AT_A,
    AT_B,
    ELSEWHERE,
    FRAME,
    KEY_A,
    KEY_B,
    KEY_C,
    PLAIN,
    UNUSED_INDEX,
    Pair,
    datagrams,
    exhaust,
    flipped,
    initiation_of,
    of,
    only,
    payloads,
    quiet,
    reasons,
    repaired,
    seeded,
    state_of,
    with_macs,
)
from uavlinkd.core import constants as c
from uavlinkd.core import establish, handshake, noise, wire
from uavlinkd.core.crypto import Entropy, KeyPair, Secret
from uavlinkd.core.drops import DropReason
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Dropped, Output, SessionEstablished, Transmit
from uavlinkd.core.path import Path
from uavlinkd.core.probe import Probe
from uavlinkd.core.settings import Link, PeerSettings
from uavlinkd.core.suites import SUITES, SUITES_BY_NAME, Suite

QUIET = quiet()
STILL_VALID_S = 100.0
LATER = 4.0
"""More than two seconds after second 1."""
ENTROPY = seeded(77)


def established(**links: Link) -> Pair:
    """A session at second 0 with quiet timers."""
    return Pair(link_a=links.get("link_a", QUIET), link_b=links.get("link_b", QUIET)).establish()


def made_initiation(
    identity: KeyPair = KEY_A, to: KeyPair = KEY_B, link: Link = PLAIN, index: int = 77, entropy: Entropy = ENTROPY
) -> bytes:
    """An initiation by the holder of this identity, made by hand."""
    initiated = handshake.initiate(identity, PeerSettings("peer", to.public, None, link), index, 0, entropy)
    return with_macs(initiated.message, to.public)


def retried(pair: Pair, start: float) -> tuple[float, bytes]:
    """Alpha's next initiation after ``start``, and when it is made."""
    for _ in range(40):
        now = max(start, pair.a.node.next_deadline())
        made = datagrams(pair.a.timeout(now), wire.INITIATION)
        if made:
            return now, made[0]
    raise AssertionError("alpha does not initiate")


def completes(pair: Pair, initiation: bytes, now: float) -> bool:
    """Whether this initiation leads to a session that carries frames."""
    response = only(datagrams(pair.b.receive(initiation, now), wire.RESPONSE))
    pair.b.receive(only(datagrams(pair.a.receive(response, now))), now)
    return pair.carries(now)


# Why something is dropped: one row for each reason.


def malformed(pair: Pair, now: float) -> list[Output]:
    """An unknown type."""
    return pair.b.receive(b"\x07hello", now)


def raw_mavlink(pair: Pair, now: float) -> list[Output]:
    """A bare frame, as any autopilot sends it."""
    return pair.b.receive(FRAME, now)


def unexpected_response(pair: Pair, now: float) -> list[Output]:
    """A response without an initiation."""
    header = wire.response_header(SUITES[0], 5, UNUSED_INDEX)
    message = header + bytes(wire.response_bytes(SUITES[0]) - len(header) - wire.MACS_BYTES)
    return pair.b.receive(with_macs(message, pair.b.node.public_key), now)


def bad_mac1(pair: Pair, now: float) -> list[Output]:
    """A genuine initiation with one bit turned over."""
    return pair.b.receive(flipped(made_initiation(), 40), now)


def other_version(pair: Pair, now: float) -> list[Output]:
    """An initiation of the version before this one."""
    return pair.b.receive(initiation_of(c.PROTOCOL_VERSION - 1, pair.b.node.public_key), now)


def cookie_required(pair: Pair, now: float) -> list[Output]:
    """An initiation under load."""
    exhaust(pair.b, now)
    return pair.b.receive(made_initiation(), now)


def rate_limited(pair: Pair, now: float) -> list[Output]:
    """More initiations with a cookie than one source may send under load."""
    exhaust(pair.b, now)
    initiation = made_initiation()
    initiated = wire.parse_initiation(initiation)
    raw = pair.b.node._handshakes.own.cookies.reply(initiation, initiated.sender_index, AT_A, now)
    cookie = pair.b.node._handshakes.own.mac_keys.open_cookie(wire.parse_cookie_reply(raw), initiation[-32:-16])
    outputs: list[Output] = []
    for _ in range(c.COOKIED_PER_SOURCE_BURST + 1):
        message = made_initiation(KEY_C)[: -wire.MACS_BYTES]
        outputs = pair.b.receive(with_macs(message, KEY_B.public, cookie), now)
    return outputs


def replayed_initiation(pair: Pair, now: float) -> list[Output]:
    """The same initiation again, after its session was not confirmed in time."""
    initiation = made_initiation()
    assert datagrams(pair.b.receive(initiation, now), wire.RESPONSE)
    pair.b.peer.sessions.expire(now + c.UNCONFIRMED_LIFETIME_S)
    return pair.b.receive(initiation, now)


def duplicate(pair: Pair, now: float) -> list[Output]:
    """The same initiation again, along the same path, while its session waits."""
    initiation = made_initiation()
    assert datagrams(pair.b.receive(initiation, now), wire.RESPONSE)
    return pair.b.receive(initiation, now)


def wrong_network(pair: Pair, now: float) -> list[Output]:
    """An envelope of this peer arrives along a line with another peer at its end."""
    pair.b.node.set_point_to_point({1: []})
    return pair.b.receive(pair.a.envelope(now), now, Path(1, ("serial", 0)))


def invalid_key_share(pair: Pair, now: float) -> list[Output]:
    """An initiation with an ephemeral key of low order."""
    message = bytearray(made_initiation())
    message[4:36] = bytes(32)
    return pair.b.receive(repaired(bytes(message), KEY_B.public), now)


def bad_handshake(pair: Pair, now: float) -> list[Output]:
    """An altered initiation whose mac1 was made right again."""
    return pair.b.receive(repaired(flipped(made_initiation(), 40), KEY_B.public), now)


def unknown_peer(pair: Pair, now: float) -> list[Output]:
    """A sound initiation of a stranger."""
    return pair.b.receive(made_initiation(KEY_C), now)


def suite_not_accepted(pair: Pair, now: float) -> list[Output]:
    """A peer that offers what our configuration does not list."""
    return pair.b.receive(made_initiation(link=Link(suites=(SUITES_BY_NAME["mlkem768"],))), now)


def header_mismatch(pair: Pair, now: float) -> list[Output]:
    """An initiation whose sender index was altered in transit."""
    return pair.b.receive(repaired(flipped(made_initiation(), 3), KEY_B.public), now)


def bad_parameters(pair: Pair, now: float) -> list[Output]:
    """A peer that asks for a tag of three bytes."""
    return pair.b.receive(made_initiation(link=Link(tag_bytes=3)), now)


def no_free_index(pair: Pair, now: float) -> list[Output]:
    """An initiation when every index is taken."""
    owners = pair.b.node._indices.owners
    kept = dict(owners)
    owners.update({index: (pair.b.peer, pair.b.session) for index in range(2**16) if index not in owners})
    outputs = pair.b.receive(made_initiation(), now)
    owners.clear()
    owners.update(kept)
    return outputs


def group_budget_spent(pair: Pair, now: float) -> list[Output]:
    """An initiation with a group from somewhere new, after the peer's share is spent."""
    peer, costly = pair.b.peer, SUITES_BY_NAME["ffdhe2048"]
    while peer.group_share.anywhere.take(now):
        pass
    settings = peer.settings
    peer.settings = replace(settings, link=replace(settings.link, suites=(costly, *settings.link.suites)))
    outputs = pair.b.receive(made_initiation(link=Link(suites=(costly,))), now, ELSEWHERE)
    peer.settings = settings
    return outputs


def over_share(pair: Pair, now: float) -> list[Output]:
    """A genuine envelope that a busy shell does not hand over."""
    return [pair.b.node.refuse(pair.a.envelope(now), AT_A)]


def too_long(pair: Pair, now: float) -> list[Output]:
    """An authentic envelope one byte longer than agreed."""
    session = pair.a.session
    padding = bytes(session.max_envelope + 1 - session.envelope_bytes(len(FRAME)))
    return pair.b.receive(pair.a.envelope(now, FRAME + padding), now)


def unexpected_cookie(pair: Pair, now: float) -> list[Output]:
    """A cookie for a session in use, which asked for none."""
    return pair.b.receive(wire.encode_cookie_reply(pair.b.session.local_index, bytes(16), bytes(32)), now)


def bad_cookie(pair: Pair, now: float) -> list[Output]:
    """A cookie that does not open, for a response of ours that waits."""
    pair.b.receive(made_initiation(), now)
    waiting = next(iter(pair.b.peer.sessions.unconfirmed))
    return pair.b.receive(wire.encode_cookie_reply(waiting, bytes(16), bytes(32)), now)


def unknown_index(pair: Pair, now: float) -> list[Output]:
    """An envelope for an unknown session."""
    return pair.b.receive(wire.envelope_header(UNUSED_INDEX, 1) + bytes(20), now)


def late(pair: Pair, now: float) -> list[Output]:
    """An envelope of a session that ended here."""
    envelope = pair.a.envelope(now)
    pair.b.receive(pair.a.envelope(now, wire.Close().encode()), now)
    pair.a.peer.sessions.clear(now)
    initiation = made_initiation_of(pair, now)
    assert completes(pair, initiation, now)
    return pair.b.receive(envelope, now)


def made_initiation_of(pair: Pair, now: float) -> bytes:
    """An initiation that alpha waits for the answer of."""
    return only(datagrams(establish.initiate(pair.a.peer, now)))


def session_expired(pair: Pair, now: float) -> list[Output]:
    """An envelope under keys that reach their end before the timer runs."""
    old = pair.a.envelope(now)
    pair.b.session.reject_at = now
    outputs = pair.b.receive(old, now)
    pair.b.session.reject_at = now + STILL_VALID_S
    return outputs


def long_counter(pair: Pair, now: float) -> list[Output]:
    """The header of an envelope rewritten in the long form."""
    envelope = pair.a.envelope(now)
    return pair.b.receive(b"\x41" + envelope[1:3] + b"\0\0" + envelope[3:], now)


def replayed(pair: Pair, now: float) -> list[Output]:
    """An envelope again three seconds later, from where the peer never was."""
    return pair.b.receive(accepted_before(pair, now), LATER, ELSEWHERE)


def late_copy(pair: Pair, now: float) -> list[Output]:
    """The same along the path of the peer."""
    return pair.b.receive(accepted_before(pair, now), LATER)


def accepted_before(pair: Pair, now: float) -> bytes:
    """An envelope that was accepted, and others since."""
    envelope = pair.a.envelope(now)
    assert payloads(pair.b.receive(envelope, now)) == [FRAME]
    while now < LATER:
        now += 0.5
        assert payloads(pair.b.receive(pair.a.envelope(now), now)) == [FRAME]
    return envelope


def delayed(pair: Pair, now: float) -> list[Output]:
    """An envelope that its sender says to be of the past."""
    envelope = pair.a.envelope(now)
    pair.b.session.refuse_below(pair.a.session.send_counter)
    return pair.b.receive(envelope, now)


def bad_tag(pair: Pair, now: float) -> list[Output]:
    """A genuine envelope with one bit of a frame turned over."""
    return pair.b.receive(flipped(pair.a.envelope(now), 12), now)


def bad_control(pair: Pair, now: float) -> list[Output]:
    """An authentic control record of an unknown kind."""
    return pair.b.receive(pair.a.envelope(now, b"\x66"), now)


def unexpected_answer(pair: Pair, now: float) -> list[Output]:
    """An answer without a question."""
    return pair.b.receive(pair.a.envelope(now, Probe(0, 7, 1, 1).encode()), now)


def doubtful(pair: Pair, now: float) -> list[Output]:
    """Frames after a silence, about which the peer says nothing."""
    envelope = pair.a.envelope(now)
    pair.b.session.trusted_until = now - c.HOLD_S - 1.0
    pair.b.receive(envelope, now - c.HOLD_S)
    return pair.b.timeout(now)


def no_session(pair: Pair, now: float) -> list[Output]:
    """Frames for a peer that was never linked."""
    pair.b.node.add_peer(PeerSettings("charlie", KEY_C.public), now)
    return pair.b.node.send(pair.b.node.peers["charlie"], [FRAME], now)


def too_large(pair: Pair, now: float) -> list[Output]:
    """A frame that fits into no envelope."""
    return pair.b.send(now, b"\xfd" * 1500)


PROVOKED: dict[DropReason, Callable[[Pair, float], list[Output]]] = {
    DropReason.MALFORMED: malformed,
    DropReason.RAW_MAVLINK: raw_mavlink,
    DropReason.UNEXPECTED_RESPONSE: unexpected_response,
    DropReason.BAD_MAC1: bad_mac1,
    DropReason.OTHER_VERSION: other_version,
    DropReason.COOKIE_REQUIRED: cookie_required,
    DropReason.RATE_LIMITED: rate_limited,
    DropReason.REPLAYED_INITIATION: replayed_initiation,
    DropReason.WRONG_NETWORK: wrong_network,
    DropReason.INVALID_KEY_SHARE: invalid_key_share,
    DropReason.BAD_HANDSHAKE: bad_handshake,
    DropReason.UNKNOWN_PEER: unknown_peer,
    DropReason.SUITE_NOT_ACCEPTED: suite_not_accepted,
    DropReason.HEADER_MISMATCH: header_mismatch,
    DropReason.BAD_PARAMETERS: bad_parameters,
    DropReason.GROUP_BUDGET_SPENT: group_budget_spent,
    DropReason.NO_FREE_INDEX: no_free_index,
    DropReason.UNEXPECTED_COOKIE: unexpected_cookie,
    DropReason.BAD_COOKIE: bad_cookie,
    DropReason.UNKNOWN_INDEX: unknown_index,
    DropReason.LATE: late,
    DropReason.OVER_SHARE: over_share,
    DropReason.TOO_LONG: too_long,
    DropReason.SESSION_EXPIRED: session_expired,
    DropReason.LONG_COUNTER: long_counter,
    DropReason.DUPLICATE: duplicate,
    DropReason.REPLAYED: replayed,
    DropReason.LATE_COPY: late_copy,
    DropReason.DELAYED: delayed,
    DropReason.BAD_TAG: bad_tag,
    DropReason.BAD_CONTROL: bad_control,
    DropReason.UNEXPECTED_ANSWER: unexpected_answer,
    DropReason.DOUBTFUL: doubtful,
    DropReason.NO_SESSION: no_session,
    DropReason.TOO_LARGE: too_large,
}
ANSWERED = {DropReason.COOKIE_REQUIRED}
"""The only reason for which anything is sent back."""
COUNTED_ONLY = {DropReason.LATE_COPY}
"""Copies of envelopes are ordinary: they are counted, and nothing is reported."""


OUTSIDE = {
    *(DropReason.FRAMES_NOT_ALLOWED, DropReason.RELAY_MALFORMED, DropReason.RELAY_UNKNOWN_HANDLE),
    *(DropReason.RELAY_OVER_LIMIT, DropReason.RELAY_UNEXPECTED_TOKEN, DropReason.RECORD_OVER_LIMIT),
    *(DropReason.UNEXPECTED_RECORD, DropReason.OLD_RECORD),
}
"""Reasons of the shell around the node: data along a relay, records, and frames of a relay. ``tests/link`` and
``tests/relay`` provoke them."""


def test_every_reason_is_provoked() -> None:
    """There is no reason without a row below, and so none that cannot happen."""
    assert set(PROVOKED) | OUTSIDE == set(DropReason)


@pytest.mark.parametrize("reason", PROVOKED, ids=str)
def test_dropped_for_its_reason_and_nothing_else_changes(reason: DropReason) -> None:
    """What is bad is dropped under its reason, counted once and not answered; the link goes on carrying frames."""
    pair = established()
    counted = sum((peer.traffic.drops for peer in pair.b.node.peers.values()), start=pair.b.node.drops)[reason]

    outputs = PROVOKED[reason](pair, 1.0)

    assert reasons(outputs) == ([] if reason in COUNTED_ONLY else [reason])
    assert bool(datagrams(outputs)) == (reason in ANSWERED)
    counted_now = sum((peer.traffic.drops for peer in pair.b.node.peers.values()), start=pair.b.node.drops)[reason]
    assert counted_now == counted + 1
    assert pair.carries(LATER)
    now, initiation = retried(pair, c.REKEY_AFTER_S)
    assert completes(pair, initiation, now)


def test_a_drop_names_the_peer_whose_session_the_header_claims() -> None:
    """A claim is good for a counter: forgeries on a peer's session are counted there, others at the node."""
    pair = established()

    assert of(bad_tag(pair, 1.0), Dropped) == [Dropped(DropReason.BAD_TAG, pair.b.peer, AT_A)]
    assert pair.b.peer.traffic.drops[DropReason.BAD_TAG] == 1
    assert of(bad_mac1(pair, 1.0), Dropped) == [Dropped(DropReason.BAD_MAC1, None, AT_A)]
    assert pair.b.node.drops == {DropReason.BAD_MAC1: 1}


# Forgers.


class Stage(NamedTuple):
    """A message at the moment at which its receiver waits for it."""

    pair: Pair
    to_bravo: bool
    message: bytes


def stage(name: str, suite: Suite) -> Stage:
    """The initiation, the response, the confirmation or a frame of a link, not yet received."""
    link = quiet(suites=(suite,))
    pair = Pair(link_a=link, link_b=link)
    initiation = pair.initiation(0.0)
    if name == "initiation":
        return Stage(pair, True, initiation)
    response = only(datagrams(pair.b.receive(initiation, 0.0)))
    if name == "response":
        return Stage(pair, False, response)
    confirmation = only(datagrams(pair.a.receive(response, 0.0)))
    if name == "confirmation":
        return Stage(pair, True, confirmation)
    pair.b.receive(confirmation, 0.0)
    return Stage(pair, True, only(datagrams(pair.a.send(0.0))))


STAGES = ["initiation", "response", "confirmation", "frame"]
KINDS = [pytest.param(SUITES_BY_NAME[name], id=name) for name in ("x25519", "ffdhe2048", "mlkem768")]


def finish(at: Stage, now: float) -> bool:
    """Whether the genuine message still does what it is for."""
    side = at.pair.b if at.to_bravo else at.pair.a
    outputs = side.receive(at.message, now)
    assert reasons(outputs) == []
    for _ in range(3):
        side = at.pair.a if side is at.pair.b else at.pair.b
        outputs = [out for datagram in datagrams(outputs) for out in side.receive(datagram, now)]
    return at.pair.carries(now)


@pytest.mark.parametrize("name", STAGES)
def test_forgeries_of_a_message_change_nothing(name: str) -> None:
    """Altered anywhere, cut anywhere or lengthened: the state stays as it was and the genuine message still works."""
    at = stage(name, SUITES_BY_NAME["x25519"])
    side = at.pair.b if at.to_bravo else at.pair.a
    before = state_of(side.node)
    forgeries = [flipped(at.message, position, position % 8) for position in range(len(at.message))]
    forgeries += [at.message[:length] for length in range(len(at.message))]
    forgeries += [at.message + b"\0", at.message + at.message]
    if name in ("initiation", "response"):
        # mac2 counts under load alone: an initiation that is altered only there is the genuine one.
        forgeries = [forged for forged in forgeries if forged[:-16] != at.message[:-16]]

    for forged in forgeries:
        outputs = side.receive(forged, 0.0)
        assert len(reasons(outputs)) == len(outputs) == 1
        assert state_of(side.node) == before
    assert finish(at, 0.0)
    assert state_of(side.node) != before


@pytest.mark.parametrize("suite", KINDS)
@pytest.mark.parametrize("name", ["initiation", "response"])
def test_forgeries_with_a_right_mac1_change_nothing(name: str, suite: Suite) -> None:
    """With the public key an attacker reaches the handshake but no further, at any byte of header or message."""
    at = stage(name, suite)
    side = at.pair.b if at.to_bravo else at.pair.a
    before = state_of(side.node)
    covered = len(at.message) - wire.MACS_BYTES
    positions = sorted({*range(0, covered, 1 if covered < 200 else 23), 0, 1, 2, 3, 4, 5, covered - 1})
    now = 0.0
    for position in positions:
        now += 1 / c.INITIATIONS_PER_S
        outputs = side.receive(repaired(flipped(at.message, position), side.node.public_key), now)
        assert len(reasons(outputs)) == len(outputs) == 1
        assert DropReason.COOKIE_REQUIRED not in reasons(outputs)
        assert state_of(side.node) == before
    assert finish(at, now)


@pytest.mark.parametrize("name", STAGES)
def test_random_bytes_change_nothing(name: str) -> None:
    """Noise of every type and of fitting lengths is dropped at every stage of a link."""
    at = stage(name, SUITES_BY_NAME["x25519"])
    draw = random.Random(name)
    for side in (at.pair.a, at.pair.b):
        before = state_of(side.node)
        for number in range(400):
            kind = draw.choice([1, 2, 3, 0x40, 0x41, draw.randrange(256)])
            suite = draw.choice(list(SUITES.values()))
            size = draw.choice([wire.initiation_bytes(suite), wire.response_bytes(suite), 52, draw.randrange(100)])
            datagram = bytes((kind, suite.number)) + draw.randbytes(max(size - 2, 0))
            assert len(reasons(side.receive(datagram, 0.0, ELSEWHERE))) == 1, number
        assert state_of(side.node) == before
    assert finish(at, 0.0)


_SHARED = established()
INDICES = [
    0,
    _SHARED.b.session.local_index,
    _SHARED.a.session.local_index,
]
HEADS = st.one_of(
    st.binary(max_size=8),
    st.tuples(st.sampled_from([0x40, 0x41]), st.sampled_from(INDICES)).map(
        lambda parts: bytes(parts[:1]) + parts[1].to_bytes(2, "big")
    ),
    st.tuples(st.sampled_from([1, 2, 3]), st.sampled_from(sorted(SUITES))).map(bytes),
)


@given(HEADS, st.one_of(st.binary(max_size=80), st.integers(0, 1800).map(bytes)))
def test_no_bytes_make_a_node_raise_or_answer(head: bytes, rest: bytes) -> None:
    """Any datagram of a stranger gives one drop: no exception, and nothing is sent."""
    outputs = _SHARED.b.node.receive(head + rest, ELSEWHERE, 1.0)

    assert [type(out) for out in outputs] == [Dropped]


def test_strangers_receive_no_answer() -> None:
    """Without a right mac1 there is no answer, not even under load; with it, only a peer has one."""
    pair = established()
    stranger = made_initiation(KEY_C)
    for datagram in (stranger, made_initiation(), made_initiation(link=Link(suites=(SUITES[17],)))):
        broken = flipped(datagram, len(datagram) - 20)
        assert datagrams(pair.b.receive(broken, 1.0, ELSEWHERE)) == []
    assert datagrams(pair.b.receive(stranger, 1.0, ELSEWHERE)) == []

    exhaust(pair.b, 1.0)
    for datagram in (stranger, made_initiation()):
        broken = flipped(datagram, len(datagram) - 20)
        assert datagrams(pair.b.receive(broken, 1.0, ELSEWHERE)) == []


def test_answers_are_never_longer_than_what_they_answer() -> None:
    """Neither a response nor a cookie amplifies, in any suite."""
    for suite in SUITES.values():
        link = quiet(suites=(suite,))
        pair = Pair(link_a=link, link_b=link)
        initiation = pair.initiation(0.0)
        response = only(datagrams(pair.b.receive(initiation, 0.0)))
        assert len(response) <= len(initiation)
        exhaust(pair.a, 0.0)
        assert len(only(datagrams(pair.a.receive(response, 0.0)))) < len(response)
        exhaust(pair.b, 0.1)
        again = made_initiation(link=link)
        assert len(only(datagrams(pair.b.receive(again, 0.1)))) < len(again)


def test_altered_suite_byte_does_not_downgrade() -> None:
    """The suite of an initiation cannot be steered: under any other it is refused, though bravo would accept all."""
    every = tuple(SUITES.values())
    for offered in every:
        pair = Pair(link_a=quiet(suites=(offered,)), link_b=quiet(suites=every))
        initiation = pair.initiation(0.0)
        for claimed in every:
            if claimed == offered:
                continue
            noise_bytes = wire.initiation_bytes(claimed) - 4 - wire.MACS_BYTES
            body = initiation[4 : -wire.MACS_BYTES][:noise_bytes].ljust(noise_bytes, b"\0")
            altered = with_macs(wire.initiation_header(claimed, 7) + body, pair.b.node.public_key)
            assert reasons(pair.b.receive(altered, 0.0)) == [DropReason.BAD_HANDSHAKE]
        response = only(datagrams(pair.b.receive(initiation, 0.0)))
        for claimed in every:
            if claimed == offered:
                continue
            noise_bytes = wire.response_bytes(claimed) - 6 - wire.MACS_BYTES
            body = response[6 : -wire.MACS_BYTES][:noise_bytes].ljust(noise_bytes, b"\0")
            altered = with_macs(bytes((2, claimed.number)) + response[2:6] + body, pair.a.node.public_key)
            assert reasons(pair.a.receive(altered, 0.0)) == [DropReason.HEADER_MISMATCH]
        outputs = pair.a.receive(response, 0.0)
        assert only(of(outputs, SessionEstablished)).suite == offered.name


def test_refused_suite_is_offered_again() -> None:
    """A peer that does not accept the first suite gets no weaker offer, ever."""
    strong, weak = SUITES_BY_NAME["mlkem768"], SUITES_BY_NAME["x25519"]
    pair = Pair(link_a=quiet(suites=(strong, weak)), link_b=quiet(suites=(weak,)))
    now = 0.0
    for _ in range(20):
        now, initiation = retried(pair, now)
        assert initiation[1] == strong.number
        assert reasons(pair.b.receive(initiation, now)) == [DropReason.SUITE_NOT_ACCEPTED]


def test_wrong_psk_gives_no_session() -> None:
    """Where the PSKs differ the initiator refuses the response, and the responder stays unconfirmed."""
    pair = Pair(psk_a=Secret(bytes(range(32))), psk_b=Secret(bytes(range(1, 33))), link_a=QUIET, link_b=QUIET)
    response = only(datagrams(pair.b.receive(pair.initiation(0.0), 0.0)))

    assert reasons(pair.a.receive(response, 0.0)) == [DropReason.BAD_HANDSHAKE]
    assert pair.b.peer.sessions.current is None
    assert reasons(pair.b.send(0.0)) == [DropReason.NO_SESSION]


def test_peer_that_lies_about_its_group_gets_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    """A configured peer that seals a bad public value is refused; its honest initiation is answered."""
    link = quiet(suites=(SUITES_BY_NAME["ffdhe2048"],))
    pair = Pair(link_a=link, link_b=link)

    class Lie:
        share = bytes(256)

        @staticmethod
        def generate(entropy: Entropy) -> type[Lie]:
            return Lie

    with monkeypatch.context() as patched:
        patched.setattr(noise, "kem_of", lambda suite: Lie)
        lie = made_initiation(link=link)
    assert reasons(pair.b.receive(lie, 0.0)) == [DropReason.INVALID_KEY_SHARE]
    assert completes(pair, pair.initiation(0.0), 0.0)


# Replayed initiations.


def test_replayed_initiation_costs_no_key_exchange(monkeypatch: pytest.MonkeyPatch) -> None:
    """An exact replay is recognised before any Diffie-Hellman, also when mac2 differs or it comes from elsewhere."""
    pair = established()
    initiation = made_initiation()
    exchanges: list[bytes] = []
    original = KeyPair.exchange

    def counting(self: KeyPair, public: bytes) -> bytes:
        exchanges.append(public)
        return original(self, public)

    monkeypatch.setattr(KeyPair, "exchange", counting)
    assert datagrams(pair.b.receive(initiation, 1.0), wire.RESPONSE)
    assert len(exchanges) == 4
    exchanges.clear()

    replays = [(replay, place) for replay in (initiation, initiation[:-1] + b"\1") for place in (AT_A, ELSEWHERE)]
    for replay, place in replays:
        assert pair.b.receive(replay, 1.0, place)[-1] == Dropped(DropReason.DUPLICATE, pair.b.peer, place)
    later = 1.0 + c.UNCONFIRMED_LIFETIME_S
    pair.b.timeout(later)
    for replay, place in replays:
        assert pair.b.receive(replay, later, place) == [Dropped(DropReason.REPLAYED_INITIATION, None, place)]
    assert exchanges == []
    assert pair.carries(later)


def test_stranger_costs_two_key_exchanges(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stranger's sound initiation costs es and ss; a forgery costs es alone."""
    pair = established()
    stranger, forgery = made_initiation(KEY_C), repaired(flipped(made_initiation(), 60), KEY_B.public)
    calls = 0
    original = KeyPair.exchange

    def counting(self: KeyPair, public: bytes) -> bytes:
        nonlocal calls
        calls += 1
        return original(self, public)

    monkeypatch.setattr(KeyPair, "exchange", counting)
    for datagram, expected in ((stranger, 2), (forgery, 1)):
        calls = 0
        pair.b.receive(datagram, 1.0)
        assert calls == expected


def test_memory_for_initiations_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last so many initiations are remembered; the one before them is answered as if it were new."""
    assert c.REMEMBERED_INITIATIONS == 1024
    pair = established()
    for number in range(c.REMEMBERED_INITIATIONS + 100):
        pair.b.node._handshakes.remember(pair.b.peer, number.to_bytes(32, "big"))
        assert len(pair.b.node._handshakes.remembered) <= c.REMEMBERED_INITIATIONS

    monkeypatch.setattr(c, "REMEMBERED_INITIATIONS", 3)
    pair = established()
    made = [made_initiation() for _ in range(4)]
    for initiation in made:
        assert datagrams(pair.b.receive(initiation, 1.0), wire.RESPONSE)
    for initiation in made[1:]:
        assert reasons(pair.b.receive(initiation, 2.0)) == [DropReason.DUPLICATE]
    assert datagrams(pair.b.receive(made[0], 2.0), wire.RESPONSE)


def test_forged_initiations_are_not_remembered() -> None:
    """Only authentic initiations of peers are kept in that memory: no other sender can flush it."""
    pair = established()
    known = len(pair.b.node._handshakes.remembered)
    for datagram in (made_initiation(KEY_C), repaired(flipped(made_initiation(), 60), KEY_B.public)):
        pair.b.receive(datagram, 1.0)

    assert len(pair.b.node._handshakes.remembered) == known


def test_sixteen_answers_wait_for_confirmation() -> None:
    """Of more initiations the newest sixteen are kept; the current session is not touched by any number."""
    pair = established()
    now = 1.0
    for _ in range(3 * c.UNCONFIRMED_PER_PEER):
        now += 1 / c.ANSWERS_WHILE_UP_PER_S
        pair.b.peer.sessions.expire(1.0)
        assert datagrams(pair.b.receive(made_initiation(), now), wire.RESPONSE)
        assert len(pair.b.peer.sessions.unconfirmed) <= c.UNCONFIRMED_PER_PEER

    assert len(pair.b.peer.sessions.unconfirmed) == c.UNCONFIRMED_PER_PEER
    assert len(pair.b.node._indices.owners) == c.UNCONFIRMED_PER_PEER + 1
    assert pair.carries(now)


@pytest.mark.parametrize("is_up", [False, True])
def test_answers_to_one_peer_are_bounded(is_up: bool) -> None:
    """A burst is answered at once; after that four a second without a cookie, two while a link is up."""
    pair = established() if is_up else Pair(link_a=QUIET, link_b=QUIET)
    rate = c.ANSWERS_WHILE_UP_PER_S if is_up else c.ANSWERS_PER_S
    assert rate == (2.0 if is_up else 4.0)
    now = 10.0
    for _ in range(c.ANSWERS_BURST):
        assert datagrams(pair.b.receive(made_initiation(), now), wire.RESPONSE)

    for moment in (now, now + 1 / rate - 0.001):
        outputs = pair.b.receive(made_initiation(), moment)
        assert reasons(outputs) == [DropReason.COOKIE_REQUIRED]
        assert datagrams(outputs, wire.RESPONSE) == []
    assert datagrams(pair.b.receive(made_initiation(), now + 1 / rate), wire.RESPONSE)


def test_bytes_to_other_addresses_are_counted_apart() -> None:
    """Responses to replayed initiations take nothing from a link's budget."""
    pair = established()
    traffic = pair.b.peer.traffic
    before, elsewhere = (traffic.datagrams_sent, traffic.bytes_sent), traffic.bytes_elsewhere

    answer = only(datagrams(pair.b.receive(made_initiation(), 1.0, ELSEWHERE), wire.RESPONSE))
    assert (traffic.datagrams_sent, traffic.bytes_sent) == before
    assert traffic.bytes_elsewhere - elsewhere == len(answer)

    answer = only(datagrams(pair.b.receive(made_initiation(), 1.0), wire.RESPONSE))
    assert (traffic.datagrams_sent, traffic.bytes_sent) == (before[0] + 1, before[1] + len(answer))


def test_replays_do_not_take_the_answers_of_a_peer_at_its_address() -> None:
    """When recorded initiations used up the answers, the peer itself gets one with a cookie."""
    pair = established()
    now, initiation = retried(pair, c.REKEY_AFTER_S)
    while pair.b.peer.answers_while_up.take(now):
        pass

    reply = only(datagrams(pair.b.receive(initiation, now), wire.COOKIE))
    assert pair.a.receive(reply, now) == []
    now, initiation = retried(pair, now)
    while pair.b.peer.answers_while_up.take(now):
        pass
    assert completes(pair, initiation, now)


# Load.


def test_under_load_a_cookie_is_asked_for_and_works() -> None:
    """An initiator asked for a cookie comes back with it a quarter second later and gets its session."""
    pair = Pair(link_a=QUIET, link_b=QUIET)
    initiation = pair.initiation(0.0)
    exhaust(pair.b, 0.0)

    outputs = pair.b.receive(initiation, 0.0)
    assert reasons(outputs) == [DropReason.COOKIE_REQUIRED]
    assert only(of(outputs, Transmit)).path == AT_A
    assert pair.a.receive(only(datagrams(outputs)), 0.0) == []

    now, again = retried(pair, 0.0)
    assert now < 0.5
    assert again[-16:] != bytes(16)
    exhaust(pair.b, now)
    assert completes(pair, again, now)


def test_cookie_counts_from_its_address_only() -> None:
    """The same initiation with a cookie from another address is asked for a cookie of its own."""
    pair = Pair(link_a=QUIET, link_b=QUIET)
    initiation = pair.initiation(0.0)
    exhaust(pair.b, 0.0)
    pair.a.receive(only(datagrams(pair.b.receive(initiation, 0.0))), 0.0)
    now, again = retried(pair, 0.0)
    exhaust(pair.b, now)

    moved = Path(0, (AT_A.host, AT_A.address[1] + 1))
    for place in (ELSEWHERE, moved):
        assert reasons(pair.b.receive(again, now, place)) == [DropReason.COOKIE_REQUIRED]
    assert completes(pair, again, now)


@pytest.mark.parametrize(("age", "works"), [(c.COOKIE_SECRET_LIFETIME_S - 0.1, True), (241.0, False)])
def test_cookie_of_the_previous_secret_counts_once_more(age: float, works: bool) -> None:
    """When the secret changed a cookie is still good, when it changed twice it is not."""
    pair = Pair(link_a=QUIET, link_b=QUIET)
    pair.b.node._handshakes.own.cookies._change_secret(0.0)
    given = 119.0
    initiation = made_initiation()
    exhaust(pair.b, given)
    reply = wire.parse_cookie_reply(only(datagrams(pair.b.receive(initiation, given))))
    cookie = pair.b.node._handshakes.own.mac_keys.open_cookie(reply, initiation[-32:-16])
    message = made_initiation()[: -wire.MACS_BYTES]
    now = given + age
    exhaust(pair.b, now)

    outputs = pair.b.receive(with_macs(message, KEY_B.public, cookie), now)

    assert bool(datagrams(outputs, wire.RESPONSE)) is works
    assert reasons(outputs) == ([] if works else [DropReason.COOKIE_REQUIRED])


def test_forged_cookie_is_harmless() -> None:
    """An observer of an initiation can make a cookie for it. The link still comes up, under load or not."""
    for under_load in (False, True):
        pair = Pair(link_a=QUIET, link_b=QUIET)
        pair.initiation(0.0)
        index, pending = next(iter(pair.a.peer.initiator.pending.items()))
        sealed = pair.b.node._handshakes.own.mac_keys.seal_cookie(b"forged cookie!!!", bytes(16), pending.mac1)
        assert pair.a.receive(wire.encode_cookie_reply(index, bytes(16), sealed), 0.0) == []

        now, initiation = retried(pair, 0.0)
        assert initiation[-16:] != bytes(16)
        if under_load:
            exhaust(pair.b, now)
            pair.a.receive(only(datagrams(pair.b.receive(initiation, now))), now)
            now, initiation = retried(pair, now)
            exhaust(pair.b, now)
        assert completes(pair, initiation, now)


def test_forged_cookie_does_not_replace_the_genuine_one() -> None:
    """An observer of an initiation sends a second cookie. The initiator ignores it, and the link comes up."""
    pair = Pair(link_a=QUIET, link_b=QUIET)
    initiation = pair.initiation(0.0)
    exhaust(pair.b, 0.0)
    assert pair.a.receive(only(datagrams(pair.b.receive(initiation, 0.0))), 0.0) == []
    index, pending = next(iter(pair.a.peer.initiator.pending.items()))
    sealed = pair.b.node._handshakes.own.mac_keys.seal_cookie(b"forged cookie!!!", bytes(16), pending.mac1)
    forged = wire.encode_cookie_reply(index, bytes(16), sealed)
    assert reasons(pair.a.receive(forged, 0.01)) == [DropReason.UNEXPECTED_COOKIE]

    now, again = retried(pair, 0.0)
    exhaust(pair.b, now)
    assert completes(pair, again, now)


def test_response_under_load_is_repeated_with_a_cookie() -> None:
    """An initiator under load asks the responder for a cookie; its answer to the next initiation is taken."""
    pair = Pair(link_a=QUIET, link_b=QUIET)
    response = only(datagrams(pair.b.receive(pair.initiation(0.0), 0.0)))
    exhaust(pair.a, 0.0)
    reply = only(datagrams(pair.a.receive(response, 0.0), wire.COOKIE))
    assert pair.b.receive(reply, 0.0) == []

    now, initiation = retried(pair, 0.0)
    response = only(datagrams(pair.b.receive(initiation, now), wire.RESPONSE))
    assert response[-16:] != bytes(16)
    exhaust(pair.a, now)
    assert of(pair.a.receive(response, now), SessionEstablished)


def test_initiations_do_not_spend_the_budget_of_responses() -> None:
    """A flood of initiations leaves our own handshakes alone."""
    pair = Pair(link_a=QUIET, link_b=QUIET)
    response = only(datagrams(pair.b.receive(pair.initiation(0.0), 0.0)))
    while pair.a.node._handshakes.admission._initiations.take(0.0):
        pass

    assert of(pair.a.receive(response, 0.0), SessionEstablished)


def test_budget_is_fifty_and_refills() -> None:
    """Fifty messages at once may cost key exchanges, then fifty a second."""
    pair = established()
    forged = [repaired(flipped(made_initiation(), 60), KEY_B.public) for _ in range(3)]
    for _ in range(c.INITIATIONS_BURST):
        assert reasons(pair.b.receive(forged[0], 9.0)) == [DropReason.BAD_HANDSHAKE]

    assert reasons(pair.b.receive(forged[1], 9.0)) == [DropReason.COOKIE_REQUIRED]
    refilled = 9.0 + 1.001 / c.INITIATIONS_PER_S
    assert reasons(pair.b.receive(forged[2], refilled)) == [DropReason.BAD_HANDSHAKE]


def test_one_source_has_its_share_under_load() -> None:
    """Ten a second from one source with a cookie; another source is not concerned."""
    pair = established()
    assert reasons(rate_limited(pair, 1.0)) == [DropReason.RATE_LIMITED]

    initiation = made_initiation()
    raw = pair.b.node._handshakes.own.cookies.reply(initiation, 77, ELSEWHERE, 1.0)
    cookie = pair.b.node._handshakes.own.mac_keys.open_cookie(wire.parse_cookie_reply(raw), initiation[-32:-16])
    with_cookie = with_macs(initiation[: -wire.MACS_BYTES], KEY_B.public, cookie)
    assert datagrams(pair.b.receive(with_cookie, 1.0, ELSEWHERE), wire.RESPONSE)


def test_neighbours_do_not_use_up_a_peers_share() -> None:
    """Others behind the same router have a share of their own: a peer is answered where it is known to be."""
    pair = established()
    host, port = AT_A.host, AT_A.address[1]
    rate_limited(pair, 1.0)  # at its own place: what is known there is one source, and its share is spent
    pair.b.node.set_paths(pair.b.peer, [Path(0, (host, port + 1))], 1.0)
    neighbour, peer = Path(0, (host, port + 2)), Path(0, (host, port + 1))

    def asked(place: Path, key: KeyPair) -> list[Output]:
        initiation = made_initiation(key)
        raw = pair.b.node._handshakes.own.cookies.reply(initiation, 77, place, 1.0)
        cookie = pair.b.node._handshakes.own.mac_keys.open_cookie(wire.parse_cookie_reply(raw), initiation[-32:-16])
        return pair.b.receive(with_macs(initiation[: -wire.MACS_BYTES], KEY_B.public, cookie), 1.0, place)

    fates = [reasons(asked(neighbour, KEY_C)) for _ in range(c.COOKIED_PER_SOURCE_BURST + 1)]
    assert fates == [[DropReason.UNKNOWN_PEER]] * c.COOKIED_PER_SOURCE_BURST + [[DropReason.RATE_LIMITED]]
    assert datagrams(asked(peer, KEY_A), wire.RESPONSE)


# Peers come and go.


def test_removed_peer_is_cut_off_at_once() -> None:
    """The Node closes its sessions, and treats its envelopes and initiations as those of a stranger."""
    pair = established()
    before = pair.a.envelope(1.0)
    pair.b.configure_path(1.0)

    closing = only(datagrams(pair.b.node.remove_peer(pair.b.peer, 1.0)))

    assert reasons(pair.b.receive(before, 1.0)) == [DropReason.LATE]
    reported = Dropped(DropReason.UNKNOWN_PEER, None, AT_A, 1, KEY_A.public)
    assert pair.b.receive(made_initiation(), 1.0) == [reported]
    assert datagrams(pair.b.receive(wire.envelope_header(UNUSED_INDEX, 5) + bytes(20), 1.0)) == []
    assert pair.b.node._indices.owners == {}
    assert pair.b.node.handle_timeout(500.0) == []
    assert pair.b.node.next_deadline() == float("inf")
    pair.a.receive(closing, 1.0)
    assert pair.a.peer.sessions.current is None


def test_removed_peer_may_come_back() -> None:
    """A peer that is added again starts without memory of the time before."""
    pair = established()
    pair.b.node.remove_peer(pair.b.peer, 1.0)
    pair.b.node.add_peer(PeerSettings("alpha", KEY_A.public, None, QUIET), 2.0)
    now, initiation = retried(pair, c.REKEY_AFTER_S)

    assert completes(pair, initiation, now)


def test_names_and_keys_are_unique() -> None:
    """A name has one key, and a key one name. A Node cannot be its own peer."""
    pair = Pair()
    for settings in (
        PeerSettings("alpha", KEY_C.public),
        PeerSettings("another", KEY_A.public),
        PeerSettings("myself", KEY_B.public),
    ):
        with pytest.raises(ValueError, match=settings.name):
            pair.b.node.add_peer(settings, 0.0)
    assert list(pair.b.node.peers) == ["alpha"]


def test_sending_to_a_removed_peer_drops_the_frame() -> None:
    """It has no session any more, and the node does not wake up for it."""
    pair = established()
    peer = pair.a.peer
    pair.a.node.remove_peer(peer, 1.0)
    assert reasons(pair.a.node.send(peer, [FRAME], 1.0)) == [DropReason.NO_SESSION]
    assert pair.a.timeout(1.0) == []
    assert pair.a.node.next_deadline() == c.NEVER


def test_node_without_peers_has_no_deadline() -> None:
    """There is nothing to do and nothing to say."""
    node = Node(Secret(bytes([5]) * 32), seeded(1), 0.0)

    assert node.next_deadline() == float("inf")
    assert node.handle_timeout(1000.0) == []
    assert node.close(1000.0) == []


def test_addresses_can_change() -> None:
    """The Node initiates to, and accepts hints from, the new address of a name, and no longer the old one."""
    pair = Pair(link_a=QUIET, link_b=QUIET)
    pair.a.node.set_paths(pair.a.peer, [ELSEWHERE], 0.0)
    stray = wire.envelope_header(UNUSED_INDEX, 5) + bytes(20)

    assert only(of(pair.a.timeout(0.0), Transmit)).path == ELSEWHERE
    assert datagrams(pair.a.receive(stray, 5.0, AT_B)) == []
    assert only(of(pair.a.receive(stray, 5.0, ELSEWHERE), Transmit)).path == ELSEWHERE


def test_address_of_two_peers_outlives_the_first() -> None:
    """Two peers are configured at one address: a hint from there is for the last one, also when the first is gone."""
    pair = established()
    charlie = pair.b.node.add_peer(PeerSettings("charlie", KEY_C.public), 1.0)
    pair.b.configure_path(1.0)
    pair.b.node.set_paths(charlie, [AT_A], 1.0)
    pair.b.node.remove_peer(pair.b.peer, 1.0)
    assert (
        len(datagrams(pair.b.receive(wire.envelope_header(UNUSED_INDEX, 5) + bytes(24), 1.0), wire.INITIATION)) == 1
    )
    pair.b.node.set_paths(charlie, [], 2.0)
    assert datagrams(pair.b.receive(wire.envelope_header(UNUSED_INDEX, 5) + bytes(24), 9.0)) == []


def test_several_peers_do_not_mix() -> None:
    """Each peer has its own sessions, timers and counters; a frame goes to the one it is for."""
    pair = established()
    charlie = Node(Secret(bytes([3]) * 32), seeded(3), 0.0)
    at_c = Path(0, ("192.0.2.3", 14600))
    charlie.add_peer(PeerSettings("bravo", KEY_B.public, None, QUIET), 0.0)
    charlie.set_paths(charlie.peers["bravo"], [AT_B], 0.0)
    pair.b.node.add_peer(PeerSettings("charlie", KEY_C.public, None, QUIET), 1.0)
    response = only(datagrams(pair.b.node.receive(only(datagrams(charlie.handle_timeout(1.0))), at_c, 1.0)))
    pair.b.node.receive(only(datagrams(charlie.receive(response, AT_B, 1.0))), at_c, 1.0)

    out = only(of(pair.b.node.send(pair.b.node.peers["charlie"], [FRAME], 2.0), Transmit))
    assert out.path == at_c
    assert payloads(charlie.receive(out.datagram, AT_B, 2.0)) == [FRAME]
    assert len(reasons(pair.a.receive(out.datagram, 2.0))) == 1
    assert pair.carries(2.0)


def test_index_of_zero_never_has_an_owner() -> None:
    """No handshake uses index 0, so a header full of zeros names no session."""
    for seed in range(50):
        pair = Pair(seed=seed, link_a=QUIET, link_b=QUIET).establish()
        assert 0 not in pair.a.node._indices.owners
        assert 0 not in pair.b.node._indices.owners


def test_one_peer_cannot_flush_another_ones_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each peer's initiations are remembered for themselves, and forgotten with the peer."""
    monkeypatch.setattr(c, "REMEMBERED_INITIATIONS", 3)
    pair = established()
    node, first = pair.b.node, made_initiation()
    assert datagrams(pair.b.receive(first, 1.0), wire.RESPONSE)
    node.add_peer(PeerSettings("noisy", KEY_C.public), 1.0)
    for number in range(10):
        node._handshakes.remember(node.peers["noisy"], number.to_bytes(32, "big"))

    assert reasons(pair.b.receive(first, 2.0)) == [DropReason.DUPLICATE]
    remembered = len(node._handshakes.remembered)
    node.remove_peer(node.peers["noisy"], 3.0)
    assert len(node._handshakes.remembered) == remembered - 3


@pytest.mark.parametrize("known_by", ["its path", "its configured address"])
def test_all_sources_together_have_a_bound(monkeypatch: pytest.MonkeyPatch, known_by: str) -> None:
    """An attacker with many addresses, and a cookie for each, causes a bounded number of key exchanges.

    A peer at its configured address, or at its last known one, does not queue with the attacker.
    """
    pair = established() if known_by == "its path" else Pair(link_a=QUIET, link_b=QUIET)
    node = pair.b.node
    monkeypatch.setattr(node._handshakes.own.cookies, "has_valid_mac2", lambda *_: True)
    while node._handshakes.admission._initiations.take(1.0):
        pass
    fates = [
        reasons(node.receive(made_initiation(KEY_C), Path(0, (f"10.0.{number // 200}.{number % 200}", 1)), 1.0))
        for number in range(int(c.COOKIED_PER_S) + 5)
    ]

    assert fates.count([DropReason.UNKNOWN_PEER]) == c.COOKIED_PER_S
    assert fates.count([DropReason.RATE_LIMITED]) == 5
    assert reasons(pair.b.receive(made_initiation(), 1.0, ELSEWHERE)) == [DropReason.RATE_LIMITED]
    if known_by == "its configured address":
        assert reasons(pair.b.receive(made_initiation(), 1.0)) == [DropReason.RATE_LIMITED]
        node.set_paths(pair.b.peer, [AT_A], 1.0)
    assert datagrams(pair.b.receive(made_initiation(), 1.0), wire.RESPONSE)


def test_one_peer_is_answered_a_bounded_number_of_times(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its initiations from any number of addresses with cookies get so many answers a second, and no more indices."""
    pair = established()
    node = pair.b.node
    monkeypatch.setattr(node._handshakes.own.cookies, "has_valid_mac2", lambda *_: True)
    answers = 0
    for number in range(100):
        out = node.receive(made_initiation(), Path(0, (f"10.0.0.{number}", 1)), 1.0)
        answers += len(datagrams(out, wire.RESPONSE))

    assert answers <= c.ANSWERS_BURST + c.COOKIED_ANSWERS_PER_S + c.ANSWERS_PER_S
