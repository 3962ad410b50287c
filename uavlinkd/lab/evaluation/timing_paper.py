"""Times the paper's method over its grid, with both ends as processes and a time limit."""

from __future__ import annotations

import json
import random
import selectors
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from types import TracebackType
from typing import Any, Self

from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.evaluation.records import Record, Status, Value

DH_BITS = (256, 512, 1024, 2048, 4096)
"""The paper's sizes; its text has 2028 for 2048 in one place."""
MAC_KEY_BITS = (512, 1024, 2048)
STANDARD_BITS = (2048, 4096)
"""The sizes of the paper for which RFC 7919 has a group."""
DATA_BYTES = 280
"""The largest MAVLink 2 frame."""
PAPER_LIMIT_S = 600.0
"""The time limit of the paper: ten minutes."""

_ANSWER_S = 60.0
_LOOK_S = 0.2


class PaperError(Exception):
    """An end of the exchange failed."""


class End:
    """One end as a process that answers each line with a line."""

    def __init__(self, role: str) -> None:
        self._process = subprocess.Popen(  # noqa: S603  constant command
            end_with_parent(sys.executable, "-m", "uavlinkd.lab.evaluation.paper", role),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        self._selector = selectors.DefaultSelector()
        assert self._process.stdout is not None
        self._selector.register(self._process.stdout, selectors.EVENT_READ)
        try:
            self.port = int(self.answer(_ANSWER_S)["port"])
        except BaseException:
            self.close()
            raise

    def ask(self, what: dict[str, Any]) -> None:
        """Send a line."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(what).encode() + b"\n")
            self._process.stdin.flush()
        except OSError:
            raise PaperError("an end of the exchange has ended") from None

    def answer(self, limit_s: float, on_wait: Callable[[], None] = lambda: None) -> dict[str, Any]:
        """Wait for a line.

        Raises:
            TimeoutError: there is no line within the limit.
            PaperError: the process has ended.
        """
        until = time.monotonic() + limit_s
        while not self._selector.select(min(_LOOK_S, max(0.0, until - time.monotonic()))):
            on_wait()
            if time.monotonic() >= until:
                raise TimeoutError
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise PaperError(f"an end of the exchange ended with status {self._process.wait()}")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def close(self) -> None:
        """Kill the process."""
        self._process.kill()
        self._process.wait()
        self._selector.close()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                stream.close()


class PaperEnds:
    """Both ends. They run many exchanges, each with new parameters and keys, until one takes too long."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)  # noqa: S311  data, not keys
        self._ends: tuple[End, End] | None = None

    def measure(
        self,
        point: dict[str, Value],
        limit_s: float,
        on_wait: Callable[[], None] = lambda: None,
    ) -> Record:
        """Measure one exchange at a point of the grid (``dh_bits``, ``mac_key_bits``, ``group``)."""
        try:
            values = self._exchange(point, limit_s, on_wait)
        except TimeoutError:
            self.close()
            reason = f"not finished in {limit_s:g} s"
            return Record("paper", point, {"limit_s": limit_s}, Status.NOT_FINISHED, reason)
        except (PaperError, OSError, ValueError, KeyError) as error:
            self.close()
            return Record("paper", point, {}, Status.FAILED, str(error) or type(error).__name__)
        if not values["verified"]:
            return Record("paper", point, values, Status.FAILED, "the tag did not verify")
        return Record("paper", point, values)

    def _exchange(self, point: dict[str, Value], limit_s: float, on_wait: Callable[[], None]) -> dict[str, Value]:
        if self._ends is None:
            with ExitStack() as stack:  # if the second one fails, the first has to be stopped too
                ends = [stack.enter_context(closing(End(role))) for role in ("initiator", "responder")]
                self._ends = ends[0], ends[1]
                stack.pop_all()
        initiator, responder = self._ends
        responder.ask({})
        initiator.ask(
            {
                "port": responder.port,
                "bits": point["dh_bits"],
                "mac_bits": point["mac_key_bits"],
                "standard": point["group"] == "standard",
                "data": self._random.randbytes(DATA_BYTES).hex(),
            }
        )
        values = initiator.answer(limit_s, on_wait)
        values |= responder.answer(_ANSWER_S)
        # Both ends have the same monotonic clock.
        values["total_s"] = values.pop("verified_at") - values.pop("started_at")
        return values

    def close(self) -> None:
        """Stop both processes."""
        for end in self._ends or ():
            end.close()
        self._ends = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def paper_points() -> list[dict[str, Value]]:
    """The paper's grid, then the same method in standard groups, which need no generated parameters."""
    made: list[dict[str, Value]] = [
        {"dh_bits": bits, "mac_key_bits": mac_bits, "group": "made"} for bits in DH_BITS for mac_bits in MAC_KEY_BITS
    ]
    standard: list[dict[str, Value]] = [
        {"dh_bits": bits, "mac_key_bits": mac_bits, "group": "standard"}
        for bits in STANDARD_BITS
        for mac_bits in MAC_KEY_BITS
    ]
    return made + standard
