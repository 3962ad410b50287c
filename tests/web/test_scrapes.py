"""Prometheus at the page: what it gets, and what it does not cost the daemon."""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import subprocess
import sys
import urllib.request
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from starlette.requests import Request

from tests.needs import need
from tests.processes.conftest import stage
from tests.processes.harness import Stage
from tests.waiting import PATIENCE_S
from tests.web.test_metrics import STATUS
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.ops.control import ControlError
from uavlinkd.web import scrapes

ROOT = Path(__file__).parents[2]
__all__ = ["stage"]
REQUEST = Request({"type": "http"})


async def test_frequent_requests_reuse_the_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also the one that the daemon does not answer, and those that come while it is asked."""
    now, asked = [100.0], list[str]()

    async def ask(request: str) -> dict[str, Any]:
        asked.append(request)
        await asyncio.sleep(0)
        if len(asked) == 2:
            raise ControlError("no daemon answers")
        return STATUS

    monkeypatch.setattr(scrapes, "monotonic", lambda: now[0])
    page = scrapes.Scrapes(ask)
    for at, status in (0.0, 200), (0.49, 200), (0.5, 503), (0.99, 503), (1.0, 200):
        now[0] = 100.0 + at
        answers = await asyncio.gather(*(page.answer(REQUEST) for _ in range(9)))
        assert {answer.status_code for answer in answers} == {status}
        expected = b"no daemon answers\n" if status == 503 else b"# HELP uavlinkd_build_info "
        assert bytes(answers[0].body).startswith(expected)
    assert asked == ["status"] * 3
    assert answers[0].headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"


@pytest.mark.parametrize("status", [{}, {"schema": 1}, STATUS | {"peers": 5}, STATUS | {"peers": {"drone1": None}}])
async def test_an_answer_that_is_no_status_is_asked_for_no_more_often(
    monkeypatch: pytest.MonkeyPatch, status: dict[str, Any]
) -> None:
    """A daemon of another version: Prometheus gets the reason, and the log no traceback for each request."""
    asked = list[str]()

    async def ask(request: str) -> dict[str, Any]:
        asked.append(request)
        return status

    monkeypatch.setattr(scrapes, "monotonic", lambda: 100.0)
    page = scrapes.Scrapes(ask)
    answers = [await page.answer(REQUEST) for _ in range(9)]
    assert {answer.status_code for answer in answers} == {503}
    assert b"restart the older one" in bytes(answers[0].body)
    assert asked == ["status"]


async def query(port: int, expression: str) -> list[str]:
    """The values of an expression in Prometheus; none before it can answer."""
    url = f"http://127.0.0.1:{port}/api/v1/query?query={expression}"
    with suppress(OSError):
        answer = json.loads(await asyncio.to_thread(lambda: urllib.request.urlopen(url).read()))
        return [sample["value"][1] for sample in answer["data"]["result"]]
    return []


async def until_seen(port: int, expression: str, value: str) -> None:
    """Wait until Prometheus has this value of an expression."""
    async with asyncio.timeout(PATIENCE_S):
        while await query(port, expression) != [value]:  # noqa: ASYNC110  Prometheus announces nothing
            await asyncio.sleep(0.2)


@asynccontextmanager
async def running(folder: Path, *command: str) -> AsyncIterator[None]:
    """A process in a folder, which ends on SIGTERM."""
    process = await asyncio.create_subprocess_exec(
        *end_with_parent(*command), cwd=folder, stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.DEVNULL
    )
    try:
        yield
    finally:
        process.terminate()
        await process.wait()


@pytest.mark.long
async def test_prometheus_asks_the_page_as_the_readmes_say(stage: Stage, tmp_path: Path) -> None:
    """By TLS, with a password. It has what the daemon says; when that has ended, it sees that."""
    need(shutil.which("prometheus") is not None, "prometheus")
    files = re.search(r"```yaml\n(.*?)```", (ROOT / "uavlinkd/ops/README.md").read_text(), re.DOTALL)
    lines = re.search(
        r"```sh\n(uavlinkd web --new.*)\n(.*\\\n.*)\nsudo uavlinkd (.*)\n",
        (ROOT / "uavlinkd/web/README.md").read_text(),
    )
    assert files is not None
    assert lines is not None
    make_password, make_certificate, start = lines.groups()
    here, port, uavlinkd = f"127.0.0.1:{free_port()}", free_port(), f"{sys.executable} -m uavlinkd"
    script = f"{make_password.replace('uavlinkd', uavlinkd, 1)}\n{make_certificate}"
    done = await asyncio.to_thread(
        subprocess.run, script, shell=True, cwd=tmp_path, check=True, capture_output=True, text=True
    )
    (tmp_path / "password.txt").write_text(done.stdout.split()[1])
    scrapes_it = files[1].replace("10.13.0.1:8790", here)
    (tmp_path / "prometheus.yml").write_text(f"global: {{ scrape_interval: 1s }}\n{scrapes_it}")
    daemon, _ = stage.pair()
    await stage.start(daemon, linked=False)
    page = *uavlinkd.split(), *start.replace("0.0.0.0:8790", here).split(), "--socket", daemon.folder / "control.sock"
    options = "--config.file=prometheus.yml", "--storage.tsdb.path=data", f"--web.listen-address=127.0.0.1:{port}"
    async with running(tmp_path, *map(str, page)), running(tmp_path, "prometheus", *options):
        await until_seen(port, "uavlinkd_frames_pass", "0")
        assert await query(port, "up") == ["1"]
        assert await daemon.stop() == 0
        await until_seen(port, "up", "0")
        assert await query(port, "uavlinkd_frames_pass") == []
