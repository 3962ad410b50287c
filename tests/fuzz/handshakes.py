"""Handshake messages that are sealed with the right keys, around any header, parameters and key share.

They go to bravo from a known or unknown initiator, and to alpha from the responder of its initiation. A message whose
clear part differs from its sealed part, or that requests something outside the protocol, is refused with its own
reason. After an accepted message both ends have keys. Tables stay within their bounds; afterwards an honest handshake
completes.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from tests.fuzz.engine import Run, Script
from tests.fuzz.stages import GROUPS, LINKS, NOW, SeededEntropy, copier, pair_of
from tests.protocol import inside
from tests.protocol.harness import AT_A, AT_B, ELSEWHERE, KEY_A, KEY_B, KEY_C, Pair, datagrams, of, only, with_macs
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import handshake, noise, wire
from uavlinkd.protocol.crypto import KeyPair
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.limits import TokenBucket
from uavlinkd.protocol.noise import HandshakeState
from uavlinkd.protocol.outputs import Dropped, Output, SessionEstablished, Transmit

LINK: Final = replace(LINKS[0], suites=GROUPS)
KEY_D: Final = KeyPair(bytes((4,)) * 32)
INITIATORS: Final = (KEY_A, KEY_A, KEY_C, KEY_D)
"""Two initiators that bravo knows, and one that it does not know."""
OFTEN: Final = (GROUPS[0], GROUPS[0], GROUPS[0], GROUPS[1])
_REFUSALS = (DropReason.MALFORMED, DropReason.HEADER_MISMATCH, DropReason.BAD_PARAMETERS)


def write(
    state: HandshakeState, payload: bytes, share: bytes | None, entropy: SeededEntropy
) -> tuple[HandshakeState, bytes]:
    """WriteMessage; ``share``: these bytes instead of an honest share or ciphertext. Then no secret is common."""
    if share is None or not state.suite.has_group:
        return state.write(payload, entropy)
    message = b""
    for token in noise.tokens_of(state.suite)[not state.is_initiator]:
        symmetric = state.symmetric
        if token == "e":
            e = KeyPair(entropy(c.KEY_BYTES))
            message += e.public
            state = state._replace(e=e, symmetric=symmetric.mix_hash(e.public).mix_key(e.public))
        elif token in ("s", "e1", "ekem1"):
            symmetric, sealed = symmetric.encrypt_and_hash(state.s.public if token == "s" else share)
            message += sealed
            state = state._replace(symmetric=symmetric)
        else:
            state = inside.mix(state, token)
    symmetric, sealed = state.symmetric.encrypt_and_hash(payload)
    return state._replace(symmetric=symmetric), message + sealed


def _payload(script: Script, header: bytes) -> bytes:
    """The sealed header and parameters, most of them valid."""
    how = script.byte()
    parameters = bytearray(
        wire.Parameters(
            generation=script.long() if how & 1 else script.byte(),
            confidential=bool(how & 2),
            tag_bytes=wire.TAG_LENGTHS[(how >> 2 & 3) % 3],
            max_envelope=max(c.MIN_ENVELOPE_LIMIT, script.word() if how & 1 else 1232),
        ).encode()
    )
    payload = bytearray(header[1:]) + parameters
    if how & 0x40:
        payload[script.byte() % len(payload)] ^= script.byte()
    if how & 0x80:
        piece = script.take(1 + (script.byte() & 15))
        at = script.byte() % len(payload)
        payload[at : at + len(piece)] = piece
        payload = payload[: len(header) - 1 + wire.Parameters.SIZE].ljust(
            len(header) - 1 + wire.Parameters.SIZE, b"\0"
        )
    return bytes(payload)


def _share(script: Script, size: int) -> bytes | None:
    """An honest share (None), or any bytes, including values that every group refuses."""
    how = script.byte()
    match how & 7:
        case 0:
            return (how >> 3 & 3).to_bytes(max(size, 1), "big")[-size:] if size else b""
        case 1:
            return b"\xff" * size
        case 2:
            return script.take(32).ljust(size, b"\5")[:size]
        case _:
            return None


def expected(payload: bytes, header: bytes) -> DropReason | None:
    """The reason to refuse an authentic payload behind this header, by its bytes alone."""
    if header[2:4] == bytes(2):
        return DropReason.MALFORMED  # sender index 0
    if payload[: len(header) - 1] != header[1:]:
        return DropReason.HEADER_MISMATCH
    *_, tag_bytes = payload[: len(header) + 7]
    mac_key_bits = int.from_bytes(payload[len(header) + 7 : len(header) + 9], "big")
    largest = int.from_bytes(payload[len(header) + 9 :], "big")
    if tag_bytes not in (8, 12, 16) or mac_key_bits != 256 or largest < 320:
        return DropReason.BAD_PARAMETERS
    return None


def _refill(pair: Pair, now: float) -> None:
    """An unlimited budget: the targets test the code behind it."""
    for pending in pair.a.peer.initiator.pending.values():
        if (key := pending.initiated.state.e1) is not None:
            inside.forget_secret(key)
    for node in (pair.a.node, pair.b.node):
        inside.refill(node, now)
        for peer in node.peers.values():
            peer.group_work = peer.proven_group_work = TokenBucket(*c.GROUP_WORK_PER_PEER, now)
            peer.answers = TokenBucket(*c.ANSWERS, now)


def _refused(outputs: list[Output]) -> DropReason:
    (dropped,) = outputs
    assert isinstance(dropped, Dropped), f"not refused: {outputs}"
    return dropped.reason


def call(pair: Pair, script: Script, entropy: SeededEntropy) -> None:
    """An initiation to bravo."""
    what = script.byte()
    initiator, suite = INITIATORS[what & 3], OFTEN[what >> 2 & 3] if what & 0x30 else GROUPS[2]
    header = wire.initiation_header(suite, script.word())
    payload = _payload(script, header)
    share = _share(script, suite.share_bytes)
    start = noise.initiator(suite, wire.prologue(suite), initiator, KEY_B.public)
    state, message = write(start, payload, share, entropy)
    datagram = with_macs(header + message, KEY_B.public)
    path = (AT_A, ELSEWHERE)[what >> 6 & 1]
    outputs = pair.b.node.receive(datagram, path, NOW)
    if reason := expected(payload, header):
        assert _refused(outputs) is reason, f"{reason} was not the reason: {outputs}"
    elif initiator is KEY_D:
        assert _refused(outputs) is DropReason.UNKNOWN_PEER
    elif type(outputs[0]) is Dropped:
        assert share is not None, f"an honest share was refused: {outputs}"
        assert _refused(outputs) is DropReason.INVALID_KEY_SHARE
    else:
        (sent,) = outputs
        assert isinstance(sent, Transmit), f"more than an answer: {outputs}"
        assert sent.path == path, "the answer went elsewhere"
        assert len(sent.datagram) <= len(datagram), "a response longer than its initiation"
        if share is None:
            _check_answer(state, wire.parse_parameters(payload[len(header) - 1 :]), sent.datagram)


def _check_answer(state: HandshakeState, asked: wire.Parameters, datagram: bytes) -> None:
    """The initiator can read the response, and the agreed parameters are at least as strong as both requests."""
    initiated = handshake.Initiated(state, asked, b"")
    agreed = handshake.receive_response(initiated, wire.parse_response(datagram)).parameters
    ours = handshake.parameters_of(LINK, 0)
    assert agreed.generation > min(asked.generation, 2**32 - 2)
    assert agreed.confidential == (asked.confidential or ours.confidential)
    assert agreed.tag_bytes >= max(asked.tag_bytes, ours.tag_bytes)
    assert agreed.max_envelope <= min(asked.max_envelope, ours.max_envelope)


def answer(pair: Pair, script: Script, initiation: bytes, entropy: SeededEntropy) -> bool:
    """Send a response to alpha, with bravo's key; returns whether it made a session."""
    received = handshake.receive_initiation(KEY_B, wire.parse_initiation(initiation))
    suite = received.initiation.suite
    what = script.byte()
    header = wire.response_header(suite, script.word(), received.initiation.sender_index)
    payload = _payload(script, header)
    share = _share(script, suite.ciphertext_bytes)
    _, message = write(received.state, payload, share, entropy)
    datagram = with_macs(header + message, KEY_A.public)
    if what & 7 == 7 and pair.a.peer.initiator.pending:  # with an invalid tag
        datagram = datagram[:-33] + bytes((datagram[-33] ^ 1,)) + datagram[-32:]
        datagram = with_macs(datagram[: -wire.MACS_BYTES], KEY_A.public)
    outputs = pair.a.node.receive(datagram, AT_B, NOW)
    if type(outputs[0]) is Dropped:
        reason = _refused(outputs)
        if reason in _REFUSALS:
            assert expected(payload, header) is reason
        return False
    assert expected(payload, header) is None, f"accepted an invalid response: {outputs}"
    assert what & 7 != 7, f"accepted an altered response: {outputs}"
    assert len(of(outputs, SessionEstablished)) == 1
    return True


