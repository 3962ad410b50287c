"""What a gate has refused, in the codes of the refusal reports (``core/README.md``, section 12)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

from uavlinkd.core.refusals import Refused
from uavlinkd.mavlink.policy.gate import ANY_OTHER, Gate, Refusal

CODES: Final[Mapping[Refusal, int]] = {refusal: code for code, refusal in enumerate(Refusal, 1)}
"""Part of the protocol: a code never changes its meaning. New reasons follow the others."""
REFUSALS: Final[Mapping[int, Refusal]] = {code: refusal for refusal, code in CODES.items()}


def totals(gate: Gate) -> Iterator[Refused]:
    """The refused frames by message, command and reason. Messages that share one count are left out."""
    with_command: dict[tuple[int, Refusal], int] = {}
    for (msgid, command, refusal), count in gate.refused_commands.items():
        if msgid == ANY_OTHER or command <= 0:
            continue  # such frames count for their message
        with_command[msgid, refusal] = with_command.get((msgid, refusal), 0) + count
        yield Refused(msgid, command, CODES[refusal], count)
    for (msgid, refusal), count in gate.refused.items():
        rest = count - with_command.get((msgid, refusal), 0)
        if msgid != ANY_OTHER and rest > 0:
            yield Refused(msgid, 0, CODES[refusal], rest)


class TotalsWatch:
    """Finds the totals that changed since the last look."""

    __slots__ = ("_gate", "_known", "_sum")

    def __init__(self) -> None:
        self._gate: Gate | None = None
        self._sum = 0
        self._known: dict[tuple[int, int, int], int] = {}

    def changed(self, gate: Gate) -> list[Refused]:
        """What a gate refused since the last call. Another gate begins at zero. Call it about once a second."""
        if gate is not self._gate:
            self._gate, self._sum, self._known = gate, 0, {}
        refused = sum(gate.totals.values())
        if refused == self._sum:
            return []
        self._sum = refused
        before, self._known = self._known, {entry[:3]: entry.total for entry in totals(gate)}
        return [Refused(*kind, total) for kind, total in self._known.items() if before.get(kind) != total]
