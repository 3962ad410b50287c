"""The registry: every attack has a name and a number of the catalogue, and bad requests are refused in words."""

from __future__ import annotations

import re

import pytest

from uavlinkd.lab.mitm.attack import AttackContext, AttackError
from uavlinkd.lab.mitm.attacks import ATTACKS, parse_attack

# What an attacker without keys cannot do: the full relay (H2), group keys and stolen keys (H6, H7, D19, D20), clocks
# (H17), snapshots (H22), and what only an authentic peer can send (D13, D14).
WITH_KEYS = {"H2", "H6", "H7", "H17", "H22", "D13", "D14", "D19", "D20"}


def test_catalogue_is_covered() -> None:
    """Every number from H1 to H22 and D1 to D21 has an attack, but for those that take a key or the machine."""
    numbers = {f"H{n}" for n in range(1, 23)} | {f"D{n}" for n in range(1, 22)}
    covered = {number for attack in ATTACKS.values() for number in attack.catalogue}
    assert covered == numbers - WITH_KEYS


@pytest.mark.parametrize("name", ATTACKS)
def test_text_of_a_request_reads_back_as_itself(name: str) -> None:
    """The text form in logs is what the command line takes."""
    spec = parse_attack(f"{name},begin_s=1.5,direction=a>b,limit=3")
    assert str(parse_attack(str(spec))) == str(spec)
    assert parse_attack(str(spec)) == spec


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no such attack"),
        ("replay-dat", "did you mean replay-data"),
        ("hold,hold_s", "key=value"),
        ("hold,hold_s=1,hold_s=2", "each once"),
        ("hold,hold_s=0", "hold_s: input should be greater than 0"),
        ("hold,colour=red", "its parameters are"),
        ("drop,kinds=everything", "kinds: input should be"),
        ("drop,share=1.1", "share"),
        ("flood-garbage,rate_per_s=1e9", "rate_per_s"),
    ],
)
def test_bad_request_is_refused_with_what_to_write(text: str, message: str) -> None:
    """One sentence that names the parameter."""
    with pytest.raises(AttackError, match=re.escape(message)):
        parse_attack(text)


def test_what_the_surroundings_lack_is_said() -> None:
    """A third peer, a public key."""
    two = AttackContext.between("a", "b")
    with pytest.raises(AttackError, match="three peers"):
        parse_attack("misroute").make(two)
    with pytest.raises(AttackError, match="public_key"):
        parse_attack("flood-initiations").make(two)
    parse_attack("flood-initiations,mac1=bad").make(two)
