"""Why a link is down: what is certain on this machine, then hints from the network, then silence.

Any sender can forge a hint. So each hint names its source and a remedy that is safe if the hint is forged: no remedy
accepts a key, a name or an address because it arrived.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Final

from uavlinkd.config.keys import encode_key
from uavlinkd.core import constants as c
from uavlinkd.core.drops import DropReason
from uavlinkd.core.path import relay_name
from uavlinkd.core.peer import Peer
from uavlinkd.link.evidence import REPORTED, Sighting
from uavlinkd.link.facts import (
    UNREACHABLE,
    UNROUTED,
    Found,
    Moment,
    PeerFacts,
    at,
    details_at,
    fault,
    hosts_of,
    listed,
    warning,
)
from uavlinkd.link.relay_link import RelayLink
from uavlinkd.ops.findings import IS_REACHABLE, titled
from uavlinkd.ops.log import shown
from uavlinkd.system.error_meanings import CONNECTED, meaning_of, web_problem

CONFIRM_S: Final = 2.0
"""A handshake that is not complete after this time is reported."""
_ASK_THERE: Final = "run `uavlinkd status` at {}: it names the cause if datagrams arrive there"
_EXPLAIN_NO_ANSWER: Final = {"firewall_here", "no_route", "wrong_psk", "no_common_suite"}

_RelayProblem = tuple[str, RelayLink]


def down_problems(peer: PeerFacts) -> Iterator[Found]:
    """All that is known about a peer that is down, except its silence."""
    relays = list(_relays(peer))
    found = [*_here(peer, relays), *_at_relays(peer, relays), *_hints(peer), *_handshakes(peer, relays), *_icmp(peer)]
    yield from found
    is_explained = any(one.cause in _EXPLAIN_NO_ANSWER for one in found)
    if not is_explained and is_deaf(peer.link.peer, peer.now):
        yield fault(
            "not_confirmed",
            "its initiations arrive, and it does not confirm this daemon's responses: these do not reach it, the PSKs"
            " differ, or an attacker replays old initiations",
            f"let UDP from this daemon through the firewall at {peer.name}; compare the PSKs",
        )


def is_deaf(peer: Peer, now: float) -> bool:
    """Whether a peer initiates, and has not confirmed the responses for :data:`CONFIRM_S`.

    One initiation may have become superfluous. So those of a peer that is up count only if they span this time.
    """
    current = peer.sessions.current
    since = current.created_at if peer.is_up and current is not None else peer.received_at or -c.NEVER
    begun = [at for one in peer.sessions.unconfirmed.values() if (at := one.session.created_at) > since]
    return bool(begun) and (max(begun) if peer.is_up else now) - min(begun) >= CONFIRM_S


def _relays(peer: PeerFacts) -> Iterator[_RelayProblem]:
    """What is wrong with each relay of a peer that has no other path, while none of them is bound for the peer."""
    link, daemon = peer.link, peer.daemon
    relays = [daemon.relays.by_name[name] for name in link.config.relays if name in daemon.relays.by_name]
    if any(relay.peer.is_up and relay.state_for(link) == "bound" for relay in relays):
        return
    may_fail = ("EPERM", *(() if daemon.peer_sockets.absent_addresses() else UNROUTED))
    for relay in relays:
        if not relay.peer.is_up and any(peer.moment.seen_at(relay, error) for error in may_fail):
            yield "not_sent", relay
        elif not link.is_overdue(peer.now) or (link.is_closed and relay.state_for(link) == "waiting"):
            continue
        elif relay.state_for(link) == "waiting":
            yield "not_bound", relay
        elif daemon.peer_sockets.unresolved(relay.name):
            yield "name_not_resolved", relay
        elif daemon.evidence.seen_at(DropReason.BAD_HANDSHAKE, ("relay", relay.config.name), peer.now) is not None:
            yield "wrong_psk", relay
        elif relay in peer.moment.silent_relays:
            yield "relay_not_answering", relay


def _here(peer: PeerFacts, relays: Sequence[_RelayProblem]) -> Iterator[Found]:
    """What is certain: this machine."""
    sockets = peer.daemon.peer_sockets
    for owner in (peer.name, *(relay.name for problem, relay in relays if problem == "name_not_resolved")):
        if names := sorted(sockets.unresolved(owner)):
            remedy = f"see `getent hosts {names[0]}`, or write an IP address; the daemon tries again each second"
            yield fault("name_not_resolved", f"{', '.join(names)} has no address now", remedy)
    for path in peer.link.peer.paths.configured:
        if path.host.startswith("fe80:") and path.address[-1] == 0:
            yield fault(
                "zone_missing",
                f"{shown(path.address)} is valid on one interface only, and names none",
                f'write it with its interface, as in "[{path.host}%wlan0]:{path.address[1]}"',
            )
    listen = peer.daemon.config.listen
    if peer.name in sockets.without_socket and listen and not sockets.networks.networks:
        yield fault(
            "family_missing",
            f"no address in listen is of the family of {peer.addresses}",
            f"add {listen[0].wildcard(of_other_version=True)} to listen",
        )
    elif peer.name in sockets.without_socket:
        yield fault(
            "family_missing",
            f"no network has an address from which to reach {peer.addresses}",
            "compare the address families with `ip -brief address`",
        )
    # Errors of sending to the peer, and to the relays to which nothing could be sent.
    look_ups: list[Callable[[str], Sighting | None]] = [peer.seen]
    look_ups += [partial(peer.moment.seen_at, relay) for problem, relay in relays if problem == "not_sent"]
    for seen in look_ups:
        if (sighting := seen("EPERM")) is not None:
            remedy = "allow outgoing UDP from the daemon's port: see `sudo nft list ruleset`"
            yield fault("firewall_here", f"this machine refuses to send to {at(sighting)} (EPERM)", remedy)
        errors = ((error, sighting) for error in UNROUTED if (sighting := seen(error)) is not None)
        if not sockets.absent_addresses() and (first := next(errors, None)) is not None:
            error, sighting = first
            yield fault("no_route", f"this machine cannot send to {at(sighting)} ({error})", meaning_of(error))


def _at_relays(peer: PeerFacts, relays: Sequence[_RelayProblem]) -> Iterator[Found]:
    is_certified = peer.link.config.settings.is_certified
    for name in (relay.config.name for problem, relay in relays if problem == "not_bound"):
        yield fault(
            "not_bound",
            f"{peer.name} is not bound at the {titled('relay', name)}: it is off, cannot reach the relay (UDP blocked"
            " there), is not a member, does not use it, or keys differ",
            f"start {peer.name}; `uavlinkd status` there and at the relay names the cause"
            if is_certified
            else f"start {peer.name}; compare both public_key with `uavlinkd pubkey`; write a [[relay]] for {name}"
            " into its file, and a [[member]] for it into the file of the relay",
        )
    yield from silent_relays(peer.moment, [relay for problem, relay in relays if problem == "relay_not_answering"])


def silent_relays(
    moment: Moment, relays: Sequence[RelayLink], fault_or_warning: Callable[..., Found] = fault
) -> Iterator[Found]:
    """What the silence of these relays means, by what else answers."""
    admitted = "a [[member]] there"
    if moment.daemon.fleet is not None:
        admitted += ", or a member of its fleet that is not revoked"
    by_udp = [relay for relay in relays if hosts_of(relay)]
    if by_udp and moment.is_udp_blocked:
        names = [relay.config.name for relay in moment.silent_relays if hosts_of(relay)]
        tried = [(relay.config.name, *_by_tls(moment, relay)) for relay in by_udp]
        remedy = (
            "try another network, or let UDP to the ports of the relays, and back, through the firewalls here, or let"
            ' members reach a relay by TLS (uavlinkd/relay/README.md, "Where UDP does not pass").'
            f" {IS_REACHABLE.format(min(hosts_of(by_udp[0])))}. If this daemon is new to a relay, it must be"
            f" {admitted}: `uavlinkd status` there shows what arrives"
        )
        yield fault_or_warning(
            "udp_blocked",
            f"UDP is probably blocked here: none of {len(names)} relays on different hosts answers ({listed(names)})"
            + "".join(f"; {name} {what}" for name, what, _ in tried if what),
            "; or ".join([*dict.fromkeys(advice for _, _, advice in tried if advice), remedy]),
        )
        relays = [relay for relay in relays if relay not in by_udp]
    for relay in relays:
        name, hosts = relay.config.name, hosts_of(relay)
        text = f"the {titled('relay', name)} does not answer at {listed(map(str, relay.config.addresses))}: "
        remedy = (
            f"{_ASK_THERE.format(name)}; else open its firewall. `uavlinkd pubkey` there must print the public_key of"
            f" the [[relay]] here, and this daemon must be {admitted}"
        )
        what, advice = _by_tls(moment, relay)
        text += what and f"{what}; by UDP " if hosts else what
        error, path = moment.reported(relay) or ("", None)
        if not hosts:
            pass
        elif path is not None and error in UNREACHABLE:
            text += f"the network reports that {shown(path.address)} is not reachable ({error}, ICMP)"
            remedy = f"compare its address, and see `ip route get ADDRESS`; or {remedy}"
        elif error:
            text += "no process listens there, or a firewall there rejects (ICMP)"
            listen = "compare its `listen` with the addresses of the [[relay]] here"
            remedy = f"start the relay, and {listen}; or {remedy}"
        elif same := next((who for host, who in moment.answering.items() if host in hosts), ""):
            text += f"that host answers ({same}), so the relay is off, its port wrong, or closed by a firewall"
        elif other := moment.other_answer(hosts):
            text += (
                f"UDP gets out here ({other} answers), so this relay is off, its address is wrong, a firewall there"
                " drops UDP, or keys or suites differ"
            )
        elif moment.passes(relay):
            text += "datagrams still come through it, so the direction from here to it is blocked"
        elif relay.peer.received_at is not None:
            text += "it did before, so it is off, or UDP to it or back is blocked"
        else:
            text += "it is off, the address is wrong, a firewall drops UDP here or there, or keys or suites differ"
            remedy += f". {IS_REACHABLE.format(min(hosts, default=name))}"
        yield fault_or_warning("relay_not_answering", text, f"{advice}; or {remedy}" if advice else remedy)


def _by_tls(moment: Moment, relay: RelayLink) -> tuple[str, str]:
    """Why a silent relay is not reached at its URLs, and the remedies; empty if it has none."""
    states = moment.daemon.peer_sockets.web.states(relay.config.addresses)
    problems = {url: web_problem("silent" if state == CONNECTED else state) for url, state in states.items()}
    what = "; ".join(f"by TLS ({url}) {what}" for url, (what, _) in problems.items())
    return what, "; or ".join(dict.fromkeys(remedy for _, remedy in problems.values() if remedy))


def relay_warnings(moment: Moment) -> Iterator[Found]:
    """Relays that are silent while no peer needs them, and ports of relays that are silent while others answer."""
    needed = {name for link in moment.down for name in link.config.relays}
    spare = [relay for relay in moment.silent_relays if relay.config.name not in needed]
    yield from silent_relays(moment, spare, warning)
    for relay in moment.daemon.relays.by_name.values():
        for path in moment.silent_paths(relay) if relay.peer.is_up else ():
            if answering := moment.answering.get(path.host, ""):
                yield warning(
                    "relay_port_silent",
                    f"no answer from {shown(path.address)}, an address of the"
                    f" {titled('relay', relay.config.name)}: that host answers ({answering}), so a firewall drops UDP"
                    " to this port only, or no process listens there",
                    "let UDP to this port through the firewalls here and there, or compare `listen` of the relay with"
                    " the addresses of the [[relay]] here",
                )


# Hints: anything here may be forged.


def _hints(peer: PeerFacts) -> Iterator[Found]:
    is_certified = peer.link.config.settings.is_certified  # no file has its key
    if not is_certified and (sighting := peer.handshake_seen(DropReason.UNKNOWN_PEER)) is not None:
        yield from _unknown_keys(peer, sighting)
    config = peer.daemon.config
    if (sighting := peer.handshake_seen(DropReason.OTHER_VERSION)) is not None:
        yield versions(sighting, config.name, peer.name)
    elif (sighting := peer.handshake_seen(DropReason.BAD_MAC1)) is not None:
        if sighting.address is not None and peer.daemon.peer_sockets.is_own(sighting.address):
            text = f"{at(sighting)} in addresses leads to this daemon itself"
            yield fault("own_address", text, f"write the address of {peer.name}")
        else:
            yield fault(
                "wrong_key_there",
                f"a sender at {at(sighting)} does not know this daemon's public key: that end may have another key"
                " for it",
                f"`uavlinkd fleet sign {peer.name}` prints a line for `uavlinkd enroll --finish` there"
                if is_certified
                else f'at {peer.name}, write public_key = "{encode_key(config.public_key)}" for {config.name}; if its'
                " key file was replaced, restart this daemon",
            )


def _icmp(peer: PeerFacts) -> Iterator[Found]:
    """What the network reports. It comes last: it may be from before the peer started. A close explains it too."""
    if peer.link.is_closed:
        return
    if (sighting := peer.seen(f"{REPORTED}ECONNREFUSED")) is not None:
        yield fault(
            "no_listener",
            f"no process listens at {at(sighting)}, or a firewall there rejects (ICMP)",
            f"start uavlinkd at {peer.name}, and compare its `listen` with `addresses` here",
        )
    for error in UNREACHABLE:
        if (sighting := peer.seen(REPORTED + error)) is not None:
            yield fault(
                "host_unreachable",
                f"the network reports that {at(sighting)} is not reachable ({error})",
                f"switch {peer.name} on, and compare its address with `addresses` here; see `ip route get ADDRESS`",
            )
            break


def _unknown_keys(peer: PeerFacts, sighting: Sighting) -> Iterator[Found]:
    if count := len(sighting.details):
        which = "the key" if count == 1 else f"{count} keys, so at least one is not {peer.name}:"
        yield fault(
            "wrong_key_here",
            f"a sender uses {which} {details_at(sighting.details)}, which this file does not have",
            f"run `uavlinkd pubkey` at {peer.name}, and write into this file what that prints: a key that arrives"
            " proves nothing. After a change of keys, restart it with its new files; if the former key was stolen,"
            " this may be the thief",
        )


def versions(sighting: Sighting, here: str, there: str) -> Found:
    """Which side to update: also if the message is forged, an update is safe."""
    seen = sorted(version for version in sighting.details if isinstance(version, int))
    named = " and ".join(f"uavlink/{version}" for version in seen)
    remedies = []
    if min(seen) < c.PROTOCOL_VERSION:
        remedies.append(f"update uavlinkd at {there}: it is older")
    if max(seen) > c.PROTOCOL_VERSION:
        remedies.append(f"update uavlinkd at {here}, this machine: it is older")
    text = f"a sender at {at(sighting)} speaks {named}, this daemon uavlink/{c.PROTOCOL_VERSION}: the two cannot link"
    return fault("other_version", text, "; ".join(remedies))


def _handshakes(peer: PeerFacts, relays: Sequence[_RelayProblem]) -> Iterator[Found]:
    """Responses of the peer, and of its relays, that this end refuses."""
    senders = []
    if (sighting := peer.seen(DropReason.BAD_HANDSHAKE)) is not None:
        senders.append(at(sighting))
    for name in (relay.config.name for problem, relay in relays if problem == "wrong_psk"):
        if (
            sighting := peer.daemon.evidence.seen_at(DropReason.BAD_HANDSHAKE, ("relay", name), peer.now)
        ) is not None:
            senders.append(f"the {titled('relay', name)} at {at(sighting)}")
    for sender in senders:
        yield fault(
            "wrong_psk",
            f"the response from {sender} does not authenticate: the PSKs differ, or only one end has one",
            "give both ends the same psk_file; never remove a PSK: the message may be forged",
        )
    if (sighting := peer.seen(DropReason.SUITE_NOT_ACCEPTED)) is not None:
        offered = ", ".join(str(suite) for suite in sighting.details)
        accepted = ", ".join(suite.name for suite in peer.link.config.settings.link.suites)
        yield fault(
            "no_common_suite",
            f"it offers the suite {offered}; this end accepts {accepted}",
            f"write this end's suites at {peer.name}, or stronger ones at both ends; never weaker ones: an old"
            " recording can cause this",
        )


def silence(peer: PeerFacts) -> Iterator[Found]:
    """A peer that is down, without any other problem."""
    config, ask = peer.link.config, _ASK_THERE.format(peer.name)
    if not peer.link.is_overdue(peer.now):
        return
    by_name = peer.daemon.relays.by_name
    refused = ""
    if config.settings.is_certified:
        refused = ", or it has a bulletin that revokes this daemon (`uavlinkd fleet list` shows whether)"
    if peer.link.is_closed:
        yield fault(
            "closed_by_peer",
            f"closed by the peer, {peer.now - peer.link.closed_at:.0f} s ago: its daemon was stopped, or its file no"
            " longer has this daemon",
            f"none if that is meant; else start uavlinkd at {peer.name}",
        )
    elif config.addresses and all(written.is_serial for written in config.addresses):
        yield fault(
            "no_answer",
            f"no answer along {peer.addresses}: it is off or out of range, or keys or modem settings differ",
            f"compare the baud rate, NETID and air speed of both modems, and set MAVLINK=0; {ask}",
        )
    elif peer.link.peer.received_at is not None:
        through = [name for name, relay in by_name.items() if relay.state_for(peer.link) == "bound"]
        via = f" through the {titled('relay', through[0])}, which answers" if through else ""
        yield fault(
            "no_answer",
            f"nothing arrives from it any more{via}: it is off, or the direction from it to here is blocked{refused}",
            f"{ask}; if its link is up there, look for a bad radio or a firewall in the direction from it to here",
        )
    elif config.addresses:
        hosts = {path.host for path in peer.link.peer.paths.configured}
        other = peer.moment.other_answer({host for host in hosts if relay_name((host, 0)) is None})
        where = f"there, while UDP gets out here ({other} answers)" if other else "here or there"
        yield fault(
            "no_answer",
            f"no answer from {peer.addresses}: it is off, a firewall drops UDP {where}, or addresses, keys or"
            f" protocol versions differ{refused}",
            f"{ask}; else open its firewall",
        )
    elif config.relays:
        relays, text = ", ".join(config.relays), "keys or PSKs differ, or it has just gone"
        if not any(relay.peer.is_up for relay in by_name.values() if relay.config.name in config.relays):
            text, ask = "no session with a relay now, which may be starting again", "wait for 3 s"
        yield fault("no_answer", f"no answer through a relay ({relays}): {text}", ask)
    else:
        yield fault(
            "not_connecting",
            f"{peer.name} has not connected, and this file has no address of it",
            f"start {peer.name}, and write this daemon's address into its file, or its address into this one, or a"
            " [[relay]] into both",
        )
