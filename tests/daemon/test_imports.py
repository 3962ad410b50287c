"""The modules that a daemon imports while it runs."""

from __future__ import annotations

import asyncio
import os
import sys

from tests.daemon.harness import Stage
from tests.daemon.test_reload import reload
from uavlinkd.lab.sim.loopback_ports import free_port

HOOK = """
import atexit, sys
def write(modules=sys.modules):
    with open(__file__ + ".modules", "w") as file:
        file.write("\\n".join(name for name, module in modules.items() if module is not None))
atexit.register(write)
"""


async def test_a_daemon_imports_no_laboratory(stage: Stage) -> None:
    """Neither ``lab``, matplotlib nor pymavlink, with every part in use: endpoints, metrics, recording, a reload."""
    a, b = stage.pair()
    a.add_endpoint("client")
    a.add_endpoint("server", "tcp:127.0.0.1:9")
    a.add_endpoint("autopilot", "serial:/dev/absent.test:57600")
    a.config |= {"metrics": {"listen": f"127.0.0.1:{free_port()}"}, "recording": {"folder": "recordings"}}
    hook = stage.folder / "hook" / "sitecustomize.py"
    hook.parent.mkdir()
    hook.write_text(HOOK)
    await a.start({"PYTHONPATH": os.pathsep.join([str(hook.parent), *sys.path])})
    await b.start()
    await a.until_linked()
    assert await reload(a) == []
    assert await a.stop() == 0
    modules = (await asyncio.to_thread((hook.parent / "sitecustomize.py.modules").read_text)).splitlines()
    assert "uavlinkd.link.daemon" in modules
    forbidden = ("uavlinkd.lab", "matplotlib", "pymavlink")
    assert [name for name in modules if name.startswith(forbidden)] == []
