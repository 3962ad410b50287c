"""The real wireguard-go as a station: from the printed code to a flight by real ground stations."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from time import monotonic

import pytest

from tests.lab.sim import scenarios
from tests.namespaces import udp_socket_in
from tests.needs import need
from tests.processes.frames import frames_in, name_of
from tests.stations.scene import Scene, need_wireguard, picture, text_in, until
from tests.waiting import Stopwatch

pytestmark = pytest.mark.long
MOST_S = 2.0
"""From the interface to the first HEARTBEAT: the autopilot sends one each second."""


@pytest.fixture
def scene() -> Iterator[Scene]:
    need_wireguard()
    with Scene() as scene:
        yield scene


def test_printed_code_is_the_printed_text(scene: Scene) -> None:
    """As zbar reads it from a picture of the terminal."""
    need(shutil.which("zbarimg") is not None, "zbarimg (Debian: zbar-tools)")
    printed = scene.add("tablet")
    file = scene.folder / "code.pgm"
    file.write_bytes(picture(printed))
    read = subprocess.run(["zbarimg", "-q", "--raw", str(file)], check=True, capture_output=True, text=True).stdout
    assert read.strip() == text_in(printed).strip()


def test_heartbeat_is_at_the_station_without_asking(scene: Scene) -> None:
    """At port 14550, as soon as the tunnel is switched on."""
    printed = scene.add("tablet")
    scene.start_daemon()
    scene.start_autopilot()
    until(lambda: scene.status()["endpoints"]["autopilot"]["clients"], "the autopilot is there")
    # Only now: wireguard-go initiates when it is configured, and again after 5 s.
    app = scene.app(printed)
    with udp_socket_in(scene.tablet.path, "0.0.0.0", 14550) as ground:
        took = Stopwatch()
        began = app.switch_on()
        frames: list[bytes] = []

        def has_heartbeat() -> bool:
            try:
                frames.extend(frames_in(ground.recv(4096)))
            except BlockingIOError:
                return False
            return any(name_of(frame) == "HEARTBEAT" for frame in frames)

        until(has_heartbeat, "a HEARTBEAT came")
        print(f"first HEARTBEAT {monotonic() - began:.2f} s after the interface")
        assert took.calm_s < MOST_S


def test_pymavlink_reads_writes_and_arms(scene: Scene) -> None:
    """All parameters, 100 items up and down, arming, from inside the tunnel."""
    app = scene.app(scene.add("tablet"))
    scene.start_daemon()
    scene.start_autopilot()
    app.switch_on()
    seen = json.loads(scene.run_on_tablet(sys.executable, "-m", "tests.stations.ground_station", "14550"))
    print(seen)
    assert seen["same_plan"]
    assert seen["items"] == 100


def test_mavsdk_flies(scene: Scene) -> None:
    """All parameters, 100 items up and down, arm, take off, land. MAVSDK is system 245."""
    scenarios.need("mavsdk.mavsdk")
    app = scene.app(scene.add("tablet", "--system-id", "245"))
    scene.start_daemon()
    scene.start_autopilot()
    app.switch_on()
    printed = scene.run_on_tablet(scenarios.PYTHON, str(scenarios.CLIENTS), "udpin:0.0.0.0:14550", "100")
    seen = json.loads(printed.splitlines()[-1])
    assert len(seen["plan"]) == 100
    assert seen["plan"][: len(scenarios.plan_sent())] == scenarios.plan_sent()
    assert seen["set"] == [500, 200]
    assert seen["top_m"] > 2.6
