"""Faults of the machine: descriptors, disks, clocks, the name service, the scheduler; and a peer that went mad."""

from __future__ import annotations

import asyncio
import json
import os
import random
import resource
import signal
import socket
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from time import monotonic, sleep
from typing import Any

from tests.daemon.fleet import Rogue
from tests.daemon.frames import frame
from tests.daemon.harness import Stage
from tests.daemon.process import DaemonProcess, Status
from tests.daemon.udp import Sockaddr, open_socket
from tests.faults.network import FAULT_S
from tests.faults.talk import UNCOUNTED, Log, Outcome, Talk, grew, prepare, reported
from tests.needs import need
from tests.waiting import Stopwatch, until
from uavlinkd.lab.sim.loopback_ports import free_port

SUSPENDED_S = float(os.environ.get("UAVLINKD_SIGSTOP_S", FAULT_S))
"""How long a process is stopped; 10 in CI."""
LINES_AT_MOST = 12
"""That a daemon may log for one of these faults, and two more each ten seconds."""


async def _linked(stage: Stage, a: DaemonProcess, b: DaemonProcess, talk: Talk) -> None:
    await stage.start(a, b)
    await talk.start()


# Descriptors.


async def descriptors(stage: Stage) -> Outcome:
    """No descriptor is left for a TCP client, a recording, a serial port or the control socket; at both daemons."""
    a, b = stage.pair()
    talk = prepare(a, b)
    scenes = [_Exhausted(daemon) for daemon in (a, b)]
    await stage.start(a, b)
    logs = [Log(a), Log(b)]
    for scene in scenes:
        scene.exhaust()
    await talk.start()  # with the first frame, a recording is to begin
    began = monotonic()
    await asyncio.sleep(FAULT_S)
    ended, watch = monotonic(), Stopwatch()
    for scene in scenes:
        scene.relieve()
    await asyncio.gather(*(scene.back() for scene in scenes))
    recovered_s, lines = watch.calm_s, max(log.count for log in logs)  # later ones are of clients that leave
    await talk.check_lost_none(began, ended, a, b)  # the link does without new descriptors
    talk.stop()
    did = [await scene.reported() for scene in scenes]
    return Outcome(f"the link lost no frame; {did[0]}", recovered_s, lines)


class _Exhausted:
    """A daemon without free descriptors, and clients that need one."""

    def __init__(self, daemon: DaemonProcess) -> None:
        self.daemon = daemon
        self._tcp = daemon.add_endpoint("tcp", f"tcpin:127.0.0.1:{free_port()}")
        self._device = daemon.folder / "ttyACM0"
        daemon.add_endpoint("serial", f"serial:{self._device}:57600")
        daemon.config["recording"] = {"folder": "recordings", "min_free_bytes": 100_000}
        self._limits = (0, 0)
        self._clients: list[socket.socket] = []
        self._ends: tuple[int, int] = (-1, -1)

    def exhaust(self) -> None:
        pid = self.daemon.pid
        self._limits = resource.prlimit(pid, resource.RLIMIT_NOFILE)
        taken = self._descriptors()
        for _ in range(5):  # one that is open for a moment must not be taken for one that stays
            sleep(0.05)
            taken &= self._descriptors()
        # Below the first free number: the others may be above, they stay open.
        first_free = next(number for number in range(len(taken) + 1) if number not in taken)
        resource.prlimit(pid, resource.RLIMIT_NOFILE, (first_free, self._limits[1]))
        self._clients = [self._connect() for _ in range(3)]
        self._ends = os.openpty()
        self._device.symlink_to(os.ttyname(self._ends[1]))

    def _descriptors(self) -> set[int]:
        return {int(name) for name in os.listdir(f"/proc/{self.daemon.pid}/fd")}

    def _connect(self) -> socket.socket:
        return socket.create_connection(self._tcp)

    def relieve(self) -> None:
        resource.prlimit(self.daemon.pid, resource.RLIMIT_NOFILE, self._limits)

    async def back(self) -> None:
        await self.daemon.until(self._is_back)

    def _is_back(self, status: Status) -> bool:
        recording = status["recording"]
        return (
            len(status["endpoints"]["tcp"]["clients"]) == len(self._clients)
            and bool(status["endpoints"]["serial"]["clients"])
            and recording["is_recording"]
            and "EMFILE" in recording["failures"]
        )

    async def reported(self) -> str:
        """Its counters; afterwards all clients are connected."""
        status = await self.daemon.status()
        counts = {
            "TCP": status["endpoints"]["tcp"]["failures"],
            "serial": status["endpoints"]["serial"]["failures"],
            "recording": status["recording"]["failures"],
        }
        for client in self._clients:
            client.close()
        for end in self._ends:
            os.close(end)
        for failures in counts.values():
            assert failures.get("EMFILE"), counts
        return "; ".join(f"{what}: {reported({'EMFILE': count['EMFILE']})}" for what, count in counts.items())


