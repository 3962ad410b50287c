"""Why a link is down: what is certain on this machine, then hints from the network, then silence.

Any sender can forge a hint. So each hint names its source and a remedy that is safe if the hint is forged: no remedy
accepts a key, a name or an address because it arrived.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Final, Protocol

from uavlinkd.config import Config
from uavlinkd.config.keys import encode_key
from uavlinkd.core.drops import DropReason
from uavlinkd.link.evidence import REPORTED, Evidence, Sighting
from uavlinkd.link.history import History
from uavlinkd.link.other_version import other_version
from uavlinkd.link.peer_link import PeerLink
from uavlinkd.link.peer_sockets import PeerSockets
from uavlinkd.link.relay_link import RelayLink
from uavlinkd.link.relays import Relays
from uavlinkd.link.shown import shown
from uavlinkd.ops.causes import Cause
from uavlinkd.ops.findings import Finding, Subject
from uavlinkd.system.error_meanings import meaning_of

CONFIRM_S: Final = 2.0
"""A handshake that is not complete after this time is reported."""
RELAY_SILENT_S: Final = 5.0
"""A relay that does not answer for this long is reported with the peers that need it."""
_UNROUTED: Final = ("ENETUNREACH", "EHOSTUNREACH", "ENETDOWN", "EADDRNOTAVAIL", "EINVAL", "EMSGSIZE", "EAFNOSUPPORT")
"""Errors of sending that are certain: this machine's kernel reports them at once."""
_NOT_SENT: Final = (Cause.FIREWALL_HERE, Cause.NO_ROUTE)
_UNREACHABLE: Final = ("EHOSTUNREACH", "ENETUNREACH", "EACCES")
"""Errors that ICMP messages report, except a closed port."""


class Network(Protocol):
    """The parts of a daemon that know about its links."""

    config: Config
    links: dict[str, PeerLink]
    peer_sockets: PeerSockets
    relays: Relays
    evidence: Evidence
    history: History


def finding(cause: Cause, subject: Subject, name: str, text: str, remedy: str) -> Finding:
    """A finding with the severity of its cause."""
    return Finding(cause, cause.severity, subject, name, text, remedy)


def link_down(daemon: Network, link: PeerLink, now: float) -> list[Finding]:
    """Why a peer is not up: a line for each cause with evidence; without any, one about its silence."""
    not_sent = _not_sent(daemon, link.name, lambda kind: _seen(daemon, kind, link, now))
    certain = [*_configured(daemon, link), *not_sent, *_relays(daemon, link, now)]
    hints = list(_hints(daemon, link, now))
    if any(one.cause in _NOT_SENT for one in certain):  # then the peer gets no response to confirm
        hints = [one for one in hints if one.cause is not Cause.NOT_CONFIRMED]
    findings = [*certain, *_reported(daemon, link, now), *hints]
    if not findings and link.is_overdue(now):
        findings.append(_silence(daemon, link))
    return findings


# Certain: this machine.


def _configured(daemon: Network, link: PeerLink) -> Iterator[Finding]:
    name, sockets = link.name, daemon.peer_sockets
    if names := sorted(sockets.unresolved(name)):
        yield _unresolved(name, names)
    for path in link.peers[0].paths.configured:
        if path.host.startswith("fe80:") and path.address[-1] == 0:  # of a name: a file must have the interface
            text = f"{shown(path.address)} is valid on one interface only, and names none"
            remedy = f'write it with its interface, as in "[{path.host}%wlan0]:{path.address[1]}"'
            yield _about(Cause.ZONE_MISSING, name, text, remedy)
    if name in sockets.without_socket:
        text = f"no address in listen is of the family of {_addresses(link)}"
        remedy = 'add "[::]:5790" to listen for IPv6, "0.0.0.0:5790" for IPv4'
        if sockets.networks is not None:
            text = f"no network has an address from which to reach {_addresses(link)}"
            remedy = "compare the address families with `ip -brief address`"
        yield _about(Cause.FAMILY_MISSING, name, text, remedy)


