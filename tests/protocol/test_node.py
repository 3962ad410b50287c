"""What a node does with datagrams: of strangers, forgers and peers. Every drop has its reason."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import pytest

from tests.protocol.harness import (
    AT_A,
    ELSEWHERE,
    FRAME,
    KEY_A,
    KEY_B,
    KEY_C,
    UNUSED_INDEX,
    Pair,
    datagrams,
    exhaust,
    flipped,
    initiation_of,
    made_initiation,
    of,
    only,
    payloads,
    quiet,
    reasons,
    repaired,
    state_of,
    stray,
    with_cookie,
    with_macs,
)
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import establish, wire
from uavlinkd.protocol import node as module
from uavlinkd.protocol import noise as noise_protocol
from uavlinkd.protocol.constants import NEVER
from uavlinkd.protocol.crypto import Entropy, KeyPair
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.node import PEERS_AT_ONCE
from uavlinkd.protocol.outputs import Dropped, Output, SessionEstablished
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.settings import Link, PeerSettings
from uavlinkd.protocol.suites import SUITES, SUITES_BY_NAME, Suite
from uavlinkd.protocol.timeouts import handle_timeout
from uavlinkd.protocol.wire import Probe

QUIET = quiet()
LATER = 4.0
"""More than two seconds after second 1."""


def established(**links: Link) -> Pair:
    """A session at second 0 with quiet timers."""
    return Pair(link_a=links.get("link_a", QUIET), link_b=links.get("link_b", QUIET)).establish()


def retried(pair: Pair, start: float) -> tuple[float, bytes]:
    """Alpha's next initiation after ``start``, and when it is made."""
    for _ in range(40):
        now = max(start, pair.a.node.next_deadline())
        if made := datagrams(pair.a.timeout(now), wire.INITIATION):
            return now, made[0]
    raise AssertionError("alpha does not initiate")


def completes(pair: Pair, initiation: bytes, now: float) -> bool:
    """Whether this initiation leads to a session that carries frames."""
    response = only(datagrams(pair.b.receive(initiation, now), wire.RESPONSE))
    pair.b.receive(only(datagrams(pair.a.receive(response, now))), now)
    return pair.carries(now)


# Why something is dropped: one row for each reason.

Provoke = Callable[[Pair, float], list[Output]]


def unexpected_response(pair: Pair, now: float) -> list[Output]:
    """A response without an initiation."""
    header = wire.response_header(SUITES[0], 5, UNUSED_INDEX)
    message = header + bytes(wire.response_bytes(SUITES[0]) - len(header) - wire.MACS_BYTES)
    return pair.b.receive(with_macs(message, pair.b.node.public_key), now)


def cookie_required(pair: Pair, now: float) -> list[Output]:
    """An initiation under load."""
    exhaust(pair.b, now)
    return pair.b.receive(made_initiation(), now)


def rate_limited(pair: Pair, now: float) -> list[Output]:
    """More initiations with a cookie than one source may send under load."""
    exhaust(pair.b, now)
    outputs: list[Output] = []
    for _ in range(c.COOKIED_PER_SOURCE.burst + 1):
        outputs = pair.b.receive(with_cookie(pair.b, made_initiation(KEY_C), AT_A, now), now)
    return outputs


def replayed_initiation(pair: Pair, now: float) -> list[Output]:
    """The same initiation again, after its session was not confirmed in time."""
    initiation = made_initiation()
    assert datagrams(pair.b.receive(initiation, now), wire.RESPONSE)
    pair.b.peer.sessions.expire(now + c.UNCONFIRMED_LIFETIME_S)
    return pair.b.receive(initiation, now + c.INITIATION_COPIES_S)


def duplicate(pair: Pair, now: float) -> list[Output]:
    """The same initiation again, along the same path, while its session waits."""
    initiation = made_initiation()
    assert datagrams(pair.b.receive(initiation, now), wire.RESPONSE)
    return pair.b.receive(initiation, now)