# Disks.


def on_small_disk(folder: Path, command: str = 'exec "$@"') -> tuple[str, ...]:
    """A launcher with a disk of 256 KiB instead of a folder, visible only to it."""
    script = f"mount -t tmpfs -o size=256k none '{folder}' && {command}"
    return ("unshare", "--mount", "sh", "-c", script, "sh")


def fill(folder: Path) -> Path:
    """Fill a disk to its last byte, with a file that can be deleted."""
    path = folder / "filler"
    with path.open("wb", buffering=0) as file, suppress(OSError):
        while True:
            file.write(bytes(1024))
    return path


async def recording_disk_full(stage: Stage) -> Outcome:
    """The disk for recordings is full, and has room again."""
    a, b = stage.pair()
    folder = a.folder / "recordings"
    folder.mkdir()
    a.config["recording"] = {"folder": "recordings", "min_free_bytes": 100_000}
    a.launcher = on_small_disk(folder)
    talk = prepare(a, b)
    await _linked(stage, a, b, talk)
    await a.until(lambda status: status["recording"]["frames"] > 0)
    before, log = await a.status(), Log(a)
    began = monotonic()
    filler = fill(Path(f"/proc/{a.pid}/root{folder}"))
    await a.until(lambda status: not status["recording"]["is_recording"])
    await asyncio.sleep(FAULT_S)
    during = await a.status()
    ended, watch = monotonic(), Stopwatch()
    filler.unlink()
    frames = during["recording"]["frames"]
    await a.until(lambda status: status["recording"]["is_recording"] and status["recording"]["frames"] > frames)
    recovered_s = watch.calm_s
    await talk.check_lost_none(began, ended, a, b)
    talk.stop()
    lost = during["recording"]["frames_lost"] - before["recording"]["frames_lost"]
    failures = grew(before, during, "recording", "failures")
    assert set(failures) == {"ENOSPC"}
    assert len(a.events("recording_stopped")) == 1
    return Outcome(
        f"the link lost no frame; {lost} frames not recorded, {reported(failures)}", recovered_s, log.count
    )


async def log_disk_full(stage: Stage) -> Outcome:
    """The disk for the log is full, while links go and come; and has room again."""
    a, b = stage.pair(lost_after_s=0.5)
    folder = a.folder / "logs"
    folder.mkdir()
    into, into_other = a.add_endpoint("one"), a.add_endpoint("other")
    a.launcher = on_small_disk(folder, f"exec \"$@\" 2>>'{folder}/log'")
    talk = prepare(a, b)
    await _linked(stage, a, b, talk)
    inside = Path(f"/proc/{a.pid}/root{folder}")
    filler = fill(inside)
    began = monotonic()
    while not (size := (inside / "log").stat().st_size) or size % 4096:  # the rest of its last block was still free
        _newcomer(into)
        await asyncio.sleep(0.02)
    await b.send_signal(signal.SIGSTOP)
    await a.until(lambda status: status["peers"][b.name]["state"] == "lost")  # and that is another
    await b.send_signal(signal.SIGCONT)
    await a.until_linked()
    await talk.back(monotonic())
    calm = monotonic()
    await asyncio.sleep(max(0.5, began + FAULT_S - monotonic()))
    ended, watch = monotonic(), Stopwatch()
    assert (inside / "log").stat().st_size == size
    filler.unlink()
    _newcomer(into_other)
    await until(lambda: "lines_lost_before" in (inside / "log").read_text())
    recovered_s = max(watch.calm_s, await talk.back(ended))
    await talk.check_lost_none(calm, ended, a, b)
    talk.stop()
    lines = (inside / "log").read_bytes()[size:].decode().splitlines()
    (reported_loss,) = (json.loads(line) for line in lines if "lines_lost_before" in line)
    return Outcome(
        "the link goes on, is lost and comes back as with a log; the first line that fits again has"
        f" lines_lost_before = {reported_loss['lines_lost_before']}",
        recovered_s,
        len([line for line in lines if line]),
    )


def _newcomer(into: Sockaddr) -> None:
    """A client that says something once: a line in the log."""
    with open_socket("127.0.0.1") as sock:
        sock.sendto(frame(0, UNCOUNTED), into)


# Clocks.


