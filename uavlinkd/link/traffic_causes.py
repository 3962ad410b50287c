"""What is wrong with the traffic of a peer: attacks with a valid key, and frames that policies refuse.

All of it is authentic, or happens on this machine. Without a peer's key, an attacker on the path can cause two of
these findings: it can forward handshakes from its own address (``key_on_two_machines``), and withhold answers
(``freshness_unverified``).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Final

from uavlinkd.link.down_causes import Network, finding, listed
from uavlinkd.link.history import GateHistory, SessionBegin
from uavlinkd.link.passage import Key
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.link.shown import shown
from uavlinkd.link.system_owners import SystemOwners
from uavlinkd.mavlink.dialect import GROUPS, command_name, ids_by_name, name_of
from uavlinkd.mavlink.policy.gate import ANY_OTHER, Gate, Refusal
from uavlinkd.mavlink.policy.roles import ROLES
from uavlinkd.ops.causes import Cause
from uavlinkd.ops.findings import Finding, Severity, Subject
from uavlinkd.ops.link_problems import UNVERIFIED

SECURITY_S: Final = 600.0
"""A finding about an attack stays for this time after the last evidence."""
COMMANDS_S: Final = 300.0
"""A refused command stays in the findings for this time: a person looks some time after the press of a button."""
REFUSED_S: Final = 10.0
"""Other refusals stay for this time."""
FLIPS: Final = 3
"""Sessions of one peer that began at another address than the one before, within :data:`FLIPS_S`."""
FLIPS_S: Final = 30.0

_BY_RULE: Final = frozenset({Refusal.MESSAGE_NOT_ALLOWED, Refusal.COMMAND_NOT_ALLOWED, Refusal.RATE_LIMITED})
_FLIGHT_COMMANDS: Final = frozenset(
    {"MAV_CMD_COMPONENT_ARM_DISARM", "MAV_CMD_NAV_TAKEOFF", "MAV_CMD_NAV_LAND", "MAV_CMD_NAV_RETURN_TO_LAUNCH"}
)
_EVERYDAY_COMMANDS: Final = frozenset({"MAV_CMD_REQUEST_MESSAGE", "MAV_CMD_SET_MESSAGE_INTERVAL"})
"""Commands that a vehicle's own components send too."""


def security(daemon: Network, link: PeerLink, owners: SystemOwners, now: float) -> Iterator[Finding]:
    """Signs that a peer's key is in wrong hands."""
    name = link.name
    if addresses := alternating(daemon.history.sessions(name), now):
        yield finding(
            Cause.KEY_ON_TWO_MACHINES,
            Subject.PEER,
            name,
            f"its sessions alternate between {listed(addresses)}: two machines may have its private key, such as a"
            " copied SD card or a stolen key",
            "run `uavlinkd pubkey` on both machines; rotate the key only if a second machine has it: the network may"
            " also switch addresses, or an attacker forward packets",
        )
    history = daemon.history.peer(name)
    if count := history.incoming.reasons.within(SECURITY_S, now).get(Refusal.HIDDEN_FRAME):
        yield hidden_frames(Subject.PEER, name, count)
    if len(history.mixed) == history.mixed.maxlen and now - history.mixed[0] <= SECURITY_S:
        foreign = history.incoming.systems.within(SECURITY_S, now)
        if owned := _owned(owners, foreign, link):
            whose = listed(f"{system} ({owner})" for system, owner in owned.items())
            yield finding(
                Cause.IMPERSONATION,
                Subject.PEER,
                name,
                f"beside its own frames it sends as system {whose}: it may be captured, relay without leave, or have"
                " the same id by mistake",
                f"inspect {name}; if it is captured, delete its [[peer]] and run `uavlinkd reload`",
            )


def hidden_frames(subject: Subject, name: str, count: int) -> Finding:
    """A peer or a local client hid frames."""
    text = f"{count:,} of its frames hid a forbidden frame, and were refused: an attack, or a file with such frames"
    remedy = f"if no file transfer of yours explains it, treat {name} as captured"
    return finding(Cause.HIDDEN_FRAME, subject, name, text, remedy)


def alternating(begins: Sequence[SessionBegin], now: float) -> list[str]:
    """The addresses between which the sessions of a peer alternate; none if they do not.

    A peer that roams leaves an address. One whose sessions return to it again and again is in two places.
    """
    moves = [
        (before, here)
        for before, here in pairwise(begins)
        if here.address != before.address and now - here.at <= SECURITY_S
    ]
    addresses = dict.fromkeys(shown(begin.address) for move in moves for begin in move)
    for (_, first), (_, last) in zip(moves, moves[FLIPS - 1 :], strict=False):
        if last.at - first.at <= FLIPS_S and len(addresses) < len(moves) + 1:
            return list(addresses)
    return []


