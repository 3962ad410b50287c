"""``python -m tests.mistakes``: make the mistakes, and print the table of README.md."""

from __future__ import annotations

import asyncio
import contextlib
import io
import sys

from tests.mistakes.row import Mistake, Result, is_in
from tests.mistakes.run import MISTAKES, run_all

_BEFORE = {"yes": "yes", "half": "half", "no": "no", "-": "not needed", "new": ""}


def table(results: dict[str, Result]) -> list[str]:
    """Markdown."""
    lines = [
        "| # | mistake | before | `check`, command | `status` here | `status` there | remedy now |",
        "|--|--|--|--|--|--|--|",
    ]
    return lines + [_line(mistake, results[mistake.row]) for mistake in MISTAKES if mistake.row in results]


def _line(mistake: Mistake, result: Result) -> str:
    answers = []
    if mistake.check:
        answers.append("names it" if is_in(mistake.check, result.check) else "no")
    if mistake.command:
        answers.append("the command names it" if is_in(mistake.command, result.command) else "no")
    here, there = (
        ", ".join(f"`{sign.cause}`" for sign in result.shown if sign.side == side) or "-"
        for side in ("here", "there")
    )
    before = _BEFORE[mistake.before]
    cells = (mistake.row, mistake.name, before, ", ".join(answers) or "-", here, there, result.remedy(mistake))
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Run the rows of the command line, or all."""
    wanted = tuple(mistake for mistake in MISTAKES if not sys.argv[1:] or mistake.row in sys.argv[1:])
    with contextlib.redirect_stdout(io.StringIO()):  # the daemons' output
        results = asyncio.run(run_all(wanted))
    print(*table(results), sep="\n")
    for mistake in wanted:
        result = results[mistake.row]
        if result.problem or result.remedy(mistake) != mistake.grade:
            print(f"{mistake.row}: {result}", file=sys.stderr)


if __name__ == "__main__":
    main()
