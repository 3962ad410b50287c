"""The attacks of a captured member, aimed at receivers of one dialect."""

from __future__ import annotations

from collections.abc import Mapping

from tests.mavlink.parsers.captured_member import MemberAttack
from tests.mavlink.parsers.generate import Part, Recipe
from tests.mavlink.parsers.judge import Deliverer, Judge, Stream
from tests.mavlink.parsers.receivers import Delivery


def deliver(attack: MemberAttack, times: int = 1) -> Stream:
    """The stream of an attack that is repeated so many times."""
    parts = tuple(Part(f"member {member}", raw) for member, raw in attack.frames) * times
    return Deliverer(cast=cast_of(attack)).deliver(Recipe(0, parts))


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
