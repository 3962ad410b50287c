"""What a real daemon answers to the page."""

from __future__ import annotations

import json
from typing import Any

import pytest
from pymavlink import mavutil

from tests.processes.conftest import stage
from tests.processes.harness import Stage
from tests.waiting import PATIENCE_S, Stopwatch
from tests.web.statuses import few_facts, overview
from uavlinkd.web.view import mode_name, view

__all__ = ["stage"]


def lasting(facts: dict[str, Any]) -> dict[str, Any]:
    """Without ages, rates and other figures of a moment."""
    return {key: fact for key, fact in facts.items() if not key.endswith("_s")}


async def test_an_overview_has_the_details_of_the_named_peers_alone(stage: Stage) -> None:
    """Its figures are those of the status, in whatever order the peers are named."""
    hub, one, other = (stage.daemon(name) for name in ("drone0", "drone1", "drone2"))
    stage.introduce(hub, one)
    stage.introduce(hub, other)
    await stage.start(hub, one, other)
    for named in ((), ("drone1",), ("drone2", "drone1"), ("drone2", "stranger", "drone2")):
        request, stopwatch = " ".join(["overview", *named]), Stopwatch()
        while stopwatch.elapsed_s < PATIENCE_S:  # a datagram may come between the two answers
            some, status = await hub.ask(request), await hub.status()
            assert some.keys() == status.keys() - {"process", "is_stuck"}
            for name, peer in some["peers"].items():
                whole = status["peers"][name]
                if name in named:
                    assert peer.keys() == whole.keys()
                    assert peer["paths"][0].keys() == whole["paths"][0].keys()
                else:
                    assert peer.keys() == few_facts().keys()
                    assert peer["paths"][0].keys() == few_facts()["paths"][0].keys() < whole["paths"][0].keys()
            if all(figures(peer) == figures(status["peers"][name], peer) for name, peer in some["peers"].items()):
                break
        else:
            raise AssertionError(json.dumps([some, status]))


def figures(peer: dict[str, Any], like: dict[str, Any] | None = None) -> dict[str, Any]:
    """Those that both answers have."""
    like = like or peer
    paths = [lasting({key: path[key] for key in like["paths"][0]}) for path in peer["paths"]]
    return lasting({key: peer[key] for key in like}) | {"paths": paths}


async def test_a_made_up_overview_is_like_a_real_one(stage: Stage) -> None:
    """Other tests of the page use it."""
    one, other = stage.pair()
    await stage.start(one, other)
    answer, made_up = await one.ask("overview"), overview()
    assert answer.keys() == made_up.keys()
    assert {key: type(fact) for key, fact in answer.items()} == {key: type(fact) for key, fact in made_up.items()}
    assert (await one.ask("problems"))["problems"] == []


def test_a_member_that_never_came_is_on_the_page() -> None:
    """As a card, or as a row among many; the headline counts it."""
    fleet = {"fleet": "k7qd2m4x", "name": "gs", "role": "operator", "serial": 1, "number": 1, "bulletins": {}}
    fleet["absent"] = {"v9": "eZPBKM+9Oztdms1v2yiR+byync+zZsR87etuOX4heHE="}
    facts = view(overview(fleet=fleet), [], "")
    assert facts["headline"][0]["text"] == "1 of 2 peers up"
    assert [(card["name"], card["word"]) for card in facts["cards"]] == [("v9", "waiting"), ("drone1", "up")]
    first = view(overview("abcdef", fleet=fleet), [], "")["rows"][0]
    assert (first["name"], first["word"], first["last_received_s"]) == ("v9", "waiting", None)


def test_modes_have_the_names_that_ground_stations_show() -> None:
    """Of ArduPilot: those of pymavlink, where its dialect still has the mode; a number that nobody named is one."""
    mapped = ((2, mavutil.mode_mapping_acm), (1, mavutil.mode_mapping_apm), (10, mavutil.mode_mapping_rover))
    for kind, names in mapped:
        for number in range(256):
            name = mode_name({"autopilot": 3, "type": kind, "custom_mode": number})
            assert name in (names.get(number), f"mode {number}")
    assert mode_name({"autopilot": 3, "type": 2, "custom_mode": 5}) == "LOITER"
    assert mode_name({"autopilot": 3, "type": 12, "custom_mode": 4}) == "mode 4", "a submarine"


@pytest.mark.parametrize(
    ("main", "sub", "name"), [(3, 0, "POSCTL"), (4, 4, "MISSION"), (4, 99, "AUTO"), (6, 3, "OFFBOARD"), (77, 0, None)]
)
def test_modes_of_px4_have_a_main_and_a_sub_mode(main: int, sub: int, name: str | None) -> None:
    number = main << 16 | sub << 24
    assert mode_name({"autopilot": 12, "type": 2, "custom_mode": number}) == (name or f"mode {number}")
