"""What other software reads: names and types in the JSON of ``status``, in the log and in the metrics.

``status.json``, ``log.json`` and ``metrics.json`` here declare them. A test fails if the code differs. Then run

    python -m tests.ops.schema

and commit the changed file. It refuses to remove or retype a name before its version rises, in
``uavlinkd/ops/schema_versions.py``; ``--unreleased`` permits it for a version that was never released. Fields of log
events that only a running daemon shows are added with

    UAVLINKD_LEARN_LOG=1 python -m pytest -n 0 tests/daemon/…
"""
