"""Why a link is down: what is certain on this machine, then hints from the network, then silence.

Any sender can forge a hint. So each hint names its source and a remedy that is safe if the hint is forged: no remedy
accepts a key, a name or an address because it arrived.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Final

from uavlinkd.config.keys import encode_key
from uavlinkd.core import constants as c
from uavlinkd.core.drops import DropReason
from uavlinkd.link.evidence import REPORTED, Sighting
from uavlinkd.link.facts import OF_PEER_DOWN, OF_PEER_SILENT, Found, PeerFacts, at, listed
from uavlinkd.link.relay_link import RelayLink
from uavlinkd.ops.findings import Severity
from uavlinkd.ops.log import shown
from uavlinkd.system.error_meanings import meaning_of

CONFIRM_S: Final = 2.0
"""A handshake that is not complete after this time is reported."""
RELAY_SILENT_S: Final = 5.0
"""A relay that does not answer for this long is reported with the peers that need it."""
_UNROUTED: Final = ("ENETUNREACH", "EHOSTUNREACH", "ENETDOWN", "EADDRNOTAVAIL", "EINVAL", "EMSGSIZE", "EAFNOSUPPORT")
"""Errors of sending that are certain: this machine's kernel reports them at once."""
_UNREACHABLE: Final = ("EHOSTUNREACH", "ENETUNREACH", "EACCES")
"""Errors that ICMP messages report, except a closed port."""
_ASK_THERE: Final = "run `uavlinkd status` at {}: it names the cause if datagrams arrive there"

# Certain: this machine.


@OF_PEER_DOWN.add(Severity.FAULT)
def _name_not_resolved(peer: PeerFacts) -> Iterator[Found]:
    sockets = peer.moment.daemon.peer_sockets
    needed = [relay.name for cause, relay in _relays(peer) if cause == "name_not_resolved"]
    for owner in (peer.name, *needed):
        if names := sorted(sockets.unresolved(owner)):
            remedy = f"see `getent hosts {names[0]}`, or write an IP address; the daemon tries again each second"
            yield Found(f"{', '.join(names)} has no address now", remedy)


@OF_PEER_DOWN.add(Severity.FAULT)
def _zone_missing(peer: PeerFacts) -> Iterator[Found]:
    for path in peer.link.peers[0].paths.configured:
        if path.host.startswith("fe80:") and path.address[-1] == 0:
            yield Found(
                f"{shown(path.address)} is valid on one interface only, and names none",
                f'write it with its interface, as in "[{path.host}%wlan0]:{path.address[1]}"',
            )


@OF_PEER_DOWN.add(Severity.FAULT)
def _family_missing(peer: PeerFacts) -> Iterator[Found]:
    sockets = peer.moment.daemon.peer_sockets
    if peer.name not in sockets.without_socket:
        return
    if sockets.networks is None:
        yield Found(
            f"no address in listen is of the family of {peer.addresses}",
            'add "[::]:5790" to listen for IPv6, "0.0.0.0:5790" for IPv4',
        )
    else:
        yield Found(
            f"no network has an address from which to reach {peer.addresses}",
            "compare the address families with `ip -brief address`",
        )


@OF_PEER_DOWN.add(Severity.FAULT)
def _firewall_here(peer: PeerFacts) -> Iterator[Found]:
    for seen in _senders(peer):
        if (sighting := seen("EPERM")) is not None:
            remedy = "allow outgoing UDP from the daemon's port: see `sudo nft list ruleset`"
            yield Found(f"this machine refuses to send to {at(sighting)} (EPERM)", remedy)


@OF_PEER_DOWN.add(Severity.FAULT)
def _no_route(peer: PeerFacts) -> Iterator[Found]:
    if not peer.moment.daemon.peer_sockets.absent_addresses():
        for seen in _senders(peer):
            if error := next((error for error in _UNROUTED if seen(error) is not None), ""):
                sighting = seen(error)
                assert sighting is not None
                yield Found(f"this machine cannot send to {at(sighting)} ({error})", meaning_of(error))


def _senders(peer: PeerFacts) -> Iterator[Callable[[str], Sighting | None]]:
    """The look-ups of errors of sending: to the peer, and to the relays to which nothing could be sent."""
    yield peer.seen
    yield from (partial(peer.seen_at, relay) for cause, relay in _relays(peer) if cause == "not_sent")


# Relays of a peer that has no other path.


