"""The estimate of energy."""

from __future__ import annotations

import pytest

from uavlinkd.lab.evaluation.energy import BOARDS, DEFAULT_WATTS_PER_CORE, estimated_joules


def test_the_default_is_what_a_raspberry_pi_4_draws() -> None:
    """Within a tenth of the figure that it is said to come from."""
    (board,) = [board for board in BOARDS if board.name == "Raspberry Pi 4"]
    assert pytest.approx(board.watts_per_core, rel=0.1) == DEFAULT_WATTS_PER_CORE


def test_every_board_has_a_source_and_draws_more_when_busy() -> None:
    """A figure that nobody can check is none."""
    for board in BOARDS:
        assert board.watts_per_core > 0
        assert board.source


def test_joules_are_seconds_by_watts() -> None:
    """3 ms at 0.9 W."""
    assert estimated_joules(0.003, 0.9) == pytest.approx(0.0027)
