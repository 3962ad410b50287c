"""Alert rules and dashboard in configs/: Prometheus's tool accepts them, and their metrics exist."""

from __future__ import annotations

import json
import re
from pathlib import Path

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
