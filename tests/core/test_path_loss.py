"""The loss of datagrams along a path whose envelopes are repeated, and where the counts come from."""

from __future__ import annotations

import random

import pytest

from tests.core.harness import AT_B, ELSEWHERE, Pair, datagrams, only
from tests.core.radios import Radios
from uavlinkd.core import constants as c
from uavlinkd.core import establish
from uavlinkd.core.path_loss import NO_REPEATS, PathLoss, datagram_loss
from uavlinkd.core.path_state import PathState


@pytest.mark.parametrize("loss", [0.02, 0.05, 0.1, 0.3, 0.6, 0.9])
@pytest.mark.parametrize("repeated", [0.0, 0.5, 0.9])
def test_loss_of_datagrams_is_found_although_repeats_hide_it(loss: float, repeated: float) -> None:
    """Whatever share of the envelopes is repeated, as long as some are not."""
    rng = random.Random(1)
    lost, sent, repeats = 0, 20_000, [0] * (c.TRANSMISSIONS - 1)
    for _ in range(sent):
        times = c.TRANSMISSIONS if rng.random() < repeated else 1
        for number in range(times - 1):
            repeats[number] += 1
        lost += all(rng.random() < loss for _ in range(times))
    assert datagram_loss(lost, sent, repeats) == pytest.approx(loss, abs=0.02)


def test_loss_is_zero_if_all_arrived() -> None:
    """Exactly."""
    assert datagram_loss(0, 100, [100, 100, 0, 0]) == 0.0


def test_share_without_reports_or_envelopes_is_zero() -> None:
    """One report says nothing: a share needs two."""
    loss = PathLoss()
    assert (loss.share(), loss.reported_at) == (0.0, -c.NEVER)
    loss.add(1.0, 10, 5)
    assert loss.share() == 0.0
    loss.add(2.0, 10, 5)
    assert (loss.share(), loss.reported_at) == (0.0, 2.0)


def test_share_of_repeated_envelopes_is_that_of_datagrams() -> None:
    """Half of the datagrams are lost, so a quarter of the envelopes that were sent twice."""
    loss = PathLoss()
    loss.add(1.0, 0, 0)
    loss.add(2.0, 100, 75, (100, 0, 0, 0))
    assert loss.share() == pytest.approx(0.5, abs=1e-3)
    assert loss.recent(c.LOSS_WINDOW_S) == (100, 25)


def test_repeats_that_were_counted_along_another_path_are_not_compared() -> None:
    """Fewer repeats than before: the estimate begins with that report."""
    loss = PathLoss()
    loss.add(1.0, 10, 10, (90, 0, 0, 0))
    loss.add(2.0, 100, 80, (50, 0, 0, 0))
    assert loss.recent(c.LOSS_WINDOW_S) == (0, 0)
    loss.add(3.0, 200, 155, (150, 0, 0, 0))
    assert loss.recent(c.LOSS_WINDOW_S) == (100, 25)
    assert loss.share() == pytest.approx(0.5, abs=1e-3)


def test_reports_are_limited_in_age_and_number() -> None:
    """The window of repair is the longest one."""
    loss = PathLoss()
    for number in range(1000):
        loss.add(number / 100, number, number)
    assert len(loss._points) == c.LOSS_POINTS
    for number in range(1000, 1100):
        loss.add(float(number), number, number)
    assert len(loss._points) <= c.REPAIR_WINDOW_S + 2


def test_repeat_is_counted_in_bytes_but_not_as_another_envelope() -> None:
    """The receiver counts an envelope once too. A path that is gone has no totals."""
    pair = Pair().establish()
    envelope = only(datagrams(pair.a.send(1.0)))
    peer = pair.a.peer
    state = peer.paths.find(AT_B)
    assert state is not None
    sent, datagrams_sent, size = state.sent, state.datagrams_sent, state.bytes_sent
    pair.a.node.note_repeat(peer, AT_B, 2, envelope)
    pair.a.node.note_repeat(peer, AT_B, 3, envelope)
    pair.a.node.note_repeat(peer, ELSEWHERE, 2, envelope)
    assert (state.sent, state.datagrams_sent, state.bytes_sent) == (
        sent,
        datagrams_sent + 2,
        size + 2 * len(envelope),
    )
    assert state.repeats == (1, 1, 0, 0)
    state.note_session()
    assert sum(state.repeats) == 0


def test_repeats_of_an_older_session_do_not_count_along_the_path() -> None:
    """Its bytes count, but the totals of the path are those of the current session."""
    radios = Radios().run(1.0)
    peer, state = radios.a.peer, radios.state(radios.a, 0)
    old = radios.pair.a.envelope(radios.now)
    radios.act(radios.a, establish.initiate(peer, radios.now))
    radios.run(0.5)
    size = state.bytes_sent
    radios.a.node.note_repeat(peer, state.path, 2, old)
    assert (state.repeats, state.bytes_sent) == (NO_REPEATS, size + len(old))
    radios.a.node.note_repeat(peer, state.path, 2, radios.pair.a.envelope(radios.now))
    assert state.repeats == (1, 0, 0, 0)
    radios.a.node.close(radios.now)
    radios.a.node.note_repeat(peer, state.path, 2, old)
    assert state.repeats == (1, 0, 0, 0)


def test_echoes_show_the_loss_of_the_only_path() -> None:
    """The newest report counts, of a probe or of an echo reply."""
    state = PathState(AT_B, 1, 0.0, is_configured=True, is_metered=False)
    assert state.loss_to_repair() == (0.0, 0)
    state.note_echo_counts(1.0, 10, NO_REPEATS, 10)
    state.note_echo_counts(2.0, 20, NO_REPEATS, 17)
    assert state.loss_to_repair() == (0.3, 3)
    assert state.loss_out == 0.3
