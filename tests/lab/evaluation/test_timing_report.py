"""The tables of the timing report contain what the records contain."""

from __future__ import annotations

from tests.lab.evaluation.samples import a_run, handshake, not_finished, paper
from uavlinkd.lab.evaluation import timing_report as report
from uavlinkd.lab.evaluation.records import Record, Status
from uavlinkd.lab.evaluation.timing_report import TimingFindings, timing_problems


def rows(findings: TimingFindings) -> dict[str, list[str]]:
    """The comparison, by the size of the group."""
    return {row[0]: list(row) for row in report.comparison(findings).rows}


def test_comparison_has_medians_search_and_factor() -> None:
    """512 bits only in the paper's method, 2048 in both; 4096 did not finish."""
    by_size = rows(a_run())
    assert by_size["512"][4:] == ["refused: too small", "-"]
    assert by_size["2048"][1:4] == ["40 s (20 s to 60 s, n = 6)", "90 %", "8 ms (4 ms to 12 ms, n = 3)"]
    # The core's median for making the initiation, and the proxy's time for the rest.
    assert by_size["2048"][4:] == ["19 ms (10 ms to 28 ms, n = 6)", "2105"]
    assert by_size["4096"][1] == "not finished in 600 s (1)"


def test_unfinished_exchanges_count_as_the_limit() -> None:
    """Two of three did not finish: the median is the limit, and the factor a lower bound."""
    records = [
        paper(2048, 512, 5.0),
        not_finished(2048, 512),
        not_finished(2048, 512),
        handshake("ffdhe2048", 256, 0.01),
    ]
    row = rows(TimingFindings({}, records))["2048"]
    assert row[1] == "600 s (5 s to 600 s, n = 3), 2 not finished"
    assert row[5] == "at least 60000"


def test_costs_of_a_suite() -> None:
    """Handshakes, processor time, bytes; tags."""
    findings = a_run()
    x25519 = next(list(row) for row in report.suites(findings).rows if row[0] == "x25519")
    assert x25519[1:] == ["7 ms (4 ms to 10 ms, n = 6)", "2 ms", "4 ms", "700 + 600", "3 + 2"]
    assert report.tag_times(findings).rows == [["45 bytes", "1 µs", "1 µs"]]


def test_what_failed_has_no_numbers_and_is_not_forgotten() -> None:
    """A failed record does not affect a median, and is a problem; suites are in the order of the wire."""
    failed = Record("handshake", {"suite": "mlkem768", "mac_key_bits": 256}, {}, Status.FAILED, "no session in 20 s")
    findings = a_run(failed, handshake("mlkem768", 512, 0.005))
    assert findings.daemon_times("mlkem768") == [0.005]
    assert timing_problems(findings) == ["handshake, suite mlkem768, mac_key_bits 256: no session in 20 s"]
    assert findings.suites() == ["x25519", "ffdhe2048", "ffdhe4096", "mlkem768"]
    assert report.summary(findings)["x25519_s"] == 0.007