def refusals(
    daemon: Network, link: PeerLink, blocked: Sequence[Key], owners: SystemOwners, now: float
) -> Iterator[Finding]:
    """What the policy of a peer that is up refuses."""
    name, history = link.name, daemon.history.peer(link.name)
    exchanged = _exchanged_role(daemon, link, now)
    if exchanged is not None:
        is_blocked = ("peer", name, "in") in blocked or ("peer", name, "out") in blocked
        yield exchanged if is_blocked else replace(exchanged, severity=Severity.WARNING)
    reasons = history.incoming.reasons.within(REFUSED_S, now)
    foreign = history.incoming.systems.within(REFUSED_S, now)
    if reasons and ("peer", name, "in") in blocked:
        if foreign and set(reasons) == {Refusal.FOREIGN_SYSTEM}:
            yield _foreign(link, foreign, owners, Cause.FOREIGN_SYSTEM)
        elif exchanged is None:
            yield all_refused(Subject.PEER, name, "in", reasons, link.config.policy)
    elif foreign:
        yield _foreign(link, foreign, owners, Cause.OTHER_SYSTEM)
    withheld = history.outgoing.reasons.within(REFUSED_S, now)
    if withheld and exchanged is None and ("peer", name, "out") in blocked:
        yield all_refused(Subject.PEER, name, "out", withheld, link.config.policy)
    yield from commands(Subject.PEER, name, history.incoming, history.outgoing, link.config.policy, now)


def freshness(link: PeerLink, now: float) -> Iterator[Finding]:
    """Frames of a peer arrive, its answers do not."""
    since = link.peer.unverified_since
    if since is not None:
        text = f"freshness unverified for {now - since:.0f} s: {UNVERIFIED}"
        remedy = "fly by other means until answers return; look for a bad radio in the direction to it"
        yield finding(Cause.FRESHNESS_UNVERIFIED, Subject.PEER, link.name, text, remedy)


def all_refused(
    subject: Subject, name: str, direction: str, reasons: Mapping[Refusal, int], policy: Mapping[str, object]
) -> Finding:
    """A policy lets nothing pass in one direction."""
    why = "; ".join(reason.meaning for reason in reasons)
    which = "from it" if direction == "in" else "to it"
    text = f"{_rule(policy)} refuses every frame {which}: {why}"
    remedy = "`uavlinkd check` prints what passes: write the role that the other end has, or allow what it needs"
    return finding(Cause.ALL_REFUSED, subject, name, text, remedy)


def commands(
    subject: Subject,
    name: str,
    incoming: GateHistory,
    outgoing: GateHistory,
    policy: Mapping[str, object],
    now: float,
) -> Iterator[Finding]:
    """The commands that a policy refused in each direction, by name."""
    sides = (
        (Cause.COMMANDS_REFUSED, incoming, "refused from it"),
        (Cause.COMMANDS_WITHHELD, outgoing, "withheld"),
    )
    for cause, gate, what in sides:
        counts = [(key, count) for key, count in gate.commands.within(COMMANDS_S, now).items() if key[2] in _BY_RULE]
        counts.sort(key=lambda entry: _rank(entry[0][1]))
        if counts:
            names = listed(f"{_command(msgid, number)} {count:,}x" for (msgid, number, _), count in counts)
            remedy = f"intended, if {_rule(policy)} is right; else write another role, or allow the command"
            yield finding(cause, subject, name, f"{names} {what}: {_rule(policy)}", remedy)


def _rank(number: int) -> int:
    """What a person looks for comes first: a list shows only its beginning, and others can make it long."""
    return 2 if number == ANY_OTHER else int(command_name(number) not in _FLIGHT_COMMANDS)


def _command(msgid: int, number: int) -> str:
    if number == ANY_OTHER:
        return "other commands"
    return f"{name_of(msgid)} ({command_name(number).removeprefix('MAV_CMD_')})"


def _rule(policy: Mapping[str, object]) -> str:
    return f"role {policy['role']}" if "role" in policy else "its policy"


