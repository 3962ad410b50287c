"""The versions of what other software reads: the JSON of ``status``, the log, the metrics.

A version rises when a name is removed, renamed or changes its type or meaning. An addition leaves it as it is.
``tests/ops/schema/`` has what each version contains.
"""

from typing import Final

STATUS_SCHEMA: Final = 2
LOG_SCHEMA: Final = 1
METRICS_SCHEMA: Final = 2
