"""Converts a policy's plain data to sets of numbers, or reports every problem in it: see :mod:`.compilation`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Literal, NamedTuple

from uavlinkd.mavlink import dialect
from uavlinkd.mavlink.dialect import COMMANDS, IDS, SAID_ONCE
from uavlinkd.mavlink.policy.roles import ROLES
from uavlinkd.system.spelling import meant

MAX_MSGID: Final = 0xFFFFFF
MAX_COMMAND: Final = 0xFFFF
MAX_SYSTEM: Final = 255

KEYS: Final = ("role", "system_ids", "allow_in", "allow_out", "rate_in", "rate_out", "mavlink1", "ground_station")

FILE_TRANSFER: Final = IDS["FILE_TRANSFER_PROTOCOL"]
_COMMANDS: Final = frozenset((IDS["COMMAND_LONG"], IDS["COMMAND_INT"]))
# MAVLink's MAV_FTP_OPCODE (https://mavlink.io/en/services/ftp.html). The others create, write, truncate, rename or
# remove; a number outside the definition may have any effect.
# In this order: TerminateSession, ResetSessions, ListDirectory, OpenFileRO, ReadFile, CalcFileCRC32, BurstReadFile;
# ACK and NAK, of either kind of request.
READING_OPCODES: Final = frozenset((1, 2, 3, 4, 5, 14, 15, 128, 129))
ANSWERING_OPCODES: Final = frozenset((128, 129))
_OPCODES: Final = {"files-read": READING_OPCODES, "file-answers": ANSWERING_OPCODES}


class PolicyProblem(NamedTuple):
    """One problem in a policy's data."""

    key: str  # with the place in a list: "allow_in[2]"
    problem: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.key}: {self.problem}; {self.remedy}"