def _unresolved(peer: str, names: list[str]) -> Finding:
    remedy = f"see `getent hosts {names[0]}`, or write an IP address; the daemon tries again each second"
    return _about(Cause.NAME_NOT_RESOLVED, peer, f"{', '.join(names)} has no address now", remedy)


def _not_sent(daemon: Network, peer: str, seen: Callable[[str], Sighting | None]) -> Iterator[Finding]:
    """Errors of sending to a peer, or to a relay that it needs. ``seen``: the evidence of a kind."""
    if (sighting := seen("EPERM")) is not None:
        text = f"this machine refuses to send to {_at(sighting)} (EPERM)"
        remedy = "allow outgoing UDP from the daemon's port: see `sudo nft list ruleset`"
        yield _about(Cause.FIREWALL_HERE, peer, text, remedy)
    if daemon.peer_sockets.absent_addresses():
        return  # reported once, for the daemon
    for error in _UNROUTED:
        if (sighting := seen(error)) is not None:
            text = f"this machine cannot send to {_at(sighting)} ({error})"
            yield _about(Cause.NO_ROUTE, peer, text, meaning_of(error))
            return


def _relays(daemon: Network, link: PeerLink, now: float) -> Iterator[Finding]:
    """The relays of a peer that has no other path: one that does not answer, or that the peer does not use."""
    relays = [daemon.relays.by_name[name] for name in link.config.relays if name in daemon.relays.by_name]
    if any(relay.peer.is_up and relay.state_for(link) == "bound" for relay in relays):
        return
    for relay in relays:
        name = relay.config.name
        if not relay.peer.is_up:
            here = list(_not_sent(daemon, link.name, partial(_seen_at_relay, daemon, relay, now)))
            if here:
                yield from here
                continue
        if not link.is_overdue(now):
            continue
        if relay.state_for(link) == "waiting":
            text = (
                f"{link.name} is not bound at the relay {name}: it is off, not a member, does not use it, or keys"
                " differ"
            )
            remedy = (
                f"start {link.name}; compare both public_key with `uavlinkd pubkey`; write a [[relay]] for {name}"
                " into its file, and a [[member]] for it into the file of the relay"
            )
            yield _about(Cause.NOT_BOUND, link.name, text, remedy)
        elif unresolved := sorted(daemon.peer_sockets.unresolved(relay.name)):
            yield _unresolved(link.name, unresolved)
        elif (psk := daemon.evidence.seen_of_relay(DropReason.BAD_HANDSHAKE, name, now)) is not None:
            yield _other_psk(link.name, f"the relay {name} at {_at(psk)}")
        elif now - relay.silent_since >= RELAY_SILENT_S:
            yield _no_relay(daemon, relay, link.name, now)


def _no_relay(daemon: Network, relay: RelayLink, peer: str, now: float) -> Finding:
    name = relay.config.name
    text = f"the relay {name} does not answer at {listed(map(str, relay.addresses))}: "
    remedy = (
        f"run `uavlinkd status` at {name}: it names the cause if datagrams arrive there; else open its"
        " firewall. `uavlinkd pubkey` there must print the public_key of the [[relay]] here, and this daemon"
        " must be a [[member]] there"
    )
    if _seen_at_relay(daemon, relay, now, f"{REPORTED}ECONNREFUSED") is not None:
        text += "no process listens there, or a firewall there rejects (ICMP)"
        remedy = f"start the relay, and compare its `listen` with the addresses of the [[relay]] here; or {remedy}"
    else:
        text += "it is off, the address is wrong, a firewall drops UDP, or keys or suites differ"
    return _about(Cause.RELAY_NOT_ANSWERING, peer, text, remedy)


# Hints: anything here may be forged.


