"""Alert rules and dashboard in configs/: Prometheus's tool accepts them, and their metrics exist."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from tests.web.test_metrics import STATUS, promtool
from uavlinkd.protocol.drops import DropReason
from uavlinkd.web.metrics import exposition

CONFIGS = Path(__file__).parents[2] / "configs"
ALERTS = CONFIGS / "prometheus-alerts.yml"
DASHBOARD = json.loads((CONFIGS / "grafana-dashboard.json").read_text())
KNOWN = set(re.findall(r"(?m)^(uavlinkd_\w+)", exposition(STATUS).decode()))


def expressions() -> list[str]:
    """The expressions of the dashboard, with its variables replaced as Grafana does."""
    return [
        target["expr"].replace("$__rate_interval", "1m").replace("$instance", ".*").replace("$peer", ".*")
        for panel in DASHBOARD["panels"]
        for target in panel["targets"]
    ]


def test_prometheus_accepts_the_alerts() -> None:
    """The tool reads all of them."""
    assert f"SUCCESS: {ALERTS.read_text().count('- alert:')} rules found" in promtool("check", "rules", ALERTS)[0]


_REFUSED = 'uavlinkd_peer_refused_frames_total{instance="a",peer="b"'

_FINDING = 'uavlinkd_finding{instance="a",cause="wrong_psk",subject="peer",name="b"'


def _path(peer: str, number: str, usable: str, down: str, network: str = "lte") -> dict[str, str]:
    """The samples of two states of a path."""
    labels = f'instance="a",peer="{peer}",path="{number}",network="{network}",address="learned"'
    return {
        f'uavlinkd_peer_path_state{{{labels},state="usable"}}': usable,
        f'uavlinkd_peer_path_state{{{labels},state="down"}}': down,
    }


# Alert -> the samples of Prometheus, every 15 s; then times, and whether the alert fires at each. Those whose
# expression is more than a metric and a limit.
CASES: dict[str, tuple[dict[str, str], list[tuple[str, bool]]]] = {
    "UavlinkdRestarts": (
        {'uavlinkd_uptime_seconds{instance="a"}': "1 16 1 16 1 16 1 16"},
        [("45s", False), ("2m", True), ("15m", False)],
    ),
    "UavlinkdSecurity": (
        {f'{_FINDING},severity="security"}}': "_ 1 1 _ _ _ _ _ _ _ _ _ _ _ _ _ _ _ _ _ _ _ _ _ _ _"},
        [("0s", False), ("15s", True), ("6m15s", False)],
    ),
    "UavlinkdFault": (
        {f'{_FINDING},severity="fault"}}': "_ 1x20", f'{_FINDING},severity="warning"}}': "1x20"},
        [("30s", False), ("1m", True)],
    ),
    "UavlinkdPathDown": (
        {  # The first was usable; the second never was; one by TLS was closed; the last peer is down.
            **_path("b", "1", usable="1x4 0x20", down="0x4 1x20"),
            **_path("b", "3", usable="1x4 0x20", down="0x4 1x20", network="TLS"),
            **_path("b", "2", usable="0x24", down="1x24"),
            **_path("c", "1", usable="1x4 0x20", down="0x4 1x20"),
            'uavlinkd_peer_up{instance="a",peer="b"}': "1x24",
            'uavlinkd_peer_up{instance="a",peer="c"}': "1x4 0x20",
        },
        [("4m", False), ("4m30s", True)],
    ),
    "UavlinkdForgeries": (
        {
            'uavlinkd_rx_dropped_total{instance="a",peer="b",reason="bad_tag"}': "0x4 1x40",
            'uavlinkd_rx_dropped_total{instance="a",peer="b",reason="late"}': "0+9x40",
        },
        [("1m", False), ("2m", True), ("7m", False)],
    ),
    "UavlinkdReplays": (
        {'uavlinkd_rx_dropped_total{instance="a",peer="b",reason="replayed"}': "0+1x20 20+50x20"},
        [("4m", False), ("8m", True)],
    ),
    "UavlinkdFlood": (
        {  # Only their sum is above 50 per second.
            'uavlinkd_rx_dropped_total{instance="a",peer="",reason="rate_limited"}': "0+100x20 2000+400x20",
            'uavlinkd_rx_dropped_total{instance="a",peer="b",reason="over_share"}': "0+0x20 0+300x20",
            'uavlinkd_rx_dropped_total{instance="a",peer="b",reason="group_budget_spent"}': "0+0x20 0+300x20",
        },
        [("4m", False), ("8m", True)],
    ),
    "UavlinkdPolicyViolation": (
        {
            f'{_REFUSED},direction="in",reason="foreign_system"}}': "0x4 1x40",
            f'{_REFUSED},direction="in",reason="rate_limited"}}': "0+9x40",
            f'{_REFUSED},direction="out",reason="foreign_system"}}': "0+9x40",
        },
        [("1m", False), ("2m", True)],
    ),
    "UavlinkdEndpointSilent": (
        {
            'uavlinkd_endpoint_clients{instance="a",endpoint="autopilot"}': "1x40",
            'uavlinkd_endpoint_receive_frames_total{instance="a",endpoint="autopilot"}': "0+50x8 400x20",
            'uavlinkd_endpoint_clients{instance="a",endpoint="spare"}': "0x40",
            'uavlinkd_endpoint_receive_frames_total{instance="a",endpoint="spare"}': "0x40",
        },
        [("2m", False), ("3m", False), ("4m30s", True)],
    ),
    "UavlinkdRelayFlood": (
        {
            'uavlinkd_relay_dropped_total{instance="a",reason="relay_unknown_handle"}': "0+100x20 2000+1000x20",
            'uavlinkd_relay_dropped_total{instance="a",reason="relay_over_limit"}': "0+9000x40",
            'uavlinkd_relay_dropped_total{instance="a",reason="relay_over_total"}': "0+9000x40",
        },
        [("4m", False), ("8m", True)],
    ),
}


@pytest.mark.parametrize("alert", CASES)
def test_alert_fires_at_the_right_time(tmp_path: Path, alert: str) -> None:
    """Prometheus's unit tests: it does not fire just before, it fires then, and its text can be expanded."""
    series, moments = CASES[alert]
    lines = [f"rule_files: [{json.dumps(str(ALERTS))}]", "evaluation_interval: 15s", "tests:", "- interval: 15s"]
    lines.append("  input_series:")
    lines += [f"  - {{series: {json.dumps(name)}, values: {json.dumps(values)}}}" for name, values in series.items()]
    lines.append("  promql_expr_test:")
    for at, is_raised in moments:
        expected = "[{value: 1}]" if is_raised else "[]"
        expression = f'count(count by (alertname) (ALERTS{{alertname="{alert}", alertstate="firing"}}))'
        lines.append(f"  - {{expr: {json.dumps(expression)}, eval_time: {at}, exp_samples: {expected}}}")
    path = tmp_path / "test.yml"
    path.write_text("\n".join(lines))
    promtool("test", "rules", path)


def test_metrics_of_alerts_and_dashboard_exist() -> None:
    """Every metric is in a real exposition, and every reason is a member of its enum."""
    text = ALERTS.read_text() + json.dumps(DASHBOARD)
    used = set(re.findall(r"\buavlinkd_\w+", text))
    assert used
    assert used <= KNOWN
    dropped = re.findall(r'rx_dropped_total\{reason=~"([\w|]+)"', ALERTS.read_text())
    assert {reason for reasons in dropped for reason in reasons.split("|")} <= set(DropReason)


def test_prometheus_accepts_the_expressions_of_the_dashboard(tmp_path: Path) -> None:
    """As recording rules, it can evaluate them all."""
    rules = [
        f"  - {{record: panel_{n}, expr: {json.dumps(expression)}}}" for n, expression in enumerate(expressions())
    ]
    path = tmp_path / "rules.yml"
    path.write_text("groups:\n- name: dashboard\n  rules:\n" + "\n".join(rules))
    assert f"SUCCESS: {len(rules)} rules found" in promtool("check", "rules", path)[0]