def wrong_network(pair: Pair, now: float) -> list[Output]:
    """An envelope of this peer arrives along a line with another peer at its end."""
    pair.b.node.facts.set_point_to_point({1: None})
    return pair.b.receive(pair.a.envelope(now), now, Path(1, ("serial", 0)))


def invalid_key_share(pair: Pair, now: float) -> list[Output]:
    """An initiation with an ephemeral key of low order."""
    message = made_initiation()
    return pair.b.receive(repaired(message[:4] + bytes(32) + message[36:], KEY_B.public), now)


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
    while peer.group_work.take(now):
        pass
    settings = peer.settings
    peer.settings = replace(settings, link=replace(settings.link, suites=(costly, *settings.link.suites)))
    outputs = pair.b.receive(made_initiation(link=Link(suites=(costly,))), now, ELSEWHERE)
    peer.settings = settings
    return outputs


def too_long(pair: Pair, now: float) -> list[Output]:
    """An authentic envelope one byte longer than agreed."""
    session = pair.a.session
    padding = bytes(session.max_envelope + 1 - session.envelope_bytes(len(FRAME)))
    return pair.b.receive(pair.a.envelope(now, FRAME + padding), now)


def bad_cookie(pair: Pair, now: float) -> list[Output]:
    """A cookie that does not open, for a response of ours that waits."""
    pair.b.receive(made_initiation(), now)
    waiting = next(iter(pair.b.peer.sessions.unconfirmed))
    return pair.b.receive(wire.encode_cookie_reply(waiting, bytes(16), bytes(32)), now)


def late(pair: Pair, now: float) -> list[Output]:
    """An envelope of a session that ended here."""
    envelope = pair.a.envelope(now)
    pair.b.receive(pair.a.envelope(now, wire.Close().encode()), now)
    pair.a.peer.sessions.clear(now)
    assert completes(pair, only(datagrams(establish.initiate(pair.a.peer, now))), now)
    return pair.b.receive(envelope, now)


def session_expired(pair: Pair, now: float) -> list[Output]:
    """An envelope under keys that reach their end before the timer runs."""
    pair.b.session.reject_at = now
    outputs = pair.b.receive(pair.a.envelope(now), now)
    pair.b.session.reject_at = now + 100.0
    return outputs


def long_counter(pair: Pair, now: float) -> list[Output]:
    """The header of an envelope rewritten in the long form."""
    envelope = pair.a.envelope(now)
    return pair.b.receive(b"\x41" + envelope[1:3] + b"\0\0" + envelope[3:], now)


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


def doubtful(pair: Pair, now: float) -> list[Output]:
    """Frames after a silence, about which the peer says nothing."""
    envelope = pair.a.envelope(now)
    pair.b.session.trusted_until = now - c.HOLD_S - 1.0
    pair.b.receive(envelope, now - c.HOLD_S)
    return pair.b.timeout(now)


def no_session(pair: Pair, now: float) -> list[Output]:
    """Frames for a peer that was never linked."""
    return pair.b.node.send(pair.b.node.add_peer(PeerSettings("charlie", KEY_C.public), now), [FRAME], now)


