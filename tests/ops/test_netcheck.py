"""``uavlinkd netcheck``: what it concludes from what relays see, and from the tokens that arrived."""

from __future__ import annotations

from typing import Any

import pytest

from uavlinkd.ops.netcheck import Filtered, Mapped, behaviours

PRIVATE, PUBLIC, OTHER = "192.168.1.5:5790", "203.0.113.7:40001", "203.0.113.7:40002"


def view(relay: str, at: str, seen_as: str, **more: Any) -> dict[str, Any]:
    """How a relay sees a socket."""
    return {"relay": relay, "relay_address": at, "socket": 0, "network": None, "seen_as": seen_as, **more}


def shown(passes: bool | None, **more: Any) -> dict[str, Any]:
    """Whether a token of a relay arrived at a socket."""
    result = {"relay": "one", "relay_address": "a:1", "socket": 0, "network": None, "other_port_passes": passes}
    return result | more


def answer(*views: dict[str, Any], state: str = "up", filtering: tuple[dict[str, Any], ...] = ()) -> dict[str, Any]:
    """A daemon's answer with these views, of the relays that they name."""
    relays = {
        name: {"state": state, "round_trip_s": 0.0234, "addresses": [f"{name}.example.org:5790"], "unresolved": []}
        for name in ("one", "two")
    }
    return {
        "relays": relays,
        "views": list(views),
        "filtering": list(filtering),
        "candidates": [PUBLIC, PRIVATE],
        "is_relay": False,
        "own": [PRIVATE],
    }


@pytest.mark.parametrize(
    ("seen", "mapped"),
    [
        ({"a:1": PRIVATE}, Mapped.NO_NAT),
        ({"a:1": PRIVATE, "b:1": PRIVATE}, Mapped.NO_NAT),
        ({"a:1": PUBLIC}, Mapped.UNKNOWN),
        ({"a:1": PUBLIC, "b:1": PUBLIC}, Mapped.INDEPENDENT),
        ({"a:1": PUBLIC, "a:2": PUBLIC}, Mapped.NOT_BY_PORT),
        ({"a:1": PUBLIC, "a:2": PUBLIC, "b:1": PUBLIC}, Mapped.INDEPENDENT),
        ({"a:1": PUBLIC, "b:1": OTHER}, Mapped.BY_EITHER),
        ({"a:1": PUBLIC, "a:2": PUBLIC, "b:1": OTHER}, Mapped.BY_ADDRESS),
        ({"a:1": PUBLIC, "a:2": OTHER}, Mapped.BY_PORT),
        ({"[2001:db8::1]:1": PUBLIC, "[2001:db8::1]:2": OTHER}, Mapped.BY_PORT),
        ({"[2001:db8::1]:1": PUBLIC, "[2001:db8::2]:1": OTHER}, Mapped.BY_EITHER),
    ],
)
def test_mapping_follows_from_the_views(seen: dict[str, str], mapped: Mapped) -> None:
    """Two ports of one relay show whether the NAT maps by port; only two hosts show whether it maps by address."""
    views = [view("one", at, seen_as) for at, seen_as in seen.items()]
    assert list(behaviours(answer(*views))) == [(None, mapped, Filtered.UNKNOWN)]


@pytest.mark.parametrize(
    ("passes", "filtered"),
    [
        ((), Filtered.UNKNOWN),
        ((None,), Filtered.UNKNOWN),
        ((False, None), Filtered.BY_PORT),
        ((True, None), Filtered.NOT_BY_PORT),
        ((False, True), Filtered.NOT_BY_PORT),
    ],
)
def test_filtering_follows_from_the_tokens(passes: tuple[bool | None, ...], filtered: Filtered) -> None:
    """One that arrives weighs more than one that does not, which a firewall of the relay may have dropped."""
    results = tuple(shown(one) for one in passes)
    assert list(behaviours(answer(view("one", "a:1", PRIVATE), filtering=results))) == [
        (None, Mapped.NO_NAT, filtered)
    ]
