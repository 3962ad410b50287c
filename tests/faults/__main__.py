"""``python -m tests.faults [NAME …]``: cause each fault for real daemons, and print the result as Markdown.

Exit status 0 only if the daemons were back in time from each. UAVLINKD_FAULT_S says how long a fault lasts (4 s).
Most take root.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import io
import sys
import traceback

from tests.faults.network import FAULT_S
from tests.faults.run import BACK_S, FAULTS, happen, markdown, why_not
from tests.faults.talk import Outcome


def main() -> int:
    """Exit status: 0 all were back in time, 1 not."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    parser.add_argument("fault", nargs="*", default=[], choices=[[], *FAULTS], metavar="NAME", help=", ".join(FAULTS))
    chosen = parser.parse_args().fault or list(FAULTS)
    reason = why_not()
    if reason is not None and any(FAULTS[name].takes_root for name in chosen):
        print(f"needs {reason}", file=sys.stderr)
        return 1
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        outcomes = asyncio.run(happen(chosen))
    failed = [one for one in outcomes.values() if not isinstance(one, Outcome) or one.recovered_s > BACK_S]
    if failed:
        print(said.getvalue())
    for failure in failed:
        if isinstance(failure, BaseException):
            traceback.print_exception(failure)
    print(f"Each fault lasted {FAULT_S:g} s.\n\n{markdown(outcomes)}")
    return 1 if failed else 0


sys.exit(main())
