"""Every mistake of the table is made, all at the same time, and its remedy is shown."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from tests.mistakes.row import Mistake, Result, is_in
from tests.mistakes.run import MISTAKES, run_all

PAGE = Path(__file__).parent / "README.md"
NEED_REMEDY, LEAST_EXACT = 52, 48


@pytest.fixture(scope="module")
def results() -> dict[str, Result]:
    """What was said about each mistake."""
    return asyncio.run(run_all())


def _first(mistake: Mistake) -> bool:
    """Whether it is one of the 58 of the first table; row 56 was one."""
    return mistake.before != "new"


@pytest.mark.long
@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: f"{mistake.row} {mistake.name}")
def test_remedy_is_shown(mistake: Mistake, results: dict[str, Result]) -> None:
    """`check` or a command prints its essential words, and `status` has the expected causes at both ends."""
    result = results[mistake.row]
    if result.problem.startswith("skipped: "):
        pytest.skip(result.problem.removeprefix("skipped: "))
    assert result.problem == ""
    assert result.remedy(mistake) == mistake.grade, result
    for pattern, text in ((mistake.check, result.check), (mistake.command, result.command)):
        assert not pattern or is_in(pattern, text), text
    assert set(result.shown) == set(mistake.signs)


@pytest.mark.long
def test_log_names_the_causes_too(results: dict[str, Result]) -> None:
    """The log has the cause of each sign that `status` shows, or will have it within a second."""
    missing = {
        (mistake.row, sign.cause)
        for mistake in MISTAKES
        for sign in mistake.signs
        if sign.cause not in results[mistake.row].logged[sign.side] and not results[mistake.row].problem
    }
    assert not missing


def test_rows_are_counted() -> None:
    """58 mistakes, of which 52 need a remedy; row 56 is written out as 13; then 34 more, with ids 59 to 92."""
    first = [mistake for mistake in MISTAKES if _first(mistake) and not mistake.row.startswith("56")]
    assert len([mistake for mistake in MISTAKES if mistake.row.startswith("56")]) == 13
    assert len(first) + 1 == 58
    needing = [mistake for mistake in first if mistake.grade != "not needed"]
    assert len(needing) + 1 == NEED_REMEDY
    assert sum(mistake.grade == "exact" for mistake in needing) + 1 >= LEAST_EXACT
    assert [mistake.row for mistake in MISTAKES if not _first(mistake)] == [str(row) for row in range(59, 93)]


def test_page_has_every_row() -> None:
    """The table of README.md is that of `python -m tests.mistakes`."""
    lines = PAGE.read_text().splitlines()
    for mistake in MISTAKES:
        (line,) = [line for line in lines if line.startswith(f"| {mistake.row} | ")]
        assert mistake.name in line
        assert line.endswith(f"| {mistake.grade} |")
