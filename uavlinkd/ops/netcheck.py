"""What ``uavlinkd ping`` and ``netcheck`` print: which paths and relays answer, and what NATs do to direct paths.

The terms are those of RFC 4787 and RFC 5780. Relays report the source address that they see, and send a token from
another port; what they cannot show is reported as unknown.
"""

from __future__ import annotations

import json
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import StrEnum
from itertools import combinations
from textwrap import fill
from typing import Any, Final

from uavlinkd.ops.findings import IS_REACHABLE
from uavlinkd.system.error_meanings import web_problem
from uavlinkd.system.terminal import printable

INTERVAL_S: Final = 1.0  # between the questions of `ping`

Answer = Mapping[str, Any]


def ping(ask: Callable[[], Answer], count: int, *, as_json: bool = False) -> bool:
    """Ask along every path ``count`` times, a second apart, and print a line for each answer that came or did not.

    ``ask`` sends the questions, and returns the paths as they were before. Returns whether the last question was
    answered along any path.
    """
    ask()
    answered = False
    for number in range(1, count + 1):
        time.sleep(INTERVAL_S)
        paths = ask()["paths"]  # also the next questions
        # A younger answer is one to the last question, which is an interval old.
        times = [path["answered_s"] for path in paths]
        answers = [time_s is not None and time_s < 1.5 * INTERVAL_S for time_s in times]
        answered = any(answers)
        if as_json:
            print(json.dumps({"number": number, "paths": paths}), flush=True)
            continue
        for path, address, is_answered in zip(paths, addresses(paths), answers, strict=True):
            no_answer = "not connected" if path["reason"] == "closed" else "no answer"
            facts = [
                address if path["relay"] is not None else f"direct to {address}",
                f"{1000 * path['round_trip_s']:.1f} ms" if is_answered else no_answer,
                f"loss {100 * path['loss_in']:.0f} % in, {100 * path['loss_out']:.0f} % out",
                f"carries {' and '.join(path['carries'])}" if path["carries"] else "carries no frames",
            ]
            if path["network"]:
                facts[0] += f" on {path['network']}"
            print(printable(f"{number}: {', '.join(facts)}"), flush=True)
        if not paths:
            print(
                f"{number}: no path is known: the peer has not connected, or no relay has bound it;"
                " `uavlinkd status` names the cause",
                flush=True,
            )
    return answered


def addresses(paths: Sequence[Answer]) -> list[str]:
    """The address of each path. Relayed paths that look alike have the relay's address too, or else their number.

    Two paths along one port of a relay lead to two addresses of the peer, which only the relay knows.
    """
    names = [path["address"] for path in paths]
    for fact, word in (("relay_address", "at"), ("number", "path")):
        times = Counter((path["network"], name) for path, name in zip(paths, names, strict=True))
        for at, path in enumerate(paths):
            if path["relay"] is not None and times[path["network"], names[at]] > 1 and path.get(fact) is not None:
                names[at] += f" {word} {path[fact]}"
    return names


class Mapped(StrEnum):
    """Which address a NAT gives to one socket for different destinations (RFC 4787, section 4.1)."""

    NO_NAT = "no NAT"
    INDEPENDENT = "endpoint-independent"
    NOT_BY_PORT = "endpoint-independent or address-dependent"
    BY_ADDRESS = "address-dependent"
    BY_EITHER = "address-dependent or address- and port-dependent"
    BY_PORT = "address- and port-dependent"
    UNKNOWN = "unknown"


class Filtered(StrEnum):
    """What a NAT or a firewall lets in (RFC 4787, section 5)."""

    NOT_BY_PORT = "endpoint-independent or address-dependent"
    BY_PORT = "address- and port-dependent"
    UNKNOWN = "unknown"