PROVOKED: dict[DropReason, Provoke] = {
    DropReason.MALFORMED: lambda pair, now: pair.b.receive(b"\x07hello", now),
    DropReason.RAW_MAVLINK: lambda pair, now: pair.b.receive(FRAME, now),
    DropReason.UNEXPECTED_RESPONSE: unexpected_response,
    DropReason.BAD_MAC1: lambda pair, now: pair.b.receive(flipped(made_initiation(), 40), now),
    DropReason.OTHER_VERSION: lambda pair, now: pair.b.receive(
        initiation_of(c.PROTOCOL_VERSION - 1, pair.b.node.public_key), now
    ),
    DropReason.COOKIE_REQUIRED: cookie_required,
    DropReason.RATE_LIMITED: rate_limited,
    DropReason.REPLAYED_INITIATION: replayed_initiation,
    DropReason.WRONG_NETWORK: wrong_network,
    DropReason.INVALID_KEY_SHARE: invalid_key_share,
    DropReason.BAD_HANDSHAKE: lambda pair, now: pair.b.receive(
        repaired(flipped(made_initiation(), 40), KEY_B.public), now
    ),
    DropReason.UNKNOWN_PEER: lambda pair, now: pair.b.receive(made_initiation(KEY_C), now),
    DropReason.SUITE_NOT_ACCEPTED: lambda pair, now: pair.b.receive(
        made_initiation(link=Link(suites=(SUITES_BY_NAME["mlkem768"],))), now
    ),
    DropReason.HEADER_MISMATCH: lambda pair, now: pair.b.receive(
        repaired(flipped(made_initiation(), 3), KEY_B.public), now
    ),
    DropReason.BAD_PARAMETERS: lambda pair, now: pair.b.receive(made_initiation(link=Link(tag_bytes=3)), now),
    DropReason.GROUP_BUDGET_SPENT: group_budget_spent,
    DropReason.NO_FREE_INDEX: no_free_index,
    DropReason.UNEXPECTED_COOKIE: lambda pair, now: pair.b.receive(
        wire.encode_cookie_reply(pair.b.session.local_index, bytes(16), bytes(32)), now
    ),
    DropReason.BAD_COOKIE: bad_cookie,
    DropReason.UNKNOWN_INDEX: lambda pair, now: pair.b.receive(stray(), now),
    DropReason.LATE: late,
    DropReason.OVER_SHARE: lambda pair, now: [pair.b.node.refuse(pair.a.envelope(now), AT_A)],
    DropReason.TOO_LONG: too_long,
    DropReason.SESSION_EXPIRED: session_expired,
    DropReason.LONG_COUNTER: long_counter,
    DropReason.DUPLICATE: duplicate,
    DropReason.REPLAYED: lambda pair, now: pair.b.receive(accepted_before(pair, now), LATER, ELSEWHERE),
    DropReason.LATE_COPY: lambda pair, now: pair.b.receive(accepted_before(pair, now), LATER),
    DropReason.DELAYED: delayed,
    DropReason.BAD_TAG: lambda pair, now: pair.b.receive(flipped(pair.a.envelope(now), 12), now),
    DropReason.BAD_CONTROL: lambda pair, now: pair.b.receive(pair.a.envelope(now, b"\x66"), now),
    DropReason.UNEXPECTED_ANSWER: lambda pair, now: pair.b.receive(
        pair.a.envelope(now, Probe(0, 7, 1, 1).encode()), now
    ),
    DropReason.DOUBTFUL: doubtful,
    DropReason.NO_SESSION: no_session,
    DropReason.TOO_LARGE: lambda pair, now: pair.b.send(now, b"\xfd" * 1500),
}
OUTSIDE = {
    *(DropReason.FRAMES_NOT_ALLOWED, DropReason.RELAY_MALFORMED, DropReason.RELAY_UNKNOWN_HANDLE),
    *(DropReason.RELAY_OVER_LIMIT, DropReason.RECORD_OVER_LIMIT),
    *(DropReason.UNEXPECTED_RECORD, DropReason.OLD_RECORD),
    *(DropReason.BAD_CERTIFICATE, DropReason.CERTIFICATE_REVOKED, DropReason.MEMBER_CONFLICT),
    *(DropReason.ROLE_NOT_ACCEPTED, DropReason.BULLETIN_AWAITED, DropReason.TOO_MANY_MEMBERS),
}
"""Reasons of the shell around the node: data along a relay, records, and frames of a relay. ``tests/daemon`` and
``tests/relay`` provoke them."""


