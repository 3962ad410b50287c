"""The daemon's status as metrics for Prometheus, in its text format 0.0.4. ``metrics.toml`` has a line for each.

Names follow https://prometheus.io/docs/practices/naming/: base units, and ``_total`` for counters. Label values are
names from the configuration or from certificates, and reasons from closed lists, so the network cannot increase their
number. A counter that shows an attack starts at zero: Prometheus cannot see an increase of a series that did not
exist before.

Points in time are exported as ages: a drone without a set clock knows how old a handshake is, but not its date.

``prometheus_client`` writes the format.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator, Mapping
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any, Final

from prometheus_client import CONTENT_TYPE_PLAIN_0_0_4, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.ops import METRICS_SCHEMA
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.path_state import PathCondition
from uavlinkd.protocol.settings import Class
from uavlinkd.relay.forwarding import RelayReason

CONTENT_TYPE = CONTENT_TYPE_PLAIN_0_0_4
LEARNED: Final = "learned"
"""The label of an address that is not configured: an attacker can cause learned paths with any address."""
UNKNOWN: Final = 255  # a modem's figure that it does not know

Status = dict[str, Any]
Part = tuple[tuple[str, ...], Status]
"""The values of the labels of a part of the daemon, and its part of the status."""

_RELAY_REASONS = (
    *(DropReason.RELAY_MALFORMED, DropReason.RELAY_UNKNOWN_HANDLE, DropReason.RELAY_OVER_LIMIT),
    *RelayReason,
)


def exposition(status: Status) -> bytes:
    """Write a status (:func:`uavlinkd.observe.status.daemon_status`) as the text that Prometheus reads."""
    # Not the global registry of the library, which measures the process its own way.
    return generate_latest(_StatusCollector(status))


class _StatusCollector(Collector):
    def __init__(self, status: Status) -> None:
        self._status = status

    def collect(self) -> Iterator[Metric]:
        """Every metric of the daemon. One without a sample is left out."""
        for part_of in _METRICS:
            present, labels = list(_PARTS[part_of["name"]](self._status)), part_of["labels"]
            for name, key, text, *more in part_of["metrics"]:
                make = CounterMetricFamily if name.endswith("_total") else GaugeMetricFamily
                family = make(f"uavlinkd_{name}", text, labels=[*labels, *more])
                for values, part in present:
                    value: Any = reduce(getitem, key.split("."), part)
                    for label, number in value.items() if more else [((), value)]:
                        if number is not None:
                            family.add_metric([*values, *([label] if isinstance(label, str) else label)], number)
                if family.samples:
                    yield family


# The parts of a status, with what is derived for their metrics.


def _daemon(status: Status) -> Iterator[Part]:
    process = status["process"]
    versions = status["schema"], process["log_schema"], METRICS_SCHEMA
    facts = {
        "finding": {tuple(finding[label] for label in _FINDING): 1 for finding in status["findings"]},
        "build": {(status["name"], process["version"], process["python"]): 1},
        "schemas": {tuple(map(str, versions)): 1},
    }
    yield (), status | facts


def _dropping(status: Status) -> Iterator[Part]:
    for name, part in {"": status, **status["peers"]}.items():
        yield (name,), {"drops": {reason: part["drops"].get(reason, 0) for reason in DropReason}}


def _peers(status: Status) -> Iterator[Part]:
    for name, peer in status["peers"].items():
        session = peer["session"] or {}
        facts = {
            "is_up": peer["state"] == "up",
            "is_unverified": peer["freshness_unverified_s"] is not None,
            "info": {tuple(str(session[label]) for label in _SESSION): 1} if session else {},
            "loss": _loss(peer) if session else {},
            "refusals": _refusals(peer),
            "said": dict.fromkeys(((problem,) for problem in peer["problems_there"]), 1),
        }
        yield (name,), peer | facts


def _paths(status: Status) -> Iterator[Part]:
    for name, peer in status["peers"].items():
        for path in peer["paths"]:
            address = path["address"] if path["is_configured"] else LEARNED
            facts = {
                "states": {state: path["state"] == state for state in PathCondition},
                "is_best": path["role"] == "best",
                "classes": {cls: cls in path["carries"] for cls in Class},
                "loss": _loss(path),
            }
            yield (name, str(path["number"]), path["network"] or "", address), path | facts


def _lines(status: Status) -> Iterator[Part]:
    for name, network in status["networks"].items():
        if (line := network["serial"]) is not None:
            yield (name,), line | {"is_open": network["is_present"], "rate_bytes_s": line["rate_bits_s"] / 8}


def _radios(status: Status) -> Iterator[Part]:
    """What a modem reports may be forged on the line: it becomes values, not labels."""
    for name, line in _lines(status):
        if line["radio"] is not None:
            radio = {key: None if figure == UNKNOWN else figure for key, figure in line["radio"].items()}
            facts = {key: {"here": radio[key], "there": radio[f"rem{key}"]} for key in ("rssi", "noise")}
            free = line["radio"]["txbuf"]
            yield name, radio | facts | {"free": free / 100 if free <= 100 else None}


def _endpoints(status: Status) -> Iterator[Part]:
    for name, endpoint in status["endpoints"].items():
        yield (name,), endpoint | {"clients": len(endpoint["clients"]), "refusals": _refusals(endpoint)}


def _fleet(status: Status) -> Iterator[Part]:
    if (fleet := status["fleet"]) is not None:
        yield (), fleet | {"members": len(fleet["held"]), "is_degraded": bool(fleet["problem"])}


def _relay(status: Status) -> Iterator[Part]:
    if (relay := status["relay"]) is not None:
        yield (), relay | {"drops": {reason: relay["dropped"].get(reason, 0) for reason in _RELAY_REASONS}}


def _relay_by_tls(status: Status) -> Iterator[Part]:
    for _, relay in _relay(status):
        if (https := relay["https"]) is not None:
            yield (), https | {"refused": dict.fromkeys(_STRANGERS, 0) | https["refused"]}


def _members(status: Status) -> Iterator[Part]:
    for _, relay in _relay(status):
        yield from (((name,), member) for name, member in relay["members"].items())


def _used_relays(status: Status) -> Iterator[Part]:
    for name, relay in status["relays"].items():
        states = {(peer, state): state == now for peer, now in relay["peers"].items() for state in _STATES}
        yield (name,), relay | {"is_up": relay["state"] == "up", "states": states}


def _loss(part: Status) -> dict[str, float]:
    return {"in": part["loss_in"], "out": part["loss_out"]}


def _refusals(part: Status) -> dict[tuple[str, str], int]:
    """By direction and reason, summed over the message types; the status has the counts of each type."""
    sums = {(direction, reason.value): 0 for direction in part["refused"] for reason in Refusal}
    for direction, messages in part["refused"].items():
        for counts in messages.values():
            for reason, count in counts.items():
                sums[direction, reason] += count
    return sums


_FINDING = ("cause", "severity", "subject", "name")
_SESSION = ("suite", "mode", "tag_bits")
_STRANGERS = ("displaced", "too_many_connections", "unproven", "slow_handshake")
_STATES = ("bound", "waiting", "unanswered")  # of a peer at a relay

_PARTS: Mapping[str, Callable[[Status], Iterator[Part]]] = {
    "daemon": _daemon,
    "drops": _dropping,
    "peer": _peers,
    "path": _paths,
    "line": _lines,
    "radio": _radios,
    "endpoint": _endpoints,
    "fleet": _fleet,
    "relay": _relay,
    "relay by TLS": _relay_by_tls,
    "member": _members,
    "used relay": _used_relays,
}
_METRICS = tomllib.loads(Path(__file__).with_name("metrics.toml").read_text("utf-8"))["part"]
