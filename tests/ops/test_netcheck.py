"""``uavlinkd netcheck``: what it concludes from what relays see."""

from __future__ import annotations

from typing import Any

import pytest

from uavlinkd.ops.netcheck import DEPENDENT, INDEPENDENT, MEANINGS, NO_NAT, UNKNOWN, mappings, report

PRIVATE, PUBLIC = "192.168.1.5:5790", "203.0.113.7:40001"


def view(relay: str, at: str, seen_as: str, **more: Any) -> dict[str, Any]:
    """How a relay sees a socket."""
    return {"relay": relay, "relay_address": at, "socket": 0, "network": None, "seen_as": seen_as, **more}


def answer(*views: dict[str, Any], state: str = "up") -> dict[str, Any]:
    """A daemon's answer with these views, of the relays that they name."""
    relays = {name: {"state": state, "round_trip_s": 0.0234} for name in ("one", "two")}
    return {"relays": relays, "views": list(views), "candidates": [PUBLIC, PRIVATE], "own": [PRIVATE]}


@pytest.mark.parametrize(
    ("views", "mapping"),
    [
        ((("one", "a:1", PRIVATE),), NO_NAT),
        ((("one", "a:1", PRIVATE), ("two", "b:1", PRIVATE)), NO_NAT),
        ((("one", "a:1", PUBLIC),), UNKNOWN),
        ((("one", "a:1", PUBLIC), ("two", "b:1", PUBLIC)), INDEPENDENT),
        ((("one", "a:1", PUBLIC), ("one", "a:2", PUBLIC)), INDEPENDENT),
        ((("one", "a:1", PUBLIC), ("two", "b:1", "203.0.113.7:40002")), DEPENDENT),
    ],
)
def test_mapping_follows_from_the_views(views: tuple[tuple[str, str, str], ...], mapping: str) -> None:
    """Two addresses of relays, or two ports of one, show whether the NAT assigns another port for each."""
    assert mappings(answer(*(view(*one) for one in views))) == {None: mapping}


def test_each_network_has_its_own_mapping() -> None:
    """LTE behind a symmetric NAT, Wi-Fi without one."""
    views = (
        view("one", "a:1", PUBLIC, network="lte"),
        view("two", "b:1", "203.0.113.7:40002", network="lte"),
        view("one", "a:1", PRIVATE, socket=1, network="wifi"),
    )
    assert mappings(answer(*views)) == {"lte": DEPENDENT, "wifi": NO_NAT}


def test_report_of_a_machine_behind_nat() -> None:
    """Line by line."""
    assert list(report(answer(view("one", "192.0.2.1:5790", PUBLIC, network="lte")))) == [
        "UDP          gets out: 2 of 2 relays answer",
        "relay        one: up, 23 ms",
        "relay        two: up, 23 ms",
        f"seen as      {PUBLIC} by one at 192.0.2.1:5790 on lte",
        "mapping      unknown on lte",
        f"             {MEANINGS[UNKNOWN]}",
        "filtering    unknown: relays do not send from a second address",
        f"candidates   {PUBLIC}, {PRIVATE}",
    ]


def test_report_without_an_answer_says_what_to_do() -> None:
    """The relays are down, or UDP is blocked."""
    lines = list(report(answer(state="waiting")))
    assert lines[0] == "UDP          gets no answer: 0 of 2 relays answer"
    assert lines[1] == "relay        one: waiting"
    assert "public_key" in lines[-1]


def test_file_without_relays_is_named() -> None:
    """Netcheck needs one."""
    (line,) = report({"relays": {}, "views": [], "candidates": [], "own": []})
    assert "[[relay]]" in line
