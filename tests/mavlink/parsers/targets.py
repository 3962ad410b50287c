"""The attacks of a captured member, aimed at receivers of one dialect."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from functools import cache

from tests.mavlink.parsers.generate import CAST, Part, Recipe
from tests.mavlink.parsers.judge import Deliverer, Judge, MakeStream, Stream, filtered
from tests.mavlink.parsers.receivers import Delivery
from uavlinkd.lab.evaluation.captured_member import MemberAttack, attacks
from uavlinkd.mavlink.dialect_table import MESSAGES
from uavlinkd.mavlink.policy.compilation import compile_policy
from uavlinkd.mavlink.policy.gate import Refusal


@cache
def lacking(dialect: str, member: str, *, numbered: bool = False) -> int:
    """A message that this member may send and the dialect lacks; with ``numbered`` one that MAVLink 1 can number."""
    known = importlib.import_module(f"pymavlink.dialects.v20.{dialect}").mavlink_map
    gate = compile_policy(CAST[member]).incoming
    return next(
        msgid
        for msgid in sorted(MESSAGES, reverse=True)
        if msgid not in known
        and not isinstance(gate.decide(msgid, is_known=True), Refusal)
        and not (numbered and msgid > 0xFF)
    )


@cache
def attacks_on(dialect: str) -> tuple[MemberAttack, ...]:
    """Every attack against receivers of this dialect."""
    return tuple(
        attacks(
            lacking(dialect, "observer"),
            lacking(dialect, "vehicle"),
            lacking(dialect, "operator"),
            lacking(dialect, "vehicle", numbered=True),
        )
    )


def deliver(attack: MemberAttack, make: MakeStream = filtered, times: int = 1) -> tuple[Stream, Deliverer]:
    """The stream of an attack that is repeated so many times."""
    deliverer = Deliverer(make, cast=cast_of(attack))
    parts = tuple(Part(f"member {member}", raw) for member, raw in attack.frames) * times
    return deliverer.deliver(Recipe(0, parts)), deliverer


def concatenated(attack: MemberAttack, times: int = 1) -> Stream:
    """The stream without the filter, as the daemon delivered it before."""
    stream = bytearray()
    authors: list[tuple[int, str | None]] = []
    frames = []
    for member, raw in attack.frames * times:
        frames.append((len(stream), len(stream) + len(raw)))
        stream += raw
        authors.append((len(stream), f"member {member}"))
    return Stream(Delivery(bytes(stream), frames), authors, 0)


def cast_of(attack: MemberAttack) -> dict[str, Mapping[str, object]]:
    """The policies of its members, by the names in :func:`deliver`."""
    return {f"member {number}": policy for number, policy in enumerate(attack.members)}


def judge_of(attack: MemberAttack) -> Judge:
    """A judge with its members' policies."""
    return Judge(cast_of(attack))
