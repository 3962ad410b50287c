"""No core dump contains a key, wherever the system sends it."""

from __future__ import annotations

import subprocess
import sys

from tests.needs import need

_ASK = """
import ctypes, resource
from uavlinkd.system.process import forbid_core_dumps
dumpable = lambda: ctypes.CDLL(None).prctl(3, 0, 0, 0, 0)
before = dumpable()
forbid_core_dumps()
print(before, dumpable(), *resource.getrlimit(resource.RLIMIT_CORE))
"""


def test_process_with_keys_is_not_dumpable() -> None:
    """It has the limit, and the flag that also applies to dumps in a pipe."""
    need(sys.platform == "linux", "Linux")
    done = subprocess.run([sys.executable, "-c", _ASK], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["1", "0", "0", "0"]
