"""What is wrong with traffic: attacks with a valid key, frames that policies refuse, local clients that are silent.

All of it is authentic, or happens on this machine. Without a peer's key, an attacker on the path can withhold answers
(``freshness_unverified``), and release several handshakes after a restart (``key_on_two_machines``).
"""

from __future__ import annotations

import errno
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from typing import Final

from uavlinkd.core.peer import Peer
from uavlinkd.core.refusals import Claim
from uavlinkd.core.sessions import Twin
from uavlinkd.endpoints.udp import UdpClient
from uavlinkd.endpoints.url import EndpointKind
from uavlinkd.link.evidence import EVIDENCE_S, GateHistory
from uavlinkd.link.facts import EndpointFacts, Found, PartFacts, PeerFacts, fault, listed, security, warning
from uavlinkd.link.own_problems import codes_there, problems_there
from uavlinkd.mavlink.dialect import GROUPS, IDS, SYSTEM_ID, command_name, name_of
from uavlinkd.mavlink.egress.lanes import EgressDrop
from uavlinkd.mavlink.policy.gate import ANY_OTHER, REFUSALS, Gate, Refusal
from uavlinkd.mavlink.policy.roles import ROLES
from uavlinkd.ops.findings import Finding
from uavlinkd.ops.log import shown
from uavlinkd.system.error_meanings import meaning_of

SECURITY_S: Final = 600.0
"""A finding about an attack stays for this time after the last evidence."""
COMMANDS_S: Final = 300.0
"""A refused command stays in the findings for this time: a person looks some time after the press of a button."""
CLAIMS_S: Final = 60.0
"""A peer's claim whose count grew within this time is a present problem."""
REFUSED_S: Final = 10.0
"""Other refusals stay for this time."""
LOSS_LASTS_S: Final = 12.0
"""A high loss is reported if it lasts for this time. An outage that is over counts as a loss for up to 10 s."""
SILENT_S: Final = 5.0
"""An endpoint without frames for this time is reported: MAVLink clients send a heartbeat every second. Its errors
count for the same time. It is opened again more often."""

_WITHOUT_CLIENT: Final = frozenset({"garbage", "device_unavailable", "no_client", "client_unreachable"})
"""Why no frame passes between an endpoint and a client. A silent client may listen."""
_BY_RULE: Final = frozenset({Refusal.MESSAGE_NOT_ALLOWED, Refusal.COMMAND_NOT_ALLOWED, Refusal.RATE_LIMITED})
_FLIGHT_COMMANDS: Final = frozenset(
    {"MAV_CMD_COMPONENT_ARM_DISARM", "MAV_CMD_NAV_TAKEOFF", "MAV_CMD_NAV_LAND", "MAV_CMD_NAV_RETURN_TO_LAUNCH"}
)
_EVERYDAY_COMMANDS: Final = frozenset({"MAV_CMD_REQUEST_MESSAGE", "MAV_CMD_SET_MESSAGE_INTERVAL"})
"""Commands that a vehicle's own components send too."""
_CLAIMS_SHOWN: Final = 3
_NOT_LISTENING: Final = "ECONNREFUSED"
_KERNEL_ERRORS: Final = frozenset(errno.errorcode.values())


def peer_problems(peer: PeerFacts) -> Iterator[Found]:
    """Of any peer: signs that a key is in wrong hands, and what the peer claims."""
    if has_twin(peer.link.peer, Twin.PEERS, peer.now):
        yield two_machines(f"{peer.name}'s private key: sessions came from {places(peer.link.peer)}")
    yield from _hidden_frames(peer)
    claims = [claim for claim in peer.link.peer.refusal_claims.recent() if peer.now - claim.changed_at <= CLAIMS_S]
    if claims:
        yield _refused_there(peer, claims)
    if codes := codes_there(peer.link.peer, peer.now):
        yield problems_there(codes)


def has_twin(peer: Peer, twin: Twin, now: float, within_s: float = SECURITY_S) -> bool:
    """Whether the sessions with a peer showed a second process with a private key."""
    return twin in peer.sessions.twins and now - peer.sessions.twins[twin] < within_s


