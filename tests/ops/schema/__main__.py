"""Writes the declarations of the schemas, as the code has them now."""

from __future__ import annotations

import argparse
import asyncio
import os
import sys

from tests.ops.schema import golden, log_names, metric_names, status_names
from uavlinkd.ops.schema_versions import LOG_SCHEMA, METRICS_SCHEMA, STATUS_SCHEMA


def main() -> int:
    """Write the files; exit status 1 if a version has to rise first."""
    parser = argparse.ArgumentParser(prog=golden.COMMAND, description=__doc__)
    parser.add_argument("--unreleased", action="store_true", help="remove names of a version that was never released")
    options = parser.parse_args()
    status = 0
    os.environ[log_names.LEARN] = "1"  # the daemons of the status show fields of the log
    for kind, version, names in (
        ("status", STATUS_SCHEMA, asyncio.run(status_names.observed()).names),
        ("metrics", METRICS_SCHEMA, metric_names.observed()),
        ("log", LOG_SCHEMA, log_names.observed(golden.load("log")["names"])),
    ):
        declared = golden.load(kind)
        broken = golden.breaks(declared["names"], names)
        if broken and version == declared["version"] and not options.unreleased:
            print(*golden.differences(kind, version, declared, names), sep="\n")
            status = 1
        else:
            golden.save(kind, version, names)
    return status


if __name__ == "__main__":
    sys.exit(main())
