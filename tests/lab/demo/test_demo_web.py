"""``uavlinkd demo --web``: the page of one of two real daemons, while attacks run."""
# ruff: noqa: ASYNC240  (small local files; nothing else waits in this loop)

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest

from tests.processes.test_demo import ENDED_S, demo
from uavlinkd.web.page import make_app
from uavlinkd.web.watch import Watcher


@pytest.mark.long
async def test_page_of_a_demo_under_attack(short_folder: Path) -> None:
    """It stays after the attacks. Ctrl-C ends the demo, and nothing is left."""
    async with demo("--web", "--attack", "forge-data", "--seconds", "2", folder=short_folder) as process:
        assert process.stdout is not None
        line = (await asyncio.wait_for(process.stdout.readline(), ENDED_S)).decode()
        url = line.removeprefix("the page is at ").removesuffix(" until Ctrl-C\n")
        assert url.startswith("http://127.0.0.1:")
        page = await asyncio.to_thread(lambda: urlopen(url).read())
        assert b"<title>" in page
        await asyncio.sleep(3)
        process.send_signal(signal.SIGINT)
        out, err = await asyncio.wait_for(process.communicate(), ENDED_S)
        assert (err, process.returncode) == (b"", 0)
        assert b"their keys are deleted" in out
        assert list(short_folder.iterdir()) == []


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
