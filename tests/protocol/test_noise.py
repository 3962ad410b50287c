"""The Noise handshake against published vectors, and against forgers."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.protocol.harness import flipped, seeded, state_of
from uavlinkd.protocol import noise
from uavlinkd.protocol.crypto import AeadKey, Entropy, KeyPair, Secret
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.noise import HandshakeState
from uavlinkd.protocol.suites import SUITES_BY_NAME, X25519, Suite

VECTORS = Path(__file__).parents[1] / "vectors" / "noise.json"
KEY_A, KEY_B = KeyPair(bytes([1]) * 32), KeyPair(bytes([2]) * 32)


def fixed(*values: bytes) -> Entropy:
    """Entropy that is known beforehand."""
    left = list(values)

    def draw(size: int, /) -> bytes:
        value = left.pop(0)
        assert len(value) == size
        return value

    return draw


def test_published_vector() -> None:
    """Every message, the handshake hash and the transport keys are those that other implementations made."""
    (vector,) = json.loads(VECTORS.read_text())["vectors"]
    assert vector["protocol_name"].encode() == noise.protocol_name(X25519)
    prologue = bytes.fromhex(vector["init_prologue"])
    psk = Secret(bytes.fromhex(vector["init_psks"][0]))
    keys = {name: KeyPair(bytes.fromhex(vector[name])) for name in ("init_static", "resp_static")}
    initiator = noise.initiator(
        X25519, prologue, keys["init_static"], bytes.fromhex(vector["init_remote_static"]), psk
    )
    responder = noise.responder(X25519, prologue, keys["resp_static"], psk)
    messages = [(bytes.fromhex(m["payload"]), bytes.fromhex(m["ciphertext"])) for m in vector["messages"]]

    entropy = fixed(bytes.fromhex(vector["init_ephemeral"]))
    initiator, first = initiator.write(messages[0][0], entropy)
    responder, payload = responder.read(first)

    assert (first, payload) == (messages[0][1], messages[0][0])
    assert responder.rs == keys["init_static"].public

    entropy = fixed(bytes.fromhex(vector["resp_ephemeral"]))
    responder, second = responder.write(messages[1][0], entropy)
    initiator, payload = initiator.read(second)

    assert (second, payload) == (messages[1][1], messages[1][0])
    assert initiator.symmetric.h == responder.symmetric.h
    assert initiator.symmetric.h.hex() == vector["handshake_hash"]
    assert initiator.symmetric.split() == responder.symmetric.split()
    ciphers = [AeadKey(secret.reveal()) for secret in initiator.symmetric.split()]
    assert len(messages) > 2
    for number, (payload, ciphertext) in enumerate(messages[2:]):
        assert ciphers[number % 2].seal(number // 2, payload, b"") == ciphertext
        assert ciphers[number % 2].open(number // 2, ciphertext, b"") == payload


KINDS = [pytest.param(SUITES_BY_NAME[name], id=name) for name in ("x25519", "ffdhe2048", "mlkem768")]
PSK = Secret(bytes(range(32)))
PAYLOAD_1, PAYLOAD_2 = b"first payload", b"second"
LOW_ORDER = [
    bytes.fromhex(vector["public"])
    for vector in json.loads(VECTORS.with_name("x25519_low_order.json").read_text())["vectors"]
]


def start(suite: Suite, psk: Secret = PSK, rs: bytes = KEY_B.public) -> tuple[HandshakeState, HandshakeState]:
    """The two states before the first message."""
    return noise.initiator(suite, b"prologue", KEY_A, rs, psk), noise.responder(suite, b"prologue", KEY_B, psk)


def first(state: HandshakeState) -> tuple[HandshakeState, bytes]:
    """Write message 1."""
    return state.write(PAYLOAD_1, seeded(1))


def second(state: HandshakeState) -> tuple[HandshakeState, bytes]:
    """Write message 2."""
    return state.write(PAYLOAD_2, seeded(2))


def reason_of(state: HandshakeState, message: bytes) -> DropReason:
    """Why a state refuses the message that it waits for; nothing of the state changes by it."""
    before = state_of(state)
    with pytest.raises(Drop) as caught:
        state.read(message)
    assert state_of(state) == before
    if state.e1 is not None:
        state.e1._computed = None  # another initiation: each computes for one ciphertext
    return caught.value.reason


def completes(initiator: HandshakeState, message: bytes, responder: HandshakeState) -> bool:
    """Whether the genuine response still makes both ends agree."""
    finished, payload = initiator.read(message)
    return payload == PAYLOAD_2 and finished.symmetric.split() == responder.symmetric.split()


@pytest.mark.parametrize("suite", [*KINDS[:2], pytest.param(*KINDS[2].values, id="mlkem768", marks=pytest.mark.long)])
def test_altered_message_leaves_its_receiver_waiting(suite: Suite) -> None:
    """A bit turned over in any byte, any truncation, or bytes behind the end; the genuine message still completes."""
    initiator, responder = start(suite)
    initiator, message = first(initiator)
    answering, response = second(responder.read(message)[0])
    for state, genuine in ((responder, message), (initiator, response)):
        forgeries = [flipped(genuine, position, position % 8) for position in range(len(genuine))]
        forgeries.append(flipped(genuine, 31, 7))  # X25519 ignores the highest bit of e; the transcript does not
        # The message always brings a whole ephemeral key: its length was checked before it came here.
        forgeries += [genuine[:length] for length in range(32, len(genuine))]
        for forged in (*forgeries, genuine + b"\0"):
            assert reason_of(state, forged) is DropReason.BAD_HANDSHAKE
    assert completes(initiator, response, answering)


def wrong_psk(state: HandshakeState) -> HandshakeState:
    """The same state with another PSK."""
    return state._replace(psk=Secret(bytes(32)))


@pytest.mark.parametrize("suite", KINDS)
def test_another_psk_fails_at_the_response(suite: Suite) -> None:
    """A peer without the PSK cannot answer, and cannot read an answer."""
    initiator, responder = start(suite)
    initiator, message = first(initiator)
    read, _ = responder.read(message)
    _, forged = second(wrong_psk(read))
    genuine, response = second(read)

    assert reason_of(initiator, forged) is DropReason.BAD_HANDSHAKE
    assert reason_of(wrong_psk(initiator), response) is DropReason.BAD_HANDSHAKE
    assert completes(initiator, response, genuine)


@pytest.mark.parametrize("suite", KINDS)
def test_each_message_is_of_and_for_the_holder_of_one_key(suite: Suite) -> None:
    """An attacker who answers with a static key of its own reaches no session, whatever it saw."""
    initiator, responder = start(suite)
    assert reason_of(responder, first(start(suite, rs=KEY_A.public)[0])[1]) is DropReason.BAD_HANDSHAKE
    initiator, message = first(initiator)
    read, _ = responder.read(message)
    thief = read._replace(s=KeyPair(bytes([9]) * 32), rs=KeyPair(bytes([8]) * 32).public)
    assert reason_of(initiator, second(thief)[1]) is DropReason.BAD_HANDSHAKE
    genuine, response = second(read)
    assert completes(initiator, response, genuine)


@pytest.mark.parametrize("suite", KINDS)
@pytest.mark.parametrize("low", LOW_ORDER, ids=range(len(LOW_ORDER)))
def test_key_of_low_order_is_refused(low: bytes, suite: Suite) -> None:
    """In place of e in either message, or of s, properly sealed by a peer; the genuine message still completes."""
    initiator, responder = start(suite)
    liar = KeyPair(bytes([9]) * 32)
    liar.public = low
    _, sealed = first(initiator._replace(s=liar))
    assert reason_of(responder, sealed) is DropReason.INVALID_KEY_SHARE
    initiator, message = first(initiator)
    read, _ = responder.read(message)
    genuine, response = second(read)
    assert reason_of(responder, low + message[32:]) is DropReason.INVALID_KEY_SHARE
    assert reason_of(initiator, low + response[32:]) is DropReason.INVALID_KEY_SHARE
    assert completes(initiator, response, genuine)


def test_bad_ciphertext_that_is_well_sealed_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A responder who seals a value outside the group into message 2 reaches no session; the genuine one does."""
    initiator, responder = start(SUITES_BY_NAME["ffdhe2048"])
    initiator, message = first(initiator)
    read, _ = responder.read(message)
    genuine, response = second(read)
    for lie in (bytes(256), bytes(255) + b"\1", b"\xff" * 256):
        liar = SimpleNamespace(encapsulate=lambda share, entropy, lie=lie: (lie, bytes(32)))
        with monkeypatch.context() as patched:
            patched.setattr(noise, "kem_of", lambda suite, liar=liar: liar)
            _, forged = second(read)
        assert reason_of(initiator, forged) is DropReason.INVALID_KEY_SHARE
    assert completes(initiator, response, genuine)
