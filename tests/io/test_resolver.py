"""Repeated resolution of host names."""

from __future__ import annotations

import asyncio
import itertools
import selectors
import socket
import threading
from collections import Counter
from collections.abc import AsyncIterator
from math import inf
from typing import Any, NoReturn

import pytest
import structlog
from structlog.testing import capture_logs

from tests.needs import need
from tests.waiting import until
from uavlinkd.io import resolver
from uavlinkd.io.resolver import Resolved, keep_resolving, resolve
from uavlinkd.system.addresses import Address

V4, V6 = socket.AF_INET, socket.AF_INET6
Names = dict[str, list[str]]


@pytest.fixture(autouse=True)
async def _look_ups_end(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[None]:
    """While the fake name service is there: a thread that asks a real one afterwards may wait for long."""
    yield
    await until(lambda: not any(thread.name == "look-up" for thread in threading.enumerate()))


@pytest.fixture
def names(monkeypatch: pytest.MonkeyPatch) -> Names:
    """A fake name service; numeric hosts use the real one. Every wait is short."""
    known: Names = {}
    genuine = socket.getaddrinfo

    def look_up(asked: bytes, port: int, *arguments: Any, **options: Any) -> Any:
        if (host := asked.decode()).endswith(".test"):
            if host not in known:
                raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
            return [answer for ip in known[host] for answer in genuine(ip, port, *arguments, **options)]
        return genuine(host, port, *arguments, **options)

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    monkeypatch.setattr(resolver, "FIRST_WAIT_S", 0.001)
    monkeypatch.setattr(resolver, "LONGEST_WAIT_S", 0.002)
    monkeypatch.setattr(resolver, "RELAXED_WAIT_S", 0.004)
    return known


async def test_link_local_address_keeps_its_zone() -> None:
    """Sending to it needs the interface."""
    interface = next((name for number, name in socket.if_nameindex() if number == 1), None)
    need(interface is not None, "an interface with number 1, as a loopback has")
    assert await resolve(Address(f"fe80::1%{interface}", 5790)) == [(V6, ("fe80::1", 5790, 0, 1))]


class Following:
    """A task that keeps resolving, and its results."""

    def __init__(self, address: Address) -> None:
        self.results: list[Resolved] = []
        self.can_use = True
        self.interval_s = 0.0
        self.wake = asyncio.Event()
        self.asked = 0
        self._task = asyncio.create_task(
            keep_resolving(address, self._ask, self._on_resolved, structlog.get_logger(), wake=self.wake)
        )

    async def stop(self) -> None:
        """Cancel the task."""
        self._task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await self._task

    def _on_resolved(self, resolved: Resolved) -> bool:
        self.results.append(resolved)
        return self.can_use

    def _ask(self) -> float:
        self.asked += 1
        return self.interval_s


async def test_only_new_results_are_reported(names: Names) -> None:
    """While the name is urgent, after an interval, and when woken; a failing name does not end the last result."""
    names["drone1.test"] = ["10.0.0.1"]
    following = Following(Address("drone1.test", 5790))
    await until(lambda: bool(following.results))
    asked = following.asked
    await until(lambda: following.asked > asked + 3)
    assert following.results == [[(V4, ("10.0.0.1", 5790))]]
    for number, interval_s in enumerate((0.0, 0.05, inf), 2):
        following.interval_s = interval_s
        asked = following.asked
        await until(lambda asked=asked: following.asked > asked + 3)  # type: ignore[misc]
        names["drone1.test"] = [f"10.0.0.{number}"]
        if interval_s == inf:  # while its address answers, the name is not looked up
            asked = following.asked
            await until(lambda asked=asked: following.asked > asked + 3)  # type: ignore[misc]
            assert len(following.results) == number - 1
            following.wake.set()
        await until(lambda number=number: len(following.results) == number)  # type: ignore[misc]
        assert following.results[-1] == [(V4, (f"10.0.0.{number}", 5790))]
    assert not following.wake.is_set()
    with capture_logs() as logs:
        del names["drone1.test"]
        following.wake.set()
        await until(lambda: bool(logs))
        assert len(following.results) == 4
        await following.stop()


class _NoWaiting(selectors.DefaultSelector):
    """Without an event, the whole timeout has passed."""

    now = 0.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        resolved = super().select(0)
        if not resolved:
            assert timeout is not None, "nothing will ever happen"
            self.now += timeout
        return resolved


def loop_of_no_time() -> asyncio.AbstractEventLoop:
    """An event loop whose clock jumps to the next timer."""
    selector = _NoWaiting()
    loop = asyncio.SelectorEventLoop(selector)
    loop.time = lambda: selector.now  # type: ignore[method-assign]
    return loop


def test_silent_server_gets_a_query_every_two_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rate holds for any silence: the system repeats a query after 5 s and gives up after 10 s."""
    put: list[float] = []

    class Silent:
        async def run(self, *_: object) -> NoReturn:
            for _again in (False, True):
                put.append(asyncio.get_running_loop().time())
                await asyncio.sleep(5.0)
            raise socket.gaierror(socket.EAI_AGAIN, "Temporary failure in name resolution")

    async def follow() -> None:
        following = Following(Address("drone1.test", 5790))
        await asyncio.sleep(60.0)
        await following.stop()

    monkeypatch.setattr(resolver, "_THREADS", Silent())
    with asyncio.Runner(loop_factory=loop_of_no_time) as runner:
        runner.run(follow())
    gaps = [after - before for before, after in itertools.pairwise([*put, 60.0])]
    assert max(gaps) == pytest.approx(1.7)
    assert len(put) == pytest.approx(36, abs=2)


async def test_names_without_answer_do_not_delay_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """The queries of ten absent peers hang, and another name still resolves."""
    gate = threading.Event()
    asked: list[bytes] = []
    genuine = socket.getaddrinfo

    def look_up(host: bytes, *arguments: Any, **options: Any) -> Any:
        if host.startswith(b"gone"):
            asked.append(host)
            gate.wait()
            raise socket.gaierror(socket.EAI_AGAIN, "Temporary failure in name resolution")
        return genuine("10.0.0.1" if host == b"there.test" else host, *arguments, **options)

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    monkeypatch.setattr(resolver, "OVERLAP_S", 0.01)
    gone = [Following(Address(f"gone{number}.test", 1)) for number in range(10)]
    try:
        await until(lambda: len(asked) >= 10 * resolver.MAX_QUERIES)
        await asyncio.sleep(0.1)  # enough time for ten times more queries
        assert Counter(asked) == {f"gone{number}.test".encode(): resolver.MAX_QUERIES for number in range(10)}
        there = Following(Address("there.test", 1))
        await until(lambda: bool(there.results))
        await there.stop()
    finally:
        gate.set()
        for following in gone:
            await following.stop()
