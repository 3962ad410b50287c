"""What the pilot should know about the links, as short texts for the ground station: at most one a second.

Texts wait here, the most severe first, then the latest. A text that waited too long, or that another one made untrue,
is dropped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Final, NamedTuple

from uavlinkd.core.constants import NEVER
from uavlinkd.core.refusals import Refused
from uavlinkd.core.settings import Class
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.mavlink.classes import KINDS, UNKNOWN
from uavlinkd.mavlink.dialect import command_name, ids_by_name, name_of
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.mavlink.policy.refusal_totals import REFUSALS, TotalsWatch
from uavlinkd.mavlink.routing import SystemComponent
from uavlinkd.mavlink.status_text import TEXT_BYTES, Note, TextSeverity

INTERVAL_S: Final = 1.0
"""Between two texts, over all peers."""
WAIT_S: Final = 10.0
"""A text that waited for longer is dropped."""
REFUSAL_INTERVAL_S: Final = 10.0
"""Between two texts about what one peer refuses, and between two about what is withheld from it: a hostile peer can
invent refusals, and must not hide this end's own ones."""

_AUTOPILOT: Final = 1  # MAV_COMP_ID_AUTOPILOT1
_STATUSTEXT: Final = ids_by_name()["STATUSTEXT"]
_LABELS: Final = {400: "(DIS)ARM"}
_LABEL_CHARACTERS: Final = 20
_CLAIM: Final = "refused"
"""The topic of what a peer claims: its texts come after this end's own ones."""
_REASONS: Final = {
    Refusal.MESSAGE_NOT_ALLOWED: "role or list",
    Refusal.COMMAND_NOT_ALLOWED: "role or list",
    Refusal.FOREIGN_SYSTEM: "system id",
    Refusal.RATE_LIMITED: "too many",
}


class _Waiting(NamedTuple):
    severity: TextSeverity
    text: str
    since: float
    link: PeerLink


class _Seen:
    """What was observed of one peer."""

    def __init__(self, link: PeerLink, now: float) -> None:
        self.link = link
        self.is_up = link.peer.is_up
        self.is_lost = False
        """Whether the loss of the link was reported, or is about to be."""
        self.is_unverified = False
        self.claims_until = -NEVER
        self.quiet_until = {"withheld": now, _CLAIM: now}
        self.system: int | None = None
        """Of the vehicle behind the link, when it was seen last."""
        self.withheld = TotalsWatch()


class PilotNotes:
    """Finds what is new, once a second. ``addresses``: those that were received behind a peer."""

    def __init__(self, addresses: Callable[[PeerLink], list[SystemComponent]]) -> None:
        self._addresses = addresses
        self._seen: dict[str, _Seen] = {}
        self._waiting: dict[tuple[str, str], _Waiting] = {}
        self._next_at = 0.0

    def next(self, links: Iterable[PeerLink], now: float) -> Note | None:
        """The text to send now, if there is one. Call it about once a second."""
        present = {link.name: link for link in links}
        self._seen = {name: seen for name, seen in self._seen.items() if present.get(name) is seen.link}
        for name, link in present.items():
            if name in self._seen:
                self._observe(self._seen[name], now)
            else:
                self._seen[name] = _Seen(link, now)
        self._waiting = {
            key: waiting
            for key, waiting in self._waiting.items()
            if key[0] in present and now - waiting.since <= WAIT_S
        }
        return None if now < self._next_at else self._pop(now)

    def _pop(self, now: float) -> Note | None:
        def turn(key: tuple[str, str]) -> tuple[TextSeverity, bool, float]:
            return self._waiting[key].severity, key[1] == _CLAIM, -self._waiting[key].since

        for key in sorted(self._waiting, key=turn):
            severity, text, _, link = self._waiting[key]
            system = self._seen[link.name].system
            if system is not None:  # a ground station shows only texts of a vehicle that it knows
                del self._waiting[key]
                self._next_at = now + INTERVAL_S
                return Note(severity, text, system)
        return None

    def _observe(self, seen: _Seen, now: float) -> None:
        link = seen.link
        name, peer = link.name, link.peer
        seen.system = _vehicle(self._addresses(link)) or seen.system or _only_system(link)
        if seen.is_up != peer.is_up:
            seen.is_up = peer.is_up
            if not peer.is_up:
                seen.is_lost = True
                self._put(link, "link", TextSeverity.CRITICAL, f"link to {name} lost", now)
            elif seen.is_lost:
                seen.is_lost = False
                self._put(link, "link", TextSeverity.NOTICE, f"link to {name} restored", now)
        if seen.is_unverified != (peer.unverified_since is not None):
            seen.is_unverified = not seen.is_unverified
            if seen.is_unverified:
                text = f"link to {name}: age of commands unverified"
                self._put(link, "freshness", TextSeverity.ERROR, text, now)
            else:
                self._waiting.pop((name, "freshness"), None)
        for topic, texts in (("withheld", _withheld_here(seen)), (_CLAIM, self._refused_there(seen))):
            first = next(texts, None)
            if first is not None and now >= seen.quiet_until[topic]:
                seen.quiet_until[topic] = now + REFUSAL_INTERVAL_S
                self._put(link, topic, TextSeverity.WARNING, first, now)
        seen.claims_until = now

    def _refused_there(self, seen: _Seen) -> Iterator[str]:
        for claim in seen.link.peer.refusal_claims.recent():
            if claim.changed_at < seen.claims_until:
                return
            if _is_wanted(claim.refused):
                reason = _REASONS.get(REFUSALS.get(claim.refused.reason, Refusal.HIDDEN_FRAME), "policy")
                yield _fit(seen.link.name, f": {_label(claim.refused)} withheld there, {reason}")

    def _put(self, link: PeerLink, topic: str, severity: TextSeverity, text: str, now: float) -> None:
        self._waiting[link.name, topic] = _Waiting(severity, text, now, link)


def _withheld_here(seen: _Seen) -> Iterator[str]:
    link = seen.link
    role = link.config.policy.get("role")
    reason = "role or list" if role is None else f"role {role}"
    for refused in seen.withheld.changed(link.policy.outgoing):
        if _is_wanted(refused):
            yield _fit(link.name, f": {_label(refused)} withheld here, {reason}")


def _is_wanted(refused: Refused) -> bool:
    """Whether a pilot sent it on purpose: a command, mission, parameter or setpoint, not a report."""
    kind = KINDS.get(refused.message, UNKNOWN)
    is_order = kind.cls is Class.CRITICAL and not kind.may_be_old
    return bool(refused.command) or (is_order and refused.message != _STATUSTEXT)


def _label(refused: Refused) -> str:
    if not refused.command:
        return name_of(refused.message)[:_LABEL_CHARACTERS]
    name = command_name(refused.command).removeprefix("MAV_CMD_")
    return _LABELS.get(refused.command, name.removeprefix("DO_").removeprefix("NAV_")[:_LABEL_CHARACTERS])


def _fit(name: str, rest: str) -> str:
    """The name is cut, if both are too long together."""
    return name[: max(0, TEXT_BYTES - len(rest))] + rest


def _vehicle(addresses: list[SystemComponent]) -> int | None:
    """The first autopilot's system, else the first system."""
    autopilots = [system for system, component in addresses if component == _AUTOPILOT]
    return next(iter(autopilots or (system for system, _ in addresses)), None)


def _only_system(link: PeerLink) -> int | None:
    """The system of a peer that may send as one only."""
    systems = [system for system in range(1, 256) if link.policy.incoming.may_speak_as(system)]
    return systems[0] if len(systems) == 1 else None
