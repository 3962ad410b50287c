"""The conditions of the radio between vehicle and ground station."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Condition:
    """The impairments of both directions. ``radio`` has the keys of a ``[[radio]]`` section of ``uavlink-mitm``."""

    name: str
    about: str
    radio: Mapping[str, object] = field(default_factory=dict)
    link: Mapping[str, object] = field(default_factory=dict)
    """Keys of the daemons' ``[link]`` section."""

    @property
    def needs_daemons(self) -> bool:
        """Whether the condition is a setting of daemons."""
        return bool(self.link)


CLEAN = Condition("clean", "no impairment; no radio emulator in the path")
CONDITIONS = (
    CLEAN,
    Condition("loss10", "10 % of datagrams lost", {"loss": 0.1}),
    Condition("loss30", "30 % of datagrams lost", {"loss": 0.3}),
    Condition("slow", "250 kbit/s", {"bits_per_s": 250_000.0}),
    Condition(
        "slow-budget",
        "250 kbit/s, and the daemons have budget_bits_s = 250000",
        {"bits_per_s": 250_000.0},
        {"budget_bits_s": 250_000},
    ),
    Condition("delay", "50 ± 20 ms in each direction", {"delay_s": 0.03, "jitter_s": 0.04}),
)
BY_NAME = {condition.name: condition for condition in CONDITIONS}
