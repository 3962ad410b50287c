"""Resolves the addresses of one peer or relay, and keeps the last answer of each."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Final

from structlog.typing import FilteringBoundLogger

from uavlinkd.config.model import PeerAddress
from uavlinkd.daemon.features import Reachable
from uavlinkd.io.resolver import LONGEST_WAIT_S, RELAXED_WAIT_S, Resolved, keep_resolving, numeric
from uavlinkd.protocol.path import Path
from uavlinkd.system.tasks import keep_running

REFRESH_S: Final = 300.0
"""The names of a peer that is up are resolved this often."""


class PeerNames:
    """The numeric addresses of ``link`` now. A look-up that fails leaves the last answer of that name."""

    def __init__(self, link: Reachable, on_change: Callable[[PeerNames], None], log: FilteringBoundLogger) -> None:
        self.link = link
        self.paths: dict[PeerAddress, Sequence[Path]] | None = None
        """The paths that the core knows, by address of the configuration; None before it knows any."""
        self._on_change = on_change
        self._answers: dict[PeerAddress, Resolved] = {address: [] for address in link.config.addresses}
        self._searches: list[tuple[asyncio.Task[None], asyncio.Event, set[str]]] = []  # those: names that fail
        for address in link.config.addresses:
            if address.is_serial or address.address.resource:
                continue  # it needs no look-up, or has one for each connection
            if address.address.ip is not None and "%" not in address.address.host:
                self._answers[address] = numeric(address.address)
                continue
            # A name; or an interface, whose number may change.
            failing, wake = set[str](), asyncio.Event()
            interval_s, on_resolved = partial(self.interval_s, address), partial(self._set, address)
            work = partial(keep_resolving, address.address, interval_s, on_resolved, log, failing, wake)
            self._searches.append((keep_running(work, f"the search for {address}"), wake, failing))

    def _set(self, address: PeerAddress, resolved: Resolved) -> bool:
        self._answers[address] = resolved
        self._on_change(self)
        return True

    def interval_s(self, address: PeerAddress) -> float:
        """How often an address is resolved now."""
        peer = self.link.peer
        if not peer.is_up:
            return LONGEST_WAIT_S
        states = [peer.paths.find(path) for path in (self.paths or {}).get(address, ())]
        # Without its network, an address does not answer anyway. A network that is back has all names resolved.
        is_down = any(state is not None and not (state.works or state.is_off) for state in states)
        return RELAXED_WAIT_S if is_down else REFRESH_S

    @property
    def unresolved(self) -> set[str]:
        """The host names that had no address at the last look-up."""
        return {name for _, _, failing in self._searches for name in failing}

    def __iter__(self) -> Iterator[tuple[PeerAddress, Resolved]]:
        """Each configured address in the order of the file, with its last answer."""
        return iter(self._answers.items())

    def wake(self) -> None:
        """Look all names up again now."""
        for _, wake, _ in self._searches:
            wake.set()

    def stop(self) -> None:
        """Stop resolving."""
        for task, _, _ in self._searches:
            task.cancel()