def is_contested(peer: Peer, now: float) -> bool:
    """Whether two processes with one key displace each other now: each loses about half of the frames."""
    return any(has_twin(peer, twin, now, EVIDENCE_S) for twin in Twin)


def places(peer: Peer) -> str:
    """Where a peer answered."""
    answered = (state for state in peer.paths.states if state.is_validated or state.is_known)
    return listed(dict.fromkeys(shown(state.path.address) for state in answered)) or "an unknown address"


def two_machines(facts: str) -> Found:
    """A private key is in use twice. ``facts``: whose, and where."""
    return security(
        "key_on_two_machines",
        f"two machines use {facts}; a card was copied, or the key is stolen",
        "run `uavlinkd pubkey` on both machines. If both print one key, run `uavlinkd keygen` on one; rotate the key"
        " only if a second machine has it: an attacker that holds handshakes back until a restart, or a captured"
        " peer, can also cause this",
    )


def _hidden_frames(part: PartFacts) -> Iterator[Found]:
    if part.now - part.history.incoming.hiding_at <= SECURITY_S:
        count = part.history.incoming.reasons.within(SECURITY_S, part.now)[Refusal.HIDDEN_FRAME]
        yield security(
            "hidden_frame",
            f"{count:,} of its frames hid a forbidden frame, and were refused: more than by accident, and outside of"
            " files",
            f"treat {part.name} as captured",
        )


def up_problems(peer: PeerFacts) -> Iterator[Found]:
    """Of a peer that is up: its freshness, and what its policy refuses."""
    if (since := peer.link.peer.unverified_since) is not None:
        yield fault(
            "freshness_unverified",
            f"freshness unverified for {peer.now - since:.0f} s: the peer's frames arrive, its echo replies do not:"
            " the direction from here to it is blocked, or an attacker delays frames. Commands, missions, parameters"
            " and manual control are held and dropped; reports pass and may be old",
            "fly by other means until answers return; look for a bad radio or a firewall in the direction to it",
        )
    yield from _losses(peer)
    yield from _unsent(peer)
    exchanged = list(_roles_exchanged(peer, is_blocked=bool(peer.history.blocked(peer.now))))
    yield from (one for one in _refused(peer) if not exchanged or one.cause != "all_refused")
    yield from exchanged
    yield from _commands(peer)


def _losses(peer: PeerFacts) -> Iterator[Found]:
    """Loss by direction, which a network may have in one only, and paths that drop long datagrams."""
    directions = ("from it to here", "from here to it")
    measured = zip(directions, peer.link.losses, peer.link.lossless_at, strict=False)
    shares = [
        (direction, min(1.0, lost / max(1, sent)))
        for direction, (sent, lost), lossless_at in measured
        if peer.now - lossless_at >= LOSS_LASTS_S
    ]
    if shares:
        yield warning(
            "high_loss",
            f"many datagrams are lost: {' and '.join(f'{share:.0%} {direction}' for direction, share in shares)}",
            "look for a bad radio, a full network or a rate limit in this direction",
        )
    for state in peer.link.peer.paths.states:
        if state.works and (dropped := state.envelope_limit.dropped):
            yield warning(
                "long_datagrams_dropped",
                f"the path to {shown(state.path.address)} drops datagrams of {dropped:,} bytes, so frames share"
                f" shorter ones: up to {state.envelope_limit.limit:,} bytes",
                "nothing is lost by that; if the path should carry more, look for a tunnel with a small MTU",
            )


def _unsent(peer: PeerFacts) -> Iterator[Found]:
    """Frames that waited here and were dropped. That newer states replace older ones is no problem."""
    dropped = peer.history.unsent.within(REFUSED_S, peer.now)
    if count := sum(dropped.get(reason, 0) for reason in (EgressDrop.OVERFLOW, EgressDrop.STALE)):
        yield warning(
            "frames_unsent",
            f"{count:,} frames to it waited here for room on its network, and were dropped: clients here send more"
            " than the network, the connection by TLS or budget_bits_s carries",
            "lower the message rates of the clients here, end a log download, or raise a budget below what the"
            " network carries",
        )


