"""The tables of the timing report contain what the records contain."""

from __future__ import annotations

import os

import pytest

if not os.environ.get("CI"):  # CI installs matplotlib
    pytest.importorskip("matplotlib", reason="the figures need matplotlib")

from tests.lab.evaluation.samples import RUN, a_run, frames, handshake, not_finished, paper, tag
from uavlinkd.lab.evaluation import report_tables as tables
from uavlinkd.lab.evaluation.energy import BOARDS
from uavlinkd.lab.evaluation.records import Record
from uavlinkd.lab.evaluation.timing_queries import Findings


def rows(findings: Findings) -> dict[str, list[str]]:
    """The comparison, by the size of the group."""
    return {row[0]: list(row) for row in tables.comparison(findings).rows}


def test_comparison_has_medians_search_and_factor() -> None:
    """512 bits only in the paper's method, 2048 in both; 4096 did not finish."""
    by_size = rows(a_run())
    assert by_size["512"][4:] == ["refused: too small", "-"]
    assert by_size["2048"][1].startswith("40 s (")
    assert by_size["2048"][2] == "90 %"
    assert by_size["2048"][3].startswith("8 ms (")
    assert by_size["2048"][4].startswith("19 ms (")
    assert by_size["2048"][5] == "2105"
    assert by_size["4096"][1] == "not finished: not finished in 600 s (1)"


def test_unfinished_exchanges_count_as_the_limit() -> None:
    """Two of three did not finish: the median is the limit, and the factor a lower bound."""
    records = [paper(2048, 512, 5.0), *(not_finished(2048, 512) for _ in range(2)), handshake("ffdhe2048", 256, 0.01)]
    row = rows(Findings(RUN, records))["2048"]
    assert row[1].startswith("600 s (")
    assert row[1].endswith(", 2 not finished and counted as the limit")
    assert row[5] == "at least 60000"


def test_factor_below_one_is_shown() -> None:
    """The paper's method may be faster."""
    fast = Record(
        "paper", {"dh_bits": 2048, "mac_key_bits": 512, "group": "made"}, {"total_s": 1.0, "parameters_s": 0.1}
    )
    row = rows(Findings(RUN, [handshake("ffdhe2048", 256, 9.0), fast]))["2048"]
    assert (row[2], row[5]) == ("10 %", "0.1")


@pytest.mark.parametrize(
    ("second", "dependent"), [(0.0041, ["0", "-"]), (0.9, ["1", "x25519"])], ids=["close", "apart"]
)
def test_dependence_on_the_key_length_is_tested(second: float, dependent: list[str]) -> None:
    """By a permutation test."""
    records = [
        handshake("x25519", length, base + k * 1e-4)
        for length, base in ((256, 0.004), (512, second))
        for k in range(5)
    ]
    (row,) = tables.dependence(Findings(RUN, records)).rows
    assert list(row[:3]) == ["1", *dependent]


def test_one_exchange_per_point_is_too_few() -> None:
    """A single measurement gives no verdict."""
    findings = Findings(RUN, [handshake("x25519", 256, 0.1), handshake("x25519", 512, 0.5)])
    assert tables.dependence(findings).rows == [["0", "0", "-", "too few repetitions"]]


def test_extremes_name_the_widest_group() -> None:
    """The group with the largest ratio of the longest to the shortest exchange."""
    findings = Findings(RUN, [paper(512, 512, seconds) for seconds in (0.1, 2.0)])
    assert tables.extremes(findings).rows == [["the paper's method", "2", "100 ms", "2 s", "512 bits", "20"]]


def test_tags_show_the_step_at_the_block() -> None:
    """Prepared states do not depend on the key; otherwise the step is after the block."""
    assert tables.tag_times(a_run()).rows == [["45 bytes", "1 µs to 1 µs (0 %)", "+0 ns", "+300 ns", "+600 ns"]]


def test_tags_at_one_length_are_not_shown() -> None:
    """A difference needs several lengths."""
    assert tables.tag_times(Findings(RUN, [tag(512, "prepared", 1e-6)])).rows == []


def test_latency_has_quantiles_and_the_delay_of_the_relay() -> None:
    """The delay is a difference of medians, and that of four datagrams."""
    assert tables.latencies(a_run()).rows[0][1:] == ["3", "500 µs", "600 µs", "600 µs"]
    assert tables.relay_delay(a_run()).rows == [["+100 µs", "+400 µs"]]
    noisy = Findings(RUN, [frames([0.5, 0.6]), frames([0.4, 0.5], relay=True)])
    assert tables.relay_delay(noisy).rows[0][0] == "-100 µs"


def test_energy_names_the_assumption_and_the_sources() -> None:
    """The reader can choose the power of another board."""
    assert [row[1] for row in tables.energy(a_run()).rows] == ["0.5 W", "not available on this machine"]
    assert [row[2] for row in tables.boards().rows] == [board.source for board in BOARDS]


def test_run_has_the_load_of_the_machine() -> None:
    """Other load explains long times."""
    findings = Findings({"load_before": 0.5}, [Record("end", {}, {"elapsed_s": 9.0, "load_after": 2.5})])
    assert ["load after", "2.5"] in tables.run_facts(findings).rows


def test_without_records_the_tables_are_empty() -> None:
    """An interrupted run has a report too."""
    findings = Findings(RUN, [])
    for table in (tables.extremes, tables.tag_times, tables.latencies, tables.relay_delay, tables.suites):
        assert table(findings).rows == []
