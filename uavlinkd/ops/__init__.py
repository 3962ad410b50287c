"""What an operator uses: commands, status, log, metrics, recordings.

The versions of what other software reads are here. A version rises when a name is removed, renamed or changes its
type or meaning. An addition leaves it as it is. ``tests/ops/schema/`` has what each version contains.
"""

from typing import Final

STATUS_SCHEMA: Final = 6
LOG_SCHEMA: Final = 5
METRICS_SCHEMA: Final = 4
CHECK_SCHEMA: Final = 1
NETCHECK_SCHEMA: Final = 1
FLEET_LIST_SCHEMA: Final = 1
DEMO_SCHEMA: Final = 1
