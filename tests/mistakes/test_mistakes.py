"""Every mistake of the table is made, all at the same time, and its remedy is shown."""

from __future__ import annotations

import asyncio

import pytest

from tests.mistakes.row import Mistake, Result, is_in
from tests.mistakes.run import MISTAKES, run_all


@pytest.fixture(scope="module")
def results() -> dict[str, Result]:
    """What was said about each mistake."""
    return asyncio.run(run_all())


@pytest.mark.long
@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: f"{mistake.row} {mistake.name}")
def test_remedy_is_shown(mistake: Mistake, results: dict[str, Result]) -> None:
    """`check` or a command prints its essential words; `status` and the log have the expected causes at both ends."""
    result = results[mistake.row]
    if result.problem.startswith("skipped: "):
        pytest.skip(result.problem.removeprefix("skipped: "))
    assert result.problem == ""
    for pattern, text in ((mistake.check, result.check), (mistake.command, result.command)):
        assert not pattern or is_in(pattern, text), text
    assert set(result.shown) == set(mistake.signs), result
    assert all(sign.cause in result.logged[sign.side] for sign in mistake.signs), result.logged
