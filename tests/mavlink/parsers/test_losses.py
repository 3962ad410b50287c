"""Frames that span lost bytes: the risk that the filter cannot prevent, measured, and no other."""

from __future__ import annotations

from tests.mavlink.parsers.losses import of_attacker, of_honest_telemetry


def test_honest_telemetry_makes_no_forbidden_frame() -> None:
    """Only the checksum prevents it: one in 65,536 of the losses inside a frame."""
    share = of_honest_telemetry(streams=5, losses=2000, seed=1)
    assert share.losses == 10_000
    assert share.forbidden <= 2
    assert share.elsewhere == 0


def test_attacker_that_knows_the_length_has_a_share_of_the_offsets() -> None:
    """Five offsets of each of its frames, of at least 24 bytes; no frame that spans no loss."""
    share = of_attacker(36)
    assert 0.15 < share.forbidden / share.losses < 0.25
    assert share.elsewhere == 0
