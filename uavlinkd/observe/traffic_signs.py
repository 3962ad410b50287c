"""The signs of findings about frames: what policies refuse, what peers report, and local clients that are silent.

All of it is authentic, or happens on this machine.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from uavlinkd.daemon.peer_link import PeerLink
from uavlinkd.io.udp import UdpClient
from uavlinkd.io.url import EndpointKind
from uavlinkd.mavlink.dialect import SYSTEM_ID, command_name, name_of
from uavlinkd.mavlink.egress.lanes import EgressDrop
from uavlinkd.mavlink.policy.gate import ANY_OTHER, REFUSALS, Refusal
from uavlinkd.observe.facts import (
    KERNEL_ERRORS,
    NOT_LISTENING,
    SECURITY_S,
    SILENT_S,
    EndpointFacts,
    PartFacts,
    PeerFacts,
    listed,
    proves_key,
)
from uavlinkd.observe.signs import Signs
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.reports import Claim
from uavlinkd.system.error_meanings import meaning_of

COMMANDS_S: Final = 300.0
"""A refused command stays in the findings for this time: a person looks some time after the press of a button."""
CLAIMS_S: Final = 60.0
"""A peer's claim whose count grew within this time is a present problem."""
REFUSED_S: Final = 10.0
"""Other refusals stay for this time."""
LOSS_LASTS_S: Final = 12.0
"""A high loss is reported if it lasts for this time. An outage that is over counts as a loss for up to 10 s."""

_BY_RULE: Final = frozenset({Refusal.MESSAGE_NOT_ALLOWED, Refusal.COMMAND_NOT_ALLOWED, Refusal.RATE_LIMITED})
_FLIGHT_COMMANDS: Final = frozenset(
    {"MAV_CMD_COMPONENT_ARM_DISARM", "MAV_CMD_NAV_TAKEOFF", "MAV_CMD_NAV_LAND", "MAV_CMD_NAV_RETURN_TO_LAUNCH"}
)
_CLAIMS_SHOWN: Final = 3


def hidden_frame(part: PartFacts) -> Signs:
    if part.now - part.history.incoming.hiding_at <= SECURITY_S:
        yield {"count": part.history.incoming.reasons.within(SECURITY_S, part.now)[Refusal.HIDDEN_FRAME]}


def freshness_unverified(peer: PeerFacts) -> Signs:
    """Also without a peer's key, an attacker on the path can withhold answers."""
    if (since := peer.link.peer.unverified_since) is not None:
        yield {"age_s": peer.now - since}


def high_loss(peer: PeerFacts) -> Signs:
    """By direction: a network may lose in one only."""
    directions = ("from it to here", "from here to it")
    shares = [
        f"{min(1.0, lost / max(1, sent)):.0%} {direction}"
        for direction, (sent, lost), lossless_at in zip(
            directions, peer.link.losses, peer.link.lossless_at, strict=False
        )
        if peer.now - lossless_at >= LOSS_LASTS_S
    ]
    if shares:
        yield {"losses": " and ".join(shares)}


def frames_unsent(peer: PeerFacts) -> Signs:
    """That newer states replace older ones is no problem."""
    dropped = peer.history.unsent.within(REFUSED_S, peer.now)
    if count := sum(dropped.get(reason, 0) for reason in (EgressDrop.OVERFLOW, EgressDrop.STALE)):
        yield {"count": count}


# What a policy refuses.


def foreign_system(part: PartFacts) -> Signs:
    """Frames of systems that the part may not speak for."""
    is_all = _is_only_foreign(part)
    systems = part.history.incoming.systems.within(REFUSED_S, part.now)
    if systems and (is_all or "in" not in part.blocked):
        allowed, how = part.rules.get("system_ids"), "write it into its system_ids"
        if part.is_certified:
            how = f"`uavlinkd fleet sign --replace {part.name} --id {min(systems)}` signs it again"
        yield {
            "which": "all" if is_all else "some",
            "systems": listed(map(str, sorted(systems)), 8),
            "ids": listed(map(str, allowed)) if isinstance(allowed, list | tuple) else str(allowed),
            "where": "in its certificate" if part.is_certified else "here",
            "how": how,
            **({} if is_all else {"severity": "warning"}),
        }


def _is_only_foreign(part: PartFacts) -> bool:
    reasons = part.history.incoming.reasons.within(REFUSED_S, part.now)
    return "in" in part.blocked and {*reasons} == {Refusal.FOREIGN_SYSTEM}


