"""The output of ``uavlinkd netcheck``: which relays answer, and how they see this daemon."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from textwrap import fill
from typing import Any

from uavlinkd.system.error_meanings import web_problem

Answer = Mapping[str, Any]


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


def report(answer: Answer) -> Iterator[str]:
    """The lines of ``netcheck``: whether UDP and TLS reach each relay, and the public addresses of this daemon."""
    relays = answer["relays"]
    if not relays:
        yield (
            "This file has no [[relay]]: netcheck asks relays how they see this machine. To add one, see"
            " uavlinkd/relay/README.md"
        )
        if answer["is_relay"]:
            yield "This daemon is a relay itself: run netcheck at its members"
        return
    for name, relay in relays.items():
        yield f"UDP          {name}: {_by_udp(relay)}"
        for address in relay["silent"]:
            yield f"             no answer at {address}"
    for url, result in answer["web"].items():
        through = f" through the proxy {result['proxy']}" if result["proxy"] else ""
        yield f"TLS          {url}{through}: {_by_tls(result['error'])}"
    for name, relay in relays.items():
        for view in relay["views"]:
            network = f" on {view['network']}" if view["network"] else ""
            yield f"seen as      {view['seen_as']} by {name} at {view['relay_address']}{network}"
    if any(relay["silent"] or not relay["is_udp"] for relay in relays.values()):
        yield "`uavlinkd status` here and at the relay names the cause"


def _by_udp(relay: Answer) -> str:
    if relay["is_udp"]:
        return "answers" if relay["round_trip_s"] is None else f"answers, {1000 * relay['round_trip_s']:.0f} ms"
    if names := relay["unresolved"]:
        return f"{', '.join(names)} has no address now: see `getent hosts {names[0]}`"
    return "does not answer; it does by TLS" if relay["state"] == "up" else "does not answer"


def _by_tls(error: str) -> str:
    return ": ".join(filter(None, web_problem(error))) if error else "connects"


def folded(line: str) -> str:
    """Fold a line of the report to 80 columns, beside its label. Names and addresses stay whole."""
    indent = " " * 13 if line[11:13] == "  " else ""
    return fill(line, 80, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