def _check_bounds(pair: Pair) -> None:
    for side in (pair.a, pair.b):
        owned = 0
        for peer in side.node.peers.values():
            assert len(peer.sessions.unconfirmed) <= 2 * c.UNCONFIRMED_PER_KIND, "too many unconfirmed sessions"
            owned += len(peer.sessions.unconfirmed) + len(peer.initiator.pending) + len(peer.sessions.confirmed)
        assert inside.owned_indices(side.node) == owned, "an index without an owner"


def make() -> Run:
    """Both roles, in each kind of group."""
    pairs = []
    for suite in GROUPS:
        pair = pair_of(replace(LINK, suites=(suite, *(group for group in GROUPS if group is not suite))))
        initiation = pair.initiation(NOW)
        pairs.append((copier(pair), initiation))

    def run(data: bytes) -> None:
        script = Script(data)
        first = script.byte()
        copy, initiation = pairs[(0, 0, 0, 0, 0, 1, 1, 2)[first & 7]]
        pair = copy()
        entropy = SeededEntropy(5)
        if first & 8:
            while script and not answer(pair, script, initiation, entropy):
                _refill(pair, NOW)
        else:
            while script:
                _refill(pair, NOW)
                call(pair, script, entropy)
                _check_bounds(pair)
        _check_sequel(pair, initiation)

    return run


def _check_sequel(pair: Pair, initiation: bytes) -> None:
    """Bravo answers alpha's own initiation; if alpha has no session by then, the response completes the handshake."""
    _check_bounds(pair)
    _refill(pair, NOW)
    response = only(datagrams(pair.b.receive(initiation, NOW)))
    if pair.a.peer.sessions.current is None:
        assert of(pair.a.receive(response, NOW), SessionEstablished), "the genuine response makes no session"
        assert pair.carries(NOW), "the link does not carry frames"
