"""The walk-through of the Raspberry Pi: the tests of the Debian packages run it, in a clean Debian under systemd."""

from __future__ import annotations

from pathlib import Path

from tests.compose.machine import Machine
from tests.processes.frames import heartbeat
from tests.walkthroughs import autopilot
from tests.walkthroughs.hosts import until
from tests.walkthroughs.test_walkthroughs import Walk, blocks_of, position, return_home, walk

__all__ = ["test_raspberry_pi_from_a_fresh_image", "walk"]


def test_raspberry_pi_from_a_fresh_image(machine: Machine, walk: Walk) -> None:
    """The package, its service and an autopilot at a serial port."""
    pi = walk.add_container("pi", machine, "10.13.0.1/24")
    station = walk.add_ground_station(walk.add_host("station", "10.13.0.254/24"))
    machine.put(Path(autopilot.__file__), "/root/autopilot.py")
    machine.say(
        "systemd-run --quiet --unit=autopilot /usr/bin/python3 /root/autopilot.py"
        f" {(heartbeat(1) + position(1)).hex()} /root/received"
    )

    walk.follow(blocks_of(6))

    def is_done() -> bool:
        station.send(return_home(1))
        received = bytes.fromhex(machine.say('python3 -c \'print(open("/root/received", "rb").read().hex())\''))
        return position(1) in station.poll() and return_home(1) in received

    until(is_done, lambda: pi.log)
