"""The estimate of energy."""

from __future__ import annotations

import pytest

from tests.lab.evaluation.samples import a_run
from uavlinkd.lab.evaluation.energy import BOARDS, DEFAULT_WATTS_PER_CORE, frames_joules, handshake_joules


def test_the_default_is_what_a_raspberry_pi_4_draws() -> None:
    """Within a tenth of the figure of its source."""
    (board,) = [board for board in BOARDS if board.name == "Raspberry Pi 4"]
    assert pytest.approx(board.watts_per_core, rel=0.1) == DEFAULT_WATTS_PER_CORE


def test_every_board_has_a_source_and_draws_more_when_busy() -> None:
    """A reader can check each figure."""
    for board in BOARDS:
        assert board.watts_per_core > 0
        assert board.source


def test_energy_is_the_processor_time_of_both_ends_by_the_power_of_a_core() -> None:
    """6 ms for a handshake and 0.4 ms per frame, at 0.5 W; None without a measurement."""
    findings = a_run()
    assert handshake_joules(findings, "x25519") == pytest.approx(0.003)
    assert frames_joules(findings, suite="x25519") == pytest.approx(0.2)
    assert handshake_joules(findings, "mlkem1024") is None
