"""Requests to a running attacker by its control socket: the same to the man in the middle and to a hostile relay."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Protocol

from uavlinkd.lab.mitm.attack import AttackError

REQUESTS = '"statistics", "pause", "resume", "stop", "attack none" or "attack NAME,key=value ..."'
MAX_REQUEST_BYTES = 4096
"""Enough for several attacks with all their parameters."""


class Attacker(Protocol):
    """What a request may ask of a running attacker."""

    stopping: asyncio.Event
    """Set by the request ``stop``."""

    def statistics(self) -> dict[str, object]:
        """The counters of this run, as plain data."""

    def pause(self) -> None:
        """Attack nothing until :meth:`resume`."""

    def resume(self) -> None:
        """End a pause."""

    def attack(self, texts: Sequence[str]) -> list[str]:
        """Replace the attacks by those that the texts select, and return their names.

        Raises:
            AttackError: unknown attack or wrong parameters. The former attacks continue.
        """


def answer_request(attacker: Attacker, request: str) -> dict[str, object]:
    """Do what a request asks, and return the answer."""
    match request.split():
        case ["statistics"]:
            return attacker.statistics()
        case ["pause"]:
            attacker.pause()
        case ["resume"]:
            attacker.resume()
        case ["stop"]:
            attacker.stopping.set()
        case ["attack", *texts] if texts:
            try:
                return {"done": "attack", "attacks": attacker.attack([] if texts == ["none"] else texts)}
            except AttackError as error:
                return {"refused": str(error)}
        case _:
            return {"refused": f"there is no request {request!r}: write {REQUESTS}"}
    return {"done": request}
