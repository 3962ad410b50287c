"""The guard of a process: what happens to an exception that is a fault of ours.

Every callback of the loop runs under it, because it is the loop's exception handler. A loop over peers, outputs or
datagrams catches the exception of one of them, calls :func:`report`, and goes on with the next.
"""

from __future__ import annotations

import asyncio
import os
from collections import Counter, deque
from collections.abc import Callable
from traceback import walk_tb
from typing import TYPE_CHECKING, Any, Final

from uavlinkd.system.clock import monotonic

if TYPE_CHECKING:  # commands that ask a daemon import this module too
    from structlog.typing import FilteringBoundLogger

MOST_FAULTS: Final = 5
WITHIN_S: Final = 60.0
"""So many faults at one place within this time end the process: its state may be damaged, and a restart takes 2 s."""
EXIT_STATUS: Final = 70
"""Of a process that its guard ended: EX_SOFTWARE in sysexits.h(3head)."""
_OURS: Final = "uavlinkd."

LoopHandler = Callable[[asyncio.AbstractEventLoop, dict[str, Any]], object]


def report(error: Exception, most: float = MOST_FAULTS) -> None:
    """Report a fault to the guard. ``most``: so many at this place within :data:`WITHIN_S` end the process.

    Infinity is for a fault that costs an answer or a line of the log, 1 for one that leaves damaged state behind.
    """
    context = {"message": f"a fault inside: {error!r}", "exception": error, "most": most}
    asyncio.get_running_loop().call_exception_handler(context)


def run(function: Callable[..., object], *arguments: Any, most: float = MOST_FAULTS) -> None:
    """Call a function. Its fault is reported and costs nothing else."""
    try:
        function(*arguments)
    except Exception as error:
        report(error, most)


def place_of(error: BaseException) -> str:
    """The innermost function of this package in which an exception was raised; empty if there is none."""
    codes = [(str(frame.f_globals.get("__name__")), frame.f_code) for frame, _ in walk_tb(error.__traceback__)]
    ours = [f"{module.removeprefix(_OURS)}.{code.co_qualname}" for module, code in codes if module.startswith(_OURS)]
    return ours[-1] if ours else ""


class FaultGuard:
    """Counts and logs the faults of each place, and ends the process when one has too many.

    ``otherwise`` handles what the loop reports of itself, such as a connection that it could not accept.
    """

    def __init__(
        self, log: FilteringBoundLogger, otherwise: LoopHandler, end: Callable[[int], object] = os._exit
    ) -> None:
        self.faults: Counter[str] = Counter()
        """By place."""
        self.last_at = -WITHIN_S
        self._log = log
        self._otherwise = otherwise
        self._end = end
        self._recent: dict[str, deque[float]] = {}
        self._logged_at: dict[str, float] = {}

    def on_failure(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Handle an exception, as the exception handler of the loop."""
        error = context.get("exception")
        if error is None or not (place := place_of(error)):
            self._otherwise(loop, context)
            return
        self.last_at = now = monotonic()
        self.faults[place] += 1
        recent = self._recent.setdefault(place, deque(maxlen=MOST_FAULTS))
        recent.append(now)
        is_over = sum(now - at <= WITHIN_S for at in recent) >= context.get("most", MOST_FAULTS)
        if is_over or now - self._logged_at.get(place, -WITHIN_S) >= WITHIN_S:
            self._logged_at[place] = now
            self._log.error("fault_caught", place=place, count=self.faults[place], exc_info=error)
        if is_over:
            # At once: a clean stop would run the code that failed. The peers notice the silence.
            self._log.critical("daemon_ended_by_faults", place=place, exit_status=EXIT_STATUS)
            self._end(EXIT_STATUS)