def _reported(daemon: Network, link: PeerLink, now: float) -> Iterator[Finding]:
    if (sighting := _seen(daemon, f"{REPORTED}ECONNREFUSED", link, now)) is not None:
        text = f"no process listens at {_at(sighting)}, or a firewall there rejects (ICMP)"
        remedy = f"start uavlinkd at {link.name}, and compare its `listen` with `addresses` here"
        yield _about(Cause.NO_LISTENER, link.name, text, remedy)
    for error in _UNREACHABLE:
        if (sighting := _seen(daemon, REPORTED + error, link, now)) is not None:
            text = f"the network reports that {_at(sighting)} is not reachable ({error})"
            remedy = (
                f"switch {link.name} on, and compare its address with `addresses` here; see `ip route get ADDRESS`"
            )
            yield _about(Cause.HOST_UNREACHABLE, link.name, text, remedy)
            return


def _hints(daemon: Network, link: PeerLink, now: float) -> Iterator[Finding]:
    if (sighting := _handshake_seen(daemon, DropReason.UNKNOWN_PEER, link, now)) is not None:
        yield from _other_key(daemon, link, sighting)
    if (sighting := _handshake_seen(daemon, DropReason.OTHER_VERSION, link, now)) is not None:
        text, remedy = other_version(sighting, daemon.config.name, link.name)
        yield _about(Cause.OTHER_VERSION, link.name, text, remedy)
    elif (sighting := _handshake_seen(daemon, DropReason.BAD_MAC1, link, now)) is not None:
        # Not while another version is seen: above its limit such initiations are counted as bad_mac1 too.
        yield _our_key_there(daemon, link, sighting)
    psk = _seen(daemon, DropReason.BAD_HANDSHAKE, link, now)
    if psk is not None:
        yield _other_psk(link.name, _at(psk))
    if (sighting := _seen(daemon, DropReason.SUITE_NOT_ACCEPTED, link, now)) is not None:
        offered = ", ".join(str(suite) for suite in sighting.details)
        accepted = ", ".join(suite.name for suite in link.config.settings.link.suites)
        text = f"it offers the suite {offered}; this end accepts {accepted}"
        remedy = (
            f"write this end's suites at {link.name}, or stronger ones at both ends; never weaker ones: an old"
            " recording can cause this"
        )
        yield _about(Cause.NO_COMMON_SUITE, link.name, text, remedy)
    elif psk is None and now - link.silent_since >= CONFIRM_S and _has_unconfirmed(link):
        text = "it initiates, and does not confirm this daemon's responses"
        remedy = f"compare the PSKs; let UDP from this daemon through the firewall at {link.name}"
        yield _about(Cause.NOT_CONFIRMED, link.name, text, remedy)


def _other_psk(peer: str, sender: str) -> Finding:
    text = f"the response from {sender} does not authenticate: the PSKs differ, or only one end has one"
    remedy = "give both ends the same psk_file; never remove a PSK: the message may be forged"
    return _about(Cause.WRONG_PSK, peer, text, remedy)


def _other_key(daemon: Network, link: PeerLink, sighting: Sighting) -> Iterator[Finding]:
    name, keys = link.name, [key for key in sighting.details if isinstance(key, bytes)]
    former = [key for key in keys if key in daemon.history.former_keys or key == link.config.previous_public_key]
    if former:
        key = encode_key(former[-1])
        text = f"a sender at {_at(sighting)} uses the former key {key}, or an attacker replays an old recording"
        remedy = f"carry the new files to {name} and restart it; if the former key was stolen, this may be the thief"
        yield _about(Cause.FORMER_KEY, name, text, remedy)
    if others := [encode_key(key) for key in keys if key not in former and key != daemon.config.public_key]:
        which = "the key" if len(others) == 1 else f"{len(others)} keys, so at least one is not {name}:"
        text = f"a sender at {_at(sighting)} uses {which} {', '.join(others)}, which this file does not have"
        remedy = (
            f"run `uavlinkd pubkey` at {name}, and write into this file what that prints: a key that arrives proves"
            " nothing. After a change of keys, restart it with its new files"
        )
        yield _about(Cause.WRONG_KEY_HERE, name, text, remedy)


