"""Messages and commands of MAVLink, groups of messages, and the facts about each message.

`dialect.json` has the numbers of each message and command: `tests.mavlink.dialect_generate` writes it. `groups.json`
has the groups, each with what it is about, and with the facts about all its messages: they are *critical*, *bulk*,
*reports* or *states* as below, or a report among them *steers* an autopilot all the same, such as DISTANCE_SENSOR.

A *group* is a tuple of message names that a policy can allow by one word. Groups may share messages.
Each message of the dialect is in at least one group, and in ``all``.

Groups follow the effect of a message on an autopilot. This matters for messages with two uses: DISTANCE_SENSOR is
telemetry to a ground station, and an obstacle to an autopilot. Such a message is in `telemetry` and in `sensors`.

The facts about a message are its class, whether it may be old, how it waits, and its instances.

*Class*: a `critical` frame must arrive, a `stream` frame is followed by another, a `bulk` frame can wait.

*Age*: after a silence, or without an answer from the peer, a frame may be old (specification, section 11). Only a
report may be delivered then: a message that asks its receiver for nothing. Positions of other vehicles are reports.
A vehicle that follows or avoids by them has to judge their age itself: see section 11 for how old they may be. Any
other message must be known to be new. That includes a ground station's HEARTBEAT, which silences the failsafe
(:mod:`.payloads`), and a message that the dialect does not have, or not in this form: the effect of an old one is
unknown.

*Lane*: on a link that cannot carry all frames, heartbeats, commands, their answers and manual control go before all
others (the group ``urgent``, a part of the class `critical`).

*State or event*: a message is a **state** if a newer one from the same source contains everything that the older one
said: attitude, position, battery, a setpoint. Of states only the newest is worth sending, and worth delivering. Every
other message is an **event**, which no later message replaces: a parameter, a mission item, a part of a file, a text,
a command, and every message that the dialect does not define.

*Instance*: some messages describe several things in turn (BATTERY_STATUS of two batteries, ADSB_VEHICLE of the
aircraft around). If the newest replaced all of them, some would starve. So the field that tells them apart is part of
the flow (:mod:`.flows`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from enum import IntEnum
from pathlib import Path
from typing import Final, NamedTuple

from uavlinkd.protocol.settings import Class

_tables = json.loads(Path(__file__).with_name("dialect.json").read_bytes())

Row = tuple[str, int, int, int, int | None, int | None, int | None]
"""Name, CRC_EXTRA, shortest and longest payload, and the offsets of target_system, of target_component and of the
number of the command that it carries. Lengths and offsets are in bytes of the payload. The shortest payload is
MAVLink 1's: all fields but the extensions."""
MESSAGES: Final[Mapping[int, Row]] = {int(msgid): tuple(row) for msgid, row in _tables["messages"].items()}
OTHER_EXTRAS: Final[Mapping[int, list[int]]] = {int(msgid): row for msgid, row in _tables["other_extras"].items()}
"""CRC_EXTRAs that other dialects have for the same message id, or for one that MESSAGES lacks."""
INSTANCES: Final[Mapping[str, tuple[int, int]]] = {name: (at, n) for name, (_, at, n) in _tables["instances"].items()}
"""By message name: offset and length, in bytes of the payload, of the fields that tell instances apart."""
COMMANDS: Final[Mapping[str, int]] = {f"MAV_CMD_{name}": number for name, number in _tables["commands"].items()}
del _tables  # 100 kB
IDS: Final[Mapping[str, int]] = {row[0]: msgid for msgid, row in MESSAGES.items()}
"""Each message's id by its name."""
_COMMAND_NAMES: Final = {number: name for name, number in COMMANDS.items()}

ALL: Final = "all"
SETUP_SIGNING: Final = IDS["SETUP_SIGNING"]
"""Carries the key of MAVLink's own signing, in clear. MAVLink 1 has no room for its number."""


def name_of(msgid: int) -> str:
    """The message's name; of an unknown one, its number."""
    row = MESSAGES.get(msgid)
    return row[0] if row else str(msgid)


def command_number(name: str) -> int | None:
    """The number of a command, with or without ``MAV_CMD_`` in front; None if no dialect has it."""
    name = name.upper()
    return COMMANDS.get(name if name.startswith("MAV_CMD_") else f"MAV_CMD_{name}")


def command_name(number: int) -> str:
    """The command's name; of an unknown one, its number."""
    return _COMMAND_NAMES.get(number, str(number))


SYSTEM_ID: Final = "MAV_SYSID (ArduPilot; before 4.7 SYSID_THISMAV) or MAV_SYS_ID (PX4)"
"""The parameter of an autopilot that has its system id."""


def _names(group: Mapping[str, list[str]]) -> tuple[str, ...]:
    return tuple(" ".join(group["messages"]).split())


_text = json.loads(Path(__file__).with_name("groups.json").read_bytes())
GROUPS: Final[Mapping[str, tuple[str, ...]]] = {name: _names(group) for name, group in _text["groups"].items()}
"""The names of the messages of each group."""
_FACTS: Final[Mapping[str, str]] = {name: group.get("facts", "") for name, group in _text["groups"].items()}
_MORE: Final[Mapping[str, tuple[str, ...]]] = {fact: _names(group) for fact, group in _text["more"].items()}
del _text


class Lane(IntEnum):
    """Which queue a frame waits in."""

    URGENT = 0
    EVENTS = 1
    STATES = 2


class MessageKind(NamedTuple):
    """The facts about one message."""

    cls: Class
    may_be_old: bool
    """Whether it may be delivered while freshness is unverified. A ground station's HEARTBEAT may not."""
    lane: Lane
    is_state: bool  # whether a newer one replaces it
    instance_at: int = 0  # where the payload tells one reported thing from another, in bytes
    instance_bytes: int = 0  # the length of that place; 0: the message reports one thing only


def _names_with(fact: str) -> frozenset[str]:
    """The messages of the groups with a fact, and those that `groups.json` adds to them."""
    groups = (GROUPS[name] for name, facts in _FACTS.items() if fact in facts.split())
    return frozenset(_MORE.get(fact, ())).union(*groups)


def _table() -> dict[int, MessageKind]:
    may_be_old = _names_with("reports") - _names_with("steers")
    urgent = frozenset(GROUPS["urgent"])
    # A report about a mission, such as MISSION_CURRENT, is telemetry: the next one makes up for it.
    critical = (_names_with("critical") - (may_be_old - urgent)).union(_MORE["critical"])
    bulk = _names_with("bulk")
    states = _names_with("states").difference(_MORE["said_once"])
    return {
        msgid: MessageKind(
            Class.CRITICAL if name in critical else Class.BULK if name in bulk else Class.STREAM,
            name in may_be_old,
            Lane.URGENT if name in urgent else Lane.STATES if name in states else Lane.EVENTS,
            name in states,
            *INSTANCES.get(name, ()),
        )
        for name, msgid in IDS.items()
    }


KINDS: Final = _table()
"""By message id. The header of a frame has its row: :attr:`.headers.Header.kind`."""
UNKNOWN: Final = MessageKind(Class.STREAM, may_be_old=False, lane=Lane.EVENTS, is_state=False)
"""Of a message that the dialect does not have, or has in another form."""
SAID_ONCE: Final = frozenset(IDS[name] for name in _MORE["said_once"])
"""Message ids in groups of states that no later frame replaces, such as a line of STATUSTEXT."""