def _about_systems(part: PartFacts, systems: Mapping[int, int], which: str) -> tuple[str, str]:
    """The text and the remedy."""
    allowed = part.rules.get("system_ids")
    ids = listed(map(str, allowed)) if isinstance(allowed, list | tuple) else str(allowed)
    is_certified = isinstance(part, PeerFacts) and part.link.config.settings.is_certified
    where = "in its certificate" if is_certified else "here"
    text = f"{which} of system {listed(map(str, sorted(systems)), 8)}; its system_ids {where} are {ids}"
    own = f"set {SYSTEM_ID} of its autopilot to {ids}"
    if owned := _owned(part, systems):  # never advise to trust one peer as another
        whose = listed(f"{system} is {owner}'s" for system, owner in owned.items())
        is_captured = f"; if no client there forwards such frames, treat {part.name} as captured"
        return text, f"{own}: {whose}{is_captured if isinstance(part, PeerFacts) else ''}"
    remedy = "write it into its system_ids"
    if is_certified:
        remedy = _sign_again(part.name, f"--id {min(systems)}")
    return text, f"{own}; or, only if you know that {part.owner} has this id, {remedy}"


def _owned(part: PartFacts, systems: Iterable[int]) -> dict[int, str]:
    """Those of the systems that belong to another than this peer or endpoint, with its name."""
    owners = {system: part.moment.owner(system, part.owner) for system in sorted(systems)}
    return {system: owner for system, owner in owners.items() if owner is not None}


def _refused(part: PartFacts) -> Iterator[Found]:
    """Frames of other systems; and all frames in one direction, for another reason."""
    blocked, incoming = part.history.blocked(part.now), part.history.incoming
    foreign = incoming.systems.within(REFUSED_S, part.now)
    only_foreign = {*incoming.reasons.within(REFUSED_S, part.now)} == {Refusal.FOREIGN_SYSTEM}
    if foreign and "in" not in blocked:
        yield warning("other_system", *_about_systems(part, foreign, "some of its frames are"))
    elif foreign and only_foreign:
        yield fault("foreign_system", *_about_systems(part, foreign, "all its frames are"))
    for direction, gate in (("in", incoming), ("out", part.history.outgoing)):
        reasons = gate.reasons.within(REFUSED_S, part.now)
        if reasons and direction in blocked and not (direction == "in" and only_foreign):
            which = "from it" if direction == "in" else "to it"
            yield fault(
                "all_refused",
                f"{part.rule} refuses every frame {which}: {'; '.join(reason.meaning for reason in reasons)}",
                "`uavlinkd check` prints what passes: write the role that the other end has, or allow what it needs",
            )


def _commands(part: PartFacts) -> Iterator[Found]:
    remedy = f"intended, if {part.rule} is right; else write another role, or allow the command"
    if names := _command_names(part.history.incoming, part.now):
        yield warning("commands_refused", f"{names} refused from it: {part.rule}", remedy)
    if names := _command_names(part.history.outgoing, part.now):
        yield warning("commands_withheld", f"{names} withheld: {part.rule}", remedy)


def _command_names(gate: GateHistory, now: float) -> str:
    counts = [(key, count) for key, count in gate.commands.within(COMMANDS_S, now).items() if key[2] in _BY_RULE]
    counts.sort(key=lambda entry: _rank(entry[0][1]))
    return listed(f"{_command(msgid, number)} {count:,}x" for (msgid, number, _), count in counts)


def _rank(number: int) -> int:
    """What a person looks for comes first: a list shows only its beginning, and others can make it long."""
    return 2 if number == ANY_OTHER else int(command_name(number) not in _FLIGHT_COMMANDS)


def _command(msgid: int, number: int) -> str:
    if number == ANY_OTHER:
        return "other commands"
    return f"{name_of(msgid)} ({command_name(number).removeprefix('MAV_CMD_')})"


# Roles that seem to be exchanged: a guess from the kind of frames.


