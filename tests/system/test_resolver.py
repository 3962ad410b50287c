"""Repeated resolution of host names."""

from __future__ import annotations

import asyncio
import itertools
import selectors
import socket
import threading
from collections import Counter
from collections.abc import Callable
from math import inf
from typing import Any, NoReturn

import pytest
import structlog
from structlog.testing import capture_logs

from tests.needs import need
from tests.waiting import until
from uavlinkd.system import resolver
from uavlinkd.system.addresses import Address
from uavlinkd.system.resolver import Resolved, keep_resolving, resolve

V4, V6 = socket.AF_INET, socket.AF_INET6
Names = dict[str, list[str]]


@pytest.fixture
def names(monkeypatch: pytest.MonkeyPatch) -> Names:
    """A fake name service; numeric hosts use the real one. Every wait is short."""
    known: Names = {}
    genuine = socket.getaddrinfo

    def look_up(host: str, port: int, *arguments: Any, **options: Any) -> Any:
        if host.endswith(".test"):
            if host not in known:
                raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
            return [answer for ip in known[host] for answer in genuine(ip, port, *arguments, **options)]
        return genuine(host, port, *arguments, **options)

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    monkeypatch.setattr(resolver, "FIRST_WAIT_S", 0.001)
    monkeypatch.setattr(resolver, "LONGEST_WAIT_S", 0.002)
    monkeypatch.setattr(resolver, "RELAXED_WAIT_S", 0.004)
    return known


async def test_order_is_kept_and_duplicates_are_removed(names: Names) -> None:
    """The result has all addresses of all names, in the order of the file, each once."""
    names["drone1.test"] = ["10.0.0.9", "::1"]
    names["alias.test"] = ["10.0.0.9"]
    resolved, failed = await resolve(
        [Address("10.0.0.1", 5790), Address("drone1.test", 5790), Address("alias.test", 5790), Address("::1", 5791)]
    )
    assert resolved == [
        (V4, ("10.0.0.1", 5790)),
        (V4, ("10.0.0.9", 5790)),
        (V6, ("::1", 5790, 0, 0)),
        (V6, ("::1", 5791, 0, 0)),
    ]
    assert failed == []


async def test_failed_name_does_not_hide_others(names: Names) -> None:
    """It is returned as failed, beside the addresses of the other names."""
    resolved, failed = await resolve([Address("gone.test", 1), Address("10.0.0.1", 2)])
    assert (resolved, failed) == ([(V4, ("10.0.0.1", 2))], ["gone.test"])


async def test_link_local_address_keeps_its_zone() -> None:
    """Sending to it needs the interface."""
    interface = next((name for number, name in socket.if_nameindex() if number == 1), None)
    need(interface is not None, "an interface with number 1, as a loopback has")
    resolved, failed = await resolve([Address(f"fe80::1%{interface}", 5790)])
    assert (resolved, failed) == ([(V6, ("fe80::1", 5790, 0, 1))], [])


class Following:
    """A task that keeps resolving, and its results."""

    def __init__(self, addresses: list[Address]) -> None:
        self.results: list[Resolved] = []
        self.can_use = True
        self.interval_s = 0.0
        self.wake = asyncio.Event()
        self.asked = 0
        self._task = asyncio.create_task(
            keep_resolving(addresses, self._ask, self._on_resolved, structlog.get_logger(), wake=self.wake)
        )

    async def until(self, condition: Callable[[], bool]) -> None:
        """Run the task until a condition holds."""
        await until(condition)

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
    """The same result is not reported twice; a different one is."""
    names["drone1.test"] = ["10.0.0.1"]
    following = Following([Address("drone1.test", 5790)])
    await following.until(lambda: bool(following.results))
    asked = following.asked
    await following.until(lambda: following.asked > asked + 3)
    assert following.results == [[(V4, ("10.0.0.1", 5790))]]
    names["drone1.test"] = ["10.0.0.2"]
    await following.until(lambda: len(following.results) == 2)
    assert following.results[1] == [(V4, ("10.0.0.2", 5790))]
    await following.stop()


async def test_unused_result_is_reported_again(names: Names) -> None:
    """A socket that cannot be opened now may open later, so the same result is reported again."""
    names["drone1.test"] = ["10.0.0.1"]
    following = Following([Address("drone1.test", 5790)])
    following.can_use, following.interval_s = False, inf
    await following.until(lambda: len(following.results) >= 3)
    following.can_use = True
    count = len(following.results)
    await following.until(lambda: len(following.results) == count + 1)
    await asyncio.sleep(0.02)
    assert following.results == [[(V4, ("10.0.0.1", 5790))]] * (count + 1)
    await following.stop()


async def test_names_of_an_answering_peer_are_not_resolved(names: Names) -> None:
    """While the address in use works, its name is not looked up; when it stops working, it is."""
    names["drone1.test"] = ["10.0.0.1"]
    following = Following([Address("drone1.test", 5790)])
    following.interval_s = inf
    await following.until(lambda: len(following.results) == 1)
    names["drone1.test"] = ["10.0.0.2"]
    asked = following.asked
    await following.until(lambda: following.asked > asked + 3)
    assert len(following.results) == 1
    following.interval_s = 0.0
    await following.until(lambda: len(following.results) == 2)
    await following.stop()