def _our_key_there(daemon: Network, link: PeerLink, sighting: Sighting) -> Finding:
    name, own = link.name, daemon.config.name
    if sighting.address is not None and daemon.peer_sockets.is_own(sighting.address):
        text = f"{_at(sighting)} in addresses leads to this daemon itself"
        return _about(Cause.OWN_ADDRESS, name, text, f"write the address of {name}")
    text = f"a sender at {_at(sighting)} does not know this daemon's public key: that end may have another key for it"
    remedy = (
        f'at {name}, write public_key = "{encode_key(daemon.config.public_key)}" for {own}; if its key file was'
        " replaced, restart this daemon"
    )
    return _about(Cause.WRONG_KEY_THERE, name, text, remedy)


def _silence(daemon: Network, link: PeerLink) -> Finding:
    name = link.name
    if link.config.addresses and all(written.is_serial for written in link.config.addresses):
        text = f"no answer along {_addresses(link)}: it is off or out of range, or keys or modem settings differ"
        remedy = (
            "compare the baud rate, NETID and air speed of both modems, and set MAVLINK=0; run `uavlinkd status` at"
            f" {name}: it names the cause if datagrams arrive there"
        )
        return _about(Cause.NO_ANSWER, name, text, remedy)
    if link.config.relays and not link.config.addresses:
        text = (
            f"no answer through a relay ({', '.join(link.config.relays)}): keys or PSKs differ, or it has just gone"
        )
        remedy = f"run `uavlinkd status` at {name}: it names the cause if datagrams arrive there"
        return _about(Cause.NO_ANSWER, name, text, remedy)
    if link.config.addresses:
        differ = "addresses, keys or protocol versions differ"
        text = f"no answer from {_addresses(link)}: it is off, a firewall drops UDP, or {differ}"
        remedy = (
            f"run `uavlinkd status` at {name}: it names the cause if datagrams arrive there; else open its firewall"
        )
        return _about(Cause.NO_ANSWER, name, text, remedy)
    text = f"{name} has not connected, and this file has no address of it"
    remedy = (
        f"start {name}, and write this daemon's address into its file, or its address into this one, or a [[relay]]"
        " into both"
    )
    return _about(Cause.NOT_CONNECTING, name, text, remedy)


# Evidence about one link.


def _seen(daemon: Network, kind: str, link: PeerLink, now: float) -> Sighting | None:
    """Evidence since the link went down."""
    sighting = daemon.evidence.seen(kind, link, now)
    return None if sighting is None or sighting.last_at < link.silent_since else sighting


def _seen_at_relay(daemon: Network, relay: RelayLink, now: float, kind: str) -> Sighting | None:
    """Evidence since the relay went silent."""
    sighting = daemon.evidence.seen_at_relay(kind, relay, now)
    return None if sighting is None or sighting.last_at < relay.silent_since else sighting


def _handshake_seen(daemon: Network, reason: DropReason, link: PeerLink, now: float) -> Sighting | None:
    """The same; of a peer without addresses, from any sender while it is the only such peer that is not up."""
    if link.config.addresses or link.relayed:
        return _seen(daemon, reason, link, now)
    sighting = daemon.evidence.seen_elsewhere(reason, now) if sole_waiting(daemon) is not None else None
    return None if sighting is None or sighting.last_at < link.silent_since else sighting


def sole_waiting(daemon: Network) -> PeerLink | None:
    """The only peer without addresses that is not up: a sender at an unknown address may be this one."""
    waiting = [link for link in daemon.links.values() if not link.config.addresses and not link.peer.is_up]
    return waiting[0] if len(waiting) == 1 else None


def _has_unconfirmed(link: PeerLink) -> bool:
    return any(peer.sessions.unconfirmed for peer in link.peers)


def _about(cause: Cause, name: str, text: str, remedy: str) -> Finding:
    return finding(cause, Subject.PEER, name, text, remedy)


def _at(sighting: Sighting) -> str:
    return "its address" if sighting.address is None else shown(sighting.address)


def _addresses(link: PeerLink) -> str:
    return listed(map(str, link.config.addresses))


def listed(names: Iterable[str], most: int = 4) -> str:
    """The first names of a list that an attacker may make long."""
    first = list(names)
    return ", ".join(first[:most]) + (f" and {len(first) - most} more" if len(first) > most else "")
