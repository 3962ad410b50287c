"""Each attack on the key exchange changes only the documented fields."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from tests.lab.mitm.samples import AB, BA, Conversation, converse, notes, play, sends
from uavlinkd.core import wire
from uavlinkd.core.cookie import MacKeys
from uavlinkd.core.crypto import KeyPair
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.suites import SUITES_BY_NAME
from uavlinkd.lab.mitm.anatomy import Parts, parts_of
from uavlinkd.lab.mitm.attack import AttackContext, Send
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


@pytest.mark.parametrize("size", [1, 4, 32])
def test_tamper_key_alters_a_part_of_the_public_key(size: int) -> None:
    """So many bytes next to each other, each of them changed."""
    changes = _changes(f"tamper-key,size={size}", PLAIN)
    assert len(changes) == 2
    for change in changes:
        assert _same_but(change, "ephemeral")
        differ = [n for n in range(32) if change.before.ephemeral[n] != change.after.ephemeral[n]]
        assert differ == list(range(differ[0], differ[0] + size))


def test_replace_key_puts_a_valid_point_in_place() -> None:
    """X25519 takes it: the secret is not zero."""
    for change in _changes("replace-key", PLAIN):
        assert _same_but(change, "ephemeral")
        KeyPair(bytes(range(32))).exchange(change.after.ephemeral)


def test_replace_key_puts_the_given_key_in_place() -> None:
    """The attacker's own, of which it knows the private part."""
    own = KeyPair(bytes(range(1, 33))).public
    for change in _changes(f"replace-key,key={own.hex()}", PLAIN):
        assert change.after.ephemeral == own


def test_random_draws_for_each_direction_by_itself() -> None:
    """Over many handshakes, all four combinations of altering and replacing occur."""
    attack = parse_attack("random").make(PLAIN.context, 5)
    seen: set[tuple[bool, bool]] = set()
    for _ in range(60):
        reported = [
            note.detail.startswith("public key replaced")
            for datagram, direction in ((PLAIN.initiation, AB), (PLAIN.response, BA))
            for note in notes(attack.on_datagram(datagram, direction, 0.0))
        ]
        seen.add((reported[0], reported[1]))
    assert seen == {(False, False), (False, True), (True, False), (True, True)}


@pytest.mark.parametrize(
    ("conversation", "suite", "expected"),
    [
        (PLAIN, "x25519", "ffdhe2048"),
        (PLAIN, "mlkem768", "mlkem768"),
        (GROUP, "x25519", "x25519"),
        (GROUP, "ffdhe2048", "x25519"),
    ],
    ids=["up", "named", "down", "same"],
)
def test_suite_downgrade_names_another_suite_at_its_length(
    conversation: Conversation, suite: str, expected: str
) -> None:
    """Whole messages of the other suite, which pass the receiver's parser and its mac1."""
    changes = _changes(f"suite-downgrade,suite={suite}", conversation)
    assert len(changes) == 2
    for change in changes:
        assert change.after.suite.name == expected
        assert change.after.ephemeral == change.before.ephemeral
        assert change.after.rest == change.before.rest


def test_suite_downgrade_may_keep_the_length() -> None:
    """Then the length does not match the suite."""
    attack = parse_attack("suite-downgrade,adapt_length=false").make(GROUP.context)
    (sent,) = sends(attack.on_datagram(GROUP.initiation, AB, 0.0))
    assert len(sent.datagram) == len(GROUP.initiation)
    with pytest.raises(Drop, match=DropReason.MALFORMED):
        wire.parse_initiation(sent.datagram)


@pytest.mark.parametrize("name", [name for name in ELEMENTS if name != "largest"])
def test_invalid_elements_give_a_secret_that_anyone_knows(name: str) -> None:
    """X25519 with any private key gives zeros for each of them, and the core refuses it."""
    with pytest.raises(Drop, match=DropReason.INVALID_KEY_SHARE):
        KeyPair(bytes(range(32))).exchange(ELEMENTS[name])