async def test_names_are_resolved_again_after_the_interval(names: Names) -> None:
    """Also while every address answers."""
    names["drone1.test"] = ["10.0.0.1"]
    following = Following([Address("drone1.test", 5790)])
    following.interval_s = 0.05
    await following.until(lambda: len(following.results) == 1)
    names["drone1.test"] = ["10.0.0.2"]
    await following.until(lambda: len(following.results) == 2)
    await following.stop()


async def test_woken_task_resolves_at_once(names: Names) -> None:
    """Its interval would never end."""
    names["drone1.test"] = ["10.0.0.1"]
    following = Following([Address("drone1.test", 5790)])
    following.interval_s = inf
    await following.until(lambda: len(following.results) == 1)
    names["drone1.test"] = ["10.0.0.2"]
    following.wake.set()
    await following.until(lambda: len(following.results) == 2)
    assert not following.wake.is_set()
    await following.stop()


def test_failing_name_that_is_not_urgent_is_resolved_less_and_less_often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Up to a query each 30 s, as long as other addresses answer; each second as soon as none does."""
    put: list[float] = []

    class Unknown:
        async def run(self, *_: object) -> NoReturn:
            put.append(asyncio.get_running_loop().time())
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    async def follow() -> None:
        following = Following([Address("drone1.test", 5790)])
        following.interval_s = 300.0
        await asyncio.sleep(1000.0)
        following.interval_s = resolver.LONGEST_WAIT_S
        await asyncio.sleep(10.0)
        await following.stop()

    monkeypatch.setattr(resolver, "_THREADS", Unknown())
    with asyncio.Runner(loop_factory=loop_of_no_time) as runner:
        runner.run(follow())
    gaps = [after - before for before, after in itertools.pairwise(put)]
    assert gaps[:7] == pytest.approx([0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 30.0])
    assert max(gaps) == pytest.approx(30.0)
    assert gaps[-5:] == pytest.approx([1.0] * 5)


async def test_name_that_appears_late_is_resolved(names: Names) -> None:
    """Names fail before the network is up. Each begin of a failure is logged once, and look-ups go on."""
    with capture_logs() as logs:
        following = Following([Address("drone1.test", 5790)])
        following.interval_s = inf
        await following.until(lambda: bool(logs))
        await asyncio.sleep(0.02)
        names["drone1.test"] = ["10.0.0.1"]
        await following.until(lambda: len(following.results) == 1)
        await following.stop()
    assert [(line["event"], line["host"]) for line in logs] == [("name_not_resolved", "drone1.test")]


async def test_last_result_is_kept_while_names_fail(names: Names) -> None:
    """Without the name service, the peer keeps its last addresses."""
    names["drone1.test"] = ["10.0.0.1"]
    with capture_logs() as logs:
        following = Following([Address("drone1.test", 5790)])
        await following.until(lambda: len(following.results) == 1)
        del names["drone1.test"]
        await following.until(lambda: bool(logs))
        assert len(following.results) == 1
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


def test_silent_server_gets_a_query_every_second(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rate holds for any silence: the system repeats a query after 5 s and gives up after 10 s."""
    put: list[float] = []

    class Silent:
        async def run(self, *_: object) -> NoReturn:
            for _again in (False, True):
                put.append(asyncio.get_running_loop().time())
                await asyncio.sleep(5.0)
            raise socket.gaierror(socket.EAI_AGAIN, "Temporary failure in name resolution")

    async def follow() -> None:
        following = Following([Address("drone1.test", 5790)])
        await asyncio.sleep(60.0)
        await following.stop()

    monkeypatch.setattr(resolver, "_THREADS", Silent())
    with asyncio.Runner(loop_factory=loop_of_no_time) as runner:
        runner.run(follow())
    gaps = [after - before for before, after in itertools.pairwise([*put, 60.0])]
    assert max(gaps) == pytest.approx(1.0)
    assert len(put) == pytest.approx(60, abs=2)


async def test_names_without_answer_do_not_delay_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """The queries of ten absent peers hang, and another name still resolves."""
    gate = threading.Event()
    asked: list[str] = []
    genuine = socket.getaddrinfo

    def look_up(host: str, *arguments: Any, **options: Any) -> Any:
        if host.startswith("gone"):
            asked.append(host)
            gate.wait()
            raise socket.gaierror(socket.EAI_AGAIN, "Temporary failure in name resolution")
        return genuine("10.0.0.1" if host == "there.test" else host, *arguments, **options)

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    monkeypatch.setattr(resolver, "LONGEST_WAIT_S", 0.01)
    gone = [Following([Address(f"gone{number}.test", 1)]) for number in range(10)]
    share = resolver.MAX_THREADS // 10
    try:
        await until(lambda: len(asked) >= 10 * share)
        await asyncio.sleep(0.1)  # enough time for ten times more queries
        assert Counter(asked) == {f"gone{number}.test": share for number in range(10)}
        there = Following([Address("there.test", 1)])
        await there.until(lambda: bool(there.results))
        await there.stop()
    finally:
        gate.set()
        for following in gone:
            await following.stop()
