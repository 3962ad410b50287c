"""The answers of a daemon that a test makes up. ``test_overview.py`` compares them with those of a real one."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from uavlinkd.ops import STATUS_SCHEMA

Status = dict[str, Any]


def overview(names: Iterable[str] = ("drone1",), **facts: object) -> Status:
    """Peers that are up, each with one path, and ``facts`` in place of those of the daemon."""
    return {
        "schema": STATUS_SCHEMA,
        "name": "ground",
        "public_key": "eZPBKM+9Oztdms1v2yiR+byync+zZsR87etuOX4heHE=",
        "monotonic_s": 1000.0,
        "frames_pass": True,
        "blocked": [],
        "has_no_client": False,
        "contested": [],
        "stopped_there": [],
        "findings": [],
        "peers": {name: few_facts() for name in names},
        "relays": {},
        "fleet": None,
        "networks": {},
        "endpoints": {},
        "drops": {},
        "faults": {},
        "stale": {},
        "unrouted": {},
        "send_failures": {},
        "relay": None,
        **facts,
    }


def few_facts(**facts: object) -> Status:
    """A peer that is up."""
    measured = {"round_trip_s": 0.02, "loss_in": 0.0, "loss_out": 0.25, "bytes_in_s": 1000.0, "bytes_out_s": 500.0}
    address = "10.0.0.1:5790"
    where = {"number": 0, "network": None, "address": address, "relay": None}
    path = where | {"state": "usable", "reason": "", "role": "stream", "answered_s": 0.2} | measured
    rules = {"role": "vehicle", "commands": {"in": False, "out": True}}
    what = {"state": "up", "path": address, "last_received_s": 0.1, "freshness_unverified_s": None, "vehicles": []}
    return what | rules | {"paths": [path], **measured, **facts}
