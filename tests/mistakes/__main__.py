"""``python -m tests.mistakes``: make the mistakes of the command line, or all, and print a table."""

from __future__ import annotations

import asyncio
import contextlib
import io
import sys

from tests.mistakes.row import Mistake, Result, is_in
from tests.mistakes.run import MISTAKES, run_all


def line(mistake: Mistake, result: Result) -> str:
    """A row of the table."""
    checks = ((mistake.check, result.check, "names it"), (mistake.command, result.command, "the command names it"))
    answers = [(words if is_in(pattern, text) else "no") for pattern, text, words in checks if pattern]
    here, there = (
        ", ".join(f"`{sign.cause}`" for sign in result.shown if sign.side == side) or "-"
        for side in ("here", "there")
    )
    return f"| {' | '.join((mistake.row, mistake.name, ', '.join(answers) or '-', here, there))} |"


def main() -> None:
    """Print it; what was not shown is in standard error."""
    wanted = tuple(mistake for mistake in MISTAKES if not sys.argv[1:] or mistake.row in sys.argv[1:])
    with contextlib.redirect_stdout(io.StringIO()):  # the daemons' output
        results = asyncio.run(run_all(wanted))
    print("| # | mistake | `check`, command | `status` here | `status` there |\n|--|--|--|--|--|")
    for mistake in wanted:
        print(line(mistake, results[mistake.row]))
        if results[mistake.row].problem:
            print(f"{mistake.row}: {results[mistake.row]}", file=sys.stderr)


if __name__ == "__main__":
    main()
