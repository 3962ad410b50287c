"""No core dump holds a key, wherever the system would send it."""

from __future__ import annotations

import subprocess
import sys

from tests.daemon.harness import need

_ASK = """
import ctypes, resource
from uavlinkd.system.core_dumps import forbid_core_dumps
dumpable = lambda: ctypes.CDLL(None).prctl(3, 0, 0, 0, 0)
before = dumpable()
forbid_core_dumps()
print(before, dumpable(), *resource.getrlimit(resource.RLIMIT_CORE))
"""


def test_a_process_with_keys_is_not_dumpable() -> None:
    """By the limit, and by the flag that counts also where dumps are piped to a program."""
    need(sys.platform == "linux", "Linux")
    done = subprocess.run([sys.executable, "-c", _ASK], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["1", "0", "0", "0"]
