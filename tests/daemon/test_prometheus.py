"""A real Prometheus that scrapes real daemons: every expression of the dashboard finds something there."""

from __future__ import annotations

import asyncio
import json
import shutil
import subprocess
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any
from urllib.error import URLError
from urllib.parse import urlencode
from urllib.request import urlopen

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.daemon.frames import command_long, heartbeat
from tests.daemon.harness import Stage
from tests.daemon.serial_pair import SerialPair
from tests.daemon.udp import Client, Sockaddr
from tests.endpoints.test_line_framing import report
from tests.needs import need
from tests.ops.test_monitoring import ALERTS, DASHBOARD, expressions
from tests.waiting import PATIENCE_S
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.sim.loopback_ports import free_port

WINDOW = "5s"
"""In place of Grafana's $__rate_interval: many scrapes."""


class Prometheus:
    """One on loopback, which scrapes all the time."""

    def __init__(self, port: int) -> None:
        self._base = f"http://127.0.0.1:{port}"

    def get(self, path: str, **query: str) -> Any:
        """What its API answers to a question that it takes."""
        with urlopen(f"{self._base}{path}?{urlencode(query)}", timeout=240) as answer:
            body = answer.read()
        response = json.loads(body) if body.startswith(b"{") else {"status": "success", "data": body.decode()}
        assert response["status"] == "success"
        return response["data"]

    def is_ready(self) -> bool:
        """Whether it answers questions."""
        try:
            return bool(self.get("/-/ready"))
        except (OSError, URLError):
            return False

    def finds(self, expression: str) -> bool:
        """Whether an expression gives anything now."""
        return bool(self.get("/api/v1/query", query=expression)["result"])


@asynccontextmanager
async def prometheus(stage: Stage, targets: list[str]) -> AsyncIterator[Prometheus]:
    """One with the alerts loaded, from its start to its end."""
    client = shutil.which("prometheus")
    need(client is not None, "prometheus, of Debian's package of that name")
    folder = stage.folder / "prometheus"
    folder.mkdir()
    config = folder / "prometheus.yml"
    scrape = {"job_name": "uavlinkd", "static_configs": [{"targets": targets}]}
    seconds = {"scrape_interval": "200ms", "scrape_timeout": "200ms", "evaluation_interval": "200ms"}
    config.write_text(json.dumps({"global": seconds, "rule_files": [str(ALERTS)], "scrape_configs": [scrape]}))
    port = free_port()
    with (folder / "log").open("wb") as log:
        process = await asyncio.create_subprocess_exec(
            *end_with_parent(str(client), f"--config.file={config}", f"--storage.tsdb.path={folder / 'data'}"),
            *(f"--web.listen-address=127.0.0.1:{port}", "--log.level=warn"),
            stdout=log,
            stderr=subprocess.STDOUT,
        )
    try:
        server = Prometheus(port)
        async with asyncio.timeout(PATIENCE_S):
            while not await asyncio.to_thread(server.is_ready):
                assert process.returncode is None, (folder / "log").read_text()
                await asyncio.sleep(0.1)
        yield server
    finally:
        if process.returncode is None:
            process.terminate()
        await process.wait()


async def cause_drops(client: Client, into: Sockaddr, peers: Sockaddr) -> None:
    """Traffic above a slow radio's rate, frames that a policy refuses, and invalid datagrams."""
    number = 0
    while True:
        for component in range(1, 30):
            client.send(heartbeat(1, component), into)
        for command in (mavlink.MAV_CMD_COMPONENT_ARM_DISARM, mavlink.MAV_CMD_NAV_TAKEOFF):
            client.send(command_long(command, 2, seq=number), into)
        client.send(b"\x99nothing", peers)
        number += 1
        await asyncio.sleep(0.02)


async def disturb(modems: SerialPair) -> None:
    """Noise on a line, and the modem's own reports."""
    while True:
        modems.injected = b"\0noise" * 3 + b"\0" + report()
        await asyncio.sleep(0.1)


async def test_dashboard_and_alerts_find_what_they_ask_for(stage: Stage) -> None:
    """Of a daemon to which all happens that the panels show."""
    a, b = stage.pair(budget_bits_s=20_000)
    into = a.add_endpoint("autopilot", deny_in=["MAV_CMD_COMPONENT_ARM_DISARM"])
    b.add_endpoint("autopilot")
    a.config["recording"] = {"folder": "recordings", "min_free_bytes": 100_000}
    for daemon, peer in ((a, a.config["peer"][0]), (b, b.config["peer"][0])):
        peer |= {"role": "swarm-member", "system_ids": [1, 2]}  # to which no command goes
        daemon.config["metrics"] = {"listen": f"127.0.0.1:{free_port()}"}
    second = f"127.0.0.1:{free_port()}"  # two paths, of which one has a lag
    b.config["listen"].append(second)
    a.config["peer"][0]["addresses"].append(second)
    modems = SerialPair(stage.folder, 24_000)
    modems.connect(a, b)
    modems.start()
    await stage.start(a, b)
    client = await stage.client()
    dropping = asyncio.create_task(cause_drops(client, into, a.sockaddr))
    disturbing = asyncio.create_task(disturb(modems))
    try:
        async with prometheus(stage, [daemon.config["metrics"]["listen"] for daemon in (a, b)]) as server:
            wanted = [expression.replace("[1m]", f"[{WINDOW}]") for expression in expressions()]
            wanted += ["uavlinkd_build_info", 'uavlinkd_peer_up{instance=~".*"}']  # of the variables
            missing = wanted
            async with asyncio.timeout(PATIENCE_S):
                while missing:
                    missing = [query for query in missing if not await asyncio.to_thread(server.finds, query)]
                    await asyncio.sleep(0.2)
            groups = (await asyncio.to_thread(server.get, "/api/v1/rules"))["groups"]
            rules = [rule for group in groups for rule in group["rules"]]
            targets = (await asyncio.to_thread(server.get, "/api/v1/targets"))["activeTargets"]
    except TimeoutError:
        raise AssertionError(f"nothing is found by: {missing}") from None
    finally:
        dropping.cancel()
        disturbing.cancel()
        modems.stop()
    assert len(wanted) > len(DASHBOARD["panels"])
    assert len(rules) == ALERTS.read_text().count("- alert:")
    assert {rule["health"] for rule in rules} <= {"ok", "unknown"}  # unknown: not yet evaluated
    assert not any(rule.get("lastError") for rule in rules)
    assert {target["health"] for target in targets} == {"up"}
