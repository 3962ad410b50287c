"""Each attack on the key exchange changes only the documented fields."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from tests.lab.mitm.samples import AB, Conversation, converse, sends
from uavlinkd.core.cookie import MacKeys
from uavlinkd.core.crypto import KeyPair
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.suites import SUITES_BY_NAME
from uavlinkd.lab.mitm.anatomy import Parts, parts_of
from uavlinkd.lab.mitm.attack import Send
from uavlinkd.lab.mitm.attacks import parse_attack
from uavlinkd.lab.mitm.attacks.key_exchange import ELEMENTS

GROUP = converse(3, SUITES_BY_NAME["ffdhe2048"], frames=2)
PLAIN = converse(4, frames=2)


@dataclass
class Change:
    """A message before and after."""

    before: Parts
    after: Parts


def _changes(text: str, conversation: Conversation, seed: int = 0) -> list[Change]:
    """What an attack does to initiation and response; everything else passes untouched."""
    attack = parse_attack(text).make(conversation.context, seed)
    changes: list[Change] = []
    for datagram, direction in conversation.said:
        (sent,) = sends(attack.on_datagram(datagram, direction, 0.0))
        assert sent.direction == direction
        before, after = parts_of(datagram), parts_of(sent.datagram)
        if sent.datagram == datagram:
            continue
        assert before is not None
        assert after is not None, "the altered message is still one of the protocol's"
        # mac1 fits again, so the alteration reaches the cryptography of the receiver.
        MacKeys(conversation.keys[direction.receiver]).check_mac1(sent.datagram)
        changes.append(Change(before, after))
    return changes


def _same_but(change: Change, *fields: str) -> bool:
    """Whether exactly these fields differ, apart from the MACs."""
    before, after = change.before._asdict(), change.after._asdict()
    return {name for name in before if name != "macs" and before[name] != after[name]} == set(fields)


@pytest.mark.parametrize(("conversation", "expected"), [(PLAIN, "ffdhe2048"), (GROUP, "x25519")], ids=["up", "down"])
def test_suite_downgrade_names_another_suite_at_its_length(conversation: Conversation, expected: str) -> None:
    """Whole messages of the other suite, which pass the receiver's parser and its mac1."""
    changes = _changes("suite-downgrade", conversation)
    assert len(changes) == 2
    for change in changes:
        assert change.after.suite.name == expected
        assert change.after.ephemeral == change.before.ephemeral
        assert change.after.rest == change.before.rest


@pytest.mark.parametrize("name", [name for name in ELEMENTS if name != "largest"])
def test_invalid_elements_give_a_secret_that_anyone_knows(name: str) -> None:
    """X25519 with any private key gives zeros for each of them, and the core refuses it."""
    with pytest.raises(Drop, match=DropReason.INVALID_KEY_SHARE):
        KeyPair(bytes(range(32))).exchange(ELEMENTS[name])


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ("field=sender", [(True, None), (True, False)]),
        ("field=receiver", [(False, True)]),
        ("field=both", [(True, None), (True, True)]),
    ],
)
def test_alter_indices_alters_those_that_it_names(options: str, expected: list[tuple[bool, bool | None]]) -> None:
    """Sender and receiver index; an initiation has no receiver index."""
    changes = _changes(f"alter-indices,{options}", PLAIN)
    result: list[tuple[bool, bool | None]] = []
    for change in changes:
        before, after = change.before.header, change.after.header
        assert _same_but(change, "header")
        assert before[:2] == after[:2]
        result.append((before[2:4] != after[2:4], before[4:6] != after[4:6] if before[4:6] else None))
    assert result == expected


def test_splice_handshake_joins_two_messages() -> None:
    """Header and key of the second, all that is sealed from the first; never of a message with itself."""
    first, second = converse(5, frames=0), converse(6, frames=0)
    attack = parse_attack("splice-handshake").make(second.context)
    assert attack.on_datagram(first.initiation, AB, 0.0) == [Send(first.initiation, AB)]
    assert attack.on_datagram(first.initiation, AB, 0.0) == [Send(first.initiation, AB)]
    (sent,) = sends(attack.on_datagram(second.initiation, AB, 0.0))
    old, new, spliced = parts_of(first.initiation), parts_of(second.initiation), parts_of(sent.datagram)
    assert old is not None
    assert new is not None
    assert spliced is not None
    assert (spliced.header, spliced.ephemeral, spliced.rest) == (new.header, new.ephemeral, old.rest)
    MacKeys(second.keys["b"]).check_mac1(sent.datagram)