def all_refused(part: PartFacts) -> Signs:
    """Frames in one direction, for another reason than their system."""
    for direction, gate in (("in", part.history.incoming), ("out", part.history.outgoing)):
        reasons = gate.reasons.within(REFUSED_S, part.now)
        if reasons and direction in part.blocked and not (direction == "in" and _is_only_foreign(part)):
            which = "from it" if direction == "in" else "to it"
            yield {"which": which, "reasons": "; ".join(reason.meaning for reason in reasons)}


def roles_exchanged(peer: PeerFacts) -> Signs:
    """A peer with the role of a vehicle sends the heartbeat of a ground station."""
    refused = peer.history.incoming.reasons.within(REFUSED_S, peer.now)
    if peer.rules.get("role") == "vehicle" and Refusal.GROUND_STATION_NOT_ALLOWED in refused:
        remedy = 'write role = "operator" if it is a ground station, "swarm-member" if both ends are vehicles'
        if peer.is_certified:
            remedy = f"sign it again with `uavlinkd fleet sign --replace {peer.name} --role operator`"
        yield {"advice": remedy, **({} if peer.blocked else {"severity": "warning"})}


def commands_withheld(part: PartFacts) -> Signs:
    """Commands to the part that its role or lists refuse, those of a flight first."""
    refused = part.history.outgoing.commands.within(COMMANDS_S, part.now)
    counts = [(key, count) for key, count in refused.items() if key[2] in _BY_RULE]
    counts.sort(key=lambda entry: _rank(entry[0][1]))
    if counts:
        yield {"commands": listed(f"{_command(msgid, number)} {count:,}x" for (msgid, number, _), count in counts)}


def _rank(number: int) -> int:
    """What a person looks for comes first: a list shows only its beginning, and others can make it long."""
    return 2 if number == ANY_OTHER else int(command_name(number) not in _FLIGHT_COMMANDS)


def _command(msgid: int, number: int) -> str:
    if number == ANY_OTHER:
        return "other commands"
    return f"{name_of(msgid)} ({command_name(number).removeprefix('MAV_CMD_')})"


# What a peer reports: a claim of its own. Nothing acts on it.


def refused_there(peer: PeerFacts) -> Signs:
    claims = [claim for claim in peer.link.peer.claims.refusals() if peer.now - claim.changed_at <= CLAIMS_S]
    if claims:
        claims.sort(key=lambda claim: not claim.refused.command)
        kinds = "; ".join(_refused_kind(claim, peer.now) for claim in claims[:_CLAIMS_SHOWN])
        more = len(claims) - _CLAIMS_SHOWN
        yield {"kinds": f"{kinds}; and {more} more kinds of frames" if more > 0 else kinds}


def _refused_kind(claim: Claim, now: float) -> str:
    refused, refusal = claim.refused, REFUSALS.get(claim.refused.reason)
    meaning = "a reason that this version does not know" if refusal is None else refusal.meaning
    command = f" {command_name(refused.command).removeprefix('MAV_CMD_')}" if refused.command else ""
    frames = "frame" if refused.total == 1 else "frames"
    age = now - claim.changed_at
    return f"{name_of(refused.message)}{command} ({meaning}, {refused.total:,} {frames}, {age:.0f} s ago)"


PROBLEMS: Final = {
    1: ("all_refused", "its policy refuses all frames of a client, such as an autopilot with another system id"),
    2: ("cut_off", "no endpoint has a client"),
    3: ("no_client", "an endpoint has no client"),
    4: ("client_silent", "a client sends no MAVLink"),
    5: ("device_unavailable", "a serial device cannot be opened"),
    6: ("garbage", "bytes that are not MAVLink arrive at an endpoint"),
    7: ("network_absent", "a network is absent"),
    8: ("radio_disturbed", "a radio's line is disturbed"),
    9: ("daemon_paused", "its process was paused"),
    11: ("key_twice", "two machines use one private key"),
}
"""The codes of problem reports with their names and meanings, the most important first."""
CUT_OFF: Final = 2
_REFUSED: Final = 1
_OF_CLIENTS: Final = frozenset(range(CUT_OFF, 7))


def codes_there(peer: Peer, now: float) -> tuple[int, ...]:
    """What a peer says about itself now: nothing if it is not up, or did not repeat it."""
    claim = peer.claims.problems
    return claim.codes if peer.is_up and now - claim.received_at <= c.PROBLEMS_LAST_S else ()


def stops_frames(link: PeerLink, now: float) -> bool:
    """Whether a peer says that frames stop there, and no telemetry contradicts it. An operator whose ground control
    software is closed stops no other one.
    """
    stopping = {_REFUSED} if link.config.policy.get("role") == "operator" else {_REFUSED, CUT_OFF}
    if stopping.isdisjoint(codes_there(link.peer, now)):
        return False
    return all(vehicle["heartbeat_s"] >= SILENT_S for vehicle in link.vehicles.status(now))


