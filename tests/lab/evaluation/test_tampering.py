"""``uavlinkd evaluate tampering --quick``: every attack against real daemons and against the paper's protocol."""

from __future__ import annotations

from pathlib import Path
from statistics import median

import pytest

from tests.lab.evaluation.quick_runs import run_quickly
from uavlinkd.lab.evaluation import tampering_plan as plans
from uavlinkd.lab.evaluation.paper_attacks import CHANGES
from uavlinkd.lab.evaluation.tampering_plan import (
    FLEET_PLANS,
    LINE_PLANS,
    PATH_PLANS,
    RELAYED_PLANS,
    WEB_PLANS,
    TrialPlan,
)
from uavlinkd.lab.evaluation.tampering_records import NOT_IN_TIME, OURS, PAPER, RECOVERY_LIMIT_S, RELAY, Verdict
from uavlinkd.lab.evaluation.tampering_run import TAMPERING
from uavlinkd.lab.hostile import web_proxy
from uavlinkd.lab.hostile.relay_attacks import RELAY_ATTACKS
from uavlinkd.lab.mitm.attack import AttackContext
from uavlinkd.lab.mitm.attacks import ATTACKS, parse_attack
from uavlinkd.lab.mitm.line_attacks import LINE_ATTACKS, parse_line_attack

ALL_PLANS: tuple[TrialPlan, ...] = (
    *plans.HANDSHAKE_PLANS,
    *plans.STALE_PLANS,
    *plans.DATA_PLANS,
    *plans.FLOOD_PLANS,
    *plans.TRAFFIC_PLANS,
    *plans.LAST_PLANS,
    *plans.MISROUTE_PLANS,
    *PATH_PLANS,
    *FLEET_PLANS,
)


def test_every_attack_of_the_registry_is_tried_also_in_a_quick_run() -> None:
    """A new attack needs a plan."""
    tried = {
        spec.partition(",")[0]
        for plan in ALL_PLANS
        if not plan.is_variant
        for text in plan.phases
        for spec in text.split()
    }
    assert tried == set(ATTACKS)


def test_every_attack_on_the_line_is_tried_also_in_a_quick_run() -> None:
    """A new one needs a plan too, and the modems accept each line."""
    attacks = [parse_line_attack(text) for plan in LINE_PLANS if not plan.is_variant for text in plan.phases]
    assert {attack.name for attack in attacks} == set(LINE_ATTACKS)
    for plan in LINE_PLANS:
        assert plan.names == tuple(parse_line_attack(text).name for text in plan.phases)


def test_every_attack_of_a_proxy_is_tried_also_in_a_quick_run() -> None:
    """A new one needs a plan too, and the proxy accepts each line."""
    texts = [plans.with_target(text, 9) for plan in WEB_PLANS for text in plan.phases]
    attacks = [parse_attack(text, web_proxy.ALL_ATTACKS) for text in texts]
    assert {attack.name for attack in attacks} >= set(web_proxy.WEB_ATTACKS)
    assert not [plan for plan in WEB_PLANS if plan.is_variant and set(plan.names) & set(web_proxy.WEB_ATTACKS)]


ON_RELAY = [plan for plan in RELAYED_PLANS if not set(plan.names) & set(RELAY_ATTACKS)]


def test_plans_can_be_made() -> None:
    """The man in the middle accepts each line, and it fits into a request."""
    for plan in (*ALL_PLANS, *ON_RELAY):
        _check_plan(plan)


def _check_plan(plan: TrialPlan) -> None:
    around = AttackContext.between(
        "drone0", "drone1", "drone2", public_keys=dict.fromkeys(("drone0", "drone1", "drone2"), bytes(32)), paths=2
    )
    texts = [*plan.phases, *([plan.paper] if plan.paper and plan.paper not in CHANGES else [])]
    for text in texts:
        reported = plans.with_target(text, 10_000)
        assert len(f"attack {reported}") < 200
        for spec in reported.split():
            parse_attack(spec).make(around)
    assert not [name for name in plan.names if name not in ATTACKS]


@pytest.mark.long
@pytest.mark.alone  # a link has two seconds to recover
async def test_quick_run(tmp_path: Path) -> None:
    """No attack succeeds against the daemons, every attack reaches the network; the relay beats the paper."""
    result = await run_quickly("tampering", tmp_path, "--seed", "3")
    print(result.out)
    assert (result.status, result.err) == (0, "")

    run = TAMPERING.read(tmp_path)
    ours, paper = run.on(OURS), run.on(PAPER)
    stages = *ALL_PLANS, *LINE_PLANS, *RELAYED_PLANS, *WEB_PLANS
    chosen = [plan for plan in stages if not plan.is_variant]
    assert {trial.attack for trial in ours} >= {plan.attack for plan in chosen}
    assert len({trial.attack for trial in ours if trial.group == "keys"}) == 6
    for trial in ours:
        assert trial.attempts > 0
        assert not trial.faults
        assert not trial.unseen, trial
        assert set(trial.successes) <= {NOT_IN_TIME}, trial
        # A false address that no member asks leaves no trace.
        is_lie = trial.attack == "relay lies about addresses"
        assert is_lie or trial.is_noticed, trial
        assert trial.recovery_s is not None
    # A busy machine may exceed the limit now and then, wherever it lets a process wait. A daemon that does so exceeds
    # it after each attack of a kind; tests/network has the limits in virtual time.
    assert median(trial.recovery_s or 0.0 for trial in ours) <= RECOVERY_LIMIT_S
    assert {trial.attack for trial in paper} >= {RELAY, *(plan.attack for plan in chosen if plan.paper)}
    relay = next(trial for trial in paper if trial.attack == RELAY)
    assert relay.faults["forged or altered"] > 0
    assert relay.sessions >= 2
    assert {trial.attack for trial in paper if trial.verdict is Verdict.SUCCEEDED} >= {
        RELAY,
        "replay-data",
        "reflect",
    }
    on_keys = [trial for trial in paper if trial.attack in CHANGES]
    assert {trial.attack for trial in on_keys} == set(CHANGES)
    assert not any(trial.faults for trial in on_keys), "the paper detects what it says"
    assert all({"hmac_mismatch", "bad_public_key"} & trial.noticed.keys() for trial in on_keys)
    by_name = {trial.attack: trial for trial in ours}
    for name, reason in (
        ("tamper-key", "bad_handshake"),
        ("invalid-element", "invalid_key_share"),
        ("bit-flip", "bad_tag"),
        ("replay-data", "duplicate"),
        ("raw-mavlink", "raw_mavlink"),
        (RELAY, "unknown_peer"),
        ("hold", "delayed"),
        ("reorder", "envelopes_out_of_order"),
        ("roam, then gone", "paths_unproven"),
        ("block-rekey", "handshakes_unanswered"),
        ("captured drone, as itself", "refused_foreign_system"),
        ("bytes injected on the line", "line_noise"),
        ("datagrams replayed on the line", "duplicate"),
        ("datagrams forged on the line", "bad_tag"),
        ("line held for 3 s and let go", "delayed"),
        ("relay misdelivers envelopes", "unknown_index"),
        ("relay invents handles", "relay_unknown_handle"),
        ("relay sends frames of its own", "frames_not_allowed"),
        ("proxy joins messages", "bad_tag"),
        ("proxy answers for the relay", "unknown_index"),
    ):
        assert by_name[name].noticed[reason] > 0
    report = (tmp_path / "tampering.md").read_text()
    assert all(trial.attack in report for trial in ours)
    assert "bad_handshake" in (tmp_path / "uavlinkd-handshake-0-drone0.log").read_text()