ANY_PEER = "every peer that UDP reaches can connect directly, also from behind a NAT that changes ports"
MOST_PEERS = "a peer can connect directly, unless its own NAT changes ports for each destination"
STABLE_PEERS = (
    "a peer can connect directly, if its own NAT does not change ports for each destination. What is let in here is"
    " unknown: no relay could show it"
)
FEW_PEERS = (
    "a peer can connect directly only if its own NAT or firewall does not filter by port. With most others, frames"
    " stay on the relay"
)
ONE_VIEW = (
    "one address of one relay cannot show how the NAT maps. Give the relay a second port in its `listen` and in the"
    " members' `addresses`, or add a second relay"
)
ONE_HOST = (
    "peers can probably connect directly. One relay cannot show whether the NAT changes ports for each address: add a"
    " second relay on another host"
)


BLOCKED = (
    "No UDP comes back from any of these hosts, so something near this machine probably drops it. Try another"
    " network, or let UDP to the ports of the relays, and back, through the firewalls here. If this daemon is new to"
    " the relays, it must be a [[member]] there, or of their fleet and not revoked: `uavlinkd status` there shows"
    " what arrives"
)
NO_RELAY = (
    "No relay answers: it is off, a firewall drops UDP here or there, or this daemon is neither its [[member]] nor of"
    " its fleet. Compare addresses and public_key. `uavlinkd status` here and there names the cause"
)
BY_TLS = (
    "TLS works where UDP does not: a firewall drops it, or the address for UDP is wrong or missing. TCP delivers late"
    " what UDP would lose, so let UDP through where you can"
)
ONE_RELAY = (
    "UDP gets out, so the cause is at the silent relay or close to it: it is off, its address or public_key is wrong,"
    " it has no [[member]] for this daemon, which is not of its fleet or revoked, or a firewall there drops UDP."
    " `uavlinkd status` there names the cause"
)
ONE_PORT = (
    "The same host answers at another port: let UDP to the silent port through the firewalls here and there, or"
    " correct `listen` of the relay, or `addresses` here"
)
_ICMP: Final = {"": "", "ECONNREFUSED": " (ICMP: no process listens there)"}
_UNREACHABLE: Final = " (ICMP: not reachable)"


def report(answer: Answer) -> Iterator[str]:
    relays = answer["relays"]
    if not relays:
        yield (
            "This file has no [[relay]]: netcheck asks relays how they see this machine. To add one, see"
            " uavlinkd/relay/README.md"
        )
        if answer["is_relay"]:
            yield "This daemon is a relay itself: run netcheck at its members"
        return
    down = [name for name, relay in relays.items() if not relay["is_udp"]]
    up = len(relays) - len(down)
    ports = [one["address"] for relay in relays.values() for one in relay["silent"] if one["host_answers"]]
    yield f"UDP          {_headline(answer, down, ports)}"
    for name, relay in relays.items():
        yield f"relay        {name}: {relay['state']}{_about(relay)}"
    for url, result in answer["web"].items():
        through = f" through the proxy {result['proxy']}" if result["proxy"] else ""
        yield f"TLS          {url}{through}: {_outcome(result['error'])}"
    for view in answer["views"] if up else ():
        network = f" on {view['network']}" if view["network"] else ""
        yield f"seen as      {view['seen_as']} by {view['relay']} at {view['relay_address']}{network}"
    for where, mapped, filtered in behaviours(answer) if up else ():
        on_network = f" on {where}" if where else ""
        yield f"mapping      {mapped}{on_network}"
        yield f"filtering    {filtered}{on_network}"
        yield f"             {meaning(mapped, filtered)}"
    yield f"candidates   {', '.join(answer['candidates']) or 'none'}"
    if answer["is_udp_blocked"]:
        yield BLOCKED
    elif down and all(relays[name]["state"] == "up" for name in down):
        yield BY_TLS
    elif any(not relays[name]["unresolved"] for name in down):
        yield ONE_RELAY if up or answer["other"] else NO_RELAY
    if ports:
        yield ONE_PORT
    silent = [one for name in down for one in relays[name]["silent"]]
    if hosts := [_host(one["address"]).strip("[]") for one in silent if not (one["host_answers"] or one["icmp"])]:
        yield IS_REACHABLE.format(hosts[0])


