"""A daemon with as many peers as a test likes, made up from the answers of a real one."""

from __future__ import annotations

import asyncio
from copy import deepcopy
from typing import Any

from tests.processes.harness import Stage
from tests.web.statuses import Status
from uavlinkd.ops.control import Answer


class MadeUpDaemon:
    """Answers ``overview`` and ``problems``. A test may change the facts at any time.

    ``status``: all facts of all peers; a request names those of which the answer has all.
    """

    def __init__(self, status: Status, few: Status) -> None:
        self.status = status
        self.problems: list[dict[str, Any]] = []
        """As in the log: findings with ``began_s`` and ``ended_s``."""
        (one,) = few["peers"].values()
        self._few_facts = one.keys()
        self._few_of_path = one["paths"][0].keys()
        self.answers = asyncio.Event()
        """Cleared: it hangs."""
        self.answers.set()

    async def answer(self, request: str) -> Answer:
        await self.answers.wait()
        name, _, detailed = request.partition(" ")
        if name == "problems":
            return {"problems": self.problems}
        if name != "overview":
            return None
        peers = {name: peer if name in detailed else self._few(peer) for name, peer in self.status["peers"].items()}
        return self.status | {"peers": peers}

    def _few(self, peer: Status) -> Status:
        few = {key: fact for key, fact in peer.items() if key in self._few_facts}
        paths = [{key: path[key] for key in self._few_of_path} for path in peer["paths"]]
        return few | {"paths": paths}

    def find(self, name: str, text: str, remedy: str, severity: str = "fault") -> None:
        """A peer has a problem, which the log has too."""
        finding = {"cause": "wrong_psk", "subject": "peer", "name": name, "text": text, "remedy": remedy}
        self.status["findings"].append(finding | {"severity": severity})
        self.problems.append(finding | {"severity": severity, "began_s": 60.0, "ended_s": None})


async def make_up(count: int) -> MadeUpDaemon:
    """A daemon with so many peers named ``drone1`` …, which are up."""
    status, few = await _real()
    (real,) = status["peers"].values()
    status["peers"] = {f"drone{number}": deepcopy(real) for number in range(1, count + 1)}
    return MadeUpDaemon(status, few)


async def _real() -> tuple[Status, Status]:
    """The answer of a real daemon with all facts of its one peer, and that with few of them."""
    async with Stage() as stage:
        one, other = stage.pair()
        one.add_endpoint("autopilot")
        await stage.start(one, other)
        return await one.ask(f"overview {other.name}"), await one.ask("overview")
