"""The records of trials, with a verdict derived from the evidence.

A trial may have thousands of attempts; the log of the man in the middle has each intervention.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from functools import cached_property
from typing import Any

from uavlinkd.lab.evaluation.records import Record, RunRecords
from uavlinkd.lab.mitm.attack import Operation

PAPER, OURS = "paper", "uavlinkd"
RELAY = "two-sided-relay"
"""The attack that must succeed against the paper's protocol and fail against uavlinkd."""
RECOVERY_LIMIT_S = 2.0
"""If a link does not recover by itself within this time, the attack succeeded."""
NOT_IN_TIME = "the link did not recover in time"
_WITHHELD = (Operation.DROPPED, Operation.HELD, Operation.REORDERED)


class Verdict(StrEnum):
    """The result of an attack; RESULTS-tampering.md has what each means."""

    SUCCEEDED = "succeeded"
    DETECTED = "detected"
    BLOCKED = "blocked"
    HARMLESS = "harmless"
    BROKEN = "broken"


@dataclass(frozen=True, slots=True)
class Trial:
    """One attack against one system. Times in seconds."""

    system: str
    attack: str
    group: str
    attempts: int
    """Datagrams forged, altered, replayed, held back and so on, including those for a stopped drone."""
    parameters: Sequence[str] = field(default_factory=list)
    """The line of attacks for the man in the middle, per phase."""
    duration_s: float = 0.0
    interventions: Mapping[str, int] = field(default_factory=dict)
    """By "attack: operation"."""
    faults: Mapping[str, int] = field(default_factory=dict)
    """False frames delivered to clients, by kind."""
    sessions: int = 0
    """Sessions of the attacker with a drone that believes it to be another."""
    achieved: Mapping[str, int] = field(default_factory=dict)
    """Of attackers with keys: initiations, answers, sessions, frames read."""
    bytes_to_strangers: int = 0
    must_be_silent: bool = False
    amplified: Sequence[str] = field(default_factory=list)
    frames_sent: int = 0
    """During the attack, counted per receiver."""
    frames_delivered: int = 0
    noticed: Mapping[str, int] = field(default_factory=dict)
    """Counters of drops and link problems that grew, of all drones together."""
    events: Mapping[str, int] = field(default_factory=dict)
    """Events in their logs meanwhile."""
    recovery_s: float | None = None
    """From the attack's end until all receivers got frames sent after it; None: not within 5 s."""
    notes: str = ""
    critical_sent: int = 0
    critical_lost: int = 0
    """Heartbeats, of those sent during the attack."""
    gap_s: float = 0.0
    """The longest time without a frame at any receiver during the attack."""
    must_stay_up: bool = False
    """Whether a path worked that was not attacked."""
    needs: Sequence[str] = field(default_factory=list)
    """The counters and events that must show the attack."""

    @property
    def stayed_up(self) -> bool:
        """Whether no drone lost its peer, or was silent for as long as a recovery may take."""
        return self.gap_s <= RECOVERY_LIMIT_S and not self.events.get("peer_lost")

    @property
    def unseen(self) -> list[str]:
        return unseen(self.needs, self.noticed, self.events)

    @property
    def withheld(self) -> int:
        """The attempts that dropped or held a genuine datagram, so that it could not be accepted."""
        return sum(n for key, n in self.interventions.items() if key.rpartition(" ")[2] in _WITHHELD)

    @property
    def frames_lost(self) -> int:
        """Frames sent during the attack and never delivered."""
        return self.frames_sent - self.frames_delivered

    @property
    def false_frames(self) -> int:
        return sum(self.faults.values())

    @property
    def is_noticed(self) -> bool:
        """Whether an operator can notice it: an event that attacks cause, or all counters that must show it."""
        logged = {name.partition(":")[0] for name in self.events}
        return bool(logged & {"peer_lost", "path_changed"} or (self.noticed and not self.unseen))

    @property
    def successes(self) -> list[str]:
        successes = [f"{count} frames {kind}" for kind, count in self.faults.items() if count]
        if self.sessions:
            successes.append(f"{self.sessions} key exchanges with the drones")
        if self.must_be_silent and self.bytes_to_strangers:
            successes.append(f"{self.bytes_to_strangers} bytes of answers to a stranger")
        if self.amplified:
            successes.append(f"amplified: {', '.join(self.amplified)}")
        if self.recovery_s is None or self.recovery_s > RECOVERY_LIMIT_S:
            successes.append(NOT_IN_TIME)
        if self.must_stay_up and self.critical_lost:
            successes.append(f"{self.critical_lost} critical frames lost while a path worked")
        if self.must_stay_up and not self.stayed_up:
            successes.append("the link went down while a path worked")
        return successes

    @property
    def verdict(self) -> Verdict:
        if self.attempts == 0:
            return Verdict.BROKEN
        if self.successes:
            return Verdict.SUCCEEDED
        if self.is_noticed:
            return Verdict.DETECTED
        return Verdict.BLOCKED if self.frames_lost else Verdict.HARMLESS

    def to_record(self) -> Record:
        return Record("trial", {"verdict": self.verdict.value, "attack": self.attack}, asdict(self))


def unseen(needs: Sequence[str], noticed: Mapping[str, int], events: Mapping[str, int]) -> list[str]:
    """The counters and events of ``needs`` that no drone shows."""
    shown = {name.partition(":")[0] for name in events} | {reason for reason, count in noticed.items() if count}
    return [name for name in needs if name not in shown]


class TamperingFindings(RunRecords):
    """The trials of one run."""

    @cached_property
    def trials(self) -> list[Trial]:
        return [Trial(**record.values) for record in self.of("trial")]

    def on(self, system: str) -> list[Trial]:
        return [trial for trial in self.trials if trial.system == system]

    def of_group(self, group: str) -> list[Trial]:
        return [trial for trial in self.trials if trial.group == group]

    def problems(self) -> list[str]:
        lines = [
            f"{trial.attack}: {trial.verdict.value}: {'; '.join(trial.successes) or 'it never reached the network'}"
            for trial in self.on(OURS)
            if trial.verdict in (Verdict.SUCCEEDED, Verdict.BROKEN)
        ]
        lines += [f"{trial.attack}: not noticed: {', '.join(trial.unseen)}" for trial in self.trials if trial.unseen]
        lines += [f"{trial.attack} on the paper's protocol: broken" for trial in self.on(PAPER) if not trial.attempts]
        relay = [trial for trial in self.on(PAPER) if trial.attack == RELAY and trial.false_frames]
        if self.on(PAPER) and [trial.verdict for trial in relay] != [Verdict.SUCCEEDED]:
            lines.append("the two-sided relay did not succeed against the paper's protocol: the relay does not work")
        return lines

    def summary(self) -> dict[str, Any]:
        facts: dict[str, Any] = {"quick": self.run.get("quick")}
        for system in (OURS, PAPER):
            trials = self.on(system)
            verdicts = Counter(trial.verdict.value for trial in trials)
            facts |= {
                f"{system}_attacks": len(trials),
                f"{system}_attempts": sum(trial.attempts for trial in trials),
                f"{system}_false_frames": sum(trial.false_frames for trial in trials),
                **{f"{system}_{verdict.value}": verdicts[verdict.value] for verdict in Verdict},
            }
        return facts
