"""What is read out of records."""

from __future__ import annotations

import pytest

from tests.lab.evaluation.samples import FAILED, a_run, handshake
from uavlinkd.lab.evaluation.timing_queries import percentile


def test_times_of_a_handshake_include_the_making_of_its_initiation() -> None:
    """The core's median for that, and the relay's time for the rest."""
    findings = a_run()
    assert findings.daemon_times("x25519", 256) == pytest.approx([0.004, 0.007, 0.010])
    assert findings.daemon_times("ffdhe4096", 256) == pytest.approx([0.019, 0.038, 0.057]), "no core record: as it is"
    assert findings.rekey_times("x25519") == pytest.approx([0.003])


def test_made_and_standard_groups_are_kept_apart() -> None:
    """Else the median of the paper's method would be one of two methods."""
    findings = a_run()
    assert len(findings.paper_times("made", 2048)) == 6
    assert findings.paper_times("standard", 2048) == pytest.approx([0.004, 0.008, 0.012])


def test_what_failed_has_no_numbers_and_is_not_forgotten() -> None:
    """A failed record does not affect a median, and is among the problems."""
    findings = a_run(FAILED, handshake("mlkem768", 512, 0.005))
    assert findings.daemon_times("mlkem768") == [0.005]
    assert findings.problems() == [FAILED]
    assert {record.status.value for record in findings.unfinished()} == {"failed", "not finished"}


def test_suites_are_in_the_order_of_the_wire() -> None:
    """As everywhere."""
    assert a_run(FAILED).suites() == ["x25519", "ffdhe2048", "ffdhe4096", "mlkem768"]


@pytest.mark.parametrize(("share", "value"), [(0.0, 1), (0.01, 1), (0.5, 50), (0.501, 51), (0.99, 99), (1.0, 100)])
def test_a_percentile_is_one_of_the_values(share: float, value: float) -> None:
    """The least that so many do not exceed."""
    assert percentile(range(100, 0, -1), share) == value
