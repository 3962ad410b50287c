"""The two handshake messages: the Noise messages, the headers in front of them and what is sealed inside.

Functions without state. ``receive_handshake.py``, ``establish.py`` and ``initiator.py`` decide when a message is read
or written, and what it changes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from uavlinkd.protocol import noise, wire
from uavlinkd.protocol.crypto import Entropy, KeyPair, Secret
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.noise import HandshakeState
from uavlinkd.protocol.settings import Link, PeerSettings
from uavlinkd.protocol.suites import Suite
from uavlinkd.protocol.wire import Parameters


class Initiated(NamedTuple):
    """The initiator's side after message 1."""

    state: HandshakeState
    parameters: Parameters
    message: bytes  # without macs


class Received(NamedTuple):
    """The responder's side after a sound message 1. ``public_key`` is authenticated, its meaning not yet checked.

    ``certificate`` is empty in the short form.
    """

    state: HandshakeState
    parameters: Parameters
    public_key: bytes
    certificate: bytes
    initiation: wire.Initiation


@dataclass(frozen=True, slots=True)
class Keys:
    """What a finished handshake gives to each side."""

    suite: Suite
    transport: tuple[Secret, Secret]
    handshake_hash: bytes
    parameters: Parameters
    remote_index: int


def parameters_of(link: Link, generation: int) -> Parameters:
    """What this side asks of a session."""
    least = link.confidential, link.tag_bytes, link.max_envelope
    return Parameters(generation, *least, link.features)


def initiate(
    identity: KeyPair, peer: PeerSettings, index: int, generation: int, entropy: Entropy, certificate: bytes = b""
) -> Initiated:
    """Message 1 to ``peer``: always the first suite of its list, whatever was lost or refused before."""
    suite = peer.link.suites[0]
    state = noise.initiator(suite, wire.prologue(suite), identity, peer.public_key, peer.psk or noise.NO_PSK)
    parameters = parameters_of(peer.link, generation)
    header = wire.initiation_header(suite, index)
    state, message = state.write(header[1:] + parameters.encode() + certificate, entropy)
    return Initiated(state, parameters, header + message)


def receive_initiation(identity: KeyPair, initiation: wire.Initiation) -> Received:
    """Read message 1. Raises ``BAD_HANDSHAKE``, ``INVALID_KEY_SHARE``, ``HEADER_MISMATCH`` or ``BAD_PARAMETERS``."""
    suite = initiation.suite
    state = noise.responder(suite, wire.prologue(suite), identity)
    state, payload = state.read(initiation.noise)
    parameters, certificate = _open_payload(payload, initiation.header)
    return Received(state, parameters, state.rs, certificate, initiation)


def respond(
    received: Received, peer: PeerSettings, index: int, generation: int, entropy: Entropy
) -> tuple[bytes, Keys]:
    """Message 2 without macs, and the session's keys: the initiator has them too once it has read it.

    Raises ``INVALID_KEY_SHARE``.
    """
    initiation = received.initiation
    header = wire.response_header(initiation.suite, index, initiation.sender_index)
    ours = parameters_of(peer.link, generation)
    state = received.state._replace(psk=peer.psk or noise.NO_PSK)
    state, message = state.write(header[1:] + ours.encode(), entropy)
    return header + message, _keys(state, ours.stronger(received.parameters), initiation.sender_index)


def receive_response(initiated: Initiated, response: wire.Response) -> Keys:
    """Read message 2. Raises ``BAD_HANDSHAKE``, ``INVALID_KEY_SHARE``, ``HEADER_MISMATCH`` or ``BAD_PARAMETERS``."""
    if response.suite != initiated.state.suite:
        raise Drop(DropReason.HEADER_MISMATCH)
    state, payload = initiated.state.read(response.noise)
    theirs, _ = _open_payload(payload, response.header)
    return _keys(state, initiated.parameters.stronger(theirs), response.sender_index)


def _open_payload(payload: bytes, header: bytes) -> tuple[Parameters, bytes]:
    """The sender's parameters and certificate; the header in clear must be the one that it sealed in front of them.

    Without this an altered index would leave two ends that agree on keys and never receive each other's envelopes.
    """
    repeated, rest = payload[: len(header) - 1], payload[len(header) - 1 :]
    if repeated != header[1:]:
        raise Drop(DropReason.HEADER_MISMATCH)
    size = Parameters.SIZE
    return wire.parse_parameters(rest[:size]), rest[size:]


def _keys(state: HandshakeState, parameters: Parameters, remote_index: int) -> Keys:
    return Keys(state.suite, state.symmetric.split(), state.symmetric.h, parameters, remote_index)
