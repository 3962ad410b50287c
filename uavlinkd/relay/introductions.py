"""The certificates that a relay's members learn of each other. uavlinkd/authority/README.md.

Pure: no I/O, no clock, no randomness. Only members by certificate take part. Their static public keys name them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from heapq import nsmallest

from uavlinkd.authority import constants as a
from uavlinkd.authority.certificates import roles_in
from uavlinkd.authority.trust import HeldCertificate
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.limits import TokenBucket
from uavlinkd.protocol.relay_records import CertificateRecord, Who


class _Certified:
    def __init__(self, held: HeldCertificate, now: float) -> None:
        self.held = held
        self.is_up = False
        self.session_at = now
        self.questions = TokenBucket(*a.WHO, now)
        self.certificates = TokenBucket(*a.CERTIFICATES, now)
        self.introductions = TokenBucket(*a.INTRODUCTIONS, now)
        self.seekers: dict[bytes, float] = {}
        """Members that wish to reach it, and when each was introduced."""


class Introductions:
    """The certified members of a relay.

    ``wished_at``: when a member bound a key last, minus infinity if it has no wish for it.
    """

    def __init__(self, wished_at: Callable[[bytes, bytes], float]) -> None:
        self._wished_at = wished_at
        self._members: dict[bytes, _Certified] = {}
        self._arrived: dict[bytes, float] = {}  # members with a new session, and when to introduce others, ascending
        self._due: dict[tuple[bytes, bytes], None] = {}  # who is to learn of whom
        self._again: deque[tuple[float, bytes, bytes, int]] = deque()
        """When to repeat which introductions, ascending: seeker, who is to learn of it, and remaining tries."""

    def __contains__(self, key: bytes) -> bool:
        return key in self._members

    # Members.

    def set(self, key: bytes, held: HeldCertificate, now: float, *, is_up: bool) -> None:
        """A member has this certificate from now on."""
        if key not in self._members:
            self._members[key] = _Certified(held, now)
        self._members[key].held, self._members[key].is_up = held, is_up

    def renew(self, held: Mapping[bytes, HeldCertificate]) -> None:
        """These are held now: members may have newer ones than before."""
        for key in self._members.keys() & held.keys():
            self._members[key].held = held[key]

    def remove(self, key: bytes) -> None:
        """Tell others nothing more about it."""
        del self._members[key]
        self._arrived.pop(key, None)

    def set_up(self, key: bytes, *, is_up: bool) -> None:
        """A member came up or went down."""
        if (member := self._members.get(key)) is not None:
            member.is_up = is_up

    def on_session(self, key: bytes, now: float) -> None:
        """A member has a new session, perhaps after a restart. Then it has forgotten the others."""
        if (member := self._members.get(key)) is not None:
            member.session_at = now
            self._arrived.pop(key, None)
            self._arrived[key] = now + a.INTRODUCED_AFTER_S

    def prune(self, key: bytes) -> None:
        """Forget seekers whose wish has ended."""
        if (member := self._members.get(key)) is not None:
            seekers = member.seekers.items()
            member.seekers = {seeker: at for seeker, at in seekers if self._wished_at(seeker, key) > -c.NEVER}

    # Questions.

    def may_ask(self, key: bytes, now: float) -> DropReason | None:
        """Why a question of a member has no effect."""
        if (member := self._members.get(key)) is None:
            return DropReason.UNEXPECTED_RECORD
        return None if member.questions.take(now) else DropReason.RECORD_OVER_LIMIT

    def answer(self, key: bytes, who: Who, now: float) -> list[CertificateRecord] | None:
        """The certificates that a member asks for; None if it got too many."""
        roles = set(roles_in(who.roles))
        others = ((other, member.held.certificate) for other, member in self._members.items() if member.is_up)
        known = (
            (certificate.serial, other)
            for other, certificate in others
            if certificate.role in roles and certificate.serial > who.after and other != key
        )
        keys = [other for _, other in nsmallest(a.CERTIFICATES_PER_ANSWER, known)]
        return list(map(self._record, keys)) if self._members[key].certificates.take(now, len(keys)) else None

    # Introductions.

    def on_bind(self, seeker: bytes, keys: Iterable[bytes], now: float) -> None:
        """A member bound these keys."""
        if seeker in self._members:
            for key in keys:
                if key in self._members and key != seeker and self._wished_at(seeker, key) > -c.NEVER:
                    self._members[key].seekers.setdefault(seeker, -c.NEVER)
                    self._introduce(seeker, key, now)

    def _introduce(self, seeker: bytes, key: bytes, now: float, tries: int = 1) -> None:
        """Send a seeker's certificate to the member that it wishes to reach, unless that has bound it too."""
        sought = self._members[key]
        introduced_at = sought.seekers[seeker]
        is_first = introduced_at < sought.session_at
        if (
            sought.is_up
            and now >= sought.session_at + a.INTRODUCED_AFTER_S
            and self._wished_at(key, seeker) < sought.session_at
            and (is_first or now >= introduced_at + a.INTRODUCED_AGAIN_S)
            and sought.introductions.take(now)
            and sought.certificates.take(now)
        ):
            sought.seekers[seeker] = now
            self._due[key, seeker] = None
            if (more := a.INTRODUCED_TRIES - 1 if is_first else tries - 1) > 0:
                self._again.append((now + a.INTRODUCED_AGAIN_S, seeker, key, more))

    @property
    def is_due(self) -> bool:
        """Whether :meth:`pop_due` may have something."""
        return bool(self._arrived or self._due or self._again)

    def pop_due(self, now: float) -> list[tuple[bytes, CertificateRecord]]:
        """The certificates to be sent now, each with its receiver."""
        while self._arrived and self._arrived[key := next(iter(self._arrived))] <= now:
            del self._arrived[key]
            self.prune(key)
            for seeker in self._members[key].seekers:
                self._introduce(seeker, key, now)
        while self._again and self._again[0][0] <= now:
            _, seeker, key, tries = self._again.popleft()
            if key in self._members and seeker in self._members[key].seekers:
                self._introduce(seeker, key, now, tries)
        due, self._due = self._due, {}
        return [(key, self._record(seeker)) for key, seeker in due if {key, seeker} <= self._members.keys()]

    def _record(self, key: bytes) -> CertificateRecord:
        return CertificateRecord(key, self._members[key].held.data)