def _headline(answer: Answer, down: list[str], ports: list[str]) -> str:
    count = len(answer["relays"])
    counted = f"{count - len(down)} of {count} relays answer"
    if answer["is_udp_blocked"]:
        return f"is probably blocked here: none of {count} relays on different hosts answers"
    if len(down) == count:
        other = answer["other"]
        return f"gets out: {other} answers directly, no relay does" if other else f"gets no answer: {counted}"
    if down:
        return f"gets out: {counted}; {', '.join(down)} alone {'does' if len(down) == 1 else 'do'} not"
    if ports:
        which = "one port does" if len(ports) == 1 else f"{len(ports)} ports do"
        return f"gets out: {counted}; {which} not: {', '.join(ports)}"
    return f"gets out: {counted}"


def _outcome(error: str) -> str:
    return ": ".join(filter(None, web_problem(error))) if error else "connects"


def folded(line: str) -> str:
    """Fold a line of the report to 80 columns, beside its label. Names and addresses stay whole."""
    indent = " " * 13 if line[11:13] == "  " else ""
    return fill(line, 80, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)


def _about(relay: Answer) -> str:
    """How fast a relay answers; where it does not, and what ICMP messages report there."""
    about, silent = "", [one["address"] + _ICMP.get(one["icmp"], _UNREACHABLE) for one in relay["silent"]]
    if relay["state"] == "up":
        about = "" if relay["is_udp"] else " by TLS"
        about += f", {1000 * relay['round_trip_s']:.0f} ms" if relay["round_trip_s"] is not None else ""
    elif names := relay["unresolved"]:
        return f"; {', '.join(names)} has no address now: see `getent hosts {names[0]}`"
    else:
        silent = silent or relay["addresses"]
    return f"{about}; no answer at {', '.join(silent)}" if silent else about


def behaviours(answer: Answer) -> Iterator[tuple[str | None, Mapped, Filtered]]:
    """Mapping and filtering in front of each socket, with the name of its network, as far as relays show them."""
    seen = defaultdict[int, dict[str, str]](dict)
    networks: dict[int, str | None] = {}
    passes = defaultdict[int, set[bool | None]](set)
    for view in answer["views"]:
        seen[view["socket"]][view["relay_address"]] = view["seen_as"]
        networks[view["socket"]] = view["network"]
    for result in answer["filtering"]:
        passes[result["socket"]].add(result["other_port_passes"])
    for socket, by_relay in seen.items():
        yield networks[socket], _mapped(by_relay, answer["own"]), _filtered(passes[socket])


def _mapped(seen: Mapping[str, str], own: list[str]) -> Mapped:
    if all(place in own for place in seen.values()):
        return Mapped.NO_NAT
    pairs = [(_host(one) == _host(other), seen[one] == seen[other]) for one, other in combinations(seen, 2)]
    at_one_host = [is_same for is_one_host, is_same in pairs if is_one_host]
    at_others = [is_same for is_one_host, is_same in pairs if not is_one_host]
    if not all(at_one_host):
        return Mapped.BY_PORT
    if at_others:
        return Mapped.INDEPENDENT if all(at_others) else Mapped.BY_ADDRESS if at_one_host else Mapped.BY_EITHER
    return Mapped.NOT_BY_PORT if at_one_host else Mapped.UNKNOWN


def _host(address: str) -> str:
    return address.rpartition(":")[0]


def _filtered(passes: set[bool | None]) -> Filtered:
    """A token that arrives is evidence. One that does not may have been dropped at the relay."""
    if True in passes:
        return Filtered.NOT_BY_PORT
    return Filtered.BY_PORT if False in passes else Filtered.UNKNOWN


def meaning(mapped: Mapped, filtered: Filtered) -> str:
    match mapped, filtered:
        case ((Mapped.BY_ADDRESS | Mapped.BY_EITHER | Mapped.BY_PORT), _):
            return FEW_PEERS
        case Mapped.UNKNOWN, _:
            return ONE_VIEW
        case Mapped.NOT_BY_PORT, _:
            return ONE_HOST
        case _, Filtered.NOT_BY_PORT:
            return ANY_PEER
        case _, Filtered.BY_PORT:
            return MOST_PEERS
    return STABLE_PEERS