@pytest.mark.parametrize("reason", PROVOKED, ids=str)
def test_dropped_for_its_reason_and_nothing_else_changes(reason: DropReason) -> None:
    """What is bad is dropped under its reason, counted once and not answered; the link goes on carrying frames."""
    assert set(PROVOKED) | OUTSIDE == set(DropReason)
    pair = established()

    def counted() -> int:
        return sum((peer.traffic.drops for peer in pair.b.node.peers.values()), start=pair.b.node.drops)[reason]

    before = counted()
    outputs = PROVOKED[reason](pair, 1.0)
    # Copies of envelopes are ordinary: they are counted, and nothing is reported.
    assert reasons(outputs) == ([] if reason is DropReason.LATE_COPY else [reason])
    assert bool(datagrams(outputs)) == (reason is DropReason.COOKIE_REQUIRED)
    assert counted() == before + 1
    assert pair.carries(LATER)
    now, initiation = retried(pair, c.REKEY_AFTER_S)
    assert completes(pair, initiation, now)


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
def test_forgeries_and_random_bytes_change_nothing(name: str) -> None:
    """Altered anywhere, cut anywhere, lengthened, or noise of fitting lengths: the genuine message still works."""
    at = stage(name, SUITES_BY_NAME["x25519"])
    receiver, message = at.pair.b if at.to_bravo else at.pair.a, at.message
    forgeries = [flipped(message, position, position % 8) for position in range(len(message))]
    forgeries += [message[:length] for length in range(len(message))]
    forgeries += [message + b"\0", message + message]
    if name in ("initiation", "response"):
        # mac2 counts under load alone: an initiation that is altered only there is the genuine one.
        forgeries = [forged for forged in forgeries if forged[:-16] != message[:-16]]
    noise, draw = list[bytes](), random.Random(name)
    for _ in range(400):
        kind, suite = draw.choice([1, 2, 3, 0x40, 0x41, draw.randrange(256)]), draw.choice(list(SUITES.values()))
        size = draw.choice([wire.initiation_bytes(suite), wire.response_bytes(suite), 52, draw.randrange(100)])
        noise.append(bytes((kind, suite.number)) + draw.randbytes(max(size - 2, 0)))
    for side in (at.pair.a, at.pair.b):
        before = state_of(side.node)
        for forged in forgeries if side is receiver else []:
            outputs = side.receive(forged, 0.0)
            assert len(reasons(outputs)) == len(outputs) == 1
            assert state_of(side.node) == before
        assert {len(reasons(side.receive(datagram, 0.0, ELSEWHERE))) for datagram in noise} == {1}
        assert state_of(side.node) == before
    assert finish(at, 0.0)
    assert state_of(receiver.node) != before


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
        now += 1 / c.INITIATIONS.per_s
        outputs = side.receive(repaired(flipped(at.message, position), side.node.public_key), now)
        assert len(reasons(outputs)) == len(outputs) == 1
        assert DropReason.COOKIE_REQUIRED not in reasons(outputs)
        assert state_of(side.node) == before
    assert finish(at, now)


def test_strangers_receive_no_answer() -> None:
    """Without a right mac1 there is no answer, not even under load; with it, only a peer has one."""
    pair = established()
    stranger = made_initiation(KEY_C)
    sent = [stranger, made_initiation(), made_initiation(link=Link(suites=(SUITES[17],)))]
    broken = [flipped(datagram, len(datagram) - 20) for datagram in sent]
    assert not any(datagrams(pair.b.receive(datagram, 1.0, ELSEWHERE)) for datagram in [*broken, stranger])
    exhaust(pair.b, 1.0)
    assert not any(datagrams(pair.b.receive(datagram, 1.0, ELSEWHERE)) for datagram in broken)


