"""Every number and verdict in the report's text comes from the records."""

from __future__ import annotations

import pytest

from tests.lab.evaluation.samples import RUN, a_run, core, frames, handshake, not_finished, paper, tag
from uavlinkd.lab.evaluation import prose
from uavlinkd.lab.evaluation.energy import BOARDS
from uavlinkd.lab.evaluation.timing_queries import Findings
from uavlinkd.lab.evaluation.records import Record


def test_the_comparison_says_what_the_numbers_say() -> None:
    """Medians, the factor between them, what did not finish, and what takes the time."""
    text = " ".join(prose.on_comparison(a_run()))
    assert "At 2048 bits the paper's method takes 40 s" in text
    assert "uavlinkd's ffdhe2048 takes 19 ms" in text
    assert "2105 times less" in text
    assert "At 4096 bits the paper's method did not finish within 600 s in any of 1 tries" in text
    assert "90 % at 2048 bits" in text
    assert "The paper's time is the search for a safe prime" in text
    assert "RFC 7919's group of 2048 bits, which is there already, takes 8 ms" in text
    assert "2.4 times shorter than ffdhe2048" in text


def test_the_comparison_does_not_claim_what_the_numbers_do_not_say() -> None:
    """Where the paper's method is the quicker one, and where its time is not that of parameters, the text says so."""
    slow = [handshake("ffdhe2048", 256, 9.0)]
    quick = [
        Record(
            "paper", {"dh_bits": 2048, "mac_key_bits": 512, "group": "made"}, {"total_s": 1.0, "parameters_s": 0.1}
        )
    ]
    text = " ".join(prose.on_comparison(Findings(RUN, [*slow, *quick])))
    assert "9.0 times more" in text
    assert "is not the most of the paper's time" in text


@pytest.mark.parametrize(
    ("second", "expected"),
    [(0.0041, "In 1 of 1 groups the time does not depend on it"), (0.9, "It does in x25519")],
    ids=["close", "apart"],
)
def test_the_scatter_says_whether_the_key_length_moves_anything(second: float, expected: str) -> None:
    """Judged by a permutation test."""
    records = [
        handshake("x25519", length, base + k * 1e-4)
        for length, base in ((256, 0.004), (512, second))
        for k in range(5)
    ]
    (text,) = prose.on_scatter(Findings(RUN, [*records, tag(2048, "from the key", 3e-6)]))
    assert expected in text


def test_a_tag_dear_enough_to_matter_is_not_talked_away() -> None:
    """The key length is cleared as the cause only where the tags are cheap beside the exchange."""
    records = [
        handshake("x25519", length, base + k * 1e-4) for length, base in ((256, 0.004), (512, 0.9)) for k in range(5)
    ]
    (text,) = prose.on_scatter(Findings(RUN, [*records, tag(2048, "from the key", 0.3)]))
    assert "may be a part of the cause" in text


def test_what_was_given_up_counts_as_the_limit_in_a_median() -> None:
    """Two of three took too long: the median is the limit, not the time of the one that came to an end."""
    records = [paper(2048, 512, 5.0), *(not_finished(2048, 512) for _ in range(2)), handshake("ffdhe2048", 256, 0.01)]
    text = prose.on_comparison(Findings(RUN, records))[0]
    assert "the paper's method takes 600 s" in text
    assert "2 not finished and counted as the limit" in text
    assert "at least 60000 times less" in text


def test_a_relay_whose_cost_is_lost_in_noise_is_said_to_be() -> None:
    """No negative cost."""
    findings = Findings(RUN, [frames([0.5, 0.6]), frames([0.4, 0.5], relay=True)])
    assert "lost in the noise" in prose.on_latency(findings)[1]


def test_one_exchange_a_point_is_too_few_to_compare() -> None:
    """No verdict from a single measurement."""
    (text,) = prose.on_scatter(Findings(RUN, [handshake("x25519", 256, 0.1), handshake("x25519", 512, 0.5)]))
    assert "too few" in text


