"""The Noise handshake against published vectors, and against forgers."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.core.harness import flipped, state_of
from uavlinkd.core import noise, wire
from uavlinkd.core.crypto import AeadKey, Entropy, KeyPair, Secret
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.noise import HandshakeState
from uavlinkd.core.suites import SUITES, SUITES_BY_NAME, X25519, Suite

VECTORS = Path(__file__).parents[1] / "vectors" / "noise.json"
PATTERNS = {"IK": noise.IK, "IKpsk1": noise.IK_PSK1, "IKpsk2": noise.IK_PSK2}
KEY_A, KEY_B = KeyPair(bytes([1]) * 32), KeyPair(bytes([2]) * 32)


def vectors() -> Iterator[Any]:
    """One parameter set per published vector."""
    for number, vector in enumerate(json.loads(VECTORS.read_text())["vectors"]):
        yield pytest.param(vector, id=f"{vector['protocol_name']}-{number}")


def fixed(*values: bytes) -> Entropy:
    """Entropy that is known beforehand."""
    left = list(values)

    def draw(size: int, /) -> bytes:
        value = left.pop(0)
        assert len(value) == size
        return value

    return draw


def seeded(seed: int) -> Entropy:
    """Entropy for tests in which its value does not matter."""
    import random

    return random.Random(seed).randbytes


@pytest.mark.parametrize("vector", list(vectors()))
def test_published_vector(vector: dict[str, Any]) -> None:
    """Every message, the handshake hash and the transport keys are those that other implementations made."""
    pattern = PATTERNS[vector["protocol_name"].split("_")[1]]
    prologue = bytes.fromhex(vector["init_prologue"])
    psk = Secret(bytes.fromhex(vector["init_psks"][0])) if vector.get("init_psks") else noise.NO_PSK
    keys = {name: KeyPair(bytes.fromhex(vector[name])) for name in ("init_static", "resp_static")}
    initiator = noise.initiator(
        pattern, X25519, prologue, keys["init_static"], bytes.fromhex(vector["init_remote_static"]), psk
    )
    responder = noise.responder(pattern, X25519, prologue, keys["resp_static"], psk)
    messages = [(bytes.fromhex(m["payload"]), bytes.fromhex(m["ciphertext"])) for m in vector["messages"]]

    entropy = fixed(bytes.fromhex(vector["init_ephemeral"]))
    initiator, first = initiator.write(pattern.initiation, messages[0][0], entropy)
    responder, payload = responder.read(pattern.initiation, first)

    assert (first, payload) == (messages[0][1], messages[0][0])
    assert responder.rs == keys["init_static"].public

    entropy = fixed(bytes.fromhex(vector["resp_ephemeral"]))
    responder, second = responder.write(pattern.response, messages[1][0], entropy)
    initiator, payload = initiator.read(pattern.response, second)

    assert (second, payload) == (messages[1][1], messages[1][0])
    assert initiator.symmetric.h == responder.symmetric.h
    if "handshake_hash" in vector:
        assert initiator.symmetric.h.hex() == vector["handshake_hash"]
    assert initiator.symmetric.split() == responder.symmetric.split()
    ciphers = [AeadKey(secret.reveal()) for secret in initiator.symmetric.split()]
    assert len(messages) > 2
    for number, (payload, ciphertext) in enumerate(messages[2:]):
        assert ciphers[number % 2].seal(number // 2, payload, b"") == ciphertext
        assert ciphers[number % 2].open(number // 2, ciphertext, b"") == payload


KINDS = [pytest.param(SUITES_BY_NAME[name], id=name) for name in ("x25519", "ffdhe2048", "mlkem768")]
ALL_SUITES = [pytest.param(suite, id=suite.name) for suite in SUITES.values()]
PSK = Secret(bytes(range(32)))
PAYLOAD_1, PAYLOAD_2 = b"first payload", b"second"
LOW_ORDER = [
    bytes.fromhex(vector["public"])
    for vector in json.loads(VECTORS.with_name("x25519_low_order.json").read_text())["vectors"]
]


def start(suite: Suite, psk: Secret = PSK, rs: bytes = KEY_B.public) -> tuple[HandshakeState, HandshakeState]:
    """The two states before the first message."""
    pattern = noise.IK_HFS_PSK2 if suite.has_group else noise.IK_PSK2
    return (
        noise.initiator(pattern, suite, b"prologue", KEY_A, rs, psk),
        noise.responder(pattern, suite, b"prologue", KEY_B, psk),
    )


def first(state: HandshakeState) -> tuple[HandshakeState, bytes]:
    """Write message 1."""
    return state.write(state.pattern.initiation, PAYLOAD_1, seeded(1))


def second(state: HandshakeState) -> tuple[HandshakeState, bytes]:
    """Write message 2."""
    return state.write(state.pattern.response, PAYLOAD_2, seeded(2))


def reason_of(state: HandshakeState, message: bytes) -> DropReason:
    """Why a state refuses the message that it waits for; nothing of the state changes by it."""
    tokens = state.pattern.response if state.is_initiator else state.pattern.initiation
    before = state_of(state)
    with pytest.raises(Drop) as caught:
        state.read(tokens, message)
    assert state_of(state) == before
    return caught.value.reason


def completes(initiator: HandshakeState, message: bytes, responder: HandshakeState) -> bool:
    """Whether the genuine response still makes both ends agree."""
    finished, payload = initiator.read(initiator.pattern.response, message)
    return payload == PAYLOAD_2 and finished.symmetric.split() == responder.symmetric.split()


@pytest.mark.parametrize("suite", ALL_SUITES)
def test_both_ends_agree_after_every_message(suite: Suite) -> None:
    """Transcript hash and chaining key are the same at both ends after each message, and so are the keys."""
    initiator, responder = start(suite)
    assert initiator.symmetric.h == responder.symmetric.h

    initiator, message_1 = first(initiator)
    responder, payload_1 = responder.read(responder.pattern.initiation, message_1)
    assert payload_1 == PAYLOAD_1
    assert (initiator.symmetric.h, initiator.symmetric.ck) == (responder.symmetric.h, responder.symmetric.ck)
    assert responder.rs == KEY_A.public

    responder, message_2 = second(responder)
    initiator, payload_2 = initiator.read(initiator.pattern.response, message_2)
    assert payload_2 == PAYLOAD_2
    assert (initiator.symmetric.h, initiator.symmetric.ck) == (responder.symmetric.h, responder.symmetric.ck)
    sending, receiving = initiator.symmetric.split()
    assert (sending, receiving) == responder.symmetric.split()
    assert sending != receiving

    share = suite.share_bytes + 16 if suite.has_group else 0
    ciphertext = suite.ciphertext_bytes + 16 if suite.has_group else 0
    assert len(message_1) == wire.NOISE_1_BYTES + share + len(PAYLOAD_1)
    assert len(message_2) == wire.NOISE_2_BYTES + ciphertext + len(PAYLOAD_2)


@pytest.mark.parametrize("suite", KINDS)
def test_altered_initiation_leaves_the_responder_waiting(suite: Suite) -> None:
    """A bit turned over in any byte of message 1, and it is refused; the genuine one is then read."""
    initiator, responder = start(suite)
    initiator, message = first(initiator)

    for position in range(len(message)):
        assert reason_of(responder, flipped(message, position, position % 8)) is DropReason.BAD_HANDSHAKE
    # X25519 ignores the highest bit of e; the transcript does not.
    assert reason_of(responder, flipped(message, 31, 7)) is DropReason.BAD_HANDSHAKE

    responder, response = second(responder.read(responder.pattern.initiation, message)[0])
    assert completes(initiator, response, responder)


@pytest.mark.parametrize("suite", KINDS)
def test_altered_response_leaves_the_initiator_waiting(suite: Suite) -> None:
    """A bit turned over in any byte of message 2, and it is refused; the genuine one then completes."""
    initiator, responder = start(suite)
    initiator, message = first(initiator)
    responder, response = second(responder.read(responder.pattern.initiation, message)[0])

    for position in range(len(response)):
        assert reason_of(initiator, flipped(response, position, position % 8)) is DropReason.BAD_HANDSHAKE
    assert reason_of(initiator, flipped(response, 31, 7)) is DropReason.BAD_HANDSHAKE

    assert completes(initiator, response, responder)


@pytest.mark.parametrize("suite", KINDS)
def test_message_of_another_length_is_refused(suite: Suite) -> None:
    """Every truncation, and bytes behind the end, fail as any forgery does."""
    initiator, responder = start(suite)
    initiator, message = first(initiator)
    _, response = second(responder.read(responder.pattern.initiation, message)[0])

    # The message always brings a whole ephemeral key: its length was checked before it came here.
    for length in range(32, len(message)):
        assert reason_of(responder, message[:length]) is DropReason.BAD_HANDSHAKE
    for length in range(32, len(response)):
        assert reason_of(initiator, response[:length]) is DropReason.BAD_HANDSHAKE
    assert reason_of(responder, message + b"\0") is DropReason.BAD_HANDSHAKE
    assert reason_of(initiator, response + b"\0") is DropReason.BAD_HANDSHAKE


def wrong_psk(state: HandshakeState) -> HandshakeState:
    """The same state with another PSK."""
    return state.with_psk(Secret(bytes(32)))


@pytest.mark.parametrize("suite", KINDS)
def test_another_psk_fails_at_the_response(suite: Suite) -> None:
    """A peer without the PSK cannot answer, and cannot read an answer."""
    initiator, responder = start(suite)
    initiator, message = first(initiator)
    read, _ = responder.read(responder.pattern.initiation, message)
    _, forged = second(wrong_psk(read))
    genuine, response = second(read)

    assert reason_of(initiator, forged) is DropReason.BAD_HANDSHAKE
    assert reason_of(wrong_psk(initiator), response) is DropReason.BAD_HANDSHAKE
    assert completes(initiator, response, genuine)


@pytest.mark.parametrize("suite", KINDS)
def test_initiation_to_another_key_is_not_read(suite: Suite) -> None:
    """Message 1 is for the holder of one static key."""
    initiator, _ = start(suite, rs=KEY_A.public)
    _, responder = start(suite)

    assert reason_of(responder, first(initiator)[1]) is DropReason.BAD_HANDSHAKE


@pytest.mark.parametrize("suite", KINDS)
def test_response_of_another_key_is_not_accepted(suite: Suite) -> None:
    """An attacker who answers with a static key of its own reaches no session, whatever it saw."""
    initiator, responder = start(suite)
    initiator, message = first(initiator)
    read, _ = responder.read(responder.pattern.initiation, message)
    thief = dataclasses.replace(read, s=KeyPair(bytes([9]) * 32), rs=KeyPair(bytes([8]) * 32).public)

    assert reason_of(initiator, second(thief)[1]) is DropReason.BAD_HANDSHAKE
    genuine, response = second(read)
    assert completes(initiator, response, genuine)


def test_prologue_suite_and_pattern_are_in_the_transcript() -> None:
    """Ends that disagree about prologue, group name or pattern do not understand each other."""
    plain, mlkem = SUITES_BY_NAME["x25519"], SUITES_BY_NAME["mlkem768"]
    _, message = first(start(plain)[0])

    for pattern, suite, prologue in (
        (noise.IK_PSK2, plain, b"Prologue"),
        (noise.IK_PSK2, mlkem, b"prologue"),
        (noise.IK_PSK1, plain, b"prologue"),
        (noise.IK, plain, b"prologue"),
    ):
        responder = noise.responder(pattern, suite, prologue, KEY_B, PSK)
        assert reason_of(responder, message) is DropReason.BAD_HANDSHAKE


@pytest.mark.parametrize("suite", KINDS)
@pytest.mark.parametrize("low", LOW_ORDER, ids=range(len(LOW_ORDER)))
def test_ephemeral_of_low_order_is_refused(low: bytes, suite: Suite) -> None:
    """A point of low order in place of e is refused in either message, and the genuine message still completes."""
    initiator, responder = start(suite)
    initiator, message = first(initiator)
    read, _ = responder.read(responder.pattern.initiation, message)
    genuine, response = second(read)

    assert reason_of(responder, low + message[32:]) is DropReason.INVALID_KEY_SHARE
    assert reason_of(initiator, low + response[32:]) is DropReason.INVALID_KEY_SHARE
    assert completes(initiator, response, genuine)


@pytest.mark.parametrize("suite", KINDS)
@pytest.mark.parametrize("low", LOW_ORDER, ids=range(len(LOW_ORDER)))
def test_static_key_of_low_order_is_refused(low: bytes, suite: Suite) -> None:
    """A point of low order in place of s, properly sealed by a peer, is refused."""
    initiator, responder = start(suite)
    liar = KeyPair(bytes([9]) * 32)
    liar.public = low
    _, message = first(dataclasses.replace(initiator, s=liar))

    assert reason_of(responder, message) is DropReason.INVALID_KEY_SHARE


class LyingKem:
    """The group of a malicious peer: it sends a chosen share, properly sealed."""

    def __init__(self, part: bytes) -> None:
        self.share = part

    def generate(self, entropy: Entropy) -> LyingKem:
        """No key pair at all."""
        return self

    def encapsulate(self, share: bytes, entropy: Entropy) -> tuple[bytes, bytes]:
        """The chosen share as the ciphertext, and an arbitrary secret."""
        return self.share, bytes(32)

    def decapsulate(self, ciphertext: bytes) -> bytes:
        """Nothing is known."""
        raise AssertionError


def lies(suite: Suite) -> list[bytes]:
    """Shares that no honest end sends."""
    size = suite.share_bytes
    if suite.name.startswith("ffdhe"):
        return [bytes(size), bytes(size - 1) + b"\1", b"\xff" * size]
    return [b"\xff" * size]


@pytest.mark.parametrize("suite", KINDS[1:])
def test_bad_share_that_is_well_sealed_is_refused(suite: Suite, monkeypatch: pytest.MonkeyPatch) -> None:
    """A peer who seals a value outside the group into message 1 gets no answer."""
    for lie in lies(suite):
        initiator, responder = start(suite)
        with monkeypatch.context() as patched:
            patched.setattr(noise, "kem_of", lambda suite, lie=lie: LyingKem(lie))
            _, message = first(initiator)
        read, _ = responder.read(responder.pattern.initiation, message)

        with pytest.raises(Drop) as caught:
            second(read)
        assert caught.value.reason is DropReason.INVALID_KEY_SHARE


def test_bad_ciphertext_that_is_well_sealed_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A responder who seals a value outside the group into message 2 reaches no session; the genuine one does."""
    suite = SUITES_BY_NAME["ffdhe2048"]
    initiator, responder = start(suite)
    initiator, message = first(initiator)
    read, _ = responder.read(responder.pattern.initiation, message)
    genuine, response = second(read)
    for lie in lies(suite):
        with monkeypatch.context() as patched:
            patched.setattr(noise, "kem_of", lambda suite, lie=lie: LyingKem(lie))
            _, forged = second(read)
        assert reason_of(initiator, forged) is DropReason.INVALID_KEY_SHARE
    assert completes(initiator, response, genuine)


