"""Why a member of the relay here may have no session: hints from handshake messages that any sender can make.

So they are warnings: the relay goes on for all others. No remedy accepts a key because it arrived.
"""

from __future__ import annotations

from collections.abc import Iterator

from uavlinkd.config.keys import encode_key
from uavlinkd.core.drops import DropReason
from uavlinkd.link.evidence import Evidence
from uavlinkd.link.shown import shown
from uavlinkd.ops.causes import Cause
from uavlinkd.ops.findings import Finding, Subject
from uavlinkd.relay.service import RelayService


def member_findings(relay: RelayService, evidence: Evidence, public_key: bytes, now: float) -> Iterator[Finding]:
    """Senders that are not members, and, while a member is down, those with another key for this relay."""
    unknown = evidence.seen_elsewhere(DropReason.UNKNOWN_PEER, now)
    if unknown is not None and unknown.address is not None:
        keys = ", ".join(encode_key(key) for key in unknown.details if isinstance(key, bytes))
        yield _about(
            Cause.NOT_A_MEMBER,
            f"a sender at {shown(unknown.address)} has a key of no [[member]] here: {keys}",
            "if it is yours, run `uavlinkd pubkey` there, write into its [[member]] what that prints, and run"
            " `uavlinkd reload` here: a key that arrives proves nothing",
        )
    is_down = any(not member.peer.is_up for member in relay.members.values())
    other = evidence.seen_elsewhere(DropReason.BAD_MAC1, now)
    if is_down and other is not None and other.address is not None:
        yield _about(
            Cause.OTHER_RELAY_KEY,
            f"a sender at {shown(other.address)} has another public key for this relay",
            f'compare the [[relay]] of each member that is down: public_key = "{encode_key(public_key)}"',
        )


def _about(cause: Cause, text: str, remedy: str) -> Finding:
    return Finding(cause, cause.severity, Subject.DAEMON, "", text, remedy)