def _relays(peer: PeerFacts) -> Iterator[tuple[str, RelayLink]]:
    """What is wrong with each relay, while none of them is bound for the peer."""
    link, daemon = peer.link, peer.moment.daemon
    relays = [daemon.relays.by_name[name] for name in link.config.relays if name in daemon.relays.by_name]
    if any(relay.peer.is_up and relay.state_for(link) == "bound" for relay in relays):
        return
    may_fail = ("EPERM", *(() if daemon.peer_sockets.absent_addresses() else _UNROUTED))
    for relay in relays:
        if not relay.peer.is_up and any(peer.seen_at(relay, error) is not None for error in may_fail):
            yield "not_sent", relay
        elif not link.is_overdue(peer.now):
            continue
        elif relay.state_for(link) == "waiting":
            yield "not_bound", relay
        elif daemon.peer_sockets.unresolved(relay.name):
            yield "name_not_resolved", relay
        elif daemon.evidence.seen_of_relay(DropReason.BAD_HANDSHAKE, relay.config.name, peer.now) is not None:
            yield "wrong_psk", relay
        elif peer.now - relay.silent_since >= RELAY_SILENT_S:
            yield "relay_not_answering", relay


@OF_PEER_DOWN.add(Severity.FAULT)
def _not_bound(peer: PeerFacts) -> Iterator[Found]:
    for cause, relay in _relays(peer):
        if cause == "not_bound":
            name = relay.config.name
            yield Found(
                f"{peer.name} is not bound at the relay {name}: it is off, not a member, does not use it, or keys"
                " differ",
                f"start {peer.name}; compare both public_key with `uavlinkd pubkey`; write a [[relay]] for {name}"
                " into its file, and a [[member]] for it into the file of the relay",
            )


@OF_PEER_DOWN.add(Severity.FAULT)
def _relay_not_answering(peer: PeerFacts) -> Iterator[Found]:
    for cause, relay in _relays(peer):
        if cause != "relay_not_answering":
            continue
        text = f"the relay {relay.config.name} does not answer at {listed(map(str, relay.addresses))}: "
        remedy = (
            f"{_ASK_THERE.format(relay.config.name)}; else open its firewall. `uavlinkd pubkey` there must print the"
            " public_key of the [[relay]] here, and this daemon must be a [[member]] there"
        )
        if peer.seen_at(relay, f"{REPORTED}ECONNREFUSED") is not None:
            text += "no process listens there, or a firewall there rejects (ICMP)"
            remedy = (
                f"start the relay, and compare its `listen` with the addresses of the [[relay]] here; or {remedy}"
            )
        else:
            text += "it is off, the address is wrong, a firewall drops UDP, or keys or suites differ"
        yield Found(text, remedy)


# Hints: anything here may be forged.


@OF_PEER_DOWN.add(Severity.FAULT)
def _no_listener(peer: PeerFacts) -> Iterator[Found]:
    if (sighting := peer.seen(f"{REPORTED}ECONNREFUSED")) is not None:
        yield Found(
            f"no process listens at {at(sighting)}, or a firewall there rejects (ICMP)",
            f"start uavlinkd at {peer.name}, and compare its `listen` with `addresses` here",
        )


@OF_PEER_DOWN.add(Severity.FAULT)
def _host_unreachable(peer: PeerFacts) -> Iterator[Found]:
    for error in _UNREACHABLE:
        if (sighting := peer.seen(REPORTED + error)) is not None:
            yield Found(
                f"the network reports that {at(sighting)} is not reachable ({error})",
                f"switch {peer.name} on, and compare its address with `addresses` here; see `ip route get ADDRESS`",
            )
            return


def _keys(peer: PeerFacts) -> tuple[str, list[str], list[str]]:
    """Where unknown keys were seen; the former ones of the peer, and others."""
    sighting = peer.handshake_seen(DropReason.UNKNOWN_PEER)
    if sighting is None:
        return "", [], []
    before = {*peer.moment.daemon.history.former_keys, peer.link.config.previous_public_key}
    keys = [key for key in sighting.details if isinstance(key, bytes) and key != peer.moment.daemon.config.public_key]
    former = [encode_key(key) for key in keys if key in before]
    return at(sighting), former, [encode_key(key) for key in keys if key not in before]


@OF_PEER_DOWN.add(Severity.FAULT)
def _former_key(peer: PeerFacts) -> Iterator[Found]:
    where, former, _ = _keys(peer)
    if former:
        yield Found(
            f"a sender at {where} uses the former key {former[-1]}, or an attacker replays an old recording",
            f"carry the new files to {peer.name} and restart it; if the former key was stolen, this may be the thief",
        )


@OF_PEER_DOWN.add(Severity.FAULT)
def _wrong_key_here(peer: PeerFacts) -> Iterator[Found]:
    where, _, others = _keys(peer)
    if others:
        which = "the key" if len(others) == 1 else f"{len(others)} keys, so at least one is not {peer.name}:"
        yield Found(
            f"a sender at {where} uses {which} {', '.join(others)}, which this file does not have",
            f"run `uavlinkd pubkey` at {peer.name}, and write into this file what that prints: a key that arrives"
            " proves nothing. After a change of keys, restart it with its new files",
        )


@OF_PEER_DOWN.add(Severity.FAULT)
def _other_version(peer: PeerFacts) -> Iterator[Found]:
    if (sighting := peer.handshake_seen(DropReason.OTHER_VERSION)) is not None:
        yield versions(sighting, peer.moment.daemon.config.name, peer.name)


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
    return Found(text, "; ".join(remedies))


