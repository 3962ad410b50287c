"""What the peers report to refuse of this end's frames: a claim of theirs, in words. Nothing acts on it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from uavlinkd.core.refusals import Claim
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.mavlink.dialect import command_name, name_of
from uavlinkd.mavlink.policy.refusal_totals import REFUSALS

RECENT_S: Final = 60.0
"""A claim whose count grew within this time is a present problem."""
_SHOWN: Final = 3


def recent(link: PeerLink, now: float) -> list[Claim]:
    """The recent claims of a peer: commands first, then the latest."""
    claims = [claim for claim in link.peer.refusal_claims.recent() if now - claim.changed_at <= RECENT_S]
    return sorted(claims, key=lambda claim: not claim.refused.command)


def as_json(link: PeerLink, now: float) -> list[dict[str, object]]:
    """Every claim of a peer that this end remembers, the latest first."""
    return [
        {
            "message": name_of(claim.refused.message),
            "command": command_name(claim.refused.command) if claim.refused.command else None,
            "reason": reason_name(claim),
            "count": claim.refused.total,
            "last_s": now - claim.changed_at,
        }
        for claim in link.peer.refusal_claims.recent()
    ]


def describe(link: PeerLink, now: float) -> str:
    """The recent claims in one sentence without the peer's name, which a finding has; empty without one."""
    claims = recent(link, now)
    if not claims:
        return ""
    by_meaning: dict[str, list[Claim]] = {}
    for claim in claims[:_SHOWN]:
        by_meaning.setdefault(_meaning(claim), []).append(claim)
    kinds = "; ".join(_kinds(meaning, several, now) for meaning, several in by_meaning.items())
    more = f"; and {len(claims) - _SHOWN} more kinds of frames" if len(claims) > _SHOWN else ""
    return f"it reports that it refuses {kinds}{more}"


def reason_name(claim: Claim) -> str:
    """The code of a reason; the number of one that this version does not know."""
    refusal = REFUSALS.get(claim.refused.reason)
    return f"reason_{claim.refused.reason}" if refusal is None else refusal.value


def _meaning(claim: Claim) -> str:
    refusal = REFUSALS.get(claim.refused.reason)
    return "a reason that this version does not know" if refusal is None else refusal.meaning


def _kinds(meaning: str, claims: Sequence[Claim], now: float) -> str:
    """Claims that share a reason, which is written once."""
    if len(claims) == 1:
        return _kind(claims[0], now, f"{meaning}, ")
    return f"{', '.join(_kind(claim, now) for claim in claims)}: {meaning}"


def _kind(claim: Claim, now: float, meaning: str = "") -> str:
    refused = claim.refused
    command = f" {command_name(refused.command).removeprefix('MAV_CMD_')}" if refused.command else ""
    frames = "frame" if refused.total == 1 else "frames"
    age = now - claim.changed_at
    return f"{name_of(refused.message)}{command} ({meaning}{refused.total:,} {frames}, {age:.0f} s ago)"
