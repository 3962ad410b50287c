"""What other software reads: names and types in the JSON of ``status``, in the log and in the metrics.

``status.json``, ``log.json`` and ``metrics.json`` here declare them. A test fails if the code differs, and prints
what to declare. Before a name is removed or retyped, its version rises in ``uavlinkd/ops/__init__.py``.
"""