def faked_clock(at: str) -> dict[str, str]:
    """The environment in which a process believes that it is another time; its monotonic clock is genuine."""
    folders = [Path("/usr/lib"), Path("/usr/lib64"), Path("/usr/local/lib")]
    libraries = [library for folder in folders for library in sorted(folder.glob("**/faketime/libfaketime.so.1"))]
    need(bool(libraries), "libfaketime (Debian: faketime)")
    return {"LD_PRELOAD": str(libraries[0]), "FAKETIME": f"@{at}", "FAKETIME_DONT_FAKE_MONOTONIC": "1", "TZ": "UTC"}


async def clock_jumps(stage: Stage) -> Outcome:
    """The system's clock leaps ten years ahead, and then 54 back; keys are made in either time."""
    environ = faked_clock("2026-01-01 00:00:00")
    del environ["FAKETIME"]
    a, b = stage.pair(rekey_after_s=1.0, reject_after_s=5.0)
    clock = a.folder / "clock"
    clock.write_text("+0")
    a.config["recording"] = {"folder": "recordings", "min_free_bytes": 100_000}
    a.config["log"] = {"level": "debug"}  # rekeys are logged
    talk = prepare(a, b)
    environ |= {"FAKETIME_TIMESTAMP_FILE": str(clock), "FAKETIME_NO_CACHE": "1"}
    a.environ = environ
    await stage.start(a, b)
    await talk.start()
    await a.until(lambda status: status["recording"]["frames"] > 0)
    began, log = monotonic(), Log(a)
    recovered_s = 0.0
    recordings = a.folder / "recordings"
    for files, years in ((2, 10), (3, -54)):
        clock.write_text(f"{365 * years:+}d")
        jumped = monotonic()
        recovered_s = max(recovered_s, await talk.back(jumped))
        await until(lambda years=years: _has_keys_of(a, years))  # type: ignore[misc]
        await until(lambda files=files: len(list(recordings.iterdir())) == files)  # type: ignore[misc]
    ended = monotonic()
    await talk.check_lost_none(began, ended, a, b)
    assert not a.events("peer_lost")
    status = await a.status()
    assert status["recording"]["frames_lost"] == 0
    talk.stop()
    return Outcome(
        "no frame lost, new keys made meanwhile; three recordings, one for each time", recovered_s, log.count
    )


def _has_keys_of(daemon: DaemonProcess, years: int) -> bool:
    """Whether keys were made at a time so far from now, by the daemon's clock."""
    days = [
        (datetime.fromisoformat(event["timestamp"]) - datetime.now(UTC)).days
        for event in daemon.events("session_established")
    ]
    return any(abs(day - 365 * years) < 2 for day in days)


# The name service.


class NameServer(asyncio.DatagramProtocol):
    """Answers every question for an IPv4 address with loopback's (RFC 1035), and any other with none."""

    def __init__(self) -> None:
        self.is_silent = False
        self.questions = 0
        self._transport: asyncio.DatagramTransport

    def connection_made(self, transport: Any) -> None:
        self._transport = transport

    def datagram_received(self, data: bytes, addr: tuple[str | Any, int]) -> None:
        self.questions += 1
        if self.is_silent:
            return
        end = data.index(b"\0", 12) + 5
        answers = data[end - 4 : end - 2] == b"\0\1"
        header = data[:2] + b"\x81\x80\0\1" + (b"\0\1" if answers else b"\0\0") + bytes(4)
        record = b"\xc0\x0c\0\1\0\1\0\0\0\1\0\4" + socket.inet_aton("127.0.0.1") if answers else b""
        self._transport.sendto(header + data[12:end] + record, addr)

    def close(self) -> None:
        self._transport.close()


async def name_service_gone(stage: Stage) -> Outcome:
    """The peer has a name, and no name server is there; then one is."""
    return await _name_service(stage, is_silent=False)


async def name_service_silent(stage: Stage) -> Outcome:
    """The name server takes questions and answers none; then it does."""
    return await _name_service(stage, is_silent=True)


def _free_host() -> str:
    """An address of loopback without a name server."""
    rng = random.SystemRandom()
    while True:
        host = f"127.{rng.randrange(1, 255)}.{rng.randrange(1, 255)}.53"
        with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.bind((host, 53))
            return host


