"""The relations between the protocol's numbers that the text beside them promises."""

from __future__ import annotations

from uavlinkd.core import constants as c
from uavlinkd.core import wire


def test_rekeying_leaves_time_and_room_for_retries_before_the_keys_end() -> None:
    """New keys are wanted long before the old ones are refused, by age, by count and for either role."""
    responder_at = c.REKEY_AFTER_S + c.RESPONDER_REKEY_SHARE * (c.REJECT_AFTER_S - c.REKEY_AFTER_S)

    assert c.REKEY_AFTER_S < responder_at < c.REJECT_AFTER_S
    assert c.REJECT_AFTER_S - responder_at > 20 * c.RETRY_MAX_S * (1 + c.RETRY_JITTER)
    assert 2 * c.REKEY_AFTER_ENVELOPES <= c.SESSION_ENVELOPE_LIMIT + 1


def test_returning_link_gets_an_initiation_within_two_seconds() -> None:
    """The longest wait with all of its jitter stays under the 2 s that the protocol promises."""
    assert c.RETRY_MIN_S < c.RETRY_MAX_S
    assert c.RETRY_MAX_S * (1 + c.RETRY_JITTER) < 2.0


def test_silence_is_asked_about_before_it_is_judged() -> None:
    """Echo, then handshake, then lost, each before ArduPilot's failsafe of 5 s."""
    assert 0 < c.ECHO_AFTER_S < c.HANDSHAKE_AFTER_S < c.LOST_AFTER_S < 5.0


def test_answers_leave_an_honest_handshake_time_to_confirm() -> None:
    """Answers made at the full rate do not push an unconfirmed session out within the first two seconds."""
    assert c.UNCONFIRMED_PER_PEER >= c.ANSWERS_BURST + 2 * c.ANSWERS_PER_S


def test_the_smallest_envelope_holds_the_largest_frame() -> None:
    """A MAVLink 2 frame of 280 bytes fits under the least limit with the longer header and the longest tag."""
    assert c.MIN_ENVELOPE_LIMIT - wire.LONG_HEADER_BYTES - max(wire.TAG_LENGTHS) >= 280
    assert c.MIN_ENVELOPE_LIMIT <= c.DEFAULT_ENVELOPE_LIMIT <= c.MAX_ENVELOPE_LIMIT <= 65507


def test_every_count_of_envelopes_fits_into_four_bytes() -> None:
    """The counter after the last one, and the count of all envelopes, fit the fields of an echo."""
    assert c.SESSION_ENVELOPE_LIMIT == 2**32 - 1
    assert c.SHORT_COUNTER_LIMIT == 2**16


def test_a_cookie_is_honoured_as_long_as_it_is_used() -> None:
    """An initiator stops using a cookie no later than the earliest moment at which it may be refused."""
    assert c.COOKIE_HELD_S <= c.COOKIE_SECRET_LIFETIME_S


def test_indices_outlive_the_envelopes_that_name_them() -> None:
    """An index is quarantined longer than any session lives: the next owner gets no envelope of the last one."""
    assert c.INDEX_QUARANTINE_S > c.REJECT_AFTER_S
