"""The table of suites."""

from __future__ import annotations

import pytest

from uavlinkd.core.suites import SUITES, SUITES_BY_NAME, X25519

TABLE = [
    (0, "x25519", 0, 0),
    (1, "ffdhe2048", 256, 256),
    (2, "ffdhe3072", 384, 384),
    (3, "ffdhe4096", 512, 512),
    (4, "ffdhe6144", 768, 768),
    (5, "ffdhe8192", 1024, 1024),
    (16, "mlkem768", 1184, 1088),
    (17, "mlkem1024", 1568, 1568),
]


@pytest.mark.parametrize(("number", "name", "share_bytes", "ciphertext_bytes"), TABLE)
def test_suite_has_the_specified_number_and_sizes(
    number: int, name: str, share_bytes: int, ciphertext_bytes: int
) -> None:
    """Number, name and the two lengths are the specification's, by either key."""
    suite = SUITES[number]

    assert suite is SUITES_BY_NAME[name]
    assert (suite.number, suite.name) == (number, name)
    assert (suite.share_bytes, suite.ciphertext_bytes) == (share_bytes, ciphertext_bytes)
    assert suite.has_group == (name != "x25519")


def test_no_suite_beside_the_table() -> None:
    """There is no other suite; above all none of 1,024 bits or less."""
    assert [(s.number, s.name, s.share_bytes, s.ciphertext_bytes) for s in SUITES.values()] == TABLE
    assert list(SUITES_BY_NAME.values()) == list(SUITES.values())
    assert SUITES[0] is X25519