def test_altered_suite_byte_does_not_downgrade() -> None:
    """The suite of an initiation cannot be steered: under any other it is refused, though bravo would accept all."""
    every = tuple(SUITES.values())
    for offered in every:
        pair = Pair(link_a=quiet(suites=(offered,)), link_b=quiet(suites=every))
        initiation = pair.initiation(0.0)
        others = [suite for suite in every if suite != offered]
        for claimed in others:
            size = wire.initiation_bytes(claimed) - 4 - wire.MACS_BYTES
            body = initiation[4 : -wire.MACS_BYTES][:size].ljust(size, b"\0")
            altered = with_macs(wire.initiation_header(claimed, 7) + body, pair.b.node.public_key)
            assert reasons(pair.b.receive(altered, 0.0)) == [DropReason.BAD_HANDSHAKE]
        response = only(datagrams(pair.b.receive(initiation, 0.0)))
        for claimed in others:
            size = wire.response_bytes(claimed) - 6 - wire.MACS_BYTES
            body = response[6 : -wire.MACS_BYTES][:size].ljust(size, b"\0")
            altered = with_macs(bytes((2, claimed.number)) + response[2:6] + body, pair.a.node.public_key)
            assert reasons(pair.a.receive(altered, 0.0)) == [DropReason.HEADER_MISMATCH]
        assert only(of(pair.a.receive(response, 0.0), SessionEstablished)).suite == offered.name


def test_refused_suite_is_offered_again() -> None:
    """A peer that does not accept the first suite gets no weaker offer, ever."""
    strong, weak = SUITES_BY_NAME["mlkem768"], SUITES_BY_NAME["x25519"]
    pair = Pair(link_a=quiet(suites=(strong, weak)), link_b=quiet(suites=(weak,)))
    now = 0.0
    for _ in range(20):
        now, initiation = retried(pair, now)
        assert initiation[1] == strong.number
        assert reasons(pair.b.receive(initiation, now)) == [DropReason.SUITE_NOT_ACCEPTED]


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
        patched.setattr(noise_protocol, "kem_of", lambda suite: Lie)
        lie = made_initiation(link=link)
    assert reasons(pair.b.receive(lie, 0.0)) == [DropReason.INVALID_KEY_SHARE]
    assert completes(pair, pair.initiation(0.0), 0.0)


# Replayed initiations.


def test_replays_and_strangers_cost_few_key_exchanges(monkeypatch: pytest.MonkeyPatch) -> None:
    """A replay costs none, also if mac2 differs or it comes from elsewhere; a forgery one, a stranger two."""
    pair = established()
    initiation = made_initiation()
    exchanges: list[bytes] = []
    original = KeyPair.exchange

    def counting(self: KeyPair, public: bytes) -> bytes:
        exchanges.append(public)
        return original(self, public)

    forgery = repaired(flipped(made_initiation(), 60), KEY_B.public)
    for datagram, expected in ((initiation, 4), (made_initiation(KEY_C), 2), (forgery, 1)):
        exchanges.clear()
        with monkeypatch.context() as patched:
            patched.setattr(KeyPair, "exchange", counting)
            pair.b.receive(datagram, 1.0)
        assert len(exchanges) == expected
    exchanges.clear()
    monkeypatch.setattr(KeyPair, "exchange", counting)
    replays = [(replay, place) for replay in (initiation, initiation[:-1] + b"\1") for place in (AT_A, ELSEWHERE)]
    for replay, place in replays:
        assert pair.b.receive(replay, 1.0, place)[-1] == Dropped(DropReason.DUPLICATE, pair.b.peer, place)
    later = 1.0 + c.INITIATION_COPIES_S
    pair.b.timeout(later)
    for replay, place in replays:
        assert pair.b.receive(replay, later, place) == [Dropped(DropReason.REPLAYED_INITIATION, None, place)]
    assert exchanges == []
    assert pair.carries(later)


