"""Resolves the addresses of one peer, and keeps the last answer of each."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Sequence
from functools import partial

from structlog.typing import FilteringBoundLogger

from uavlinkd.config import PeerAddress
from uavlinkd.system.resolver import Resolved, keep_resolving, numeric
from uavlinkd.system.tasks import keep_running


class PeerNames:
    """The numeric addresses of a peer now. A look-up that fails leaves the last answer of that name.

    ``interval_s`` returns the interval between the look-ups of an address, ``on_change`` is called after each change.
    """

    def __init__(
        self,
        addresses: Sequence[PeerAddress],
        interval_s: Callable[[PeerAddress], float],
        on_change: Callable[[], None],
        log: FilteringBoundLogger,
    ) -> None:
        self._answers: dict[PeerAddress, Resolved] = {address: [] for address in addresses}
        self._failing: list[set[str]] = []
        self._wakes: list[asyncio.Event] = []
        self._tasks: list[asyncio.Task[None]] = []
        self._on_change = on_change
        for address in addresses:
            if address.is_serial:
                continue  # it needs no look-up
            if address.address.ip is not None and "%" not in address.address.host:
                self._answers[address] = numeric(address.address)
            else:  # a name; or an interface, whose number may change
                self._follow(address, interval_s, log)

    def _follow(
        self, address: PeerAddress, interval_s: Callable[[PeerAddress], float], log: FilteringBoundLogger
    ) -> None:
        failing, wake = set[str](), asyncio.Event()
        on_resolved = partial(self._set, address)
        work = keep_resolving((address.address,), partial(interval_s, address), on_resolved, log, failing, wake)
        self._failing.append(failing)
        self._wakes.append(wake)
        self._tasks.append(keep_running(work, f"the search for {address}"))

    def _set(self, address: PeerAddress, resolved: Resolved) -> bool:
        self._answers[address] = resolved
        self._on_change()
        return True

    @property
    def unresolved(self) -> set[str]:
        """The host names that had no address at the last look-up."""
        return set().union(*self._failing)

    def __iter__(self) -> Iterator[tuple[PeerAddress, Resolved]]:
        """Each configured address in the order of the file, with its last answer."""
        return iter(self._answers.items())

    def wake(self) -> None:
        """Look all names up again now."""
        for wake in self._wakes:
            wake.set()

    def stop(self) -> None:
        """Stop resolving."""
        for task in self._tasks:
            task.cancel()
