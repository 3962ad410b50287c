"""One session: the keys that one handshake gave, and what they sealed and opened so far."""

from __future__ import annotations

from uavlinkd.protocol import constants as c
from uavlinkd.protocol import wire
from uavlinkd.protocol.counters import Arrivals, CounterHistory, ReplayWindow
from uavlinkd.protocol.crypto import AeadKey, MacKey, equal, hkdf_expand
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.handshake import Keys
from uavlinkd.protocol.path import Pace
from uavlinkd.protocol.verification import HeldFrames, Verification
from uavlinkd.protocol.wire import Report

EnvelopeKey = MacKey | AeadKey
"""The key of one direction: of HMAC-SHA256, or in a confidential session of ChaCha20-Poly1305."""


_pack_short = wire.SHORT_HEADER.pack
_DIRECTIONS = b" initiator to responder", b" responder to initiator"


def _derived(keys: Keys, purpose: bytes) -> list[bytes]:
    """A key for the initiator's envelopes and one for the responder's, each from its own key of Noise ``Split()``.

    The label names purpose and direction; the transcript hash behind it ties the key to every byte of the handshake.
    """
    labels = (c.PROTOCOL_NAME + purpose + direction + keys.handshake_hash for direction in _DIRECTIONS)
    return [hkdf_expand(key.reveal(), label, c.KEY_BYTES) for key, label in zip(keys.transport, labels, strict=True)]


def envelope_keys(keys: Keys) -> list[EnvelopeKey]:
    """Those of the initiator and of the responder."""
    if keys.parameters.confidential:
        return [AeadKey(key) for key in _derived(keys, b" confidential")]
    return [MacKey(key) for key in _derived(keys, b" authenticated")]


