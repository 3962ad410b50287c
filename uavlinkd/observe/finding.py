"""What a finding is: one cause that stops frames or threatens a link, with its remedy."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple


class Severity(IntEnum):
    """How much a finding matters. The smallest is shown first."""

    SECURITY = 0  # an attack, or a key in two places
    FAULT = 1  # frames do not pass
    WARNING = 2  # frames pass, or none is there to pass


class Subject(IntEnum):
    DAEMON = 0
    PEER = 1
    ENDPOINT = 2


class Finding(NamedTuple):
    """One cause with its remedy, as ``status`` shows it in one line."""

    cause: str  # its code, such as `wrong_psk`: a word of a closed list, for scripts
    severity: Severity
    subject: Subject
    name: str  # the peer's or endpoint's name; empty for the daemon
    text: str  # what is wrong, with the facts: one sentence without a full stop
    remedy: str  # what the operator does: one sentence without a full stop

    def as_json(self) -> dict[str, str]:
        """Plain values for ``status --json``."""
        return {
            field: value.name.lower() if isinstance(value, IntEnum) else value
            for field, value in self._asdict().items()
        }
