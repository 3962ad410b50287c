"""The output of ``uavlinkd netcheck``: which relays answer, and how they see this daemon."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
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
        yield "no [[relay]] in this file: netcheck asks relays how they see this machine (uavlinkd/relay/README.md)"
        return
    is_complete = True
    for name, relay in relays.items():
        by_udp = [path for path in relay["paths"] if path["network"] != "TLS"]
        answers = any(path["state"] == "usable" for path in by_udp) and relay["state"] == "up"
        time_s = relay["round_trip_s"]
        what = "answers" if time_s is None else f"answers, {1000 * time_s:.0f} ms"
        what_else = "does not answer; it does by TLS" if relay["state"] == "up" else "does not answer"
        yield f"UDP          {name}: {what if answers else what_else}"
        silent = [path for path in by_udp if path["is_configured"] and path["state"] != "usable"]
        yield from (f"             no answer at {path['address']}" for path in silent)
        is_complete = is_complete and answers and not silent
    for url, result in answer["web"].items():
        through = f" through the proxy {result['proxy']}" if result["proxy"] else ""
        problem = ": ".join(filter(None, web_problem(result["error"]))) if result["error"] else "connects"
        yield f"TLS          {url}{through}: {problem}"
    yield from (f"seen as      {seen} by {name}" for name, relay in relays.items() for seen in relay["seen_as"])
    if not is_complete:
        yield "open the UDP port in the relay's firewall and its provider's; `uavlinkd status` at both says more"
