"""The page beside a daemon that hangs, ends, returns, or answers what is not a status; and hostile names."""

from __future__ import annotations

import asyncio
import json
import signal
from collections.abc import AsyncIterator, Callable
from contextlib import aclosing, asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.processes.conftest import stage
from tests.processes.harness import Stage
from tests.waiting import PATIENCE_S, Stopwatch
from tests.web.served import is_answered, served
from tests.web.statuses import Status, few_facts, overview
from uavlinkd.ops import STATUS_SCHEMA
from uavlinkd.web import watch
from uavlinkd.web.watch import LONGEST_S, Watcher
from uavlinkd.web.watch import PATIENCE_S as ANSWER_S

__all__ = ["stage"]

LOST_S = 3.0
HOSTILE = (
    *(
        "</script><script>alert(1)</script>",
        "a\n\nevent: now\ndata: {}\n\n",
        "a\r\rdata: x",
        "\0",
        "\u2028\u2029\x85",
    ),
    *("\ud800", "<img src=x onerror=alert(1)>", "javascript:alert(1)", "__proto__", "\x1b]0;owned\x07", "a" * 5000),
)


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """The page asks as often as it can, unless a test is about the pace."""
    for name in ("SHORTEST_S", "LONGEST_S", "SAMPLE_S"):
        monkeypatch.setattr(watch, name, 0.01)


class Daemon:
    """Answers what a test says, as :class:`Watcher` gets it."""

    def __init__(self, *peers: str) -> None:
        self.status: Any = overview(peers or ("drone1",))
        self.problems: Any = {"problems": []}
        self.error: Exception | None = None
        self.asked: list[str] = []

    async def ask(self, request: str) -> dict[str, Any]:
        self.asked.append(request)
        await asyncio.sleep(0)
        if self.error is not None:
            raise self.error
        answer: dict[str, Any] = self.problems if request == "problems" else self.status
        return answer


@asynccontextmanager
async def watcher_of(daemon: Daemon) -> AsyncIterator[Watcher]:
    watcher = Watcher(daemon.ask)
    running = asyncio.create_task(watcher.run())
    try:
        yield watcher
        assert not running.done(), running
    finally:
        running.cancel()
        await asyncio.wait([running])


async def message(watcher: Watcher, peer: str, condition: Callable[[Status], bool]) -> Status:
    """The first of the messages about a peer that fulfils a condition. Each of them is one event."""
    async with asyncio.timeout(PATIENCE_S), aclosing(watcher.messages(peer)) as messages:
        async for sent in messages:
            event, end = sent.removeprefix(b"retry: 1000\n\n"), b"\n\n"
            assert event.endswith(end)
            assert event.count(b"\n") == 3
            assert not {b"\r", b"\0"} & {bytes([byte]) for byte in event}
            if event.startswith(b"event: now\n") and condition(facts := json.loads(event.split(b"data: ", 1)[1])):
                return dict(facts)
    raise AssertionError


# A daemon that fails.


async def test_a_daemon_that_hangs_ends_or_returns_is_shown(stage: Stage) -> None:
    """A stopped process is lost within 3 s, as one that ended; both come back without the browser's doing."""
    one, other = stage.pair()
    await stage.start(one, other)
    async with served(one.folder / "control.sock") as page, page.events() as events:
        assert (await events.until(is_answered))["daemon"] == one.name
        await one.send_signal(signal.SIGSTOP)
        stopwatch = Stopwatch()
        lost = await events.until(lambda facts: "lost" in facts)
        assert stopwatch.calm_s < LOST_S
        assert "timed out" in lost["lost"]
        await one.send_signal(signal.SIGCONT)
        await events.until(is_answered)
        await one.stop()
        lost = await events.until(lambda facts: "lost" in facts)
        assert "no daemon answers at" in lost["lost"]
        await stage.start(one)
        assert (await events.until(is_answered))["daemon"] == one.name


def test_a_lost_daemon_is_shown_in_time() -> None:
    """Whatever the pace was."""
    assert LONGEST_S + ANSWER_S < LOST_S


