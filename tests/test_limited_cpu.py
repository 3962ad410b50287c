"""A process with a limit gets no more of a core than its share."""

from __future__ import annotations

import signal
import subprocess
import sys

from tests.limited_cpu import limited_cpu
from uavlinkd.lab.child_processes import end_with_parent

SHARE = 0.2
BURN = """
from time import monotonic, process_time
began_at, began_cpu = monotonic(), process_time()
while process_time() - began_cpu < 0.2:
    pass
print((process_time() - began_cpu) / (monotonic() - began_at))
"""


def test_limited_process_gets_its_share_of_a_core() -> None:
    """200 ms of CPU time take about a second at a fifth of a core; a busy machine can only make the share smaller."""
    with limited_cpu(SHARE) as limit:
        command = [*limit.launcher, sys.executable, "-c", BURN]
        said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        assert limit.throttled_s() > 0
    assert float(said) < 1.5 * SHARE


def test_processes_of_the_group_end_with_it() -> None:
    """A process that the test left running is killed, and the group is removed."""
    with limited_cpu(SHARE) as limit:
        command = [*limit.launcher, sys.executable, "-c", "import time; time.sleep(600)"]
        process = subprocess.Popen(end_with_parent(*command))
        while not (limit.folder / "cgroup.procs").read_text():  # the shell joins before it becomes Python
            assert process.poll() is None
    assert process.wait() == -signal.SIGKILL
    assert not limit.folder.exists()
