"""The signatures of one endpoint: frames to its autopilot get one, frames from it count only with one.

No clock is read, and no stored timestamp proves anything: a disk can be read only or rolled back, and PX4 itself
remembers none but that of its key. So this end *asks*: a TIMESYNC request with a random number, which
every autopilot answers. A signed echo of it is new, and proves the key, and the timestamp from which on frames are
new. Until then nothing passes, in either direction. A signed frame with an old timestamp (a replay, or an autopilot
that was restarted and forgot) is dropped and makes this end ask again: the question's timestamp is greater than all
before, and the autopilot's own follows it.

Times are monotonic seconds; the caller passes them and the source of random bytes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from enum import StrEnum
from itertools import count
from math import inf
from struct import Struct
from typing import Final

from uavlinkd.mavlink.dialect import IDS
from uavlinkd.mavlink.frames import MAVLINK2, SIGNATURE_BYTES, Frame, pack, payload_bytes
from uavlinkd.mavlink.own_frames import RADIO_COMPONENT, RADIO_SYSTEM
from uavlinkd.mavlink.payloads import HEARTBEAT, may_be_old
from uavlinkd.mavlink.signing.signature import (
    LAST_TIMESTAMP,
    Signer,
    is_signed,
    stream_of,
    timestamp_of,
    without_signature,
)
from uavlinkd.mavlink.vehicles import Vehicles
from uavlinkd.protocol.crypto import Secret

MOST_SENDERS: Final = 14
"""Senders that get a signature. An autopilot keeps 16 until it is restarted and refuses all others
(MAVLINK_MAX_SIGNING_STREAMS of the C library): two are for other links to it."""
MOST_REPORTERS: Final = 4
"""Most senders with a signature whose first frame asks for nothing: other vehicles displace no ground station."""
MOST_OF_SOURCE: Final = 8
"""Most senders with a signature of one peer, station or endpoint: a captured one that invents some leaves room."""
MOST_STREAMS: Final = 64
"""Senders behind the endpoint whose timestamps are kept."""
ASK_S: Final = 0.25
"""Between two questions."""
QUESTIONS: Final = 8
"""The latest questions that may still be answered."""
LEAP: Final = 12_000_000
"""Two minutes in timestamps, from the greatest to that of a question. Of a sender that it does not know, an autopilot
accepts timestamps that are up to a minute old, and after a restart it knows none: behind a leap these are void."""
STEP: Final = 100_000
"""A greater step of the autopilot's timestamp (a restart of ArduPilot, satellites, an old frame) has to be proven."""

TIMESYNC: Final = IDS["TIMESYNC"]
SETUP_SIGNING: Final = IDS["SETUP_SIGNING"]
_AUTOPILOT: Final = 1  # MAV_COMP_ID_AUTOPILOT1
_TIMES: Final = Struct("<qq")  # tc1: 0 in a question; ts1: the number, which the answer repeats
_SETUP: Final = Struct("<QBB32s")  # initial_timestamp, target_system, target_component, secret_key


class SigningDrop(StrEnum):
    """Why a frame does not pass, as the endpoint counts it."""

    UNSIGNED = "unsigned"
    BAD_SIGNATURE = "bad_signature"
    REPLAYED = "replayed"
    REFLECTED = "reflected"
    NOT_PROVEN = "not_proven"  # this end asked, and no answer has come yet
    MAVLINK1 = "mavlink1_not_signed"
    TOO_MANY_SENDERS = "too_many_senders"
    TOO_MANY_REPORTERS = "too_many_reporters"
    NO_TIMESTAMP = "no_timestamp"  # the autopilot's is the last that there is


