"""The registry: every attack of the catalogue is in it."""

from __future__ import annotations

from uavlinkd.lab.mitm.attacks import ATTACKS

# What an attacker without keys cannot do: the full relay (H2), group keys and stolen keys (H6, H7, D19, D20), clocks
# (H17), snapshots (H22), and what only an authentic peer can send (D13, D14).
WITH_KEYS = {"H2", "H6", "H7", "H17", "H22", "D13", "D14", "D19", "D20"}


def test_catalogue_is_covered() -> None:
    """Every number from H1 to H22 and D1 to D21 has an attack, but for those that take a key or the machine."""
    numbers = {f"H{n}" for n in range(1, 23)} | {f"D{n}" for n in range(1, 22)}
    covered = {number for attack in ATTACKS.values() for number in attack.catalogue}
    assert covered == numbers - WITH_KEYS
