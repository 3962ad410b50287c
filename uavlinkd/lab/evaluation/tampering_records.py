"""The records of trials, with a verdict derived from the evidence.

One JSON line per trial. A trial may have thousands of attempts; the log of the man in the middle has each
intervention.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from uavlinkd.lab.mitm.attack import Operation

PAPER, OURS = "paper", "uavlinkd"
"""The systems."""
RELAY = "two-sided-relay"
"""The attack that must succeed against the paper's protocol and fail against uavlinkd."""
RECOVERY_LIMIT_S = 2.0
"""If a link does not recover by itself within this time, the attack succeeded."""
NOT_IN_TIME = "the link did not recover in time"


EFFECT_HEAD = ("attack", "duration", "attempts", "false frames accepted", "genuine frames lost")
"""The heads of the columns of :attr:`Trial.effect`."""
_WITHHELD = (Operation.DROPPED, Operation.HELD, Operation.REORDERED)


class Verdict(StrEnum):
    """The result of an attack."""

    SUCCEEDED = "succeeded"
    """A forged, altered, replayed, reflected or misrouted frame was delivered; or the attacker shares keys with a
    drone; or a drone answered where it must be silent, or amplified; or the link did not recover."""
    DETECTED = "detected"
    """The attack did not succeed, and the drones noticed it: a counter beyond its rate without an attack, and a line
    in the log."""
    BLOCKED = "blocked"
    """The attack did not succeed, but frames were lost or late meanwhile. Dropping and delaying shows no datagram
    that a drone could refuse."""
    HARMLESS = "harmless"
    """The attack did not succeed, all frames were delivered, and there was nothing to notice."""
    BROKEN = "broken"
    """The attack never reached the network."""


@dataclass(frozen=True, slots=True)
class Trial:
    """One attack against one system. Times in seconds."""

    system: str
    attack: str
    """The row of the table."""
    group: str
    seed: int
    parameters: tuple[str, ...]
    """The line of attacks for the man in the middle, per phase."""
    begin_s: float
    """Since the run began."""
    duration_s: float
    attempts: int
    """Datagrams forged, altered, replayed, held back and so on, including those for a stopped drone."""
    interventions: Mapping[str, int]
    """By "attack: operation"."""
    target: int
    """The requested number of attempts; 0 if the duration was limited."""
    faults: Mapping[str, int]
    """False frames delivered to clients, by kind."""
    sessions: int
    """Sessions of the attacker with a drone that believes it to be another."""
    achieved: Mapping[str, Any]
    """Of attackers with keys: initiations, answers, frames read."""
    bytes_to_strangers: int
    must_be_silent: bool
    amplified: tuple[str, ...]
    frames_sent: int
    """During the attack, counted per receiver."""
    frames_delivered: int
    noticed: Mapping[str, Mapping[str, int]]
    """By drone: counters of drops and link problems that grew."""
    events: Mapping[str, Mapping[str, int]]
    """By drone: events in its log meanwhile."""
    recovery_s: float | None
    """From the attack's end until all receivers got frames sent after it; None: not within 5 s."""
    notes: str = ""
    observed_s: float = 0.0
    """How long the drones' counters were observed: longer than the attack."""
    control: Mapping[str, float] = field(default_factory=dict)
    """The counters of all drones of this stage per second without an attack."""

    critical_sent: int = 0
    critical_lost: int = 0
    """Heartbeats, of those sent during the attack."""
    gap_s: float = 0.0
    """The longest time without a frame at any receiver during the attack."""
    must_stay_up: bool = False
    """Whether a path worked that was not attacked."""
    needs: tuple[str, ...] = ()
    """The counters and events that must show the attack."""

    @property
    def stayed_up(self) -> bool:
        """Whether no drone lost its peer, or was silent for as long as a recovery may take."""
        return self.gap_s <= RECOVERY_LIMIT_S and not any(events.get("peer_lost") for events in self.events.values())

    @property
    def unseen(self) -> list[str]:
        """What should have shown the attack, and did not."""
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
    def effect(self) -> list[str]:
        """What it did and achieved, as the first cells of a row."""
        return [
            self.attack,
            f"{self.duration_s:.0f} s",
            f"{self.attempts:,}",
            str(sum(self.faults.values())),
            f"{self.frames_lost:,} of {self.frames_sent:,}",
        ]

    @property
    def is_noticed(self) -> bool:
        """Whether an operator can notice it: an event that attacks cause, or a counter beyond its usual rate."""
        logged = {name.partition(":")[0] for events in self.events.values() for name in events}
        is_logged = bool(logged & {"peer_lost", "path_changed"})
        return is_logged or any(count > self._usual(reason) for reason, count in self.reasons.items())

    def _usual(self, reason: str) -> float:
        """The maximum count that is usual without an attack."""
        rate = self.control.get(reason, 0.0)
        return 2 + 2 * rate * self.observed_s if rate else 0.0

    @property
    def reasons(self) -> dict[str, int]:
        """The sums of all drones' counters."""
        total: dict[str, int] = {}
        for counts in self.noticed.values():
            for reason, count in counts.items():
                total[reason] = total.get(reason, 0) + count
        return dict(sorted(total.items(), key=lambda pair: -pair[1]))

    @property
    def successes(self) -> list[str]:
        """The successes of the attacker, as text."""
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
        """The verdict, derived from the evidence."""
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


