"""Findings: each names one cause that stops frames or threatens a link, and its remedy."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class Severity(IntEnum):
    """How much a finding matters. The smallest is shown first."""

    SECURITY = 0
    """An attack, or a key in two places."""
    FAULT = 1
    """Frames do not pass."""
    WARNING = 2
    """Frames pass, or none is there to pass."""


class Subject(IntEnum):
    """What a finding is about."""

    DAEMON = 0
    PEER = 1
    ENDPOINT = 2


@dataclass(frozen=True, slots=True)
class Finding:
    """One cause with its remedy, as ``status`` shows it in one line."""

    cause: str
    """Its code, such as ``wrong_psk``: a word of a closed list, for scripts."""
    severity: Severity
    subject: Subject
    name: str
    """The peer's or endpoint's name; empty for the daemon."""
    text: str
    """What is wrong, with the facts: one sentence without a full stop."""
    remedy: str
    """What the operator does: one sentence without a full stop."""

    def as_json(self) -> dict[str, str]:
        """Plain values for ``status --json``."""
        return {
            "cause": self.cause,
            "severity": self.severity.name.lower(),
            "subject": self.subject.name.lower(),
            "name": self.name,
            "text": self.text,
            "remedy": self.remedy,
        }
