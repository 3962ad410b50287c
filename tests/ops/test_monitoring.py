"""Alert rules and dashboard in configs/: by Prometheus's own tool, and about metrics that there are."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest

from tests.daemon.harness import need
from tests.ops.test_metrics import STATUS
from uavlinkd.core.drops import DropReason
from uavlinkd.ops.metrics import exposition

CONFIGS = Path(__file__).parents[2] / "configs"
ALERTS = CONFIGS / "prometheus-alerts.yml"
DASHBOARD = json.loads((CONFIGS / "grafana-dashboard.json").read_text())
KNOWN = set(re.findall(r"(?m)^(uavlinkd_\w+)", exposition(STATUS, 1.0).decode()))


def promtool(*arguments: str | Path) -> str:
    """What Prometheus's tool says; it has to be content."""
    path = shutil.which("promtool")
    need(path is not None, "promtool, of Debian's package prometheus")
    done = subprocess.run([str(path), *map(str, arguments)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def expressions() -> list[str]:
    """Of the dashboard, with its variables replaced as Grafana does."""
    return [
        target["expr"].replace("$__rate_interval", "1m").replace("$instance", ".*").replace("$peer", ".*")
        for panel in DASHBOARD["panels"]
        for target in panel["targets"]
    ]


def test_prometheus_takes_the_alerts() -> None:
    """All of them."""
    assert f"SUCCESS: {ALERTS.read_text().count('- alert:')} rules found" in promtool("check", "rules", ALERTS)


_REFUSED = 'uavlinkd_peer_refused_frames_total{instance="a",peer="b"'

# Alert -> what Prometheus has sampled, each 15 s; when it is looked at; whether it is raised then.
CASES: dict[str, tuple[dict[str, str], list[tuple[str, bool]]]] = {
    "UavlinkdNotThere": ({'up{job="uavlinkd",instance="a"}': "1 0x20"}, [("15s", False), ("1m", True)]),
    "UavlinkdStartsAgainAndAgain": (
        {'uavlinkd_uptime_seconds{instance="a"}': "1 16 1 16 1 16 1 16"},
        [("45s", False), ("2m", True), ("15m", False)],
    ),
    "UavlinkdPeerDown": (
        {'uavlinkd_peer_up{instance="a",peer="b"}': "1 1 0x20"},
        [("15s", False), ("30s", False), ("1m", True)],
    ),
    "UavlinkdLoss": (
        {'uavlinkd_path_loss_ratio{instance="a",peer="b",direction="in"}': "0.2x4 0.21x20"},
        [("1m", False), ("2m30s", True)],
    ),
    "UavlinkdSlow": (
        {'uavlinkd_round_trip_seconds{instance="a",peer="b"}': "1x4 1.1x20"},
        [("1m", False), ("2m30s", True)],
    ),
    "UavlinkdFreshnessUnverified": (
        {'uavlinkd_peer_freshness_unverified{instance="a",peer="b"}': "0 0 1x20"},
        [("15s", False), ("30s", False), ("1m", True)],
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
        {  # Only all of them together are above 50 a second.
            'uavlinkd_rx_dropped_total{instance="a",peer="",reason="rate_limited"}': "0+100x20 2000+400x20",
            'uavlinkd_rx_dropped_total{instance="a",peer="b",reason="over_share"}': "0+0x20 0+300x20",
            'uavlinkd_rx_dropped_total{instance="a",peer="b",reason="group_budget_spent"}': "0+0x20 0+300x20",
        },
        [("4m", False), ("8m", True)],
    ),
    "UavlinkdPeerOversteps": (
        {
            f'{_REFUSED},direction="in",reason="foreign_system"}}': "0x4 1x40",
            f'{_REFUSED},direction="in",reason="rate_limited"}}': "0+9x40",
            f'{_REFUSED},direction="out",reason="foreign_system"}}': "0+9x40",
        },
        [("1m", False), ("2m", True)],
    ),
    "UavlinkdNobodyAtEndpoint": (
        {'uavlinkd_endpoint_programs{instance="a",endpoint="autopilot"}': "1x4 0x20"},
        [("1m", False), ("3m", True)],
    ),
    "UavlinkdEndpointSilent": (
        {
            'uavlinkd_endpoint_programs{instance="a",endpoint="autopilot"}': "1x40",
            'uavlinkd_endpoint_receive_frames_total{instance="a",endpoint="autopilot"}': "0+50x8 400x20",
            'uavlinkd_endpoint_programs{instance="a",endpoint="spare"}': "0x40",
            'uavlinkd_endpoint_receive_frames_total{instance="a",endpoint="spare"}': "0x40",
        },
        [("2m", False), ("3m", False), ("4m30s", True)],
    ),
    "UavlinkdNotRecording": (
        {'uavlinkd_recording_up{instance="a"}': "1x4 0x20"},
        [("1m15s", False), ("4m", True)],
    ),
}


def test_every_alert_is_tried() -> None:
    """Below."""
    assert set(CASES) == set(re.findall(r"- alert: (\w+)", ALERTS.read_text()))


@pytest.mark.parametrize("alert", CASES)
def test_alert_is_raised_when_it_should_be(tmp_path: Path, alert: str) -> None:
    """By Prometheus's own unit tests: not just before, but then, and its words can be made."""
    series, moments = CASES[alert]
    lines = [f"rule_files: [{json.dumps(str(ALERTS))}]", "evaluation_interval: 15s", "tests:", "- interval: 15s"]
    lines.append("  input_series:")
    lines += [f"  - {{series: {json.dumps(name)}, values: {json.dumps(each)}}}" for name, each in series.items()]
    lines.append("  promql_expr_test:")
    for at, is_raised in moments:
        expected = "[{value: 1}]" if is_raised else "[]"
        expression = f'count(count by (alertname) (ALERTS{{alertname="{alert}", alertstate="firing"}}))'
        lines.append(f"  - {{expr: {json.dumps(expression)}, eval_time: {at}, exp_samples: {expected}}}")
    path = tmp_path / "test.yml"
    path.write_text("\n".join(lines))
    promtool("test", "rules", path)


def test_alerts_and_dashboard_ask_for_what_there_is() -> None:
    """Every metric in them stands in a real exposition, every reason is one."""
    text = ALERTS.read_text() + json.dumps(DASHBOARD)
    asked = set(re.findall(r"\buavlinkd_\w+", text))
    assert asked
    assert asked <= KNOWN
    dropped = re.findall(r'rx_dropped_total\{reason=~"([\w|]+)"', ALERTS.read_text())
    assert {reason for each in dropped for reason in each.split("|")} <= set(DropReason)


def test_prometheus_takes_the_expressions_of_the_dashboard(tmp_path: Path) -> None:
    """Written as recording rules, each is one that it can evaluate."""
    rules = [f"  - {{record: panel_{n}, expr: {json.dumps(each)}}}" for n, each in enumerate(expressions())]
    path = tmp_path / "rules.yml"
    path.write_text("groups:\n- name: dashboard\n  rules:\n" + "\n".join(rules))
    assert f"SUCCESS: {len(rules)} rules found" in promtool("check", "rules", path)


def test_dashboard_has_what_grafana_needs() -> None:
    """The keys of its model (dashboard schema 36), panels with ids of their own that do not overlap."""
    assert {"title", "uid", "schemaVersion", "panels", "templating", "time"} <= set(DASHBOARD)
    assert DASHBOARD["schemaVersion"] == 36
    assert "id" not in DASHBOARD  # Grafana gives it when the file is imported
    panels: list[dict[str, Any]] = DASHBOARD["panels"]
    assert len({panel["id"] for panel in panels}) == len(panels)
    for panel in panels:
        assert {"type", "title", "description", "gridPos", "targets", "fieldConfig", "options"} <= set(panel)
        assert panel["type"] in ("stat", "timeseries")
        at = panel["gridPos"]
        assert 0 <= at["x"] < at["x"] + at["w"] <= 24
        assert len({target["refId"] for target in panel["targets"]}) == len(panel["targets"])
    for one, other in combinations([panel["gridPos"] for panel in panels], 2):
        assert (
            one["x"] + one["w"] <= other["x"]
            or other["x"] + other["w"] <= one["x"]
            or one["y"] + one["h"] <= other["y"]
            or other["y"] + other["h"] <= one["y"]
        )


def test_dashboard_is_bound_to_no_one_source() -> None:
    """Whoever imports it chooses the Prometheus; and every variable that it uses is there."""
    text = json.dumps(DASHBOARD["panels"])
    assert set(re.findall(r'"uid": "([^"]*)"', text)) == {"${datasource}"}
    variables = {each["name"] for each in DASHBOARD["templating"]["list"]}
    used = set(re.findall(r"\$\{?(\w+)", text)) - {"__rate_interval"}
    assert used <= variables == {"datasource", "instance", "peer"}
