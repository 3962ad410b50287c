"""What other software reads: names and types in the JSON of commands, in the log and in the metrics.

``status.json``, ``check.json``, ``netcheck.json``, ``fleet-list.json``, ``log.json`` and ``metrics.json`` here
declare them. A test fails if the code differs, and prints what to declare. Before a name is removed or retyped, its
version rises in ``uavlinkd/ops/__init__.py``.
"""
