"""Problems of a fleet with an authority: members that are refused, bulletins, and the state on the disk."""

from __future__ import annotations

from collections.abc import Container, Iterator
from typing import Final

from uavlinkd.authority.exchange import ROLLED_BACK
from uavlinkd.authority.trust import BulletinVerdict
from uavlinkd.core.drops import Detail, Drop, DropReason
from uavlinkd.core.path import SocketAddress
from uavlinkd.link.facts import Found, Moment, PeerFacts, details_at, fault, security, warning


def fleet_problems(moment: Moment) -> Iterator[Found]:
    """Those of this daemon, and of members that it refused recently."""
    if (fleet := moment.daemon.fleet) is None:
        return
    trust, number = fleet.trust, fleet.trust.bulletin.number
    if trust.own is not None and trust.bulletin.refuses(trust.own.certificate.serial):
        yield fault(
            "own_certificate_revoked",
            f"the bulletin {number} revokes the certificate of this daemon (serial"
            f" {trust.own.certificate.serial}): members refuse it",
            "if this machine was not captured, run `uavlinkd enroll` here again and let the authority sign its line",
        )
    for contact in fleet.config.contacts:
        if contact.key not in trust.held:
            try:
                trust.judge(contact.key, contact.certificate)
            except Drop as drop:
                name = drop.detail if isinstance(drop.detail, str) else contact.name
                yield fault(
                    "contact_refused",
                    f"the contact {name} is refused: {drop.reason.meaning}",
                    "if it was not captured, let the authority sign it again, and write that certificate into its"
                    " [[contact]] here and into its own file; else write another contact",
                )
    if number < fleet.config.required_bulletin:
        yield fault(
            "bulletin_awaited",
            f"this daemon accepts no member by certificate: its bulletin is {number}, and require_bulletin is"
            f" {fleet.config.required_bulletin}",
            "run `uavlinkd fleet publish` where this daemon is reachable, or connect it to a pinned peer that has it",
        )
    if fleet.problem:
        yield warning(
            "fleet_state_degraded",
            f"{fleet.problem}: since the last restart, or after the next one, this daemon may accept revoked members",
            "let the daemon's user write there, and make room on the disk; then restart the daemon",
        )
    yield from _bulletins(fleet.noticed(moment.now))
    yield from _refused(moment, trust.held)


def _bulletins(noticed: dict[str, tuple[float, str]]) -> Iterator[Found]:
    """``noticed``: each event with its time, and the name of the peer that caused it last."""
    by = {event: who for event, (_, who) in noticed.items()}
    merged = "compare both folders of the authority; publish one with a higher number that revokes what both do"
    if who := by.get(BulletinVerdict.CONFLICT.value):
        yield security(
            "bulletin_conflict",
            f"{who} has another bulletin of the same number: two copies of the authority's key are in use, or it is"
            " stolen. This daemon keeps its own one",
            merged,
        )
    if who := by.get(BulletinVerdict.SHRINKS.value):
        yield security(
            "bulletin_shrinks",
            f"{who} sent a newer bulletin that accepts revoked members again, which this daemon refused: two copies"
            " of the authority's key are in use, or it is stolen",
            merged,
        )
    if who := by.get(ROLLED_BACK):
        yield warning(
            "bulletin_rolled_back",
            f"{who} has an older bulletin than it had: its disk was restored, or a second machine has its key",
            "it gets the newest one now: compare the machine, and replace its key if two have it",
        )


_REFUSED: Final = {
    DropReason.BAD_CERTIFICATE: warning(
        "bad_certificate",
        "the authority of this fleet did not sign the certificate of",
        "if the sender is yours, run `uavlinkd enroll` there again, for this fleet; else it is an attacker",
    ),
    DropReason.CERTIFICATE_REVOKED: warning(
        "certificate_revoked",
        "refused, because the bulletin revokes it, or `deny` in this file names it:",
        "none if it was captured; else let the authority sign it again",
    ),
    DropReason.MEMBER_CONFLICT: warning(
        "member_conflict",
        "two members claim one name or system id, and one is refused:",
        "sign one of them again with another name and other ids, and revoke the certificate that it had",
    ),
    DropReason.ROLE_NOT_ACCEPTED: warning(
        "role_not_accepted",
        "this file has no policy for members of its role:",
        'none if that is meant, as with operator = "pinned"; else write a [[fleet_role]]',
    ),
}
"""The senders follow each text."""


def _refused(moment: Moment, held: Container[Detail]) -> Iterator[Found]:
    named: set[SocketAddress | None] = set()
    for reason, found in _REFUSED.items():
        if details := _seen(moment, reason):
            named.update(details.values())
            yield found._replace(text=f"{found.text} {details_at(details)}")
    unknown = _seen(moment, DropReason.UNKNOWN_PEER)
    if strangers := {key: at for key, at in unknown.items() if key not in held and at not in named}:
        yield warning(
            "not_a_member",
            f"a sender without a valid certificate has a key of no member here: {details_at(strangers)}",
            "`uavlinkd fleet list` shows whose key it is. Leave a revoked member out; let another one of yours run"
            " `uavlinkd enroll` again",
        )


def _seen(moment: Moment, reason: DropReason) -> dict[Detail, SocketAddress | None]:
    sighting = moment.daemon.evidence.seen_anywhere(reason, moment.now)
    return {} if sighting is None else sighting.details


def pinned_problems(peer: PeerFacts) -> Iterator[Found]:
    """A peer of the configuration, which no bulletin cuts off."""
    fleet, key = peer.daemon.fleet, peer.link.key
    if fleet is None or peer.link.config.settings.is_certified:
        return
    if (serial := fleet.exchange.serial(key)) and fleet.trust.bulletin.refuses(serial):
        yield warning(
            "revoked_but_pinned",
            f"the bulletin revokes its certificate (serial {serial}), but its [[peer]] in this file lets it in",
            "if it was captured, delete that section and run `uavlinkd reload`",
        )
