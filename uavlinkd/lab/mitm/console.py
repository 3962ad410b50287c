"""What the commands of ``uavlink-mitm`` share: exit statuses, requests to a running one, and a run until a signal."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Protocol, TypeVar

from uavlinkd.ops.control import ControlError, ask
from uavlinkd.system.signals import on_signal
from uavlinkd.system.terminal import printable

OK, FAILED, WRONG = 0, 1, 2
_Result = TypeVar("_Result")


class Service(Protocol):
    """A proxy, or a pair of modems."""

    stopping: asyncio.Event

    async def start(self) -> None:
        """Begin."""

    async def stop(self) -> None:
        """End, whatever has begun."""


async def run_until_stopped(service: Service, seconds: float | None, result: Callable[[], _Result]) -> _Result:
    """Run until SIGTERM, SIGINT, ``stop`` on the control socket, or for ``seconds``.

    ``result`` is called before the service stops. Raises what its ``start`` raises.
    """
    for name in ("SIGTERM", "SIGINT"):
        on_signal(name, service.stopping.set)
    await service.start()
    try:
        with suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await service.stopping.wait()
        return result()
    finally:
        await service.stop()


def send_request(path: Path, request: str) -> int:
    """Ask a running one, and print its answer. Returns the exit status."""
    try:
        answer = ask(path, request)
    except ControlError as error:
        return fail(error)
    if "refused" in answer:
        return fail(answer["refused"])
    print(json.dumps(answer, indent=2))
    return OK


def fail(problem: object, status: int = FAILED) -> int:
    """Print a problem to standard error. Returns the exit status."""
    print(printable(str(problem), keep="\n"), file=sys.stderr)
    return status