def test_invalid_element_puts_each_in_its_turn() -> None:
    """All values occur, and only the key changes."""
    attack = parse_attack("invalid-element,message=initiation").make(PLAIN.context)
    put: list[bytes] = []
    for _ in ELEMENTS:
        (sent,) = sends(attack.on_datagram(PLAIN.initiation, AB, 0.0))
        after = parts_of(sent.datagram)
        assert after is not None
        put.append(after.ephemeral)
    assert put == list(ELEMENTS.values())
    (change,) = _changes("invalid-element,element=p,message=response", PLAIN)
    assert _same_but(change, "ephemeral")
    assert change.after.ephemeral == ELEMENTS["p"]


def test_corrupt_share_alters_the_sealed_share_where_there_is_one() -> None:
    """Both messages in a suite with a group; no message in a suite without."""
    changes = _changes("corrupt-share", GROUP)
    assert [_same_but(change, "share") for change in changes] == [True, True]
    assert _changes("corrupt-share", PLAIN) == []


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


def test_zero_indices_are_malformed() -> None:
    """The receiver refuses them before anything else, although mac1 fits."""
    attack = parse_attack("alter-indices,field=both,value=zero").make(PLAIN.context)
    altered = []
    for datagram, direction in PLAIN.said:
        (sent,) = sends(attack.on_datagram(datagram, direction, 0.0))
        if sent.datagram != datagram:
            assert parts_of(sent.datagram) is None
            MacKeys(PLAIN.keys[direction.receiver]).check_mac1(sent.datagram)
            altered.append(sent.datagram[2:6])
    initiation, response = altered
    assert (initiation[:2], response) == (bytes(2), bytes(4))


@pytest.mark.parametrize("mac", ["mac1", "mac2"])
def test_alter_macs_alters_that_mac_alone(mac: str) -> None:
    """The other bytes are unchanged."""
    attack = parse_attack(f"alter-macs,mac={mac}").make(PLAIN.context)
    (sent,) = sends(attack.on_datagram(PLAIN.initiation, AB, 0.0))
    differ = [n for n in range(147) if sent.datagram[n] != PLAIN.initiation[n]]
    assert len(differ) == 1
    assert differ[0] in (range(115, 131) if mac == "mac1" else range(131, 147))


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


def test_genuine_message_follows_where_it_is_to() -> None:
    """With beside=true, the genuine message follows the altered one."""
    attack = parse_attack("tamper-key,beside=true").make(PLAIN.context)
    altered, genuine = sends(attack.on_datagram(PLAIN.initiation, AB, 0.0))
    assert genuine == Send(PLAIN.initiation, AB)
    assert altered.datagram != PLAIN.initiation


@pytest.mark.parametrize("options", ["", ",repair_mac1=false"])
def test_mac1_stays_stale_without_the_public_key(options: str) -> None:
    """Then the receiver's first HMAC ends it."""
    knows = AttackContext.between("a", "b") if not options else PLAIN.context
    attack = parse_attack(f"tamper-key{options}").make(knows)
    actions = attack.on_datagram(PLAIN.initiation, AB, 0.0)
    with pytest.raises(Drop, match=DropReason.BAD_MAC1):
        MacKeys(PLAIN.keys["b"]).check_mac1(sends(actions)[0].datagram)
    assert "mac1 stale" in notes(actions)[0].detail


@pytest.mark.parametrize("message", ["initiation", "response"])
@pytest.mark.parametrize("name", ["tamper-key", "replace-key", "random", "suite-downgrade", "invalid-element"])
def test_only_the_message_that_is_named_is_altered(name: str, message: str) -> None:
    """The other one passes."""
    reported = notes(play(parse_attack(f"{name},message={message}").make(PLAIN.context), PLAIN.said))
    assert [note.kind for note in reported] == [message]