def _roles_exchanged(peer: PeerFacts, *, is_blocked: bool) -> Iterator[Found]:
    role, gates = peer.rules.get("role"), peer.link.policy
    refused = peer.history.incoming.reasons.within(REFUSED_S, peer.now)
    withheld = peer.history.outgoing.reasons.within(REFUSED_S, peer.now)
    # With routing.relay the frames may be those of other peers.
    is_withheld = Refusal.MESSAGE_NOT_ALLOWED in withheld and not peer.daemon.config.relays_frames
    sign = ""
    if role == "vehicle":
        is_one = "a vehicle"
        if Refusal.GROUND_STATION_NOT_ALLOWED in refused:
            sign = "it sends a ground station's heartbeat"
        elif is_withheld and _has(gates.outgoing, _only("vehicle", "operator")):
            sign = "the client here sends a vehicle's telemetry"
        remedy = 'write role = "operator" if it is a ground station, "swarm-member" if both ends are vehicles'
    elif role == "operator":
        is_one = "a ground station"
        if Refusal.MESSAGE_NOT_ALLOWED in refused and _has(gates.incoming, _only("vehicle", "operator")):
            sign = "it sends a vehicle's telemetry"
        elif is_withheld and _has(gates.outgoing, _only("operator", "vehicle")):
            sign = "the client here sends an operator's requests"
        remedy = 'write role = "vehicle" if it is a vehicle: a role says what the peer is, not what this end is'
    if peer.link.config.settings.is_certified:
        remedy = _sign_again(peer.name, "--role operator" if role == "vehicle" else "--role vehicle")
    if sign:
        text = f'role = "{role}" says that it is {is_one}, but {sign}: the roles may be exchanged'
        fault_if_blocked = fault if is_blocked else warning
        yield fault_if_blocked("roles_exchanged", text, remedy)


def _sign_again(name: str, option: str) -> str:
    command = f"uavlinkd fleet sign --replace {name} {option}"
    return f"sign it again: `uavlinkd enroll {name}` there | `{command}` | `uavlinkd enroll --finish` there"


def _has(gate: Gate, messages: frozenset[int]) -> bool:
    """Whether the gate refused one of these messages because of its rules."""
    carriers = frozenset(IDS[name] for name in ("COMMAND_LONG", "COMMAND_INT"))
    plain = {msgid for msgid, refusal in gate.refused if refusal is Refusal.MESSAGE_NOT_ALLOWED}
    if plain & messages - carriers:
        return True
    numbers = {number for _, number, refusal in gate.refused_commands if refusal is Refusal.MESSAGE_NOT_ALLOWED}
    sent = {command_name(number) for number in numbers if number != ANY_OTHER}
    return bool(carriers & messages and sent - _EVERYDAY_COMMANDS)


@cache
def _only(role: str, other: str) -> frozenset[int]:
    """Messages that one role sends and the other does not: a vehicle's telemetry, or an operator's requests."""
    sent = {entry: {*GROUPS.get(entry, (entry,))} for name in (role, other) for entry in ROLES[name].allow_in}
    names = {name for entry in ROLES[role].allow_in for name in sent[entry]}
    others = {name for entry in ROLES[other].allow_in for name in sent[entry]}
    return frozenset(IDS[name] for name in names - others if name in IDS)


# What the peer reports to refuse of this end's frames: a claim of its own. Nothing acts on it.


def _refused_there(peer: PeerFacts, claims: list[Claim]) -> Found:
    claims.sort(key=lambda claim: not claim.refused.command)
    here, remedies = peer.daemon.config.name, []
    foreign = {REFUSALS.get(claim.refused.reason) is Refusal.FOREIGN_SYSTEM for claim in claims}
    if True in foreign:
        remedies.append(
            f"set {SYSTEM_ID} of the client here to an id in system_ids for {here} in {peer.name}'s file, or add the"
            " id there"
        )
    if False in foreign:
        remedies.append(f"if these frames are needed, change the role or lists of {here} in {peer.name}'s file")
    kinds = "; ".join(_refused_kind(claim, peer.now) for claim in claims[:_CLAIMS_SHOWN])
    more = f"; and {len(claims) - _CLAIMS_SHOWN} more kinds of frames" if len(claims) > _CLAIMS_SHOWN else ""
    return warning("refused_there", f"it reports that it refuses {kinds}{more}", "; ".join(remedies))


