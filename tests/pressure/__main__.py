"""``python -m tests.pressure``: attacks real daemons on loopback and prints the effect on their other peers."""

from __future__ import annotations

import argparse
import asyncio
import sys
from contextlib import nullcontext

from tests.limited_cpu import limited_cpu
from tests.pressure.scene import HEADER, PLANS, Plan, Seen, watch
from tests.processes.harness import Stage


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.pressure", description=__doc__)
    parser.add_argument("plans", nargs="*", metavar="PLAN", help=f"of: {', '.join(PLANS)}")
    parser.add_argument(
        "--seconds", type=float, default=4.0, help="duration of the frames in both directions during each attack"
    )
    parser.add_argument("--share", type=float, help="the part of one core that the daemon gets")
    options = parser.parse_args()
    if unknown := set(options.plans) - set(PLANS):
        parser.error(f"no such plan: {', '.join(unknown)}")
    print(HEADER)
    for name in options.plans or PLANS:
        print(asyncio.run(_run(PLANS[name], options.seconds, options.share)).line(), flush=True)
    return 0


async def _run(plan: Plan, seconds: float, share: float | None) -> Seen:
    with nullcontext() if share is None else limited_cpu(share) as limit:
        async with Stage() as stage:
            return await watch(stage, plan, seconds, () if limit is None else limit.launcher)


sys.exit(main())