@pytest.mark.parametrize(
    "answered",
    [
        *(
            b"",
            b"\n",
            b"null\n",
            b"[]\n",
            b"5\n",
            b'"overview"\n',
            b"\xff\xfe\n",
            b"garbage\n",
            b"{",
            b'{"schema": 1',
        ),
        *(b"{}\n", b'{"schema": 999}\n', b'{"schema": "1"}\n', b'{"error": "it failed"}\n', b'{"error": null}\n'),
        *(b"[" * 100_000, b'{"a":' * 100_000, b'{"schema": 1e999}\n', b'{"error": {"a": ["<script>"]}}\n'),
        f'{{"schema": {STATUS_SCHEMA}}}\n'.encode(),
        f'{{"schema": {STATUS_SCHEMA}, "peers": 5}}\n'.encode(),
        f'{{"schema": {STATUS_SCHEMA}, "peers": {{"a": null}}}}\n'.encode(),
    ],
)
async def test_an_answer_that_is_no_status_is_a_lost_daemon(tmp_path: Path, answered: bytes) -> None:
    """The page says so, goes on, and shows the daemon once it answers."""
    answers = [answered]

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        request = await reader.readline()
        whole = json.dumps({"problems": []} if request == b"problems\n" else overview()).encode()
        writer.write(answers[0] if answers else whole)
        writer.close()

    daemon = await asyncio.start_unix_server(serve, tmp_path / "control.sock")
    async with (
        served(tmp_path / "control.sock") as page,
        page.events() as events,
        page.events("/events?peer=drone1") as other,
    ):
        await events.until(lambda facts: "lost" in facts and "not answered yet" not in facts["lost"])
        await other.until(lambda facts: "lost" in facts)
        answers.clear()
        assert (await events.until(is_answered))["daemon"] == "ground"
        await other.until(is_answered)
    daemon.close()


@pytest.mark.parametrize("schema", [STATUS_SCHEMA - 1, STATUS_SCHEMA + 1, None])
async def test_a_daemon_of_another_version_is_lost_with_a_remedy(schema: int | None) -> None:
    """Its figures may mean something else."""
    daemon = Daemon()
    daemon.status["schema"] = schema
    async with watcher_of(daemon) as watcher:
        lost = await message(watcher, "", lambda facts: "version" in facts.get("lost", ""))
        assert "restart the older one" in lost["lost"]
        daemon.status["schema"] = STATUS_SCHEMA
        await message(watcher, "", is_answered)


@pytest.mark.parametrize("missing", sorted(overview().keys() - {"public_key", "monotonic_s", "unrouted", "faults"}))
async def test_a_status_without_a_key_stops_nothing(missing: str) -> None:
    """Nor one with another type in its place."""
    daemon = Daemon()
    async with watcher_of(daemon) as watcher:
        await message(watcher, "", is_answered)
        for wrong in (None, 5, "text", [5], {"drone1": 5}):
            daemon.status = {**overview(), missing: wrong}
            await message(watcher, "drone1", lambda facts: True)
            await message(watcher, "", lambda facts: True)
        daemon.status = {key: value for key, value in overview().items() if key != missing}
        await message(watcher, "", lambda facts: "lost" in facts)
        daemon.status = overview()
        await message(watcher, "", is_answered)


# Hostile names and texts.


@pytest.mark.parametrize("text", HOSTILE)
async def test_hostile_text_stays_in_its_event(text: str) -> None:
    """In each place that others can set, on the whole page and on that of a peer: data, and the same as before."""
    finding = {"cause": text, "severity": "security", "subject": "peer", "name": text, "text": text, "remedy": text}
    peer = few_facts(path=text)
    peer["paths"][0] |= {"address": text, "network": text, "relay": text}
    daemon = Daemon()
    daemon.status = overview(findings=[finding], contested=[text], stopped_there=[text], name=text)
    daemon.status["peers"] = {text: peer}
    daemon.status["send_failures"] = {text: 3}
    daemon.problems = {"problems": [{**finding, "began_s": 9.0, "ended_s": None}]}
    async with watcher_of(daemon) as watcher:
        for looked_at in ("", text):
            facts = await message(watcher, looked_at, is_answered)
            assert facts["daemon"] == text
            assert facts["problems"][0]["text"] == text
            assert facts["past"][0]["remedy"] == text
            assert facts["cards"][0]["name"] == text
            assert facts["cards"][0]["word"] == "attack"