class PolicyError(ValueError):
    """A policy's data is invalid. Lists every problem."""

    def __init__(self, problems: Iterable[PolicyProblem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(map(str, self.problems)))


Direction = Literal["in", "out"]


@dataclass(frozen=True, slots=True)
class Rules:
    """The rules for one direction. Numbers are message ids, or commands if the name contains `commands`."""

    allows_all: bool
    allowed: frozenset[int]  # by name or group: the message as the dialect defines it
    allowed_numbers: frozenset[int]  # by number: in any definition
    allowed_commands: frozenset[int]
    opcodes: frozenset[int]  # of FILE_TRANSFER_PROTOCOL, where only some of its requests or its answers pass

    def allows_command(self, number: int) -> bool:
        """Whether a command passes as a message of its own."""
        return (
            self.allows_all
            or number in self.allowed_commands
            or not _COMMANDS.isdisjoint(self.allowed | self.allowed_numbers)
        )


@dataclass(frozen=True, slots=True)
class Settings:
    """A policy's data after reading."""

    is_empty: bool  # no data, which only a local endpoint may have
    role: str | None
    systems: frozenset[int] | None  # that it may send as; None: any
    systems_text: str
    rules: Mapping[Direction, Rules]
    rates: Mapping[Direction, Mapping[int, float]]  # frames a second, by message id
    mavlink1: bool
    ground_station: bool


Report = Callable[[str, str, str], None]  # key, problem, remedy


class _Entry(NamedTuple):
    """The meaning of one entry of a list."""

    is_all: bool = False
    messages: tuple[int, ...] = ()
    number: int | None = None
    command: int | None = None
    opcodes: frozenset[int] = frozenset()  # the only ones of FILE_TRANSFER_PROTOCOL


def read_settings(data: Mapping[str, object], *, is_local: bool) -> Settings:
    """Read a policy's plain data. ``is_local``: for an endpoint, where everything passes without a list.

    Raises PolicyError with every problem of the data.
    """
    problems: list[PolicyProblem] = []

    def report(key: str, problem: str, remedy: str) -> None:
        problems.append(PolicyProblem(key, problem, remedy))

    for key in data:
        if key not in KEYS:
            report(str(key), "no such key", _did_you_mean(str(key), KEYS, f"the keys are {', '.join(KEYS)}"))
    role_name = data.get("role")
    role = ROLES.get(role_name) if isinstance(role_name, str) else None
    if role_name is not None and role is None:
        report("role", f"no such role: {role_name!r}", f"the roles are {', '.join(ROLES)}")
    if not is_local:
        _check_is_complete(data, report)
    systems, systems_text = _systems(data, report, is_needed=not is_local)
    rules: dict[Direction, Rules] = {}
    rates: dict[Direction, Mapping[int, float]] = {}
    presets: dict[Direction, tuple[str, ...] | None] = {"in": role and role.allow_in, "out": role and role.allow_out}
    for direction, preset in presets.items():
        allow = _entries(data, f"allow_{direction}", report)
        allows_all = is_local and preset is None and f"allow_{direction}" not in data
        rules[direction] = _rules((*(preset or ()), *allow), allows_all=allows_all)
        rates[direction] = _rates(data, f"rate_{direction}", report)
    if role is not None:
        rates["in"] = {**_rates({"rate_in": role.rate_in}, "rate_in", report), **rates["in"]}
    settings = Settings(
        is_empty=not data,
        role=role_name if isinstance(role_name, str) else None,
        systems=systems,
        systems_text=systems_text,
        rules=rules,
        rates=rates,
        mavlink1=_flag(data, "mavlink1", True, report),
        ground_station=_flag(data, "ground_station", role is None or role.ground_station, report),
    )
    if problems:
        raise PolicyError(problems)
    return settings


def _check_is_complete(data: Mapping[str, object], report: Report) -> None:
    """Report a missing list of a peer's policy: a missing key never allows a message."""
    if "role" in data:
        return
    missing = [key for key in ("allow_in", "allow_out") if key not in data]
    if len(missing) == 2:
        names = ", ".join(f'"{name}"' for name in ROLES if name != dialect.ALL)
        remedy = f'write role = one of {names}, or both lists; role = "{dialect.ALL}" passes everything'
        report("role", "missing, as are allow_in and allow_out: the policy does not define what passes", remedy)
    for key in missing if len(missing) == 1 else ():
        direction = "come from" if key == "allow_in" else "go to"
        report(
            key,
            f"missing: without a role, the policy does not define what may {direction} this peer",
            f'write {key} = ["telemetry"] or other entries; [] passes nothing, ["{dialect.ALL}"] everything',
        )


@lru_cache(maxsize=256)  # a fleet's peers mostly have the same lists, and share their rules
def _rules(allow: tuple[str | int, ...], *, allows_all: bool) -> Rules:
    allowed = [entry for entry in map(_entry, allow) if isinstance(entry, _Entry)]
    by_name = (set(entry.messages) - ({FILE_TRANSFER} if entry.opcodes else set()) for entry in allowed)
    return Rules(
        allows_all=allows_all or any(entry.is_all for entry in allowed),
        allowed=frozenset[int]().union(*by_name),
        allowed_numbers=frozenset(entry.number for entry in allowed if entry.number is not None),
        allowed_commands=frozenset(entry.command for entry in allowed if entry.command is not None),
        opcodes=frozenset[int]().union(*(entry.opcodes for entry in allowed)),
    )


def _entry(item: str | int) -> _Entry | PolicyProblem:
    """The meaning of a list's entry, or its problem (without its key)."""
    if isinstance(item, str) and item.isdecimal():
        item = int(item)
    if isinstance(item, int):
        if 0 <= item <= MAX_MSGID:
            return _Entry(number=item)
        return PolicyProblem("", f"no message can have the number {item}", f"write 0 to {MAX_MSGID}")
    if item == dialect.ALL:
        return _Entry(is_all=True)
    if item.startswith(("MAV_CMD_", "command:")):
        return _command_entry(item)
    msgid = dialect.IDS.get(item)
    if msgid is not None:
        return _Entry(messages=(msgid,))
    members = dialect.GROUPS.get(item)
    if members is not None:
        ids = tuple(dialect.IDS[name] for name in members)
        return _Entry(messages=ids, opcodes=_OPCODES.get(item, frozenset()))
    known = (*dialect.GROUPS, *dialect.IDS)
    remedy = "write groups in small letters, messages in capitals, and an unknown message by its number"
    return PolicyProblem("", f"no such group or message: {item!r}", _did_you_mean(item, known, remedy))


def _command_entry(item: str) -> _Entry | PolicyProblem:
    name = item.removeprefix("command:")
    number = int(name) if name.isdecimal() else dialect.command_number(name)
    if number is None:
        remedy = "write its name as in the MAVLink definitions, or command:NUMBER"
        return PolicyProblem("", f"no such command: {name!r}", _did_you_mean(name, COMMANDS, remedy))
    if number > MAX_COMMAND:
        return PolicyProblem("", f"no command can have the number {number}", f"write 0 to {MAX_COMMAND}")
    return _Entry(command=number)


def _entries(data: Mapping[str, object], key: str, report: Report) -> tuple[str | int, ...]:
    """A list of the data, with its problems reported."""
    value = data.get(key, ())
    if not isinstance(value, (list, tuple)):
        report(key, f"{value!r} is not a list", f'write {key} = ["telemetry", "PING"]')
        return ()
    # True is excluded: it equals 1, also as a key of the cache of `_rules`.
    items = tuple(item if isinstance(item, str) or type(item) is int else repr(item) for item in value)
    for place, item in enumerate(items):
        entry = _entry(item)
        if isinstance(entry, PolicyProblem):
            report(f"{key}[{place}]", entry.problem, entry.remedy)
        elif key.startswith("allow") and dialect.SETUP_SIGNING in (entry.number, *entry.messages):
            report(f"{key}[{place}]", "SETUP_SIGNING never crosses", "leave it out")
    return items


def _systems(data: Mapping[str, object], report: Report, *, is_needed: bool) -> tuple[frozenset[int] | None, str]:
    """The systems that it may send as, and the same as text."""
    remedy = 'write its systems, such as system_ids = [1] or [1, "10-20"], or "all" to trust it with every system'
    value = data.get("system_ids")
    if value is None:
        if is_needed:
            report("system_ids", "missing: it names the systems that the peer may send as", remedy)
        return None, "any system"
    if value in (dialect.ALL, [dialect.ALL]):
        return None, "any system"
    if not isinstance(value, (list, tuple)) or not value:
        report("system_ids", f"{value!r} names no systems", remedy)
        return frozenset(), "none"
    systems: set[int] = set()
    for place, item in enumerate(value):
        first, _, last = str(item).partition("-")
        numbers = (first, last or first)
        if isinstance(item, bool) or not all(n.isdecimal() and 1 <= int(n) <= MAX_SYSTEM for n in numbers):
            report(f"system_ids[{place}]", f"{item!r} is not a system from 1 to {MAX_SYSTEM}", remedy)
        elif int(numbers[0]) > int(numbers[1]):
            report(f"system_ids[{place}]", f"{item!r} is in descending order", f'write "{last}-{first}"')
        else:
            systems.update(range(int(numbers[0]), int(numbers[1]) + 1))
    return frozenset(systems), ", ".join(map(str, value))


def _rates(data: Mapping[str, object], key: str, report: Report) -> Mapping[int, float]:
    """Frames a second by message id. A message's own rate replaces those of its groups, of which the lowest counts.

    An outgoing rate of a group of reports, such as telemetry, does not apply to its messages that are sent once.
    """
    value = data.get(key, {})
    if not isinstance(value, Mapping):
        report(key, f"{value!r} is not a table", f"write {key} = {{ ATTITUDE = 10 }}")
        return {}
    of_groups: dict[int, float] = {}
    of_messages: dict[int, float] = {}
    for item, rate in value.items():
        name = str(item)
        entry = _entry(name)
        if isinstance(entry, PolicyProblem):
            report(f"{key}.{name}", entry.problem, entry.remedy)
            continue
        if entry.command is not None or entry.is_all:
            report(f"{key}.{name}", "a rate is for messages", "name a message or a group")
        if isinstance(rate, bool) or not isinstance(rate, (int, float)) or not math.isfinite(rate) or rate < 0:
            report(
                f"{key}.{name}",
                f"{rate!r} is not a rate",
                "write frames a second; 0 stops the message",
            )
            continue
        if entry.number is not None or name in dialect.IDS:
            of_messages[entry.messages[0] if entry.number is None else entry.number] = float(rate)
        else:
            thinned = entry.messages if key == "rate_in" else set(entry.messages) - SAID_ONCE
            for msgid in thinned:
                of_groups[msgid] = min(float(rate), of_groups.get(msgid, math.inf))
    return of_groups | of_messages


def _flag(data: Mapping[str, object], key: str, default: bool, report: Report) -> bool:
    value = data.get(key, default)
    if isinstance(value, bool):
        return value
    report(key, f"{value!r} is neither true nor false", f"write {key} = true or {key} = false")
    return default


def _did_you_mean(word: str, known: Iterable[str], otherwise: str) -> str:
    """A suggestion: the known word that is most similar."""
    likely = meant(word, known)
    return f"did you mean {likely!r}?" if likely else otherwise
