"""The list of all attacks of a hostile relay."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from uavlinkd.lab.hostile.fleet_attacks import Introduce, Withhold
from uavlinkd.lab.hostile.relay_attacks import (
    BindWrongMembers,
    InventHandles,
    LieAboutAddresses,
    LieAboutFilters,
    RelayAttack,
    RestartAndReplay,
    SendOwnFrames,
)
from uavlinkd.lab.mitm.attack import Attack
from uavlinkd.lab.mitm.attacks import ATTACKS

_ALL: tuple[type[RelayAttack], ...] = (
    *(LieAboutAddresses, BindWrongMembers, InventHandles, SendOwnFrames, LieAboutFilters, RestartAndReplay),
    *(Withhold, Introduce),
)
RELAY_ATTACKS: Final[Mapping[str, type[RelayAttack]]] = MappingProxyType({one.name: one for one in _ALL})
ALL_ATTACKS: Final[Mapping[str, type[Attack]]] = MappingProxyType({**RELAY_ATTACKS, **ATTACKS})
"""All that a relay can do: its own attacks, and those of the man in the middle on what it forwards."""