class EndpointSigning:
    """The keys of one endpoint, its timestamps, and what its autopilot has proven.

    ``keys``: the one in force, and perhaps a newer one that the autopilot may have already. ``is_open``: frames pass
    unsigned until the autopilot proves a key. ``drops`` gets :class:`SigningDrop`.
    """

    def __init__(
        self,
        keys: Sequence[Secret],
        link_id: int,
        random: Callable[[int], bytes],
        drops: Counter[str],
        *,
        is_open: bool = False,
    ) -> None:
        self.signers = [Signer(key) for key in keys]
        """From the oldest to the newest. A newer one that was proven ends those before it."""
        self.signer = self.signers[0]
        """Signs; proven if :attr:`is_proven`."""
        self.is_proven = False
        self.is_open = is_open
        self.may_lack_key = False
        """Whether to hear HEARTBEATs without a signature: the autopilot was told to use no key, or has lost it."""
        self.has_foreign_key = False
        """Whether a signed frame came that none of the keys made."""
        self.accepts_unsigned = False
        """Whether the autopilot answered a question that had no signature."""
        self.vehicles = Vehicles()
        """The autopilots behind the endpoint; those without a signature only while they need none."""
        self.proven_at = self.verified_at = self.unsigned_at = -inf
        """When the last answer and the last frame with a valid signature came; and while none is needed, the last
        HEARTBEAT without."""
        self.timestamp = 0
        """The greatest of all verified frames and of this end."""
        self.link_id = link_id
        self.send: Callable[[bytes], object]
        """Sends an own frame to the clients of the endpoint; it comes back to :meth:`sign`."""
        self._random, self._drops, self._sequence = random, drops, count()
        self._floor = 0
        """Of a sender that is not in ``_streams``, frames above this timestamp are new."""
        self._streams: dict[bytes, int] = {}
        self._senders: dict[bytes, tuple[str, bool]] = {}  # by system and component: from where, a reporter?
        self._questions: dict[int, Signer | None] = {}
        self._own: dict[bytes, Signer | None] = {}  # frames of this end: who signs them, or nobody
        self._ask_at = 0.0

    # To the autopilot.

    def sign(self, frame: Frame, source: str) -> Frame | None:
        """The frame with the next timestamp; None if it may not leave. Call it in the order of writing.

        ``source``: the peer or endpoint that it comes from, as the configuration names it.
        """
        raw, header = frame
        if self._own and raw in self._own:
            signer = self._own[raw]
            if signer is None:
                return frame
        elif not self.is_proven:
            if not self.is_open:
                self._drops[SigningDrop.NOT_PROVEN] += 1
            return frame if self.is_open else None
        elif reason := self._why_not(frame, source):
            self._drops[reason] += 1
            return None
        else:
            signer = self.signer
        self.timestamp = min(self.timestamp + 1, LAST_TIMESTAMP)
        return Frame(signer.sign(raw, self.link_id, self.timestamp), header)

    def _why_not(self, frame: Frame, source: str) -> SigningDrop | None:
        if frame.raw[0] != MAVLINK2:
            return SigningDrop.MAVLINK1
        if self.timestamp >= LAST_TIMESTAMP:
            return SigningDrop.NO_TIMESTAMP
        if frame.raw[5:7] in self._senders:
            return None
        reports = may_be_old(frame)
        taken = self._senders.values()
        if reports and sum(is_reporter for _, is_reporter in taken) >= MOST_REPORTERS:
            return SigningDrop.TOO_MANY_REPORTERS
        if len(taken) >= MOST_SENDERS or sum(one == source for one, _ in taken) >= MOST_OF_SOURCE:
            return SigningDrop.TOO_MANY_SENDERS
        self._senders[frame.raw[5:7]] = source, reports
        return None

    # From the autopilot.

    def admits(self, frames: Sequence[Frame]) -> bool:
        """Whether a stranger that sent these may become a client."""
        if self.is_open or self.may_lack_key:
            return True
        if any(is_signed(frame.raw) and self._signer_of(frame.raw) for frame in frames):
            return True
        for frame in frames:
            self._drop_unsigned(frame)
        return False

    def accept(self, frames: Sequence[Frame], now: float) -> list[Frame]:
        """Those that are signed and new, without their signatures."""
        passed: list[Frame] = []
        asks: Signer | None = None
        for frame in frames:
            raw, header = frame
            signer = self._signer_of(raw) if is_signed(raw) else None
            if signer is None:
                self._pass_unsigned(frame, passed, now)
                continue
            timestamp, stream = timestamp_of(raw), stream_of(raw)
            last = self._streams.get(stream)
            is_current = self.is_proven and signer is self.signer
            if raw[-SIGNATURE_BYTES] == self.link_id:  # this end's own, and somebody on the cable returned it
                self._drops[SigningDrop.REFLECTED] += 1
                continue
            if is_current and timestamp <= (self._floor if last is None else last):
                self._drops[SigningDrop.REPLAYED] += 1
                asks = signer
                continue
            if is_current and timestamp > self.timestamp + STEP:
                self.is_proven = is_current = False
                self._questions.clear()
            self.timestamp = max(self.timestamp, timestamp)
            self.verified_at = now
            if header.msgid == HEARTBEAT:
                self.vehicles.note(frame, now)
            if header.msgid == TIMESYNC and self._questions and self._is_answer(frame, signer):
                self._prove(signer, stream, timestamp)
                self.proven_at = now
            elif not is_current:
                self._drops[SigningDrop.NOT_PROVEN] += 1
                asks = signer
            elif last is None and len(self._streams) >= MOST_STREAMS:
                self._drops[SigningDrop.TOO_MANY_SENDERS] += 1
            else:
                self._streams[stream] = timestamp
                passed.append(Frame(without_signature(raw), header))
        if asks is not None and now >= self._ask_at:
            self.ask(asks, now)
        return passed

    def _signer_of(self, raw: bytes) -> Signer | None:
        for signer in self.signers:
            if signer.verifies(raw):
                return signer
        return None

    def _pass_unsigned(self, frame: Frame, passed: list[Frame], now: float) -> None:
        has_signature = is_signed(frame.raw)
        self.has_foreign_key |= has_signature
        if frame.header.msgid == HEARTBEAT and not has_signature and (self.is_open or self.may_lack_key):
            self.vehicles.note(frame, now)
            if frame.header.component == _AUTOPILOT:
                self.unsigned_at = now
        if self.is_open:
            passed.append(frame)
        else:
            self._drop_unsigned(frame)

    def _drop_unsigned(self, frame: Frame) -> None:
        """Count a frame that none of the keys signed."""
        self._drops[SigningDrop.BAD_SIGNATURE if is_signed(frame.raw) else SigningDrop.UNSIGNED] += 1

    # Questions.

    def ask(self, signer: Signer | None, now: float) -> None:
        """Ask the autopilot to prove that it has this key; None: whether it accepts what is unsigned."""
        if self.is_proven or not self._questions:  # frames may have been signed since the last leap
            self.timestamp += LEAP
        number = int.from_bytes(self._random(8), "little") >> 1 | 1
        self._questions[number] = signer
        if len(self._questions) > QUESTIONS:
            del self._questions[next(iter(self._questions))]
        self._ask_at = now + ASK_S
        self._send(TIMESYNC, _TIMES.pack(0, number), signer)

    def set_up(self, key: Secret | None, system: int) -> None:
        """Send SETUP_SIGNING, signed with the key in force if there is one. None: the autopilot is to use no key."""
        secret, first = (bytes(32), 0) if key is None else (key.reveal(), self.timestamp + 1)
        signer = self.signer if self.is_proven else None
        self._send(SETUP_SIGNING, _SETUP.pack(first, system, _AUTOPILOT, secret), signer)

    def _send(self, message: int, payload: bytes, signer: Signer | None) -> None:
        raw = pack(message, payload, next(self._sequence), RADIO_SYSTEM, RADIO_COMPONENT)
        if len(self._own) >= QUESTIONS:
            del self._own[next(iter(self._own))]
        self._own[raw] = signer
        self.send(raw)

    def _is_answer(self, frame: Frame, signer: Signer) -> bool:
        times = payload_bytes(frame, 0, _TIMES.size).ljust(_TIMES.size, b"\0")
        answered, number = _TIMES.unpack(times)
        if not answered or number not in self._questions:
            return False
        asked = self._questions[number]
        self.accepts_unsigned |= asked is None
        return asked is signer

    def _prove(self, signer: Signer, stream: bytes, timestamp: int) -> None:
        """The autopilot has this key, and all of its frames from now on have greater timestamps."""
        self.signer, self.is_proven, self.is_open = signer, True, False
        self.signers = self.signers[self.signers.index(signer) :]
        later = {one: last for one, last in self._streams.items() if last > timestamp}
        self._floor, self._streams = timestamp, later | {stream: timestamp}
        self._questions.clear()
        self._own.clear()

    def add(self, key: Secret) -> Signer:
        """A newer key that the autopilot may have from now on."""
        for signer in self.signers:
            if signer.secret == key:
                return signer
        self.signers.append(Signer(key))
        return self.signers[-1]