def test_the_tags_say_where_the_step_is() -> None:
    """Prepared states do not depend on the key; without, the step is behind the block."""
    text = " ".join(prose.on_tags(a_run()))
    assert "does not matter once a session's states are prepared" in text
    assert "256 to 512 bits change it by +0 ns" in text
    assert "of 512 bits by +300 ns" in text
    assert "2048 bits instead of 520 by +600 ns" in text


def test_prepared_tags_that_do_differ_are_said_to() -> None:
    """The verdict is the numbers'."""
    lengths = (256, 512, 520, 2048)
    records = [tag(length, states, length * 1e-8) for length in lengths for states in ("prepared", "from the key")]
    assert "seems to matter" in prose.on_tags(Findings(RUN, records))[0]


def test_the_latency_says_what_the_relay_costs() -> None:
    """The difference of two medians, for four datagrams of a handshake."""
    text = " ".join(prose.on_latency(a_run()))
    assert "half of 3 frames within 500 µs" in text
    assert "adds +100 µs" in text
    assert "so +400 µs of each handshake's time" in text


def test_the_suites_are_ranked_by_median_and_ties_are_admitted() -> None:
    """What overlaps is not told apart."""
    apart = prose.on_suites(a_run())[0]
    assert apart.startswith("The quickest suite is x25519, 7 ms; the slowest ffdhe4096, 38 ms.")
    close = [
        handshake(suite, 256, base * k)
        for suite, base in (("x25519", 0.0100), ("mlkem768", 0.0101))
        for k in (1, 2, 3)
    ]
    assert "The middle halves of x25519 and mlkem768 overlap" in prose.on_suites(Findings(RUN, close))[0]


def test_energy_is_processor_time_of_both_ends_by_the_watts_given() -> None:
    """6 ms and 0.4 ms a frame, at half a watt."""
    findings = a_run()
    assert prose.handshake_joules(findings, "x25519") == pytest.approx(0.003)
    assert prose.frames_joules(findings, suite="x25519") == pytest.approx(0.2)
    assert prose.handshake_joules(findings, "mlkem1024") is None


def test_energy_is_called_an_estimate_and_its_sources_are_named() -> None:
    """A reader can choose watts of a board, and knows that nothing was measured where nothing was."""
    text = " ".join(prose.on_energy(a_run()))
    assert "estimate" in text
    assert "times 0.5 W" in text
    assert "no joules are measured" in text
    assert all(board.source in text for board in BOARDS)


@pytest.mark.parametrize(("before", "after", "warned"), [(0.5, 1.9, False), (0.5, 2.5, True), (7.0, None, True)])
def test_a_busy_machine_is_named(before: float, after: float | None, warned: bool) -> None:
    """Above what the run itself makes, on two cores."""
    findings = Findings({"cores": 2, "load_before": before}, [Record("end", {}, {"load_after": after})])
    assert bool(prose.on_the_machine(findings)) == warned


def test_no_records_make_no_claims() -> None:
    """A run that was interrupted at once still gives a report, which says that there is nothing."""
    nothing = Findings(RUN, [])
    for write in (prose.on_scatter, prose.on_histogram, prose.on_tags, prose.on_latency, prose.on_suites):
        text = " ".join(write(nothing))
        assert any(word in text for word in ("too few", "not measured", "No handshake", "No frame")), text
    assert prose.on_comparison(nothing) == []


def test_the_histogram_says_how_wide_each_method_spreads() -> None:
    """The longest over the shortest, of the widest group."""
    (text,) = prose.on_histogram(Findings(RUN, [paper(512, 512, s) for s in (0.1, 2.0)] + [core("x25519", 256, 0.1)]))
    assert "2 exchanges between 100 ms and 2 s" in text
    assert "512 bits, whose longest is 20 times its shortest" in text


def test_frames_that_all_took_the_same_are_no_problem() -> None:
    """One frame, one number."""
    assert "the last after 1 ms" in prose.on_latency(Findings(RUN, [frames([1.0])]))[0]
