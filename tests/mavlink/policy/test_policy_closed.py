"""A peer's policy fails closed: it refuses everything that its configuration does not allow."""

from __future__ import annotations

from itertools import product

import pytest

from tests.mavlink.policy.test_policy import blank, heartbeat
from uavlinkd.mavlink.dialect_table import MESSAGES
from uavlinkd.mavlink.policy.compilation import PolicyError, compile_policy
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.mavlink.policy.roles import ROLES

OPEN = (["all"], ["all"])


def problems(data: dict[str, object]) -> dict[str, str]:
    """The problems of a peer's policy, by key."""
    with pytest.raises(PolicyError) as caught:
        compile_policy(data)
    return {problem.key: f"{problem.problem}; {problem.remedy}" for problem in caught.value.problems}


def test_peer_without_a_policy_is_an_error_with_its_remedy() -> None:
    """Neither a role nor a list: the error names the key, each role, and the word for everything."""
    reported = problems({})
    assert list(reported) == ["role", "system_ids"]
    assert all(f'"{role}"' in reported["role"] for role in ROLES)
    assert 'role = "all" passes everything' in reported["role"]


@pytest.mark.parametrize(
    "data",
    [
        {"system_ids": [1]},
        {"system_ids": [1], "deny_in": ["shell"]},
        {"system_ids": [1], "deny_in": ["all"], "deny_out": ["all"]},
        {"system_ids": [1], "rate_in": {"ATTITUDE": 1}},
        {"system_ids": [1], "mavlink1": False, "ground_station": False},
    ],
)
def test_other_keys_do_not_replace_lists(data: dict[str, object]) -> None:
    """System ids, denials, rates and flags do not define what may pass."""
    assert list(problems(data)) == ["role"]


@pytest.mark.parametrize(("given", "missing"), [("allow_in", "allow_out"), ("allow_out", "allow_in")])
def test_one_list_alone_is_an_error(given: str, missing: str) -> None:
    """Without a role both lists are needed; the error names the values that pass nothing and everything."""
    reported = problems({"system_ids": [1], given: ["telemetry"]})
    assert list(reported) == [missing]
    assert f'{missing} = ["telemetry"]' in reported[missing]
    assert '[] passes nothing, ["all"] everything' in reported[missing]


@pytest.mark.parametrize("role", ROLES)
def test_system_ids_are_needed_in_every_role(role: str) -> None:
    """Also for a peer that is trusted with everything."""
    assert list(problems({"role": role})) == ["system_ids"]


def test_role_all_passes_everything_but_signing_keys() -> None:
    """In both directions: known and unknown messages, both versions, heartbeats of ground stations."""
    made = compile_policy({"role": "all", "system_ids": "all"})
    for gate, msgid in product((made.incoming, made.outgoing), MESSAGES):
        assert gate.check(blank(msgid, system=77), 0.0) == (Refusal.SETUP_SIGNING if msgid == 256 else None)
    assert made.incoming.check(heartbeat(kind=6, version=1), 0.0) is None
    assert any('role = "all"' in warning for warning in made.warnings)


def test_role_all_keeps_systems_and_denials() -> None:
    """It has the other keys of every role."""
    made = compile_policy({"role": "all", "system_ids": [1], "deny_in": ["shell"]})
    assert made.incoming.check(heartbeat(system=2), 0.0) is Refusal.FOREIGN_SYSTEM
    assert made.incoming.check(blank(126), 0.0) is Refusal.MESSAGE_NOT_ALLOWED
    assert made.outgoing.check(blank(126), 0.0) is None


def test_endpoint_without_lists_passes_everything() -> None:
    """The wire to a local client is trusted, so an endpoint needs neither a role nor a list."""
    for data in ({}, {"system_ids": [1]}, {"deny_in": ["shell"]}, {"allow_out": ["telemetry"]}):
        made = compile_policy(data, is_local=True)
        assert made.incoming.check(heartbeat(), 0.0) is None
        assert made.outgoing.check(heartbeat(), 0.0) is None