def _foreign(link: PeerLink, systems: Mapping[int, int], owners: SystemOwners, cause: Cause) -> Finding:
    name = link.name
    seen, allowed = listed(map(str, sorted(systems)), 8), link.config.policy.get("system_ids")
    ids = listed(map(str, allowed)) if isinstance(allowed, list | tuple) else str(allowed)
    which = "all its frames are" if cause is Cause.FOREIGN_SYSTEM else "some of its frames are"
    text = f"{which} of system {seen}; its system_ids here are {ids}"
    own = f"set SYSID_THISMAV or MAV_SYSID (ArduPilot), or MAV_SYS_ID (PX4), of its autopilot to {ids}"
    if owned := _owned(owners, systems, link):  # never advise to trust one peer as another
        whose = listed(f"{system} is {owner}'s" for system, owner in owned.items())
        return finding(cause, Subject.PEER, name, text, f"{own}: {whose}")
    remedy = f"{own}; or, only if you know that {name} has this id, write it into system_ids"
    return finding(cause, Subject.PEER, name, text, remedy)


def _owned(owners: SystemOwners, systems: Iterable[int], link: PeerLink) -> dict[int, str]:
    """Those of the systems that belong to another than this peer, with its name."""
    return {system: name for system in sorted(systems) if (name := owners.other_than(link, system)) is not None}


# Roles that seem to be exchanged.


def _exchanged_role(daemon: Network, link: PeerLink, now: float) -> Finding | None:
    role, history = link.config.policy.get("role"), daemon.history.peer(link.name)
    refused = history.incoming.reasons.within(REFUSED_S, now)
    withheld: Mapping[Refusal, int] = {}
    if not daemon.config.routing.relay:  # otherwise the frames may be those of other peers
        withheld = history.outgoing.reasons.within(REFUSED_S, now)
    sign = None
    if role == "vehicle":
        if refused.get(Refusal.GROUND_STATION_NOT_ALLOWED):
            sign = "it sends a ground station's heartbeat"
        elif withheld.get(Refusal.MESSAGE_NOT_ALLOWED) and _has(link.policy.outgoing, _telemetry()):
            sign = "the client here sends a vehicle's telemetry"
        remedy = 'write role = "operator" if it is a ground station, "swarm-member" if both ends are vehicles'
    elif role == "operator":
        if refused.get(Refusal.MESSAGE_NOT_ALLOWED) and _has(link.policy.incoming, _telemetry()):
            sign = "it sends a vehicle's telemetry"
        elif withheld.get(Refusal.MESSAGE_NOT_ALLOWED) and _has(link.policy.outgoing, _requests()):
            sign = "the client here sends an operator's requests"
        remedy = 'write role = "vehicle" if it is a vehicle: a role says what the peer is, not what this end is'
    if sign is None:
        return None
    text = f'role = "{role}" says that it is {_A[str(role)]}, but {sign}: the roles may be exchanged'
    return finding(Cause.ROLES_EXCHANGED, Subject.PEER, link.name, text, remedy)


_A: Final = {"vehicle": "a vehicle", "operator": "a ground station"}


def _has(gate: Gate, messages: frozenset[int]) -> bool:
    """Whether the gate refused one of these messages because of its rules."""
    plain = {msgid for msgid, refusal in gate.refused if refusal is Refusal.MESSAGE_NOT_ALLOWED}
    if plain & messages - _carriers():
        return True
    numbers = {number for _, number, refusal in gate.refused_commands if refusal is Refusal.MESSAGE_NOT_ALLOWED}
    sent = {command_name(number) for number in numbers if number != ANY_OTHER}
    return bool(_carriers() & messages and sent - _EVERYDAY_COMMANDS)


@cache
def _carriers() -> frozenset[int]:
    return frozenset(ids_by_name()[name] for name in ("COMMAND_LONG", "COMMAND_INT"))


@cache
def _telemetry() -> frozenset[int]:
    """Messages that a vehicle sends and an operator does not."""
    return _only(ROLES["vehicle"].allow_in, ROLES["operator"].allow_in)


@cache
def _requests() -> frozenset[int]:
    """Messages that an operator sends and a vehicle does not."""
    return _only(ROLES["operator"].allow_in, ROLES["vehicle"].allow_in)


def _only(wanted: Sequence[str], others: Sequence[str]) -> frozenset[int]:
    return _expanded(wanted) - _expanded(others)


def _expanded(entries: Sequence[str]) -> frozenset[int]:
    ids = ids_by_name()
    names = {name for entry in entries for name in GROUPS.get(entry, (entry,))}
    return frozenset(ids[name] for name in names if name in ids)