def test_memory_for_initiations_is_bounded_and_belongs_to_each_peer(monkeypatch: pytest.MonkeyPatch) -> None:
    """The one before the last so many is answered as if it were new. Only authentic ones of the peer count."""
    monkeypatch.setattr(c, "REMEMBERED_LEAST", 3)
    monkeypatch.setattr(c, "REMEMBERED_INITIATIONS", 0)
    pair = established()
    node, memory = pair.b.node, pair.b.node._handshakes.remembered
    noisy = node.add_peer(PeerSettings("noisy", KEY_C.public), 1.0)
    made = [made_initiation() for _ in range(4)]
    for initiation in made:
        assert datagrams(pair.b.receive(initiation, 1.0), wire.RESPONSE)
    pair.b.receive(repaired(flipped(made_initiation(), 60), KEY_B.public), 1.0)
    for number in range(10):
        node._handshakes.remember(noisy, number.to_bytes(32, "big"), bytes(16), 1.0)
    assert len(memory) == 6
    for initiation in made[1:]:
        assert reasons(pair.b.receive(initiation, 2.0)) == [DropReason.DUPLICATE]
    assert datagrams(pair.b.receive(made[0], 2.0), wire.RESPONSE)
    node.remove_peer(noisy, 3.0)
    assert len(memory) == 3


def test_bytes_to_other_addresses_are_counted_apart() -> None:
    """Responses to replayed initiations take nothing from a link's budget."""
    pair = established()
    traffic, paths = pair.b.peer.traffic, pair.b.peer.paths
    before, elsewhere = paths.totals, traffic.bytes_elsewhere
    answer = only(datagrams(pair.b.receive(made_initiation(), 1.0, ELSEWHERE), wire.RESPONSE))
    assert paths.totals == before
    assert traffic.bytes_elsewhere - elsewhere == len(answer)
    answer = only(datagrams(pair.b.receive(made_initiation(), 1.0), wire.RESPONSE))
    assert paths.totals[:2] == (before.datagrams_sent + 1, before.bytes_sent + len(answer))


# Cookies under load.


def test_response_under_load_is_repeated_with_a_cookie() -> None:
    """An initiator under load asks the responder for a cookie; its answer to the next initiation is taken."""
    pair = Pair(link_a=QUIET, link_b=QUIET)
    response = only(datagrams(pair.b.receive(pair.initiation(0.0), 0.0)))
    exhaust(pair.a, 0.0)
    assert pair.b.receive(only(datagrams(pair.a.receive(response, 0.0), wire.COOKIE)), 0.0) == []
    now, initiation = retried(pair, 0.0)
    response = only(datagrams(pair.b.receive(initiation, now), wire.RESPONSE))
    assert response[-16:] != bytes(16)
    exhaust(pair.a, now)
    assert of(pair.a.receive(response, now), SessionEstablished)


# Peers come and go.


def test_removed_peer_is_cut_off_at_once() -> None:
    """The Node closes its sessions, and treats its envelopes and initiations as those of a stranger."""
    pair = established()
    before, peer = pair.a.envelope(1.0), pair.b.peer
    pair.b.configure_path(1.0)
    closing = only(datagrams(pair.b.node.remove_peer(peer, 1.0)))
    assert reasons(pair.b.receive(before, 1.0)) == [DropReason.LATE]
    reported = Dropped(DropReason.UNKNOWN_PEER, None, AT_A, 1, KEY_A.public)
    assert pair.b.receive(made_initiation(), 1.0) == [reported]
    assert datagrams(pair.b.receive(stray(), 1.0)) == []
    assert reasons(pair.b.node.send(peer, [FRAME], 1.0)) == [DropReason.NO_SESSION]
    assert pair.b.node._indices.owners == {}
    assert pair.b.node.handle_timeout(500.0) == pair.b.node.close(500.0) == []
    assert pair.b.node.next_deadline() == NEVER
    pair.a.receive(closing, 1.0)
    assert pair.a.peer.sessions.current is None
    pair.b.node.add_peer(PeerSettings("alpha", KEY_A.public, None, QUIET), 2.0)
    now, initiation = retried(pair, c.REKEY_AFTER_S)
    assert completes(pair, initiation, now)


