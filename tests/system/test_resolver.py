"""Host names to addresses, again and again."""

from __future__ import annotations

import asyncio
import itertools
import selectors
import socket
import threading
from collections import Counter
from collections.abc import Callable
from typing import Any, NoReturn

import pytest
import structlog
from structlog.testing import capture_logs

from tests.daemon.harness import need
from tests.waiting import until
from uavlinkd.system import resolver
from uavlinkd.system.addresses import Address
from uavlinkd.system.resolver import Resolved, keep_resolving, resolve

V4, V6 = socket.AF_INET, socket.AF_INET6
Names = dict[str, list[str]]


@pytest.fixture
def names(monkeypatch: pytest.MonkeyPatch) -> Names:
    """A name service that a test fills; numeric hosts are asked of the real one. No wait is longer than a moment."""
    known: Names = {}
    genuine = socket.getaddrinfo

    def look_up(host: str, port: int, *arguments: Any, **options: Any) -> Any:
        if host.endswith(".test"):
            if host not in known:
                raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
            return [each for ip in known[host] for each in genuine(ip, port, *arguments, **options)]
        return genuine(host, port, *arguments, **options)

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    monkeypatch.setattr(resolver, "FIRST_WAIT_S", 0.001)
    monkeypatch.setattr(resolver, "LONGEST_WAIT_S", 0.002)
    return known


async def test_order_is_kept_and_doubles_are_left_out(names: Names) -> None:
    """All addresses of all names, in the order of the file, each once."""
    names["drone1.test"] = ["10.0.0.9", "::1"]
    names["alias.test"] = ["10.0.0.9"]
    found, failed = await resolve(
        [Address("10.0.0.1", 5790), Address("drone1.test", 5790), Address("alias.test", 5790), Address("::1", 5791)]
    )
    assert found == [(V4, "10.0.0.1", 5790), (V4, "10.0.0.9", 5790), (V6, "::1", 5790), (V6, "::1", 5791)]
    assert failed == []


async def test_a_name_that_fails_does_not_hide_the_others(names: Names) -> None:
    """It is returned as failed, beside what was found."""
    found, failed = await resolve([Address("gone.test", 1), Address("10.0.0.1", 2)])
    assert (found, failed) == ([(V4, "10.0.0.1", 2)], ["gone.test"])


async def test_a_link_local_address_keeps_its_zone() -> None:
    """Without the interface nothing could be sent there."""
    interface = next((name for number, name in socket.if_nameindex() if number == 1), None)
    need(interface is not None, "an interface with number 1, as a loopback has")
    found, failed = await resolve([Address(f"fe80::1%{interface}", 5790)])
    assert (found, failed) == ([(V6, "fe80::1%1", 5790)], [])


class Following:
    """One task that keeps resolving, and what it told."""

    def __init__(self, addresses: list[Address]) -> None:
        self.told: list[Resolved] = []
        self.is_wanted = self.can_use = True
        self.asked = 0
        self._task = asyncio.create_task(keep_resolving(addresses, self._ask, self._tell, structlog.get_logger()))

    async def until(self, condition: Callable[[], bool]) -> None:
        """Let it work until then."""
        await until(condition)

    async def stop(self) -> None:
        """End it."""
        self._task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await self._task

    def _tell(self, found: Resolved) -> bool:
        self.told.append(found)
        return self.can_use

    def _ask(self) -> bool:
        self.asked += 1
        return self.is_wanted


async def test_only_what_is_new_is_told(names: Names) -> None:
    """The same answer again is no news; another one is."""
    names["drone1.test"] = ["10.0.0.1"]
    following = Following([Address("drone1.test", 5790)])
    await following.until(lambda: following.asked > 3)
    assert following.told == [[(V4, "10.0.0.1", 5790)]]
    names["drone1.test"] = ["10.0.0.2"]
    await following.until(lambda: len(following.told) == 2)
    assert following.told[1] == [(V4, "10.0.0.2", 5790)]
    await following.stop()


async def test_what_could_not_be_used_is_told_again(names: Names) -> None:
    """A socket that could not be had now may be had later: the same answer is then no old news."""
    names["drone1.test"] = ["10.0.0.1"]
    following = Following([Address("drone1.test", 5790)])
    following.can_use = following.is_wanted = False
    await following.until(lambda: len(following.told) >= 3)
    following.can_use = True
    told = len(following.told)
    await following.until(lambda: len(following.told) == told + 1)
    await asyncio.sleep(0.02)
    assert following.told == [[(V4, "10.0.0.1", 5790)]] * (told + 1)
    await following.stop()


async def test_a_peer_that_answers_is_not_looked_up(names: Names) -> None:
    """While the address in use works, names may change without harm; when it does not, they are asked again."""
    names["drone1.test"] = ["10.0.0.1"]
    following = Following([Address("drone1.test", 5790)])
    following.is_wanted = False
    await following.until(lambda: len(following.told) == 1)
    names["drone1.test"] = ["10.0.0.2"]
    asked = following.asked
    await following.until(lambda: following.asked > asked + 3)
    assert len(following.told) == 1
    following.is_wanted = True
    await following.until(lambda: len(following.told) == 2)
    await following.stop()


async def test_a_name_that_comes_late_is_found(names: Names) -> None:
    """Before the network is there names fail: told once each time they begin to fail, and asked until they do not."""
    with capture_logs() as logs:
        following = Following([Address("drone1.test", 5790)])
        following.is_wanted = False
        await following.until(lambda: bool(logs))
        await asyncio.sleep(0.02)
        names["drone1.test"] = ["10.0.0.1"]
        await following.until(lambda: len(following.told) == 1)
        await following.stop()
    assert [(line["event"], line["host"]) for line in logs] == [("name_not_resolved", "drone1.test")]


async def test_an_answer_that_vanishes_is_kept(names: Names) -> None:
    """When the name service goes away, what it said before goes on being used."""
    names["drone1.test"] = ["10.0.0.1"]
    with capture_logs() as logs:
        following = Following([Address("drone1.test", 5790)])
        await following.until(lambda: len(following.told) == 1)
        del names["drone1.test"]
        await following.until(lambda: bool(logs))
        assert len(following.told) == 1
        await following.stop()


class _NoWaiting(selectors.DefaultSelector):
    """Where nothing comes, the time in which it could have come has passed."""

    now = 0.0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        found = super().select(0)
        if not found:
            assert timeout is not None, "nothing will ever happen"
            self.now += timeout
        return found


def loop_of_no_time() -> asyncio.AbstractEventLoop:
    """An event loop whose clock jumps to what is next."""
    selector = _NoWaiting()
    loop = asyncio.SelectorEventLoop(selector)
    loop.time = lambda: selector.now  # type: ignore[method-assign]
    return loop


def test_a_silent_server_is_asked_each_second(monkeypatch: pytest.MonkeyPatch) -> None:
    """However long it is silent: the system repeats a question after 5 s and gives up after 10."""
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


async def test_names_that_nobody_answers_for_leave_room_for_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten peers that are not there, each question hanging: another's name is answered all the same."""
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
    share = resolver.MOST_THREADS // 10
    try:
        await until(lambda: len(asked) >= 10 * share)
        await asyncio.sleep(0.1)  # in which each could ask ten times more
        assert Counter(asked) == {f"gone{number}.test": share for number in range(10)}
        there = Following([Address("there.test", 1)])
        await there.until(lambda: bool(there.told))
        await there.stop()
    finally:
        gate.set()
        for each in gone:
            await each.stop()
