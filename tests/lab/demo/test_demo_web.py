"""``uavlinkd demo --web``: a browser starts attacks on two real daemons, and sees that they are refused."""
# ruff: noqa: ASYNC240  (small local files; nothing else waits in this loop)

from __future__ import annotations

import asyncio
import http.client
import json
import signal
import subprocess
import sys
import tempfile
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Iterator
from contextlib import aclosing, asynccontextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from tests.processes.test_demo import ENDED_S, demo
from tests.waiting import PATIENCE_S, until
from uavlinkd.lab.demo.web import ATTACKS
from uavlinkd.web.page import make_app
from uavlinkd.web.watch import Watcher

NAMES = [spec.name for spec in ATTACKS.values()]


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty folder with a short path. There is no display, whatever this machine has."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with tempfile.TemporaryDirectory(prefix="demo-") as name:
        yield Path(name)


@asynccontextmanager
async def page(*arguments: str, folder: Path) -> AsyncIterator[tuple[asyncio.subprocess.Process, str]]:
    """A demo and the address of its page."""
    async with demo("--web", *arguments, folder=folder) as process:
        assert process.stdout is not None
        line = (await asyncio.wait_for(process.stdout.readline(), ENDED_S)).decode()
        url = line.removeprefix("the page is at ").removesuffix(" until q or Ctrl-C\n")
        assert urlsplit(url).hostname == "127.0.0.1", line
        yield process, url


async def answer(url: str, method: str, path: str, **headers: str) -> tuple[int, str]:
    """Status and text of one answer."""

    def ask() -> tuple[int, str]:
        connection = http.client.HTTPConnection(urlsplit(url).netloc, timeout=PATIENCE_S)
        try:
            connection.request(method, path, headers=headers)
            response = connection.getresponse()
            policy = response.headers["Content-Security-Policy"]
            assert "script-src 'self'; style-src 'self'" in policy
            assert "unsafe" not in policy
            return response.status, response.read().decode()
        finally:
            connection.close()

    return await asyncio.to_thread(ask)


async def events(url: str) -> AsyncGenerator[dict[str, Any]]:
    """The server's events about attacks."""
    address = urlsplit(url)
    reader, writer = await asyncio.open_connection(address.hostname, address.port)
    try:
        writer.write(f"GET /attacks HTTP/1.1\r\nHost: {address.netloc}\r\n\r\n".encode())
        while line := await asyncio.wait_for(reader.readline(), PATIENCE_S):
            if line.startswith(b"data: "):
                yield json.loads(line[6:])
    finally:
        writer.close()
        await writer.wait_closed()


async def first(url: str, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """The first event for which a condition holds."""
    async with aclosing(events(url)) as stream:
        async for event in stream:
            if condition(event):
                return event
    raise AssertionError("the events ended")


@pytest.mark.long
async def test_a_started_attack_is_refused_and_counted(folder: Path) -> None:
    """One at a time; it ends by itself, and Ctrl-C ends the demo although a browser looks on."""
    async with page(folder=folder) as (process, url):
        assert (await answer(url, "POST", "/attacks/nonsense", Origin=url.rstrip("/")))[0] == 404
        starts = [answer(url, "POST", "/attacks/forge-data", Origin=url.rstrip("/")) for _ in range(2)]
        answers = sorted(await asyncio.gather(*starts))
        assert answers == [(204, ""), (409, "an attack is running: it ends within seconds\n")]
        after = await first(url, lambda event: event["results"] and event["running"] is None)
        ((attack, attempts, counted),) = after["results"]
        assert (attack, attempts > 10) == ("Forge commands", True)
        assert "altered or forged" in counted
        assert after["frames"]["altered"] == 0
        assert 0 < after["frames"]["delivered"] <= after["frames"]["sent"]

        async with aclosing(events(url)) as stream:
            assert (await anext(stream))["running"] is None
            process.send_signal(signal.SIGINT)
            out, err = await asyncio.wait_for(process.communicate(), ENDED_S)
        assert (err, process.returncode) == (b"", 0)
        assert b"their keys are deleted" in out
        assert list(folder.iterdir()) == []


@pytest.mark.long
async def test_another_site_cannot_attack(folder: Path) -> None:
    """Nor a request without an origin, nor one by a name that was made to resolve to this address."""
    async with page(folder=folder) as (_, url):
        own = url.rstrip("/")
        for status, headers in (
            (403, {}),
            (403, {"Origin": "null"}),
            (403, {"Origin": "https://site.example"}),
            (403, {"Origin": own.replace("127.0.0.1", "localhost")}),
            (403, {"Origin": own, "Sec-Fetch-Site": "cross-site"}),
            (421, {"Origin": "http://site.example", "Host": "site.example"}),
        ):
            assert (await answer(url, "POST", "/attacks/forge-data", **headers))[0] == status, headers
        assert (await answer(url, "GET", "/attacks/forge-data", Origin=own))[0] == 405
        event = await first(url, lambda event: True)
        assert (event["running"], event["results"]) == (None, [])
        assert [name for name, _ in event["attacks"]] == NAMES


@pytest.mark.long
async def test_the_demo_ends_after_its_seconds(folder: Path) -> None:
    """Its last line is the summary."""
    async with page("--seconds", "1", "--json", folder=folder) as (process, _):
        out, err = await asyncio.wait_for(process.communicate(), ENDED_S)
        summary = json.loads(out.splitlines()[-1])
        assert err == b""
        assert summary["frames_delivered"] > 0
        assert process.returncode == (0 if summary["frames_delivered"] == summary["frames_sent"] else 1)


@pytest.mark.parametrize("has_display", [True, False])
@pytest.mark.long
async def test_a_browser_opens_where_it_can(folder: Path, monkeypatch: pytest.MonkeyPatch, has_display: bool) -> None:
    """The browser, here a script, gets the address. Without a display, none starts."""
    with tempfile.TemporaryDirectory() as place:
        script, written = Path(place) / "browser", Path(place) / "written"
        script.write_text(f'#!/bin/sh\necho "$1" >{written}.new && mv {written}.new {written}\n')
        script.chmod(0o700)
        monkeypatch.setenv("BROWSER", f"{script} %s")
        if has_display:
            monkeypatch.setenv("DISPLAY", ":0")
        async with page(folder=folder) as (_, url):
            if has_display:
                await until(written.exists)
                assert written.read_text() == f"{url}\n"
            else:
                await first(url, lambda event: event["frames"]["sent"] > 100)
                assert not written.exists()


def test_without_the_extra_the_remedy_is_named() -> None:
    """One line, and no demo."""
    main = "from uavlinkd.cli import main; sys.exit(main(['demo', '--web']))"
    script = f"import sys; sys.modules['starlette'] = None; {main}"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("uavlinkd demo --web needs the extra `web` (starlette")
    assert done.stderr.endswith(" -m pip install '.[web]'\n")


def test_the_page_of_a_daemon_only_reads() -> None:
    """Without the laboratory, no resource takes anything but GET."""

    async def ask(_: str) -> dict[str, Any]:
        return {}

    methods = {method for route in make_app(Watcher(ask), []).routes for method in getattr(route, "methods", ())}
    assert methods == {"GET", "HEAD"}