@OF_PEER_DOWN.add(Severity.FAULT, unless=("other_version",))
def _own_address(peer: PeerFacts) -> Iterator[Found]:
    sighting = peer.handshake_seen(DropReason.BAD_MAC1)
    if sighting is not None and sighting.address is not None and _is_own(peer, sighting):
        yield Found(f"{at(sighting)} in addresses leads to this daemon itself", f"write the address of {peer.name}")


@OF_PEER_DOWN.add(Severity.FAULT, unless=("other_version",))
def _wrong_key_there(peer: PeerFacts) -> Iterator[Found]:
    config = peer.moment.daemon.config
    sighting = peer.handshake_seen(DropReason.BAD_MAC1)
    if sighting is not None and not _is_own(peer, sighting):
        yield Found(
            f"a sender at {at(sighting)} does not know this daemon's public key: that end may have another key for"
            " it",
            f'at {peer.name}, write public_key = "{encode_key(config.public_key)}" for {config.name}; if its key file'
            " was replaced, restart this daemon",
        )


def _is_own(peer: PeerFacts, sighting: Sighting) -> bool:
    return sighting.address is not None and peer.moment.daemon.peer_sockets.is_own(sighting.address)


@OF_PEER_DOWN.add(Severity.FAULT)
def _wrong_psk(peer: PeerFacts) -> Iterator[Found]:
    senders = []
    if (sighting := peer.seen(DropReason.BAD_HANDSHAKE)) is not None:
        senders.append(at(sighting))
    for cause, relay in _relays(peer):
        name, evidence = relay.config.name, peer.moment.daemon.evidence
        if cause == "wrong_psk" and (sighting := evidence.seen_of_relay(DropReason.BAD_HANDSHAKE, name, peer.now)):
            senders.append(f"the relay {name} at {at(sighting)}")
    for sender in senders:
        yield Found(
            f"the response from {sender} does not authenticate: the PSKs differ, or only one end has one",
            "give both ends the same psk_file; never remove a PSK: the message may be forged",
        )


@OF_PEER_DOWN.add(Severity.FAULT)
def _no_common_suite(peer: PeerFacts) -> Iterator[Found]:
    if (sighting := peer.seen(DropReason.SUITE_NOT_ACCEPTED)) is not None:
        offered = ", ".join(str(suite) for suite in sighting.details)
        accepted = ", ".join(suite.name for suite in peer.link.config.settings.link.suites)
        yield Found(
            f"it offers the suite {offered}; this end accepts {accepted}",
            f"write this end's suites at {peer.name}, or stronger ones at both ends; never weaker ones: an old"
            " recording can cause this",
        )


@OF_PEER_DOWN.add(Severity.FAULT, unless=("firewall_here", "no_route", "wrong_psk", "no_common_suite"))
def _not_confirmed(peer: PeerFacts) -> Iterator[Found]:
    if has_unconfirmed(peer) and peer.now - peer.link.silent_since >= CONFIRM_S:
        yield Found(
            "it initiates, and does not confirm this daemon's responses",
            f"compare the PSKs; let UDP from this daemon through the firewall at {peer.name}",
        )


def has_unconfirmed(peer: PeerFacts) -> bool:
    """Whether it initiated and has not confirmed the response."""
    return any(one.sessions.unconfirmed for one in peer.link.peers)


# Silence, without any other problem.


@OF_PEER_SILENT.add(Severity.FAULT)
def _no_answer(peer: PeerFacts) -> Iterator[Found]:
    config, ask = peer.link.config, _ASK_THERE.format(peer.name)
    if not peer.link.is_overdue(peer.now):
        return
    if config.addresses and all(written.is_serial for written in config.addresses):
        yield Found(
            f"no answer along {peer.addresses}: it is off or out of range, or keys or modem settings differ",
            f"compare the baud rate, NETID and air speed of both modems, and set MAVLINK=0; {ask}",
        )
    elif config.addresses:
        yield Found(
            f"no answer from {peer.addresses}: it is off, a firewall drops UDP, or addresses, keys or protocol"
            " versions differ",
            f"{ask}; else open its firewall",
        )
    elif config.relays:
        relays = ", ".join(config.relays)
        yield Found(f"no answer through a relay ({relays}): keys or PSKs differ, or it has just gone", ask)


@OF_PEER_SILENT.add(Severity.FAULT)
def _not_connecting(peer: PeerFacts) -> Iterator[Found]:
    config = peer.link.config
    if peer.link.is_overdue(peer.now) and not config.addresses and not config.relays:
        yield Found(
            f"{peer.name} has not connected, and this file has no address of it",
            f"start {peer.name}, and write this daemon's address into its file, or its address into this one, or a"
            " [[relay]] into both",
        )