async def _name_service(stage: Stage, *, is_silent: bool) -> Outcome:
    host = _free_host()
    a, b = stage.daemon("drone0"), stage.daemon("drone1")
    psk = stage.psk()
    a.add_peer(b, [f"drone1.fault.test:{b.sockaddr[1]}"], psk)
    b.add_peer(a, [], psk)
    resolv = a.folder / "resolv.conf"
    resolv.write_text(f"nameserver {host}\n")
    script = f"mount --bind '{resolv}' /etc/resolv.conf && exec \"$@\""
    a.launcher = ("unshare", "--mount", "sh", "-c", script, "sh")
    talk = prepare(a, b)
    loop = asyncio.get_running_loop()
    server = NameServer()
    server.is_silent = is_silent
    if is_silent:
        await loop.create_datagram_endpoint(lambda: server, local_addr=(host, 53))
    await stage.start(a, b, linked=False)
    log = Log(a)
    await asyncio.sleep(FAULT_S)
    status = await a.status()
    assert status["peers"]["drone1"]["state"] == "waiting"
    if not is_silent:
        await loop.create_datagram_endpoint(lambda: server, local_addr=(host, 53))
    server.is_silent = False
    ended, watch = monotonic(), Stopwatch()
    await a.until_linked()
    await talk.start()
    await talk.back(ended)
    recovered_s = watch.calm_s
    talk.stop()
    server.close()
    failed = a.events("name_not_resolved")
    assert len(failed) == (1 if not is_silent else len(failed)) <= 1
    return Outcome(
        "peer waiting; name_not_resolved reported once" if failed else "peer waiting", recovered_s, log.count
    )


# The scheduler.


async def suspended(stage: Stage) -> Outcome:
    """The process is stopped, and goes on."""
    a, b = stage.pair()
    talk = prepare(a, b)
    await _linked(stage, a, b, talk)
    log = Log(a)
    await a.send_signal(signal.SIGSTOP)
    began = monotonic()
    await asyncio.sleep(SUSPENDED_S)
    waiting, sent = monotonic(), len(talk.voices[1].sent_at)
    # What the other daemon passes on later is new to this one.
    await b.until(lambda status: status["endpoints"]["talk"]["frames_received"] >= sent)
    ended = monotonic()
    await a.send_signal(signal.SIGCONT)
    recovered_s = await talk.back(ended)
    for speaker, hearer in (talk.voices, talk.voices[::-1]):
        old = {n for n, at in speaker.sent_at.items() if began + 0.1 < at < waiting}
        assert not [n for n in old if speaker.frame(n) in hearer.received_at], (
            "what had waited came as if it were new"
        )
    talk.check_no_copies()
    talk.stop()
    await a.until_logged("daemon_paused")
    await a.until_logged("frames_dropped", reason="stale")
    dropped = sum((await a.status())["stale"].values())  # the log's counts come in portions
    return Outcome(
        f"daemon_paused reported; {dropped} frames that had waited dropped as stale", recovered_s, log.count
    )


# A peer.


async def garbage_with_valid_keys(stage: Stage) -> Outcome:
    """A peer's own keys seal thousands of records and invalid frames; another peer talks meanwhile."""
    a, b = stage.pair()
    captured = stage.daemon("captured")
    psk = stage.psk()
    a.add_peer(captured, [], psk)
    talk = prepare(a, b)
    await stage.start(b, a, linked=False)
    await talk.start()
    rng = random.Random(8)
    genuine = frame(1 << 21, 7)
    began = monotonic()
    before, log = await a.status(), Log(a)
    async with Rogue(captured, a, psk) as rogue:
        while monotonic() < began + FAULT_S:
            for _ in range(50):
                if rogue.is_up:
                    with suppress(AssertionError):  # it sent a close itself: there are no keys for a moment
                        rogue.say(garbage(rng, genuine))
            await asyncio.sleep(0.02)
        ended = monotonic()
        recovered_s = await talk.back(ended)
        await rogue.until(lambda: rogue.is_up)
    after = await a.status()
    await talk.check_lost_none(began, ended, a, b)
    talk.check_no_copies()
    talk.stop()
    drops = grew(before, after, "peers", "captured", "drops")
    malformed = grew(before, after, "peers", "captured", "malformed")
    assert drops.get("bad_control", 0) > 100
    assert malformed
    return Outcome(
        f"the other peer lost no frame; dropped: {reported(drops)}; malformed: {reported(malformed)}",
        recovered_s,
        log.count,
    )


def garbage(rng: random.Random, genuine: bytes) -> bytes:
    """An invalid payload: noise, records with a right first byte, frames cut or altered."""
    noise = rng.randbytes(rng.randrange(1, 400))
    at = rng.randrange(len(genuine))
    return rng.choice(
        (
            noise,
            bytes((rng.randrange(8),)) + noise[: rng.randrange(40)],
            genuine[: at + 1],
            genuine[:at] + bytes((genuine[at] ^ 1 << rng.randrange(8),)) + genuine[at + 1 :],
            genuine + noise,
        )
    )