class Session:
    """Seals envelopes to a peer and opens those from it.

    Every envelope is accepted at most once, and leaves no trace unless its tag verifies.
    """

    def __init__(
        self,
        keys: Keys,
        local_index: int,
        now: float,
        lifetime_s: float,
        verify_interval_s: float = c.VERIFY_INTERVAL_S,
        *,
        is_initiator: bool,
    ) -> None:
        order = 1 if is_initiator else -1
        self._send, self._receive = envelope_keys(keys)[::order]
        self._record_keys: list[AeadKey] | None = None  # to the peer, and from it
        if keys.parameters.features & c.FEATURE_RECORDS:
            self._record_keys = [AeadKey(key) for key in _derived(keys, b" records")][::order]
        self.suite = keys.suite
        self.parameters = keys.parameters
        self.is_initiator = is_initiator
        self.local_index = local_index
        self.remote_index = keys.remote_index
        self.created_at = now
        self.reject_at = now + lifetime_s
        self.send_counter = 0
        self.received = 0
        self.uncounted = 0
        """Questions to candidates and tests of a path's limit: they are not lost if they do not arrive."""
        self.window = ReplayWindow()
        self.trusted_until = now + c.LATE_AFTER_S
        """An envelope that arrives until then is new: the silence before it was short."""
        self.first_received_at = c.NEVER
        """When the peer's first envelope came: from then on it sends on this session, or on one of higher rank."""
        self.held = HeldFrames()
        self.unverified_reports: dict[type, tuple[int, Report]] = {}
        """The newest report after a silence, with its counter: kept until the peer shows whether it is new."""
        self.verification = Verification(now, verify_interval_s)
        self.order_base = 0
        """See :meth:`order_of`."""
        self.arrivals: Arrivals | None = None
        """When each envelope arrived first; None while the peer has one path."""
        self._floor = -1  # the peer said that this counter, and those below, are of the past
        self._received_history = CounterHistory(now)
        self._sent_history = CounterHistory(now)
        self.tag_bytes = c.AEAD_TAG_BYTES if keys.parameters.confidential else keys.parameters.tag_bytes
        """Length of the tag in both directions."""
        self.max_envelope = keys.parameters.max_envelope
        self.payload_limit = self.payload_limit_of(keys.parameters.max_envelope)
        """Longest payload that fits into an envelope to the peer."""

    def envelope_bytes(self, payload_bytes: int) -> int:
        """Length of the next envelope around a payload of this length."""
        header = wire.SHORT_HEADER_BYTES if self.send_counter < c.SHORT_COUNTER_LIMIT else wire.LONG_HEADER_BYTES
        return header + payload_bytes + self.tag_bytes

    def order_of(self, counter: int) -> int:
        """A number that grows with the counter, and from each session to those of higher rank; 0 with one path."""
        return 0 if self.arrivals is None else self.order_base + counter

    def payload_limit_of(self, envelope_bytes: int) -> int:
        """Longest payload that fits into an envelope of this length."""
        return envelope_bytes - wire.LONG_HEADER_BYTES - self.tag_bytes

    @property
    def expected(self) -> int:
        """Envelopes that the peer has sent, as far as is known here."""
        return self.window.highest + 1

    def is_usable(self, now: float) -> bool:
        """Whether the keys may still seal."""
        return now < self.reject_at and self.send_counter < c.SESSION_ENVELOPE_LIMIT

    def fresh(self, now: float, age_s: float | None = None) -> int:
        """The lowest counter that was sealed in the last ``age_s``, or a step before; the next one if none was.

        ``age_s`` is :data:`c.LATE_AFTER_S`, or less.
        """
        return self._sent_history.past(self.send_counter - 1, self.send_counter, now, age_s)[0] + 1

    def refuse_below(self, fresh: int) -> None:
        """The peer says that it sealed what has a lower counter than this too long ago."""
        self._floor = max(self._floor, fresh - 1)

    def missing(self, now: float) -> int:
        """Envelopes that the peer sent and that can be accepted no more, as far as is known here."""
        highest, received = self._received_history.past(self.window.highest, self.received, now)
        return highest + 1 - received

    def seal(self, payload: bytes, now: float) -> bytes:
        """The next envelope: header, payload, tag. A counter is never used twice."""
        counter = self.send_counter
        if now >= self._sent_history.next_at:
            self._sent_history.note(counter - 1, counter, now)
        if counter < c.SHORT_COUNTER_LIMIT:
            header = _pack_short(wire.SHORT_ENVELOPE, self.remote_index, counter)
        else:
            assert counter < c.SESSION_ENVELOPE_LIMIT
            header = wire.envelope_header(self.remote_index, counter)
        self.send_counter = counter + 1
        key = self._send
        if isinstance(key, AeadKey):
            return header + key.seal(counter, payload, header)
        signed = header + payload
        mac = key.prepared.copy()
        mac.update(signed)
        return signed + mac.finalize()[: self.tag_bytes]

    def sealed_record(self, record: bytes) -> bytes:
        """The payload of the next envelope around a record, which is encrypted in every mode.

        Both ends must have set :data:`c.FEATURE_RECORDS`. The counter is the nonce: :meth:`seal` must follow at once.
        """
        assert self._record_keys is not None
        return wire.SealedRecord(self._record_keys[0].seal(self.send_counter, record, b"")).encode()

    def open_record(self, counter: int, sealed: bytes) -> bytes:
        """The record in an authentic envelope with this counter.

        Raises ``BAD_CONTROL`` if it does not open, or if this session has no records.
        """
        record = None if self._record_keys is None else self._record_keys[1].open(counter, sealed, b"")
        if record is None:
            raise Drop(DropReason.BAD_CONTROL)
        return record

    def set_pace(self, pace: Pace, interval_s: float, now: float) -> None:
        """The peer has another best path. ``interval_s``: between requests, if the path's network carries them."""
        if pace != self.held.pace:
            self.held.pace = pace
            self.verification.set_pace(max(interval_s, pace.interval_s), pace.hold_s, now)

    def is_late(self, counter: int, now: float) -> bool:
        """Whether the peer overtook this counter longer than :data:`c.LATE_AFTER_S` ago."""
        return counter <= self._received_history.past(self.window.highest, self.received, now)[0]

    def open(self, datagram: bytes, header_bytes: int, counter: int, now: float) -> bytes | None:
        """The payload of an envelope whose header says it is for this session. None for an authentic copy.

        A copy has a counter that was accepted before, or that is below the window. It changes nothing. Raises
        ``TOO_LONG``, ``SESSION_EXPIRED``, ``DELAYED`` or ``BAD_TAG``.
        """
        if len(datagram) > self.max_envelope:
            raise Drop(DropReason.TOO_LONG)
        if now >= self.reject_at:
            raise Drop(DropReason.SESSION_EXPIRED)
        window, is_copy = self.window, False
        if counter <= window.highest:
            is_copy = window.is_used(counter)
            if not is_copy and (counter <= self._floor or self.is_late(counter, now)):
                raise Drop(DropReason.DELAYED)
        elif counter <= self._floor:
            raise Drop(DropReason.DELAYED)

        key, tag_at = self._receive, len(datagram) - self.tag_bytes
        if isinstance(key, AeadKey):
            payload = key.open(counter, memoryview(datagram)[header_bytes:], datagram[:header_bytes])
            if payload is None:
                raise Drop(DropReason.BAD_TAG)
        else:
            mac = key.prepared.copy()
            mac.update(datagram[:tag_at])
            if tag_at < header_bytes or not equal(mac.finalize()[: self.tag_bytes], datagram[tag_at:]):
                raise Drop(DropReason.BAD_TAG)
            payload = datagram[header_bytes:tag_at]
        if is_copy:
            return None

        if not self.received:
            self.first_received_at = now
        if now >= self._received_history.next_at:
            self._received_history.note(window.highest, self.received, now)
        if counter == window.highest + 1:  # as window.mark(), without a call
            window.highest = counter
        else:
            if counter < window.highest:
                self._received_history.add(counter)
            window.mark(counter)
        self.received += 1
        return payload

    def reopen(self, datagram: bytes, header_bytes: int, counter: int) -> bytes:
        """The payload of an envelope for which :meth:`open` returned None: its tag was verified."""
        if isinstance(self._receive, AeadKey):
            payload = self._receive.open(counter, memoryview(datagram)[header_bytes:], datagram[:header_bytes])
            assert payload is not None
            return payload
        return datagram[header_bytes : len(datagram) - self.tag_bytes]
