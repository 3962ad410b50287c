"""uavlinkd alone: with many peers, its memory, and the duration of its start."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Final

from tests.bench.cable import END_S
from tests.bench.contenders import LINK_PORT, NotMeasuredError, Running, last_words, until
from tests.bench.daemons import configuration, daemon_command, peer, peers_up, start_daemon
from tests.bench.measure import Bench, at_rate, resident_bytes
from tests.bench.traffic import Traffic, TrafficError, Worker
from uavlinkd.config import keys
from uavlinkd.lab.evaluation.records import Value, cpu_seconds

SINK_PORT: Final = 14601
"""Port of the sink that counts the frames of all systems."""
LINKED_S: Final = 120.0
READY_S: Final = 30.0
NO_LISTENER: Final = "127.0.0.1:9"
"""An address without a listener."""
LOOK_EVERY_S: Final = 0.5
WARM_UP_S: Final = 1.0


@contextmanager
def hub(bench: Bench, peers: int) -> Iterator[tuple[Bench, Running]]:
    """A daemon on the right with so many linked peers, all of them on the left; and how to send through them.

    Raises:
        NotMeasuredError: they are not linked in time, or one of the processes ended.
    """
    left, right = bench.cable.left, bench.cable.right
    with tempfile.TemporaryDirectory(prefix="uavbench-") as name:
        folder = Path(name)
        private = [keys.generate_private_key() for _ in range(peers)]
        own = keys.generate_private_key()
        keys.write_secret_file(folder / "hub.key", own + "\n")
        sections = [
            peer(f"drone{system}", keys.public_key_text(key), {"role": "vehicle", "system_ids": [system]})
            for system, key in enumerate(private, 1)
        ]
        (folder / "hub.toml").write_text(
            configuration("hub", peers=sections, endpoint=f"udpout:127.0.0.1:{SINK_PORT}")
        )
        plan = folder / "swarm.json"
        plan.touch(0o600)
        facts = {"host": right.address, "port": LINK_PORT, "public_key": keys.public_key_text(own)}
        facts |= {"private_keys": private, "frames": str(bench.frames), "patience_s": LINKED_S}
        plan.write_text(json.dumps(facts))
        try:
            daemon = start_daemon(right, folder / "hub.toml")
            until(lambda: peers_up(folder / "hub.sock") >= 0, "the daemon answers")
            traffic = Traffic(Worker(left, "swarm", str(plan)), Worker(right, "sink", str(SINK_PORT), "0"))
            until(lambda: peers_up(folder / "hub.sock") == peers, f"{peers} peers are up", LINKED_S)
            yield replace(bench, traffic=traffic), Running([], [daemon])
        except (NotMeasuredError, TrafficError) as error:
            raise NotMeasuredError(f"{error}{last_words(folder)}") from None
        finally:
            left.end_all_but(bench.traffic.processes)
            right.end_all_but(bench.traffic.processes)


def with_peers(bench: Bench, peers: int, rate_each: float, seconds: float) -> dict[str, Value]:
    """CPU time per frame of a daemon with so many peers, each sending so many frames a second."""
    with hub(bench, peers) as (inside, running):
        inside.traffic.flow(running.target, rate_each * peers, WARM_UP_S)
        return _of_right(at_rate(inside, running, rate_each * peers, seconds))


def memory(bench: Bench, peers: int) -> dict[str, Value]:
    """Resident memory of a daemon with so many linked peers, after traffic of each."""
    with hub(bench, peers) as (inside, running):
        inside.traffic.flow(running.target, 50.0 * peers, 2.0)
        return {"rss": resident_bytes(running.right[0].pid)}


def start() -> dict[str, Value]:
    """Time of a daemon from exec to its ready notification (sd_notify), and its memory then.

    Raises:
        NotMeasuredError: it does not say so.
    """
    with tempfile.TemporaryDirectory(prefix="uavbench-") as name:
        folder = Path(name)
        own, other = keys.generate_private_key(), keys.generate_private_key()
        keys.write_secret_file(folder / "drone.key", own + "\n")
        config = folder / "drone.toml"
        text = configuration(
            "drone",
            peers=[
                peer("ground", keys.public_key_text(other), {"role": "operator", "system_ids": [255]}, [NO_LISTENER])
            ],
            endpoint=f"udpout:{NO_LISTENER}",
        )
        config.write_text(text.replace(f'listen = ["0.0.0.0:{LINK_PORT}"]\n', ""))
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notified, (folder / "log").open("wb") as log:
            notified.bind(str(folder / "notify"))
            notified.settimeout(LOOK_EVERY_S)
            environ = {**os.environ, "NOTIFY_SOCKET": str(folder / "notify")}
            began = time.monotonic()
            process = subprocess.Popen(daemon_command(config), env=environ, stdout=log, stderr=log)
            try:
                while not _says_ready(notified):
                    if process.poll() is not None or time.monotonic() - began > READY_S:
                        raise NotMeasuredError(f"not ready in {READY_S:g} s: {(folder / 'log').read_text()[-500:]}")
                ready = time.monotonic() - began
                return {"ready_s": ready, "cpu_s": cpu_seconds(process.pid), "rss": resident_bytes(process.pid)}
            finally:
                process.terminate()
                try:
                    process.wait(END_S)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()


def _says_ready(notified: socket.socket) -> bool:
    try:
        return b"READY=1" in notified.recv(4096).split(b"\n")
    except TimeoutError:
        return False


def _of_right(values: dict[str, Value]) -> dict[str, Value]:
    return {name: value for name, value in values.items() if not name.endswith(("_left", "_left_us"))}
