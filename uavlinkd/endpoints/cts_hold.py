"""How long a modem lowers CTS, by the bytes that the kernel holds for it. Sans-IO: ``now`` is monotonic seconds."""

from __future__ import annotations


class CtsHold:
    """Looks at a line in which the modem can stop this end by the CTS wire."""

    __slots__ = ("_noted_at", "_since", "total_s")

    def __init__(self) -> None:
        self.total_s = 0.0
        """The time for which the modem held this end, until the last look."""
        self._since: float | None = None
        self._noted_at = 0.0

    def note(self, now: float, *, is_held: bool) -> None:
        """A look: ``is_held`` if the kernel has bytes that the wire should have carried by now."""
        if self._since is not None:
            self.total_s += now - self._noted_at
        if not is_held:
            self._since = None
        elif self._since is None:
            self._since = now
        self._noted_at = now

    def lasts_s(self, now: float) -> float:
        """How long it has lasted; 0 if the last look found nothing held."""
        return 0.0 if self._since is None else now - self._since

    def end(self) -> None:
        """The device is closed."""
        self._since = None
