"""The defaults of what a configuration may change."""

from __future__ import annotations

import dataclasses

import pytest

from uavlinkd.core import constants as c
from uavlinkd.core import wire
from uavlinkd.core.settings import Link, PeerSettings, Timers, previous_of
from uavlinkd.core.suites import X25519


def test_timers_default_to_the_constants() -> None:
    """Each timer that a configuration may change begins with the documented number."""
    for field in dataclasses.fields(Timers):
        assert getattr(Timers(), field.name) == getattr(c, field.name.upper())


def test_the_default_link_is_within_the_protocol() -> None:
    """What is asked for by default is authentication by 16-byte tags, over the suite without a group."""
    link = Link()

    assert link.suites == (X25519,)
    assert not link.confidential
    assert link.tag_bytes in wire.TAG_LENGTHS
    assert link.mac_key_bits in wire.MAC_KEY_LENGTHS
    assert c.MIN_ENVELOPE_LIMIT <= link.max_envelope <= c.MAX_ENVELOPE_LIMIT


def test_settings_are_frozen() -> None:
    """Settings of the core cannot change after they were given."""
    settings = PeerSettings("bravo", bytes(32))

    with pytest.raises(dataclasses.FrozenInstanceError):
        settings.link = Link()  # type: ignore[misc]
    assert settings.psk is None


def test_a_peer_by_its_previous_key_differs_in_name_and_key() -> None:
    """It is another peer of the node, with the same link."""
    settings = PeerSettings("alpha", bytes(32), None, Link(tag_bytes=12), initiates=False)
    before = previous_of(settings, bytes([1]) * 32)
    assert before.name not in ("", settings.name)
    assert before.public_key == bytes([1]) * 32
    assert (before.link, before.initiates) == (settings.link, False)
