"""A status in words: one source for the screen of ``uavlinkd status`` and for the page of ``uavlinkd web``."""

from __future__ import annotations

import errno
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from typing import Any, Final, NamedTuple

from uavlinkd.mavlink.egress.lanes import EgressDrop
from uavlinkd.mavlink.frames import FrameFault
from uavlinkd.mavlink.policy.gate import WITHHELD, Refusal
from uavlinkd.ops.log import titled
from uavlinkd.protocol.drops import Attention, DropReason, LinkProblem, Reason
from uavlinkd.relay.forwarding import RelayReason
from uavlinkd.system.error_meanings import meaning_of

Status = dict[str, Any]
Count = tuple[str, int]
"""A reason in plain words, and how often."""

ENDPOINT_FAILURES: Final[Mapping[str, str]] = {
    "unsent": "unsent frames",
    "outgoing_full": "frames above the queue's limit",
    "stale": "frames that waited too long",
    "thinned": "frames replaced by newer ones",
    "disconnected": "disconnected",
    "stalled": "stalled connections",
    "too_many_clients": "clients above the limit",
    "displaced": "silent clients replaced",
    "http": "web browsers",
    "connect_timeout": "attempts without an answer",
    "not_resolved": "attempts without an address",
    "family_unavailable": "addresses of an unavailable family",
    "stranger": "datagrams of another address",
    "other_port": "datagrams of another port of the client's host",
    "unsigned": "unsigned frames",
    "bad_signature": "frames with a wrong signature",
    "replayed": "signed frames with an old timestamp",
    "reflected": "own frames that came back",
    "not_proven": "frames before the key was proved",
    "mavlink1_not_signed": "MAVLink 1 frames, which have no signatures",
    "too_many_senders": "frames of more senders than an autopilot remembers",
}
"""Errors of an endpoint that the daemon names itself; the others are names of the kernel."""
_NOT_USABLE: Final = {"unanswered": "no answer", "loss": "loss", "network": "no network"}
"""Why a path is not usable, in plain words."""
_EXPLAINED: Final = frozenset[str](reason for reason in DropReason if reason.attention is Attention.EXPLAINED)
"""What the log never has a line about: copies, and frames while the link was down, which a finding explains."""
_SHOWN_REASONS: Final = 3
_SHOWN_NAMES: Final = 8


_ABSENT: Final[Mapping[str, object]] = {
    "state": "waiting",
    "path": None,
    **dict.fromkeys(("last_received_s", "freshness_unverified_s", "round_trip_s", "role")),
    "commands": {"in": False, "out": False},
    "vehicles": (),
    "paths": (),
    **dict.fromkeys(("loss_in", "loss_out", "bytes_in_s", "bytes_out_s"), 0.0),
}
"""The facts of a peer that has not come yet."""


class Phrase(NamedTuple):
    """A part of the headline."""

    text: str
    is_good: bool


class ProblemLine(NamedTuple):
    """One line: a cause and its remedy, of all that have the same problem."""

    severity: str
    peers: list[str]
    """Empty for the daemon and its endpoints."""
    who: str
    """The peers or endpoints, in words; empty for the daemon."""
    text: str
    remedy: str


def peers_of(status: Status) -> dict[str, Status]:
    """All peers by name, with the members of the fleet that have not come since the daemon's start."""
    absent: dict[str, str] = (status["fleet"] or {"absent": {}})["absent"]
    peers: dict[str, Status] = status["peers"]
    return {name: {"public_key": key, **_ABSENT} for name, key in absent.items()} | peers


def headline(status: Status) -> Iterator[Phrase]:
    """How many are up, and what stops frames although they are."""
    peers = peers_of(status).values()
    relay = status["relay"]
    counts = []
    if peers or relay is None:
        counts.append(f"{sum(peer['state'] == 'up' for peer in peers)} of {len(peers)} peers up")
    if relay is not None:
        members = relay["members"].values()
        counts.append(f"relay: {sum(member['is_up'] for member in members)} of {len(members)} members up")
    yield Phrase(", ".join(counts), status["frames_pass"])
    for blocked in status["blocked"]:
        towards = "from" if blocked["direction"] == "in" else "to"
        yield Phrase(f"all frames {towards} {blocked['name']} are refused", False)
    if status["has_no_client"]:
        yield Phrase("no endpoint has a client", False)
    for key, words in (
        ("contested", "two machines use one key with"),
        ("stopped_there", "frames stop, as reported by"),
    ):
        if status[key]:
            yield Phrase(f"{words} {some(status[key])}", False)


