"""Which traffic the policies wholly refused within the last seconds."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from tests.daemon.frames import frame
from uavlinkd.link.passage import WINDOW_S, Key, Passage
from uavlinkd.mavlink.frames import SplitCounters, split_payload
from uavlinkd.mavlink.policy.compilation import Policy, compile_policy

LEFT_IN: Key = ("peer", "left", "in")


class Traffic:
    """A peer and an endpoint with a policy each, and their samples."""

    def __init__(self, rules: dict[str, Any]) -> None:
        self.link: Any = SimpleNamespace(name="left", counters=SplitCounters(), frames_sent=0)
        self.endpoint: Any = SimpleNamespace(name="autopilot", counters=SplitCounters(), frames_sent=0)
        self.local_policy = compile_policy({}, is_local=True)
        self.set_policy(rules)
        self.passage = Passage()

    def set_policy(self, rules: dict[str, Any]) -> None:
        """Replace the policy of the peer."""
        self.link.policy = compile_policy(rules, is_local=False)

    def receive(self, *systems: int) -> None:
        """Frames of these systems arrive from the peer."""
        for system in systems:
            for one in split_payload(frame(1, system), self.link.counters):
                self.link.policy.incoming.check(one, 0.0)

    def send(self, *systems: int) -> None:
        """Frames of these systems go to the peer."""
        for system in systems:
            for one in split_payload(frame(1, system), SplitCounters()):
                self.link.frames_sent += self.link.policy.outgoing.check(one, 0.0) is None

    def tick(self, seconds: int = 1) -> None:
        """Time passes."""
        for _ in range(seconds):
            self.passage.add_sample([self.link], self._endpoints)

    @property
    def blocked(self) -> list[Key]:
        """What is wholly refused."""
        return self.passage.blocked([self.link], self._endpoints)

    @property
    def _endpoints(self) -> list[tuple[Any, Policy]]:
        return [(self.endpoint, self.local_policy)]


@pytest.fixture
def traffic() -> Traffic:
    """A peer that may speak as system 2 only."""
    return Traffic({"role": "all", "system_ids": [2]})


def test_peer_with_another_system_is_blocked_at_once(traffic: Traffic) -> None:
    """Its first refused frame counts, and any frame that passes ends it."""
    traffic.tick()
    assert traffic.blocked == []
    traffic.receive(7)
    assert traffic.blocked == [LEFT_IN]
    traffic.receive(2)
    assert traffic.blocked == []


def test_refusal_is_forgotten_after_the_window(traffic: Traffic) -> None:
    """A refusal of before is history, and a passed frame of before does not hide a present one."""
    traffic.receive(2, 7, 7)
    traffic.tick(WINDOW_S)
    assert traffic.blocked == []
    traffic.receive(7)
    assert traffic.blocked == [LEFT_IN]
    traffic.tick(WINDOW_S)
    assert traffic.blocked == []


def test_frames_that_are_all_withheld_are_blocked() -> None:
    """The same towards the peer."""
    traffic = Traffic({"system_ids": "all", "allow_in": ["all"], "allow_out": ["PING"]})
    traffic.send(1)
    assert traffic.blocked == [("peer", "left", "out")]


def test_policy_that_passes_nothing_is_intended() -> None:
    """``allow_in = []`` says that no frame of the peer is wanted."""
    traffic = Traffic({"system_ids": "all", "allow_in": [], "allow_out": []})
    traffic.receive(1)
    traffic.send(1)
    assert traffic.blocked == []


def test_new_policy_starts_its_counts_at_zero(traffic: Traffic) -> None:
    """A reload makes the totals smaller: what the new policy refuses counts in full."""
    traffic.receive(7, 7, 7)
    traffic.tick()
    traffic.set_policy({"role": "all", "system_ids": [3]})
    assert traffic.blocked == []
    traffic.receive(7)
    assert traffic.blocked == [LEFT_IN]
