"""What NATs let in, as tokens from another port of each relay show. uavlinkd/core/README.md, section 22."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Iterator
from typing import Final, NamedTuple

from uavlinkd.core import constants as c
from uavlinkd.core.constants import NEVER
from uavlinkd.core.crypto import Entropy
from uavlinkd.core.drops import DropReason
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Output, RecordReceived
from uavlinkd.core.path import Path
from uavlinkd.core.path_state import PathState
from uavlinkd.core.peer import Peer
from uavlinkd.core.relay_records import TOKEN, FilterTest, FilterTested, token_of
from uavlinkd.link.relay_link import RelayLink

TOKEN_START: Final = bytes((TOKEN,))


class FilterResult(NamedTuple):
    """Of one path to a relay."""

    relay: str
    path: Path
    passes: bool | None
    """Whether a token from another port arrived; None if neither it nor enough answers did."""


class _Test:
    """Of one path to a relay. It has one token."""

    __slots__ = ("answers", "has_passed", "name", "next_at", "path", "peer", "tries", "try_s")

    def __init__(self, name: str, peer: Peer, state: PathState, now: float) -> None:
        self.name = name
        """Of the relay."""
        self.peer = peer
        self.path = state.path
        self.try_s = min(max(c.FILTER_TRY_S, 2 * (state.srtt_s or 0.0)), c.FILTER_TRY_MOST_S)
        self.next_at = now
        """When the next try is due, or the test ends; infinity after its end."""
        self.tries = self.answers = 0
        self.has_passed = False

    @property
    def result(self) -> FilterResult:
        """What is known."""
        passes = True if self.has_passed else False if self.answers >= c.FILTER_ANSWERS else None
        return FilterResult(self.name, self.path, passes)


class FilterTests:
    """Tests of one daemon, all at the same time, when a person asks. Times are monotonic seconds.

    ``on_due`` is called when :attr:`next_at` may be earlier than before.
    """

    def __init__(self, node: Node, entropy: Entropy, on_due: Callable[[], None]) -> None:
        self._node = node
        self._entropy = entropy
        self._on_due = on_due
        self._tests: dict[bytes, _Test] = {}  # by token; empty while none run
        self.results: tuple[FilterResult, ...] = ()
        """Of the last tests that ended."""
        self.ended = asyncio.Event()
        """Set while no tests run."""
        self.ended.set()

    @property
    def next_at(self) -> float:
        """When :meth:`do_due` has something to do."""
        return min((test.next_at for test in self._tests.values()), default=NEVER)

    def begin(self, relays: Iterable[RelayLink], now: float) -> None:
        """Test the best path from each socket to each relay that is up. Tests that run are not disturbed."""
        if self._tests:
            return
        for relay in relays:
            for state in _best_paths(relay.peer):
                token = self._entropy(c.FILTER_TOKEN_BYTES)
                self._tests[token] = _Test(relay.config.name, relay.peer, state, now)
        self.results = ()
        if self._tests:
            self.ended.clear()
            self._on_due()

    def do_due(self, now: float) -> list[Output]:
        """Ask relays for tokens, and end the tests. Call it at :attr:`next_at`."""
        out: list[Output] = []
        for token, test in self._tests.items():
            if now < test.next_at:
                continue
            if test.has_passed or test.tries == c.FILTER_TRIES:
                test.next_at = NEVER
                continue
            test.tries += 1
            test.next_at = now + test.try_s
            out += self._node.send_record(test.peer, test.path, FilterTest(token), now)
        if self._tests and self.next_at == NEVER:
            self.results = tuple(test.result for test in self._tests.values())
            self._tests.clear()
            self.ended.set()
        return out

    def on_record(self, received: RecordReceived) -> DropReason | None:
        """A relay sent a token from another port. Returns why its record has no effect; None if it has one."""
        test = self._tests.get(received.record.token) if isinstance(received.record, FilterTested) else None
        if test is None or received.peer is not test.peer or received.path != test.path:
            return DropReason.UNEXPECTED_RECORD
        test.answers += 1
        self._look(test)
        return None

    def take_token(self, data: bytes, path: Path) -> bool:
        """Note a datagram that begins with :data:`TOKEN_START`. Returns False if it is to be dropped.

        From a port to which there is a path it shows nothing: a NAT lets it in because this daemon sent there.
        """
        test = self._tests.get(token_of(data))
        if test is None or (path.socket, path.host) != (test.path.socket, test.path.host):
            return False
        if any(peer.paths.find(path) is not None for peer in self._node.peers.values()):
            return False
        test.has_passed = True
        self._look(test)
        return True

    def _look(self, test: _Test) -> None:
        """End a test early whose token arrived, with all answers: these are not to come after its end."""
        if test.has_passed and test.answers >= test.tries:
            test.next_at = -NEVER
            self._on_due()


def _best_paths(relay: Peer) -> Iterator[PathState]:
    """The working path with the lowest round trip from each socket to a relay that is up."""
    best: dict[int, PathState] = {}
    for state in relay.paths.states if relay.is_up else ():
        path = state.path
        if state.works and not (path.is_relayed or path.is_serial):
            before = best.get(path.socket)
            if before is None or (state.srtt_s or NEVER) < (before.srtt_s or NEVER):
                best[path.socket] = state
    yield from best.values()
