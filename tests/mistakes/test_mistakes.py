"""Every mistake of the table is made, all at the same time: `check`, the logs or `status` show its remedy."""

from __future__ import annotations

import asyncio
from time import monotonic

import pytest

from tests.mistakes.link_rows import LINK_ROWS
from tests.mistakes.relay_rows import RELAY_ROWS
from tests.mistakes.row import Mistake, Result, Side, is_in
from tests.mistakes.scene import Scene
from tests.processes.harness import Stage
from tests.processes.process import DaemonProcess, Status
from tests.waiting import PATIENCE_S

STARTS = 4
"""Daemons that start at the same time: each needs a core for a third of a second."""
POLL_S = 1.0
LIMIT_S = 4 * PATIENCE_S
"""So many daemons on a busy machine need minutes for what takes one of them seconds."""


def _order(mistake: Mistake) -> tuple[int, str]:
    number = "".join(filter(str.isdigit, mistake.row))
    return int(number), mistake.row


MISTAKES = tuple(sorted((*LINK_ROWS, *RELAY_ROWS), key=_order))


async def run_all(mistakes: tuple[Mistake, ...] = MISTAKES) -> dict[str, Result]:
    """What was said, by row."""
    starting = asyncio.Semaphore(STARTS)
    async with Stage() as stage:
        results = await asyncio.gather(*(_run(mistake, stage, starting) for mistake in mistakes))
    return dict(zip((mistake.row for mistake in mistakes), results, strict=True))


async def _run(mistake: Mistake, stage: Stage, starting: asyncio.Semaphore) -> Result:
    result, scene = Result(), Scene(stage, mistake.row, starting)
    try:
        await mistake.make(scene)
        begun = monotonic()
        result.check, result.command = scene.check, scene.command
        while mistake.signs:
            for side, daemon in (("here", scene.here), ("there", scene.there)):
                if daemon.is_running:
                    _note(result, mistake, side, daemon, await daemon.status())  # type: ignore[arg-type]
            is_logged = all(sign.cause in result.logged[sign.side] for sign in mistake.signs)
            if len(result.shown) == len(mistake.signs) and is_logged:
                break
            if monotonic() - begun > LIMIT_S:
                missing = [sign for sign in mistake.signs if sign not in result.shown]
                result.problem = f"not shown: {missing}" if missing else "not logged"
                break
            await asyncio.sleep(POLL_S)
    except pytest.skip.Exception as skipped:
        result.problem = f"skipped: {skipped}"
    except (AssertionError, OSError, TimeoutError) as error:
        result.problem = f"{type(error).__name__}: {error}"[:1000]
    finally:
        scene.close()
    return result


def _note(result: Result, mistake: Mistake, side: Side, daemon: DaemonProcess, status: Status) -> None:
    for finding in status["findings"]:
        result.causes[side].add(finding["cause"])
        for sign in mistake.signs:
            is_shown = (sign.side, sign.cause) == (side, finding["cause"]) and is_in(sign.remedy, finding["remedy"])
            if is_shown and sign not in result.shown:
                result.shown.append(sign)
    if any(sign.side == side for sign in result.shown):
        result.logged[side] |= {line["cause"] for line in daemon.events("problem_began")}
        # A few causes have an event of their own, by the same name.
        result.logged[side] |= {sign.cause for sign in mistake.signs if daemon.events(sign.cause)}


@pytest.fixture(scope="module")
def results() -> dict[str, Result]:
    """What was said about each mistake."""
    return asyncio.run(run_all())


@pytest.mark.long
@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: f"{mistake.row} {mistake.make.__name__}")
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
