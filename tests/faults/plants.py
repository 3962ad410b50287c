"""A daemon in which exceptions are planted while it runs: ``python -m tests.faults.plants run --config FILE``.

The package has nothing for this. A profile function of the interpreter raises when a function of the package is
entered, or when it returns, so that what it did remains and what it returns is lost. Requests on the control socket:

* ``plant FILE FUNCTION call|return TIMES [WHO]``: raise so often, in calls whose arguments name WHO, if it is given.
  Once is forgotten by the guard after a moment, so that many can follow each other;
* ``planted``: how often it was raised since then, and when first;
* ``deafen``: the loop stops to watch the sockets for peers, and all timers go on.
"""

from __future__ import annotations

import asyncio
import sys
import threading
from time import monotonic
from types import FrameType

from uavlinkd.cli import main
from uavlinkd.daemon.daemon import Daemon
from uavlinkd.system import guard


class PlantedError(Exception):
    """The exception that is raised. No code of the package expects it."""


class Plant:
    """Raises :class:`PlantedError` in one function."""

    def __init__(self, file: str, function: str, event: str, times: str, who: str = "") -> None:
        self.hits: list[float] = []
        self._file = file
        self._function = function
        self._event = event
        self._left = int(times)
        self._who = who
        self._loop = asyncio.get_running_loop()

    def arm(self) -> None:
        """Raise from now on. The interpreter forgets a profile function that has raised."""
        sys.setprofile(self)
        threading.setprofile(self)  # of threads that start later

    def __call__(self, frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if event != self._event or code.co_qualname != self._function or not code.co_filename.endswith(self._file):
            return
        if not self._left or (self._who and not any(_names(value, self._who) for value in frame.f_locals.values())):
            return
        self._left -= 1
        self.hits.append(monotonic())
        if self._left:
            self._loop.call_soon_threadsafe(self.arm)
        raise PlantedError(f"planted at the {event} of {self._function}")


def _names(value: object, who: str) -> bool:
    """Whether an argument is a peer or link of this name, or has one."""
    return who in (getattr(value, "name", None), getattr(getattr(value, "peer", None), "name", None))


_WITHIN_S = guard.WITHIN_S
_FORGOTTEN_S = 0.5
_original = Daemon.answer
_plants: list[Plant] = []


async def _answer(self: Daemon, request: str) -> dict[str, object] | None:
    match request.split():
        case ["plant", *words]:
            guard.WITHIN_S = _FORGOTTEN_S if words[3] == "1" else _WITHIN_S  # type: ignore[misc]
            _plants.append(Plant(*words))
            _plants[-1].arm()
            return {}
        case ["planted"]:
            return {"hits": len(_plants[-1].hits), "at": min(_plants[-1].hits, default=None)}
        case ["deafen"]:
            for sock in self.parts.peer_sockets.open_sockets().values():
                asyncio.get_running_loop().remove_reader(sock)
            return {}
    return await _original(self, request)


if __name__ == "__main__":
    Daemon.answer = _answer  # type: ignore[method-assign]
    sys.exit(main())