def test_mlkem_ciphertext_of_another_key_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the responder's ciphertext does not hold the secret that it used, the response does not verify."""
    suite = SUITES_BY_NAME["mlkem768"]
    initiator, responder = start(suite)
    initiator, message = first(initiator)
    read, _ = responder.read(responder.pattern.initiation, message)
    monkeypatch.setattr(noise, "kem_of", lambda suite: LyingKem(bytes(suite.ciphertext_bytes)))
    _, forged = second(read)
    monkeypatch.undo()

    assert reason_of(initiator, forged) is DropReason.BAD_HANDSHAKE


@pytest.mark.parametrize("step", [first, second])
def test_each_ephemeral_is_fresh(step: Callable[[HandshakeState], tuple[HandshakeState, bytes]]) -> None:
    """Writing the same message again with other entropy gives another ephemeral key: no state is used up."""
    initiator, responder = start(SUITES_BY_NAME["x25519"])
    state = initiator
    if step is second:
        state, _ = responder.read(responder.pattern.initiation, first(initiator)[1])
    tokens = state.pattern.initiation if step is first else state.pattern.response

    _, one = state.write(tokens, b"", seeded(5))
    _, other = state.write(tokens, b"", seeded(6))

    assert one[:32] != other[:32]


def test_protocol_names() -> None:
    """The name hashes into every key; a group is named beside X25519."""
    names = {suite.name: start(suite)[0] for suite in SUITES.values()}
    named = {name: noise.protocol_name(state.pattern, state.suite).decode() for name, state in names.items()}

    assert named["x25519"] == "Noise_IKpsk2_25519_ChaChaPoly_SHA256"
    assert named["ffdhe3072"] == "Noise_IKhfs+psk2_25519+FFDHE3072_ChaChaPoly_SHA256"
    assert named["mlkem1024"] == "Noise_IKhfs+psk2_25519+MLKEM1024_ChaChaPoly_SHA256"
    assert len(set(named.values())) == len(SUITES)


def test_short_protocol_name_is_padded_and_long_one_hashed() -> None:
    """InitializeSymmetric pads a name of up to 32 bytes with zeros and hashes a longer one (Noise, section 5.2)."""
    assert noise.SymmetricState.initialize(b"n" * 31).h == b"n" * 31 + b"\0"
    assert noise.SymmetricState.initialize(b"n" * 32).h == b"n" * 32
    assert len(noise.SymmetricState.initialize(b"n" * 33).h) == 32
    assert noise.SymmetricState.initialize(b"n" * 33).h != b"n" * 32


def test_without_a_key_the_payload_is_in_the_clear_but_hashed() -> None:
    """Before the first exchange a payload is only bound to the transcript (Noise, section 5.2)."""
    state = noise.SymmetricState.initialize(b"name")

    sealed, out = state.encrypt_and_hash(b"payload")
    opened, back = state.decrypt_and_hash(b"payload")

    assert (out, back) == (b"payload", b"payload")
    assert sealed.h == opened.h == state.mix_hash(b"payload").h
