"""What a trial of an attack came to, and the verdict on it: made of evidence alone.

One JSON line a trial. Trials of attacks on single datagrams hold thousands of attempts; each intervention stands in
the log of the man in the middle.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from uavlinkd.lab.mitm.attack import What

PAPER, OURS = "paper", "uavlinkd"
"""The systems."""
RELAY = "two-sided-relay"
"""The attack that must succeed against the one, and not against the other."""
RECOVERY_LIMIT_S = 2.0
"""A link that does not carry frames again by then, without help, was broken by the attack."""


_WITHHELD = (What.DROPPED, What.HELD, What.REORDERED)


class Verdict(StrEnum):
    """What became of an attack."""

    SUCCEEDED = "succeeded"
    """Something forged, altered, replayed, reflected or misrouted came out at a local program; or the attacker shares
    keys with a drone; or a drone answered where it must be silent, or amplified; or the link stayed down."""
    DETECTED = "detected"
    """Nothing of that, and the drones noticed: counters with a name, beyond what they count where nothing is
    attacked, and a line in the log."""
    BLOCKED = "blocked"
    """Nothing of that, but frames were missing or late while it lasted, for which no datagram is to blame: an
    attacker who drops and delays is not refused, he is outlasted."""
    HARMLESS = "harmless"
    """Nothing of that: every frame came out, and there was nothing to notice."""
    BROKEN = "broken"
    """No attack: it never reached the wire."""


@dataclass(frozen=True, slots=True)
class Trial:
    """One attack against one system. Times in seconds."""

    system: str
    attack: str
    """The row of the table."""
    group: str
    seed: int
    parameters: tuple[str, ...]
    """What the man in the middle was told, one phase after the other."""
    begin_s: float
    """Since the run began."""
    duration_s: float
    attempts: int
    """Datagrams forged, altered, replayed, held back and so on. While a drone was down some met nobody."""
    interventions: Mapping[str, int]
    """By "attack: what"."""
    target: int
    """So many attempts were wanted; 0 where time was."""
    faults: Mapping[str, int]
    """What came out at local programs and may not, by kind."""
    sessions: int
    """Keys that the attacker shares with a drone that takes it for another."""
    achieved: Mapping[str, Any]
    """Of attackers with keys: initiations, answers, what they could read."""
    bytes_to_strangers: int
    must_be_silent: bool
    amplified: tuple[str, ...]
    frames_sent: int
    """While the attack lasted, for each who was to get them."""
    frames_delivered: int
    noticed: Mapping[str, Mapping[str, int]]
    """By drone: counters that grew, of drops and of what disturbed its links."""
    events: Mapping[str, Mapping[str, int]]
    """By drone: what its log says happened meanwhile."""
    recovery_s: float | None
    """From the attack's end until frames sent after it had come out everywhere; None: not within five seconds."""
    notes: str = ""
    observed_s: float = 0.0
    """How long the drones' counters were watched: longer than the attack lasted."""
    control: Mapping[str, float] = field(default_factory=dict)
    """What the drones of this stage count a second, all together, where nothing is attacked."""

    @property
    def withheld(self) -> int:
        """Of the attempts: genuine datagrams that were dropped or held, of which nothing could be accepted."""
        return sum(n for key, n in self.interventions.items() if key.rpartition(" ")[2] in _WITHHELD)

    @property
    def frames_lost(self) -> int:
        """Sent while the attack lasted, and never delivered."""
        return self.frames_sent - self.frames_delivered

    @property
    def is_noticed(self) -> bool:
        """Whether a person can find out: an event that attacks cause, or counts beyond those of quiet times."""
        told = any(events.get(each) for events in self.events.values() for each in ("peer_lost", "path_changed"))
        return told or any(count > self._usual(reason) for reason, count in self.reasons.items())

    def _usual(self, reason: str) -> float:
        """As many as may well be counted in that time without an attack."""
        rate = self.control.get(reason, 0.0)
        return 2 + 2 * rate * self.observed_s if rate else 0.0

    @property
    def reasons(self) -> dict[str, int]:
        """The counters of all drones together."""
        total: dict[str, int] = {}
        for counts in self.noticed.values():
            for reason, count in counts.items():
                total[reason] = total.get(reason, 0) + count
        return dict(sorted(total.items(), key=lambda each: -each[1]))

    @property
    def successes(self) -> list[str]:
        """In what the attacker succeeded, in words; nothing if not."""
        found = [f"{count} frames {kind}" for kind, count in self.faults.items() if count]
        if self.sessions:
            found.append(f"{self.sessions} key exchanges with the drones")
        if self.must_be_silent and self.bytes_to_strangers:
            found.append(f"{self.bytes_to_strangers} bytes of answers to a stranger")
        if self.amplified:
            found.append(f"amplified: {', '.join(self.amplified)}")
        if self.recovery_s is None or self.recovery_s > RECOVERY_LIMIT_S:
            found.append("the link did not come back in time")
        return found

    @property
    def verdict(self) -> Verdict:
        """From the evidence above."""
        if self.attempts == 0:
            return Verdict.BROKEN
        if self.successes:
            return Verdict.SUCCEEDED
        if self.is_noticed:
            return Verdict.DETECTED
        return Verdict.BLOCKED if self.frames_lost else Verdict.HARMLESS

    def to_json(self) -> str:
        """One line, with the verdict."""
        facts = {**asdict(self), "frames_lost": self.frames_lost, "verdict": self.verdict.value}
        return json.dumps({**facts, "successes": self.successes})


@dataclass(frozen=True, slots=True)
class Flood:
    """A drone's load under spoofed initiations, sampled. Times in seconds since the first sample."""

    rate_per_s: float
    begin_s: float
    end_s: float
    """When the flood began and ended."""
    at_s: list[float]
    cpu_share: dict[str, list[float]]
    """Of one core, by daemon, since the sample before."""
    memory_bytes: dict[str, list[int]]
    """Resident."""
    sent_hz: list[float]
    delivered_hz: list[float]
    """Frames a second of the genuine link, both directions."""
    initiations: int

    def to_json(self) -> str:
        """One line."""
        return json.dumps({"flood": asdict(self)})


@dataclass(slots=True)
class Run:
    """All of a run."""

    facts: dict[str, Any] = field(default_factory=dict)
    trials: list[Trial] = field(default_factory=list)
    floods: list[Flood] = field(default_factory=list)

    def of(self, system: str) -> list[Trial]:
        """Those against one system."""
        return [trial for trial in self.trials if trial.system == system]


class TamperingRecordsError(Exception):
    """Records that cannot be read. The message is for a person."""


def read_run(path: Path) -> Run:
    """The records of a run.

    Raises:
        TamperingRecordsError: there are none, or a line is no record.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise TamperingRecordsError(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise TamperingRecordsError(f"{path}: is no text") from None
    run = Run()
    for number, line in enumerate(lines, 1):
        try:
            found = json.loads(line)
            if "run" in found:
                run.facts = dict(found["run"])
            elif "flood" in found:
                run.floods.append(Flood(**found["flood"]))
            else:
                run.trials.append(_trial(found))
        except (ValueError, TypeError, KeyError, AttributeError):
            raise TamperingRecordsError(f"{path}: line {number} is no record of an evaluation") from None
    return run


def _trial(found: dict[str, Any]) -> Trial:
    for derived in ("frames_lost", "verdict", "successes"):
        found.pop(derived)
    return Trial(**{**found, "parameters": tuple(found["parameters"]), "amplified": tuple(found["amplified"])})