def name_of_problem(code: int) -> str:
    """The name of a code; a number for one that only a newer version knows."""
    return PROBLEMS[code][0] if code in PROBLEMS else f"problem_{code}"


def problems_there(peer: PeerFacts) -> Signs:
    if codes := codes_there(peer.link.peer, peer.now):
        meanings = [PROBLEMS[code][1] if code in PROBLEMS else f"problem {code}" for code in codes]
        severity = {"severity": "fault"} if stops_frames(peer.link, peer.now) else {}
        yield {"meanings": "; ".join(meanings), "advice": _advice_there(peer, codes), **severity}


def _advice_there(peer: PeerFacts, codes: tuple[int, ...]) -> str:
    """What helps without a login there, which a vehicle behind LTE does not have."""
    number, look = f"{SYSTEM_ID} of its autopilot", "look at the power, wiring and baud rate of its autopilot"
    if peer.rules.get("role") == "operator":
        number, look = "the system id of its ground control software", "open its ground control software"
    if _REFUSED in codes and isinstance(ids := peer.rules.get("system_ids"), list | tuple):
        return f"set {number} to {listed(map(str, ids))}"
    return "run `uavlinkd status` there" if _OF_CLIENTS.isdisjoint(codes) else look


# Local endpoints.


def is_silent_by(cause: str) -> Callable[[EndpointFacts], Signs]:
    """Whether this is why no MAVLink comes from the client of an endpoint."""

    def signs(endpoint: EndpointFacts) -> Signs:
        why, fields = endpoint.silence
        if why == cause:
            yield fields

    return signs


def station_unverified(endpoint: EndpointFacts) -> Signs:
    """A station answers no questions, and makes no new keys either."""
    if DropReason.DOUBTFUL in endpoint.history.failures.lasting(endpoint.now):
        stations = endpoint.daemon.config.stations
        yield {"address": stations.address if stations else ""}


_UNVERIFIED: Final = (
    (
        *(("bad_signature",), "signs with another key"),
        "if a change of the key was interrupted, run the same `uavlinkd signing` again; else put that key, perhaps"
        " the .old one, in the place of the file, or remove it there, and run `uavlinkd signing setup`",
    ),
    (
        *(("unsigned",), "does not sign, or its frames are another sender's"),
        "run `uavlinkd signing setup`, which hands it a new key, or `clear`, if that was interrupted",
    ),
    (
        *(("not_proven", "replayed"), "signs, and answers no question of this daemon: the direction to it is cut"),
        "look at the wire from here to it, and at its baud rate",
    ),
)


def autopilot_unverified(endpoint: EndpointFacts) -> Signs:
    """Frames come, and its autopilot does not prove the key: nothing passes."""
    signing, lasting = endpoint.endpoint.signing, endpoint.history.failures.lasting(endpoint.now)
    if signing is None or proves_key(signing, endpoint.now):
        return
    is_signed = endpoint.now - signing.verified_at < SILENT_S
    causes = {"not_proven"} if is_signed else {"bad_signature", "unsigned", "replayed"}
    for drops, what, advice in _UNVERIFIED:
        if not causes.intersection(lasting).isdisjoint(drops):
            yield {"what": what, "advice": advice}
            return


def too_many_senders(endpoint: EndpointFacts) -> Signs:
    """More systems and components send to the autopilot than it can tell apart."""
    drops = endpoint.history.failures.within(REFUSED_S, endpoint.now)
    if count := drops.get("too_many_senders", 0):
        yield {"count": count}


def send_fails(endpoint: EndpointFacts) -> Signs:
    """An error of the kernel that lasts: nothing else shows that one direction is blocked."""
    url, failures = endpoint.config.url, endpoint.history.failures
    errors = [name for name in failures.lasting(endpoint.now) if name in KERNEL_ERRORS - {NOT_LISTENING}]
    is_shown_otherwise = url.kind is EndpointKind.UDPOUT and bool(endpoint.silence[0])
    if errors and url.kind in (EndpointKind.UDPIN, EndpointKind.UDPOUT) and not is_shown_otherwise:
        yield {"error": errors[0], "meaning": meaning_of(errors[0])}


def other_port(endpoint: EndpointFacts) -> Signs:
    """The client's host answers, from a port that anybody on it may have."""
    client = endpoint.endpoint
    if isinstance(client, UdpClient) and "other_port" in endpoint.history.failures.within(SILENT_S, endpoint.now):
        yield {"other": client.other_port}