def problems(findings: Iterable[Mapping[str, str]]) -> list[ProblemLine]:
    """A line per problem, security first. A problem of several, such as a silent relay, is one line."""
    several: dict[tuple[str, ...], list[str]] = {}
    for finding in findings:
        key = tuple(finding[field] for field in ("severity", "subject", "text", "remedy"))
        several.setdefault(key, []).append(finding["name"])
    prefixes = {"peer": "", "endpoint": "endpoint "}
    return [
        ProblemLine(
            severity,
            names if subject == "peer" else [],
            prefixes[subject] + some(names) if subject in prefixes else "",
            text,
            remedy,
        )
        for (severity, subject, text, remedy), names in several.items()
    ]


def some(names: Sequence[str]) -> str:
    more = f" and {len(names) - _SHOWN_NAMES} more" if len(names) > _SHOWN_NAMES else ""
    return ", ".join(names[:_SHOWN_NAMES]) + more


def fleet_line(fleet: Status) -> Phrase:
    """This daemon in its fleet, with the peers whose bulletin has another number."""
    number = fleet["number"]
    who = f"{titled(str(fleet['role']), str(fleet['name']))}, serial {fleet['serial']}"
    text = f"fleet {fleet['fleet']}: {who}; bulletin {number}"
    other = [f"{name} has {its}" for name, its in fleet["bulletins"].items() if its not in (None, number)]
    return Phrase(f"{text}, but {some(other)}", False) if other else Phrase(text, True)


def used_relay(name: str, relay: Status) -> Phrase:
    """A relay that this daemon uses, with the state of each peer there."""
    time_s = relay["round_trip_s"]
    measured = "" if time_s is None else f", {1000 * time_s:.0f} ms"
    peers = ", ".join(f"{peer} {state}" for peer, state in relay["peers"].items()) or "no peer uses it"
    is_well = relay["state"] == "up" and "unanswered" not in relay["peers"].values()
    role = "" if relay["peer"] is None else f", also the peer {relay['peer']}"
    by_tls = " by TLS" if relay["state"] == "up" and relay["paths"][0]["network"] == "TLS" else ""
    return Phrase(f"{titled('relay', name)}{role}: {relay['state']}{by_tls}{measured}; {peers}", is_well)


def other_losses(status: Status) -> Iterator[str]:
    """What was dropped and is in no line of a peer or endpoint."""
    relay = status["relay"]
    if relay is not None and (text := listed(by_count(relay["dropped"], DropReason, RelayReason))):
        yield f"not forwarded: {text}"
    if dropped := listed(_dropped(status)):
        yield f"dropped, from no known peer: {dropped}"
    for error, count in ranked(list(status["send_failures"].items()))[:_SHOWN_REASONS]:
        yield f"not sent: {count:,}, because {meaning_of(error) or error}"
    if stale := sum(status["stale"].values()):
        yield f"dropped after a pause of the daemon: {stale:,} frames"


def condition(path: Status) -> str:
    """A closed path by TLS is no failure: it is not needed, or a problem of the relay names it."""
    return "closed" if path["reason"] == "closed" else str(path["state"])


def path_state(path: Status) -> str:
    """The role of a usable path; of another one, what is wrong."""
    if path["state"] == "usable":
        return str(path["role"])
    if condition(path) == "closed":
        return "not connected"
    reason = _NOT_USABLE.get(path["reason"])
    return f"{path['state']}: {reason}" if reason else str(path["state"])


def carried(path: Status) -> str:
    """The classes of frames that go along a path now."""
    return "all" if len(path["carries"]) == 3 else "+".join(path["carries"]) or "-"


def repair_line(repair: Status) -> str:
    """What the repair of a lossy link does. Its duration is in the status."""
    kilobytes = f"{repair['bytes'] / 1000:,.0f} kB repeated so far"
    return f"sends critical frames {repair['transmissions']} times; {kilobytes}"


def network_exit(network: Status) -> str:
    """The interface, address or device of a network."""
    line = network["serial"]
    return str(network["interface"] or network["address"] or f"{line['device']} at {line['baud']} baud")


def network_text(network: Status) -> str:
    """This machine's addresses on a network, or what is known about its radio; why it is absent."""
    if not network["is_present"]:
        return f"absent: {network['absent_because']}"
    line = network["serial"]
    return ", ".join(network["addresses"]) if line is None else _radio_line(line)