def test_names_and_keys_are_unique() -> None:
    """A name has one key, and a key one name. A Node cannot be its own peer."""
    pair = Pair()
    for name, key in (("alpha", KEY_C), ("another", KEY_A), ("myself", KEY_B)):
        with pytest.raises(ValueError, match=name):
            pair.b.node.add_peer(PeerSettings(name, key.public), 0.0)
    assert list(pair.b.node.peers) == ["alpha"]


def test_address_of_two_peers_outlives_the_first() -> None:
    """Two peers are configured at one address: a hint from there is for the last one, also when the first is gone."""
    pair = established()
    charlie = pair.b.node.add_peer(PeerSettings("charlie", KEY_C.public), 1.0)
    pair.b.configure_path(1.0)
    pair.b.node.set_paths(charlie, [AT_A], 1.0)
    pair.b.node.remove_peer(pair.b.peer, 1.0)
    assert len(datagrams(pair.b.receive(stray(), 1.0), wire.INITIATION)) == 1
    pair.b.node.set_paths(charlie, [], 2.0)
    assert datagrams(pair.b.receive(stray(), 9.0)) == []


def test_fault_in_the_timers_of_one_peer_costs_no_other_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten are due together. The failing one has its timers back within a second, whatever the fault interrupted."""
    node = Pair().a.node
    for number in range(10):
        key = KeyPair((1000 + number).to_bytes(32)).public
        node.set_paths(node.add_peer(PeerSettings(str(number), key), 0.0), [Path(0, (f"192.0.2.{number}", 1))], 0.0)
    initiated = Counter[str]()

    def fail_once(peer: Peer, now: float) -> list[Output]:
        out = handle_timeout(peer, now)
        if peer.name == "3" and not initiated[peer.name]:
            initiated[peer.name] += 1
            raise ZeroDivisionError
        initiated[peer.name] += len(datagrams(out, wire.INITIATION))
        return out

    monkeypatch.setattr(module, "handle_timeout", fail_once)
    now, faults = 5.0, 0
    while node.next_deadline() <= (now := max(now, node.next_deadline())) <= 5.0 + c.RECOVER_S:
        try:
            node.handle_next(now)
        except ZeroDivisionError:
            faults += 1
    assert faults == 1
    assert len(initiated) == len(node.peers) == 11
    assert min(initiated.values()) >= 2


def test_many_peers_that_are_due_together_are_handled_in_parts() -> None:
    """A shell reads its sockets in between. The next deadline stays in the past until each peer has had its turn."""
    node, count = Pair().a.node, 3 * PEERS_AT_ONCE
    for number in range(count):
        key = KeyPair((1000 + number).to_bytes(32)).public
        node.set_paths(node.add_peer(PeerSettings(str(number), key), 0.0), [Path(0, (f"192.0.2.{number}", 1))], 0.0)
    parts = list[int]()
    while node.next_deadline() <= 5.0:
        before = {peer for peer in node.peers.values() if peer.timers.next_at <= 5.0}
        node.handle_timeout(5.0)
        parts.append(len(before) - sum(peer.timers.next_at <= 5.0 for peer in before))
    assert max(parts) == PEERS_AT_ONCE
    assert sum(parts) >= count
    assert all(peer.timers.next_at > 5.0 for peer in node.peers.values())


def test_a_fault_while_an_envelope_is_received_leaves_all_timers_of_its_peer_soon_due(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The shell gets the exception. A datagram that names no peer wakes none."""
    pair = established()
    envelope = pair.a.envelope(1.0)

    def fail(*arguments: Any) -> Any:
        raise RuntimeError("planted")

    monkeypatch.setattr("uavlinkd.protocol.session.Session.open", fail)
    with pytest.raises(RuntimeError, match="planted"):
        pair.b.receive(envelope, 1.0)
    assert pair.b.node.next_deadline() <= 1.0 + c.RECOVER_S
    monkeypatch.undo()
    assert pair.carries(1.5)
    monkeypatch.setattr(type(pair.b.node._handshakes), "receive", fail)
    with pytest.raises(RuntimeError, match="planted"):
        pair.b.receive(made_initiation(), 2.0)
