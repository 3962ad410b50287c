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

from collections import Counter, deque
from collections.abc import Callable, Sequence
from enum import StrEnum
from itertools import count
from math import inf
from struct import Struct
from typing import Final

from uavlinkd.mavlink.dialect import IDS
from uavlinkd.mavlink.frames import MAVLINK2, Frame, new_frame, pack, payload_bytes
from uavlinkd.mavlink.own_frames import RADIO_SYSTEM
from uavlinkd.mavlink.payloads import may_be_old
from uavlinkd.mavlink.signing.signature import FIRST_LINK_ID, LAST_TIMESTAMP, Signer, is_signed, without_signature
from uavlinkd.protocol.crypto import Secret

MOST_SENDERS: Final = 14
"""Senders that get a signature. An autopilot keeps 16 until it is restarted and refuses all others
(MAVLINK_MAX_SIGNING_STREAMS of the C library): one is for questions, and one for another link to it."""
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
_ASKER: Final = 240
"""MAV_COMP_ID_UDP_BRIDGE, the sender of questions and keys."""
_OWN: Final = bytes((RADIO_SYSTEM, _ASKER))
_TIMES: Final = Struct("<qq")  # tc1: 0 in a question; ts1: the number, which the answer repeats
_SETUP: Final = Struct("<QBB32s")  # initial_timestamp, target_system, target_component, secret_key


class SigningDrop(StrEnum):
    """Why a frame does not pass, as the endpoint counts it."""

    UNSIGNED = "unsigned"
    BAD_SIGNATURE = "bad_signature"
    REPLAYED = "replayed"
    REFLECTED = "reflected"
    NOT_PROVEN = "not_proven"  # this end asked, and no answer has come yet; or the client has signed nothing
    MAVLINK1 = "mavlink1_not_signed"
    TOO_MANY_SENDERS = "too_many_senders"


class EndpointSigning:
    """The keys of one endpoint, its timestamps, and what its autopilot has proven.

    ``drops`` gets :class:`SigningDrop`.
    """

    def __init__(self, key: Secret, link_id: int, random: Callable[[int], bytes], drops: Counter[str]) -> None:
        self.signer = Signer(key)
        """Signs; proven if :attr:`is_proven`."""
        self.signers = [self.signer]
        """The one in force, and perhaps a newer one, which ends the other when it is proven."""
        self.is_proven = False
        self.accepts_unsigned = False
        """Whether the autopilot answered a question that had no signature."""
        self.proven_at = self.verified_at = -inf
        """When the last answer and the last frame with a valid signature came."""
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
        self._own = deque[bytes](maxlen=QUESTIONS)  # frames of this end: signed already, or to be without a signature
        self._ask_at = 0.0

    # To the autopilot.

    def sign(self, frames: Sequence[Frame], source: str, *, is_genuine: bool = True) -> list[Frame]:
        """The frames with the next timestamps, without those that may not leave. Call it in the order of writing.

        ``source``: the peer or endpoint that they come from, as the configuration names it. ``is_genuine``: whether
        the client ever sent a signed frame. Another one gets questions alone: it could repeat its copies of others.
        """
        may_leave = self.is_proven and is_genuine
        signed: list[Frame] = []
        for frame in frames:
            raw, header = frame
            sender = raw[5:7]
            if sender == _OWN and raw in self._own:
                signed.append(frame)
                continue
            is_usual = may_leave and sender in self._senders and raw[0] == MAVLINK2
            if not is_usual and (reason := self._why_not(frame, source) if may_leave else SigningDrop.NOT_PROVEN):
                self._drops[reason] += 1
                continue
            signed.append(new_frame(Frame, (self._sign(raw, self.signer), header)))
        return signed

    def _why_not(self, frame: Frame, source: str) -> SigningDrop | None:
        if frame.raw[0] != MAVLINK2:
            return SigningDrop.MAVLINK1
        reports = may_be_old(frame)
        taken = self._senders.values()
        of_source, reporters = sum(one == source for one, _ in taken), sum(one for _, one in taken)
        if len(taken) >= MOST_SENDERS or of_source >= MOST_OF_SOURCE or (reports and reporters >= MOST_REPORTERS):
            return SigningDrop.TOO_MANY_SENDERS
        self._senders[frame.raw[5:7]] = source, reports
        return None

    def _sign(self, raw: bytes, signer: Signer) -> bytes:
        self.timestamp = min(self.timestamp + 1, LAST_TIMESTAMP)
        return signer.sign(raw, self.link_id, self.timestamp)

    # From the autopilot.

    def accept(self, frames: Sequence[Frame], now: float) -> list[Frame]:
        """Those that are signed and new, without their signatures."""
        passed: list[Frame] = []
        for frame in frames:
            raw, header = frame
            for signer in self.signers:
                if (read := signer.read(raw)) is not None:
                    break
            else:
                self._drops[SigningDrop.BAD_SIGNATURE if is_signed(raw) else SigningDrop.UNSIGNED] += 1
                continue
            stream, timestamp = read
            is_usual = self.is_proven and signer is self.signer and header.msgid != TIMESYNC
            is_next = self._streams.get(stream, LAST_TIMESTAMP) < timestamp <= self.timestamp + STEP
            if not (is_usual and is_next) and not self._is_new(frame, signer, stream, timestamp, now):
                continue
            self._streams[stream] = timestamp
            self.timestamp = max(self.timestamp, timestamp)
            self.verified_at = now
            passed.append(new_frame(Frame, (without_signature(raw), header)))
        return passed

    def _is_new(self, frame: Frame, signer: Signer, stream: bytes, timestamp: int, now: float) -> bool:
        """Whether a frame with a valid signature counts. Another one may be an answer, or call for a question."""
        if stream[2] >= FIRST_LINK_ID:  # a daemon's, of this end or another, and somebody brought it here
            self._drops[SigningDrop.REFLECTED] += 1
            return False
        is_current = self.is_proven and signer is self.signer
        if is_current and timestamp <= self._streams.get(stream, self._floor):
            self._drops[SigningDrop.REPLAYED] += 1
            self._ask_again(signer, now)
            return False
        if is_current and timestamp > self.timestamp + STEP:
            self.is_proven = is_current = False
            self._questions.clear()
        self.timestamp = max(self.timestamp, timestamp)
        self.verified_at = now
        if self._questions and frame.header.msgid == TIMESYNC and self._is_answer(frame, signer):
            self._prove(signer, stream, timestamp)
            self.proven_at = now
            return False
        if not is_current:
            self._drops[SigningDrop.NOT_PROVEN] += 1
            self._ask_again(signer, now)
            return False
        if stream not in self._streams and len(self._streams) >= MOST_STREAMS:
            self._drops[SigningDrop.TOO_MANY_SENDERS] += 1
            return False
        return True

    # Questions.

    def _ask_again(self, signer: Signer, now: float) -> None:
        if now >= self._ask_at:
            self.ask(signer, now)

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
        raw = pack(message, payload, next(self._sequence), *_OWN)
        self._own.append(raw if signer is None else self._sign(raw, signer))
        self.send(self._own[-1])

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
        self.signer, self.is_proven = signer, True
        self.signers = self.signers[self.signers.index(signer) :]
        later = {one: last for one, last in self._streams.items() if last > timestamp}
        self._floor, self._streams = timestamp, later | {stream: timestamp}
        self._questions.clear()

    def add(self, key: Secret) -> Signer:
        """A newer key that the autopilot may have from now on."""
        for signer in self.signers:
            if signer.secret == key:
                return signer
        self.signers = [self.signer, Signer(key)]
        return self.signers[-1]