def _radio_line(line: Status) -> str:
    """What is known about the radio behind a serial device. Pairs of numbers are here/there."""
    parts = [f"up to {line['rate_bits_s']:,} bits/s", f"{line['line_noise']:,} damaged"]
    if (radio := line["radio"]) is not None:
        parts += [
            f"rssi {radio['rssi']}/{radio['remrssi']}",
            f"noise {radio['noise']}/{radio['remnoise']}",
            f"modem {100 - radio['txbuf']} % full" if radio["txbuf"] <= 100 else "modem's queue unknown",
        ]
    return ", ".join(parts)


# What was dropped or refused.


def web_line(https: Status) -> str:
    """Where a relay listens for TLS, who is connected, and why strangers were refused: codes of README.md."""
    members, strangers = https["connections"] - https["strangers"], https["strangers"]
    refused = listed([(reason.replace("_", " "), count) for reason, count in https["refused"].items()])
    text = f"by TLS at {https['address']}: {members:,} members, {strangers:,} strangers"
    return f"{text}; refused so far: {refused}" if refused else text


def peer_drops(peer: Status) -> list[Count]:
    """All reasons of a peer. Missing envelopes are in its losses."""
    return [
        *_dropped(peer),
        *by_count(peer["malformed"], FrameFault),
        *by_count(peer["waiting_dropped"], EgressDrop),
        *_refused(peer),
    ]


def _dropped(part: Status) -> list[Count]:
    drops = part["drops"].items()
    return by_count({reason: count for reason, count in drops if reason not in _EXPLAINED}, DropReason)


def withheld(part: Status) -> str:
    """How many frames the policy of a peer or endpoint withholds from it, which is no problem; empty if none."""
    count = sum(count for reason, count in _by_reason(part, "out").items() if reason in WITHHELD)
    return f"{count:,} frames, by its role or lists" if count else ""


def overtaken(peer: Status) -> str:
    """How many envelopes with frames arrived after later ones; empty if none did."""
    count, received = peer[LinkProblem.ENVELOPES_OUT_OF_ORDER], peer["envelopes_received"]
    text = f"{count:,} of {received:,} envelopes, {100 * count / max(1, count, received):.2g} %"
    return f"{text} (repair, a change or the death of a path)" if count else ""


def endpoint_drops(endpoint: Status) -> list[Count]:
    """All reasons of a local endpoint."""
    return by_count(endpoint["faults"], FrameFault) + by_count(endpoint["failures"]) + _refused(endpoint)


def signing_lines(status: Status) -> Iterator[Phrase]:
    """Each endpoint that signs, and whether its autopilot proves the key."""
    for name, endpoint in status["endpoints"].items():
        if (signing := endpoint["signing"]) is not None:
            is_verified, link_id = signing["is_verified"], signing["link_id"]
            result = "proves" if is_verified else "does not prove"
            yield Phrase(f"{name} signing: the autopilot {result} the key, link id {link_id}", is_verified)


def _refused(part: Status) -> list[Count]:
    """What the policy refused: all that came from there, and what hides a forbidden frame."""
    sums = _by_reason(part, "out")
    hidden = Counter({reason: count for reason, count in sums.items() if reason not in WITHHELD})
    return by_count(_by_reason(part, "in") + hidden, Refusal)


def _by_reason(part: Status, direction: str) -> Counter[str]:
    sums = Counter[str]()
    for reasons in part["refused"].get(direction, {}).values():
        sums.update(reasons)
    return sums


def phrase(code: str, *lists: Iterable[Reason]) -> str:
    """A reason in plain words, for a count in front; an error of the kernel in the system's words."""
    for reason in chain(*lists):
        if reason == code and reason.phrase:
            return reason.phrase
    if code in ENDPOINT_FAILURES:
        return ENDPOINT_FAILURES[code]
    return os.strerror(getattr(errno, code)).lower() if hasattr(errno, code) else code.replace("_", " ")


def by_count(counts: Mapping[str, int], *lists: Iterable[Reason]) -> list[Count]:
    return [(phrase(code, *lists), count) for code, count in counts.items() if count]


def ranked(counts: list[Count]) -> list[Count]:
    """The most frequent reasons first, after hidden frames: a captured member could hide these by other refusals."""
    return sorted(counts, key=lambda item: (item[0] != Refusal.HIDDEN_FRAME.phrase, -item[1]))


def listed(counts: list[Count]) -> str:
    ordered = ranked(counts)
    text = ", ".join(f"{count:,} {reason}" for reason, count in ordered[:_SHOWN_REASONS])
    return text + (", …" if len(ordered) > _SHOWN_REASONS else "")