def unseen(
    needs: Sequence[str], noticed: Mapping[str, Mapping[str, int]], events: Mapping[str, Mapping[str, int]]
) -> list[str]:
    """The counters and events of ``needs`` that no drone shows."""
    shown = {name.partition(":")[0] for logged in events.values() for name in logged}
    shown.update(reason for counts in noticed.values() for reason, count in counts.items() if count)
    return [name for name in needs if name not in shown]


@dataclass(frozen=True, slots=True)
class FloodSamples:
    """Samples of the drones' load under spoofed initiations. Times are seconds since the first sample."""

    rate_per_s: float
    begin_s: float
    end_s: float
    """The start and end of the flood."""
    at_s: list[float]
    cpu_share: dict[str, list[float]]
    """Share of one core since the last sample, by daemon."""
    memory_bytes: dict[str, list[int]]
    """Resident memory, by daemon."""
    sent_hz: list[float]
    delivered_hz: list[float]
    """Genuine frames per second, both directions."""
    initiations: int

    def to_json(self) -> str:
        """One line."""
        return json.dumps({"flood": asdict(self)})


@dataclass(slots=True)
class Run:
    """The facts, trials and floods of a run."""

    facts: dict[str, Any] = field(default_factory=dict)
    trials: list[Trial] = field(default_factory=list)
    floods: list[FloodSamples] = field(default_factory=list)

    def of(self, system: str) -> list[Trial]:
        """The trials against one system."""
        return [trial for trial in self.trials if trial.system == system]


class TamperingRecordsError(Exception):
    """The records cannot be read. The message is for the operator."""


def read_run(path: Path) -> Run:
    """Read the records of a run.

    Raises:
        TamperingRecordsError: there are no records, or a line is malformed.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise TamperingRecordsError(f"{path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise TamperingRecordsError(f"{path}: is not text") from None
    run = Run()
    for number, line in enumerate(lines, 1):
        try:
            fields = json.loads(line)
            if "run" in fields:
                run.facts = dict(fields["run"])
            elif "flood" in fields:
                run.floods.append(FloodSamples(**fields["flood"]))
            else:
                run.trials.append(_trial(fields))
        except (ValueError, TypeError, KeyError, AttributeError):
            raise TamperingRecordsError(f"{path}: line {number} is not a record of an evaluation") from None
    return run


def _trial(fields: dict[str, Any]) -> Trial:
    for derived in ("frames_lost", "verdict", "successes"):
        fields.pop(derived)
    lists = ("parameters", "amplified", "needs")
    return Trial(**{**fields, **{name: tuple(fields[name]) for name in lists if name in fields}})
