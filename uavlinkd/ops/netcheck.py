"""``uavlinkd netcheck``: which relays answer, how NAT maps this daemon's sockets, and what that means.

The terms are those of RFC 4787 and RFC 5780. Relays report the source address that they see; what they cannot show is
reported as unknown.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from typing import Any, Final

NO_NAT: Final = "no NAT"
INDEPENDENT: Final = "endpoint-independent"
DEPENDENT: Final = "address- and port-dependent"
UNKNOWN: Final = "unknown"

MEANINGS: Final = {
    NO_NAT: "peers can connect directly, unless a firewall in between drops what it did not ask for",
    INDEPENDENT: "most peers can connect directly. Two ends whose NATs both map like this always can",
    DEPENDENT: (
        "a peer can connect directly only if its own NAT, or none, lets any port in. With most others frames stay on"
        " the relay"
    ),
    UNKNOWN: (
        "one address of one relay cannot show how the NAT maps. Give the relay a second port in its `listen` and in"
        " the members' `addresses`, or add a second relay"
    ),
}

Answer = Mapping[str, Any]


def report(answer: Answer) -> Iterator[str]:
    """The lines of the report for a daemon's answer."""
    relays = answer["relays"]
    if not relays:
        yield "This file has no [[relay]]: netcheck asks relays how they see this machine. Add one (README, Relays)"
        return
    up = [name for name, relay in relays.items() if relay["state"] == "up"]
    yield f"UDP          {'gets out' if up else 'gets no answer'}: {len(up)} of {len(relays)} relays answer"
    for name, relay in relays.items():
        round_trip = f", {1000 * relay['round_trip_s']:.0f} ms" if relay["round_trip_s"] is not None else ""
        yield f"relay        {name}: {relay['state']}{round_trip if name in up else ''}"
    for view in answer["views"]:
        network = f" on {view['network']}" if view["network"] else ""
        yield f"seen as      {view['seen_as']} by {view['relay']} at {view['relay_address']}{network}"
    for where, mapping in mappings(answer).items():
        yield f"mapping      {mapping} on {where}" if where else f"mapping      {mapping}"
        yield f"             {MEANINGS[mapping]}"
    yield "filtering    unknown: relays do not send from a second address"
    yield f"candidates   {', '.join(answer['candidates']) or 'none'}"
    if not up:
        yield "No relay answers: compare addresses and public_key with the relay, and let UDP through the firewalls"


def mappings(answer: Answer) -> dict[str | None, str]:
    """The mapping behaviour (RFC 4787, section 4.1) in front of each network, as far as the views show it."""
    by_socket = defaultdict[int, dict[str, str]](dict)
    networks: dict[int, str | None] = {}
    for view in answer["views"]:
        by_socket[view["socket"]][view["relay_address"]] = view["seen_as"]
        networks[view["socket"]] = view["network"]
    return {networks[socket]: _mapping(seen, answer["own"]) for socket, seen in by_socket.items()}


def _mapping(seen: Mapping[str, str], own: list[str]) -> str:
    if all(place in own for place in seen.values()):
        return NO_NAT
    if len(seen) < 2:
        return UNKNOWN
    return INDEPENDENT if len(set(seen.values())) == 1 else DEPENDENT
