"""The longest envelopes of slow networks: what shares one, what is copied, and what is never tested there."""

from __future__ import annotations

import pytest

from tests.core.harness import FRAME
from tests.core.radios import Radios, link
from uavlinkd.core import constants as c
from uavlinkd.core.envelope_limit import limit_at
from uavlinkd.core.probe import QUESTION_BYTES
from uavlinkd.core.settings import Class

LTE, SIK = 0, 1
LIMIT = 150
LONG_FRAME = FRAME[:1] + bytes(279)
"""As long as the longest MAVLink frame."""


def two_radios(limits: dict[int, int]) -> Radios:
    """Both ends send along LTE and a slow radio, with these limits by socket."""
    radios = Radios((0.02, 0.2), link(), link(), both_configured=True)
    for side in (radios.a, radios.b):
        side.node.set_envelope_limits(limits)
    radios.run(8.0, 0.1, radios.sender(radios.a), radios.sender(radios.b))
    assert radios.state(radios.a, LTE).works
    assert radios.state(radios.a, SIK).works
    return radios


def sent_lengths(radios: Radios, cls: Class, frames: list[bytes]) -> dict[int, list[int]]:
    """The lengths of the envelopes along each radio that carry these frames of alpha."""
    before = len(radios.sent)
    radios.send(radios.a, cls, *frames)
    sent = radios.sent[before:]
    return {radio: [len(one.datagram) for one in sent if one.path.socket == radio] for radio in (LTE, SIK)}


@pytest.mark.parametrize(
    ("bits_s", "limit"), [(1_600, 120), (4_000, 120), (4_001, 120), (8_000, 245), (9_600, 295), (40_000, 500)]
)
def test_limit_is_what_a_quarter_of_a_second_carries(bits_s: float, limit: int) -> None:
    """With the framing on the line, and between 120 and 500 bytes."""
    assert limit_at(bits_s) == limit
    assert limit in (c.SLOW_ENVELOPE_LEAST, c.SLOW_ENVELOPE_MOST) or 8 * (limit + c.LINE_BYTES) == bits_s / 4


def test_limit_of_an_ip_network_has_room_for_its_headers() -> None:
    """They are on the air too."""
    assert limit_at(8_000, 48) == 250 - 48


def test_critical_envelopes_fit_the_slowest_path_of_their_copies() -> None:
    """The copies are bit-identical, so the one along LTE is as short."""
    radios = two_radios({SIK: LIMIT})
    lengths = sent_lengths(radios, Class.CRITICAL, [FRAME] * 20)
    assert lengths[LTE] == lengths[SIK]
    assert max(lengths[LTE]) <= LIMIT


def test_stream_envelopes_fit_the_best_path() -> None:
    """LTE carries them in one."""
    radios = two_radios({SIK: LIMIT})
    lengths = sent_lengths(radios, Class.STREAM, [FRAME] * 20)
    assert len(lengths[LTE]) == 1
    assert lengths[LTE][0] > 20 * len(FRAME)
    assert lengths[SIK] == []


def test_stream_that_is_too_long_for_the_slow_path_is_not_copied_there() -> None:
    """While the best path is suspect, its envelopes go along the other one too, as far as they fit."""
    radios = two_radios({SIK: LIMIT})
    radios.radios[LTE].is_dead = True
    radios.run(0.35, 0.1, radios.sender(radios.a))
    assert len(radios.a.peer.paths.stream_route) == 2
    lengths = sent_lengths(radios, Class.STREAM, [FRAME] * 20)
    assert (len(lengths[LTE]), lengths[SIK]) == (1, [])
    lengths = sent_lengths(radios, Class.STREAM, [LONG_FRAME])
    assert lengths[LTE] == lengths[SIK] != []


def test_one_frame_always_fits() -> None:
    """The longest frame goes alone, along both."""
    radios = two_radios({SIK: LIMIT})
    lengths = sent_lengths(radios, Class.CRITICAL, [FRAME, LONG_FRAME, FRAME])
    assert lengths[LTE] == lengths[SIK]
    assert [length > LIMIT for length in lengths[SIK]] == [False, True, False]


def test_the_only_path_has_its_limit_too() -> None:
    """Frames of all classes share its envelopes."""
    radios = Radios((0.2,), link(), link(), both_configured=True)
    radios.a.node.set_envelope_limits({0: LIMIT})
    radios.run(3.0, 0.1, radios.sender(radios.a))
    lengths = sent_lengths(radios, Class.STREAM, [FRAME] * 20)
    assert max(lengths[0]) <= LIMIT
    radios.a.node.set_envelope_limits({})
    assert len(sent_lengths(radios, Class.STREAM, [FRAME] * 20)[0]) == 1


def test_a_question_joins_an_envelope_only_within_the_limit() -> None:
    """The probe in front of frames counts."""
    radios = two_radios({LTE: LIMIT})
    fitting = LIMIT - radios.a.session.envelope_bytes(0)
    for size, joins in ((fitting - QUESTION_BYTES - 2, True), (fitting - QUESTION_BYTES + 1, False)):
        radios.state(radios.a, LTE).question_at = radios.now
        lengths = sent_lengths(radios, Class.STREAM, [FRAME[:1] + bytes(size - 1)])
        assert lengths[LTE] == [radios.a.session.envelope_bytes(size + QUESTION_BYTES * joins)]


@pytest.mark.parametrize("limit", [120, LIMIT, 500])
def test_no_probe_is_longer_than_the_limit(limit: int) -> None:
    """LTE is tested with the longest envelope, the slow radio never with more than it may carry."""
    radios = two_radios({SIK: limit})
    longest = {
        radio: max(len(one.datagram) for one in radios.sent if one.path.socket == radio) for radio in (LTE, SIK)
    }
    assert longest[LTE] == radios.a.session.max_envelope
    assert longest[SIK] <= max(limit, 147)  # an initiation
