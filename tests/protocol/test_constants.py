"""Numbers and defaults: the relations that the text beside them promises."""

from __future__ import annotations

from uavlinkd.protocol import constants as c
from uavlinkd.protocol import wire


def test_numbers_fit_together() -> None:
    """Each relation is a promise of the text beside one of the numbers."""
    responder_at = c.REKEY_AFTER_S + c.RESPONDER_REKEY_SHARE * (c.REJECT_AFTER_S - c.REKEY_AFTER_S)
    assert c.REKEY_AFTER_S < responder_at < c.REJECT_AFTER_S < c.INDEX_QUARANTINE_S
    assert c.REJECT_AFTER_S - responder_at > 20 * c.RETRY_MAX_S * (1 + c.RETRY_JITTER), "time for retries"
    assert 2 * c.REKEY_AFTER_ENVELOPES <= c.SESSION_ENVELOPE_LIMIT + 1, "room for retries"
    assert c.RETRY_MIN_S < c.RETRY_MAX_S < c.RETRY_MAX_S * (1 + c.RETRY_JITTER) < 2.0
    assert 0 < c.ECHO_AFTER_S < c.HANDSHAKE_AFTER_S < c.LOST_AFTER_S < 5.0, "before ArduPilot's failsafe"
    assert c.ANSWERS.burst + 2 * c.ANSWERS.per_s <= c.UNCONFIRMED_PER_KIND, "two seconds to confirm"
    assert c.MIN_ENVELOPE_LIMIT - wire.LONG_HEADER_BYTES - max(wire.TAG_LENGTHS) >= 280, "the longest frame fits"
    assert c.MIN_ENVELOPE_LIMIT <= c.DEFAULT_ENVELOPE_LIMIT <= c.MAX_ENVELOPE_LIMIT <= 65507
    assert c.COOKIE_HELD_S <= c.COOKIE_SECRET_LIFETIME_S