def _refused_kind(claim: Claim, now: float) -> str:
    refused, refusal = claim.refused, REFUSALS.get(claim.refused.reason)
    meaning = "a reason that this version does not know" if refusal is None else refusal.meaning
    command = f" {command_name(refused.command).removeprefix('MAV_CMD_')}" if refused.command else ""
    frames = "frame" if refused.total == 1 else "frames"
    age = now - claim.changed_at
    return f"{name_of(refused.message)}{command} ({meaning}, {refused.total:,} {frames}, {age:.0f} s ago)"


# Local endpoints.


def endpoint_problems(endpoint: EndpointFacts) -> Iterator[Found]:
    """What its policy refuses, why its client is silent, and why frames do not reach it."""
    yield from _hidden_frames(endpoint)
    yield from _refused(endpoint)
    yield from _commands(endpoint)
    failures, url = endpoint.history.failures, endpoint.config.url
    is_silent = endpoint.now - endpoint.history.silent_since >= SILENT_S
    if is_silent:
        yield _silent(endpoint)
    errors = [name for name in failures.lasting(endpoint.now) if name in _KERNEL_ERRORS - {_NOT_LISTENING}]
    if errors and (url.kind is EndpointKind.UDPIN or (url.kind is EndpointKind.UDPOUT and not is_silent)):
        yield warning("send_fails", f"datagrams to clients of {url} are lost ({errors[0]})", meaning_of(errors[0]))
    if isinstance(endpoint.endpoint, UdpClient) and "other_port" in failures.within(SILENT_S, endpoint.now):
        yield warning(
            "other_port",
            f"datagrams from {endpoint.endpoint.other_port} are dropped: the client is {url}, at another port",
            "let the client send from that port; or write udpin:HOST:PORT here, and let the client send there",
        )


def has_no_client(findings: Iterable[Finding], endpoints: int) -> bool:
    """Whether there are so many endpoints, and by the findings none of them has a client."""
    return 0 < endpoints == sum(one.cause in _WITHOUT_CLIENT for one in findings)


def _silent(endpoint: EndpointFacts) -> Found:
    silent_s = endpoint.now - endpoint.history.silent_since
    url, ports = endpoint.config.url, endpoint.endpoint.ports
    failures = endpoint.history.failures.within(SILENT_S, endpoint.now)
    error = next((name for name in failures if name in _KERNEL_ERRORS or name == "connect_timeout"), "")
    # A client of `udpin` has sent MAVLink: the bytes are another sender's.
    is_known = url.kind is EndpointKind.UDPIN and bool(ports)
    if not is_known and endpoint.history.garbage.within(SILENT_S, endpoint.now):
        return warning(
            "garbage",
            f"bytes arrive at {url}, and none of them is MAVLink",
            "correct the baud rate, set the port of the autopilot to MAVLink, and let only this daemon read it",
        )
    if ports and not (url.kind is EndpointKind.UDPOUT and error):
        return warning(
            "client_silent",
            f"the client {listed(port.name for port in ports)} has sent no MAVLink for {silent_s:.0f} s",
            "check that it runs, speaks MAVLink here and sends, not only listens; then power, wiring and baud rate",
        )
    if url.kind is EndpointKind.SERIAL:
        error = next(iter(failures), "")
        text = f"{url} cannot be opened{f' ({error})' if error else ''}"
        return fault("device_unavailable", text, meaning_of(error) or "plug the device in")
    if url.listens:
        text = f"no client has sent MAVLink to {url} within {silent_s:.0f} s"
        return warning("no_client", text, "let the autopilot or ground station send there")
    if "not_resolved" in failures or (url.kind is EndpointKind.UDPOUT and not ports):
        text, remedy = f"the host of {url} has no address now", "write an IP address, or see `getent hosts NAME`"
    elif error in ("", _NOT_LISTENING, "connect_timeout"):
        text = f"no process listens at {url}{f' ({error})' if error else ''}"
        remedy = "start the client there, or correct the port"
    else:
        text, remedy = f"{url} cannot be reached ({error})", meaning_of(error)
    return warning("client_unreachable", text, remedy)
