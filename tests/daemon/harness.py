"""Real daemons as processes on loopback, and what stands around them: programs that speak MAVLink, and a relay.

::

    async with Stage() as stage:  # or the fixture `stage`
        a, b = stage.pair()  # configured to call each other, not yet running
        into = a.add_endpoint("autopilot")  # a udpin; (host, port)
        ground = await stage.program()  # a UDP socket with a memory
        b.add_endpoint("ground", f"udpout:{ground}")
        await stage.start(a, b)  # both answer, and are linked
        autopilot = await stage.program()
        autopilot.send(frame(1), into)
        await ground.until(lambda: ground.received == frame(1))

When the stage ends, each daemon must have ended cleanly, none may have written a traceback or anything else that is
no log line, and no secret may stand in anything that a daemon said.
"""

from __future__ import annotations

import asyncio
import json
import os
import random
import signal
import socket
import sys
import tempfile
from base64 import b64encode, urlsafe_b64encode
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from enum import StrEnum
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from uavlinkd.config import keys
from uavlinkd.lab.sim.links import Changes

PATIENCE_S = 60.0
"""How long anything may take that has to happen: much more than it does take, for busy machines."""
POLL_S = 0.01
BUFFER_BYTES = 1 << 21

WITHOUT_UVLOOP = "import sys; sys.modules['uvloop'] = None; from uavlinkd.cli import main; sys.exit(main())"
ODD = ("1", "3", "5", "7", "9")

Sockaddr = tuple[str, int]
Status = dict[str, Any]


def need(is_there: bool, what: str) -> None:
    """Skip a test without what it needs; in CI that is a failure (tests/conftest.py)."""
    if not is_there:
        pytest.skip(f"needs {what}")


@cache
def has_ipv6() -> bool:
    """Whether this machine has an IPv6 loopback."""
    try:
        with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as sock:
            sock.bind(("::1", 0))
    except OSError:
        return False
    return True


def drops(status: Status) -> dict[str, int]:
    """What a daemon discarded, by reason.

    Without the answers to a call that was over by then: where two daemons call each other at the same moment, one of
    the two answers is no longer waited for.
    """
    counts: Counter[str] = Counter(status["drops"])
    for peer in status["peers"].values():
        counts.update(peer["drops"])
    return {reason: amount for reason, amount in counts.items() if reason != "unexpected_response"}


def _open_policy(settings: Mapping[str, object]) -> dict[str, object]:
    """A peer's settings, with all that they do not name allowed in so many words."""
    lists = {"allow_in", "allow_out"}
    allowed: dict[str, object] = {"system_ids": "all"}
    if "role" not in settings:
        allowed |= {key: ["all"] for key in lists} if lists & set(settings) else {"role": "all"}
    return allowed | dict(settings)


_given_ports: set[int] = set()


def free_port() -> int:
    """A port that is free for UDP and TCP, below the range that the kernel assigns."""
    while True:
        port = random.SystemRandom().randrange(10240, 32768)
        if port in _given_ports:
            continue
        with suppress(OSError):
            for kind in (socket.SOCK_DGRAM, socket.SOCK_STREAM):
                _try_port(port, kind)
            _given_ports.add(port)
            return port


def _try_port(port: int, kind: socket.SocketKind) -> None:
    """Bind it for a moment.

    Raises:
        OSError: it is in use.
    """
    with socket.socket(socket.AF_INET, kind) as sock:
        sock.bind(("0.0.0.0", port))
    if has_ipv6():
        with socket.socket(socket.AF_INET6, kind) as sock:
            sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            sock.bind(("::", port))


def shown(address: Sockaddr) -> str:
    """``host:port``, IPv6 in brackets."""
    host, port = address
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def frame(number: int, system: int = 1, component: int = 1) -> bytes:
    """A genuine MAVLink 2 frame that differs from that of every other number."""
    codec = mavlink.MAVLink(None, system, component)
    codec.seq = number % 256
    return bytes(mavlink.MAVLink_named_value_int_message(number, b"number", number).pack(codec))


def heartbeat(system: int = 1, component: int = 1) -> bytes:
    """A genuine HEARTBEAT, MAVLink 2."""
    codec = mavlink.MAVLink(None, system, component)
    return bytes(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3).pack(codec))


class Program(asyncio.DatagramProtocol):
    """A UDP socket that keeps what comes, byte for byte. It does not know what MAVLink is."""

    def __init__(self, sock: socket.socket) -> None:
        self.datagrams: list[bytes] = []
        self.sources: list[Sockaddr] = []
        self.received = bytearray()
        self._changes = Changes()
        self._sock = sock
        self._transport: asyncio.BaseTransport

    def __str__(self) -> str:
        return shown(self.address)

    @property
    def address(self) -> Sockaddr:
        """Where it is."""
        host, port = self._sock.getsockname()[:2]
        return host, port

    def send(self, datagram: bytes, to: Sockaddr) -> None:
        """Send one datagram. Not through the transport: that swallows empty ones."""
        self._sock.sendto(datagram, to)

    def clear(self) -> None:
        """Forget what has come."""
        self.datagrams.clear()
        self.sources.clear()
        self.received.clear()

    async def until(self, condition: Callable[[], bool], timeout_s: float = PATIENCE_S) -> None:
        """Wait for a condition on what has come.

        Raises:
            TimeoutError: it does not hold in time.
        """
        await self._changes.until(condition, timeout_s)

    async def until_heard(self, data: bytes, timeout_s: float = PATIENCE_S) -> None:
        """Wait until these bytes are among those that came."""
        await self.until(lambda: data in self.received, timeout_s)

    def close(self) -> None:
        """Close the socket."""
        self._transport.close()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = transport

    def datagram_received(self, data: bytes, addr: tuple[str | Any, int]) -> None:
        self.datagrams.append(data)
        self.sources.append(addr[:2])
        self.received += data
        self._changes.notify()


async def open_program(host: str = "127.0.0.1", port: int = 0) -> Program:
    """A program with a socket there."""
    sock = open_socket(host, port)
    _, program = await asyncio.get_running_loop().create_datagram_endpoint(lambda: Program(sock), sock=sock)
    return program


def open_socket(host: str, port: int = 0) -> socket.socket:
    """A UDP socket with room for bursts."""
    sock = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
    sock.setblocking(False)
    sock.bind((host, port))
    return sock


class End(StrEnum):
    """The two ends of a relay."""

    A = "a"
    B = "b"

    @property
    def other(self) -> End:
        """The other one."""
        return End.B if self is End.A else End.A


class Relay:
    """The network between two daemons, in the hands of a test: each end hears the other from the relay's address.

    ``on_datagram(end, datagram)`` is called with each datagram for an end, and has to call :meth:`deliver`, or not.
    """

    def __init__(self) -> None:
        self.on_datagram: Callable[[End, bytes], None] = self.deliver
        self._sides: dict[End, _RelaySide] = {}

    def address_for(self, end: End) -> Sockaddr:
        """Where that end has to call."""
        host, port = self._sides[end].sock.getsockname()
        return host, port

    def attach(self, end: End, address: Sockaddr) -> None:
        """Where an end listens. One that calls first need not be attached."""
        self._sides[end].correspondent = address

    def deliver(self, end: End, datagram: bytes) -> None:
        """Send a datagram to an end; the end sees it come from the other."""
        side = self._sides[end]
        if side.correspondent is not None:
            side.sock.sendto(datagram, side.correspondent)

    async def open(self) -> None:
        """Open both sockets."""
        loop = asyncio.get_running_loop()
        for end in End:
            side = self._sides[end] = _RelaySide(self, end)
            await loop.create_datagram_endpoint(lambda side=side: side, sock=side.sock)  # type: ignore[misc]

    def close(self) -> None:
        """Close both sockets."""
        for side in self._sides.values():
            side.transport.close()


class _RelaySide(asyncio.DatagramProtocol):
    def __init__(self, relay: Relay, end: End) -> None:
        self._relay = relay
        self._end = end
        self.sock = open_socket("127.0.0.1")
        self.transport: asyncio.BaseTransport
        self.correspondent: Sockaddr | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport

    def datagram_received(self, data: bytes, addr: tuple[str | Any, int]) -> None:
        self.correspondent = addr[:2]
        self._relay.on_datagram(self._end.other, data)


class DaemonProcess:
    """A daemon: its folder, its configuration as plain values, and its process while there is one.

    ``config`` may be changed until :meth:`start`, which writes the file.
    """

    def __init__(self, name: str, folder: Path, listen: Sequence[str]) -> None:
        self.name = name
        self.folder = folder
        folder.mkdir()
        self.private_key = keys.generate_private_key()
        self.public_key = keys.public_key_text(self.private_key)
        keys.write_secret_file(folder / "daemon.key", self.private_key)
        self.config: dict[str, Any] = {
            "name": name,
            "private_key_file": "daemon.key",
            "listen": list(listen),
            "control_socket": "control.sock",
            "link": {},
            "endpoint": [],
            "peer": [],
        }
        self.lines: list[str] = []
        """All that its processes wrote to standard error and output."""
        self.statuses: list[str] = []
        """All that it answered, as JSON."""
        self.exit_status: int | None = None
        """Of the last process; None while it runs."""
        self.launcher: tuple[str, ...] = ()
        """What starts the program, such as ``ip netns exec NAME``. It becomes the program: there is one process."""
        self.environ: dict[str, str] = {}
        """What stands in its environment besides ours, however it is started."""
        self._process: asyncio.subprocess.Process | None = None
        self._reading: asyncio.Task[None] | None = None
        self._changes = Changes()

    # Its configuration.

    @property
    def config_file(self) -> Path:
        """Where :meth:`start` writes the configuration."""
        return self.folder / "daemon.toml"

    @property
    def address(self) -> str:
        """Where peers call it: the first listen address."""
        return str(self.config["listen"][0])

    @property
    def sockaddr(self) -> Sockaddr:
        """The same, for a socket."""
        host, _, port = self.address.rpartition(":")
        return host.strip("[]"), int(port)

    def add_endpoint(self, name: str, url: str = "", **settings: object) -> Sockaddr:
        """Add a local endpoint, by default a ``udpin`` on a free port of loopback; host and port of its URL."""
        url = url or f"udpin:127.0.0.1:{free_port()}"
        self.config["endpoint"].append({"name": name, "url": url, **settings})
        host, _, port = url.partition(":")[2].rpartition(":")
        return host.strip("[]"), int(port)

    def add_peer(
        self, peer: DaemonProcess, addresses: Sequence[str], psk: str | None = None, **settings: object
    ) -> None:
        """Add a peer, with a key shared with it where there is one. It may say what ``settings`` do not refuse."""
        section: dict[str, object] = {"name": peer.name, "public_key": peer.public_key, "addresses": list(addresses)}
        if psk is not None:
            section["psk_file"] = f"{peer.name}.psk"
            keys.write_secret_file(self.folder / f"{peer.name}.psk", psk)
        self.config["peer"].append({**section, **_open_policy(settings)})

    def write_config(self) -> Path:
        """Write the configuration file."""
        self.config_file.write_text(to_toml(self.config))
        return self.config_file

    # Its life.

    @property
    def pid(self) -> int:
        """Of the process."""
        assert self._process is not None
        return self._process.pid

    @property
    def is_running(self) -> bool:
        """Whether there is a process."""
        return self._process is not None and self._process.returncode is None

    async def start(self, environ: Mapping[str, str] | None = None, *, on_terminal: bool = False) -> None:
        """Start a process with the configuration as it is now. It is not yet ready then."""
        assert not self.is_running
        self.write_config()
        self.exit_status = None
        master, slave = os.openpty() if on_terminal else (None, asyncio.subprocess.PIPE)
        self._process = await asyncio.create_subprocess_exec(
            *(*self.launcher, sys.executable, *self._program(), "run", "--config", str(self.config_file)),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=slave if on_terminal else asyncio.subprocess.PIPE,
            stderr=slave if on_terminal else asyncio.subprocess.STDOUT,
            env={**os.environ, **self.environ, **(environ or {})},
        )
        if master is not None:
            os.close(slave)
            stream = asyncio.StreamReader()
            await asyncio.get_running_loop().connect_read_pipe(
                lambda: asyncio.StreamReaderProtocol(stream), os.fdopen(master, "rb", 0)
            )
        else:
            assert self._process.stdout is not None
            stream = self._process.stdout
        self._reading = asyncio.create_task(self._read(stream))

    def _program(self) -> tuple[str, str]:
        """The daemon, as it is; every other one as if uvloop were not installed, so that both loops are tested."""
        return ("-c", WITHOUT_UVLOOP) if self.name.endswith(ODD) else ("-m", "uavlinkd")

    async def ready(self) -> Status:
        """Wait until the daemon answers on its control socket."""
        return await self.until(lambda status: True)

    async def send_signal(self, number: signal.Signals) -> None:
        """Send it a signal."""
        assert self._process is not None
        self._process.send_signal(number)

    async def ended(self) -> int:
        """Wait for its end; its exit status, negative for the signal that killed it."""
        assert self._process is not None
        assert self._reading is not None
        self.exit_status = await asyncio.wait_for(self._process.wait(), PATIENCE_S)
        await self._reading
        return self.exit_status

    async def stop(self, number: signal.Signals = signal.SIGTERM) -> int:
        """Send a signal, and wait for the end."""
        await self.send_signal(number)
        return await self.ended()

    async def kill(self) -> None:
        """End it as a power failure would."""
        assert await self.stop(signal.SIGKILL) == -signal.SIGKILL

    async def _read(self, stream: asyncio.StreamReader) -> None:
        with suppress(OSError):  # EIO: how a terminal says that its other end has gone
            async for line in stream:
                self.lines.append(line.decode(errors="backslashreplace").rstrip("\r\n"))
                self._changes.notify()

    # What it says.

    async def status(self) -> Status:
        """Ask it how it is.

        Raises:
            OSError: nobody answers.
        """
        reader, writer = await asyncio.open_unix_connection(self.folder / "control.sock", limit=1 << 24)
        try:
            writer.write(b"status\n")
            line = await asyncio.wait_for(reader.readline(), PATIENCE_S)
        finally:
            writer.close()
            with suppress(OSError):
                await writer.wait_closed()
        self.statuses.append(line.decode())
        status: Status = json.loads(line)
        return status

    async def until(self, condition: Callable[[Status], bool], timeout_s: float = PATIENCE_S) -> Status:
        """Ask it until what it answers fulfils a condition, and return that."""
        latest: Status = {}
        try:
            async with asyncio.timeout(timeout_s):
                while True:
                    with suppress(OSError, ValueError):
                        latest = await self.status()
                        if condition(latest):
                            return latest
                    if not self.is_running:
                        await self.ended()
                        raise AssertionError("\n".join([f"{self.name} ended with {self.exit_status}:", *self.lines]))
                    await asyncio.sleep(POLL_S)
        except TimeoutError:
            raise AssertionError(f"{self.name} did not come to that; it says: {json.dumps(latest)}") from None

    async def until_linked(self, timeout_s: float = PATIENCE_S) -> Status:
        """Wait until every peer is up."""
        return await self.until(
            lambda status: all(peer["state"] == "up" for peer in status["peers"].values()), timeout_s
        )

    def events(self, name: str | None = None, **facts: object) -> list[dict[str, Any]]:
        """Its log: the lines with this event name and these facts."""
        parsed = [json.loads(line) for line in self.lines if line.startswith("{")]
        wanted = {**facts, **({} if name is None else {"event": name})}
        return [each for each in parsed if all(each.get(key) == value for key, value in wanted.items())]

    async def until_logged(self, name: str, *, timeout_s: float = PATIENCE_S, **facts: object) -> dict[str, Any]:
        """Wait for a log line, and return the newest such."""
        await self._changes.until(lambda: bool(self.events(name, **facts)), timeout_s)
        return self.events(name, **facts)[-1]

    @property
    def plain_lines(self) -> list[str]:
        """What it wrote that is no log line."""
        return [line for line in self.lines if not line.startswith("{")]


class Stage:
    """Everything that a test starts, and its end."""

    def __init__(self) -> None:
        self.daemons: list[DaemonProcess] = []
        self.secrets: list[str] = []
        """Keys in base64 that nobody may say."""
        self._programs: list[Program | Relay] = []
        self._folder = tempfile.TemporaryDirectory(prefix="uavlinkd-")

    @property
    def folder(self) -> Path:
        """For files. Its name is short: the path of a Unix socket has to be."""
        return Path(self._folder.name)

    def daemon(self, name: str, listen: Sequence[str] | None = None) -> DaemonProcess:
        """A daemon without peers and endpoints, by default listening on a free port of loopback."""
        daemon = DaemonProcess(
            name, self.folder / name, [f"127.0.0.1:{free_port()}"] if listen is None else list(listen)
        )
        self.secrets.append(daemon.private_key)
        self.daemons.append(daemon)
        return daemon

    def psk(self) -> str:
        """A new pre-shared key."""
        psk = keys.generate_psk()
        self.secrets.append(psk)
        return psk

    def pair(self, **link: object) -> tuple[DaemonProcess, DaemonProcess]:
        """Two daemons, drone0 and drone1, with a PSK, that call each other; ``link`` is the section of both."""
        a, b = self.daemon("drone0"), self.daemon("drone1")
        a.config["link"].update(link)
        b.config["link"].update(link)
        self.introduce(a, b)
        return a, b

    def introduce(self, a: DaemonProcess, b: DaemonProcess, **settings: object) -> None:
        """Make two daemons peers that call each other."""
        psk = self.psk()
        a.add_peer(b, [b.address], psk, **settings)
        b.add_peer(a, [a.address], psk, **settings)

    async def start(self, *daemons: DaemonProcess, linked: bool = True) -> None:
        """Start daemons, and wait until they answer; and until they are linked, where ``linked``."""
        for daemon in daemons:
            await daemon.start()
        for daemon in daemons:
            await (daemon.until_linked() if linked else daemon.ready())

    async def program(self, host: str = "127.0.0.1", port: int = 0) -> Program:
        """A program that speaks MAVLink over UDP."""
        program = await open_program(host, port)
        self._programs.append(program)
        return program

    async def relay(self) -> Relay:
        """A network between two daemons."""
        relay = Relay()
        await relay.open()
        self._programs.append(relay)
        return relay

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            await self._end()
            for daemon in self.daemons if error is None else ():
                self._look_at(daemon)
        finally:
            for program in self._programs:
                program.close()
            await asyncio.sleep(0)  # transports close in the loop's next turn
            self._folder.cleanup()
            for daemon in self.daemons:  # pytest shows this where a test fails
                print(f"--- {daemon.name} said:", *daemon.lines, sep="\n")

    async def _end(self) -> None:
        running = [daemon for daemon in self.daemons if daemon.is_running]
        for daemon in running:
            await daemon.send_signal(signal.SIGTERM)
        for daemon in running:
            try:
                status = await daemon.ended()
            except TimeoutError:
                await daemon.kill()
                raise AssertionError(f"{daemon.name} did not end on SIGTERM") from None
            assert status == 0, f"{daemon.name} ended with {status}"

    def _look_at(self, daemon: DaemonProcess) -> None:
        said = "\n".join([*daemon.lines, *daemon.statuses])
        assert "Traceback" not in said, f"{daemon.name} raised an exception"
        for secret in self.secrets:
            for form in secret_forms(secret):
                assert form not in said, f"{daemon.name} told a secret"
        if daemon.exit_status in (0, -signal.SIGKILL) and daemon.events():
            assert daemon.plain_lines == [], f"{daemon.name} wrote what is no log line"


def secret_forms(secret: str) -> list[str]:
    """How a key could stand in text, whole or its first half."""
    raw = keys.decode_key(secret)
    forms = [secret.rstrip("="), raw.hex(), repr(raw)[2:-1], str(list(raw))[1:-1]]
    forms += [urlsafe_b64encode(raw).decode().rstrip("="), urlsafe_b64encode(raw[:15]).decode()]
    forms += [b64encode(raw[:15]).decode(), raw[:16].hex(), repr(raw[:16])[2:-1], raw.hex(" "), raw.hex(":")]
    return forms + [form.upper() for form in forms if form == form.lower()]


def to_toml(config: Mapping[str, Any]) -> str:
    """A configuration file, of plain values."""
    lines = [f"{key} = {_value(value)}" for key, value in config.items() if not _is_table(value)]
    for key, value in config.items():
        if isinstance(value, dict):
            lines += [f"[{key}]", *(f"{_key(name)} = {_value(each)}" for name, each in value.items())]
        elif _is_table(value):
            for table in value:
                lines += [f"[[{key}]]", *(f"{_key(name)} = {_value(each)}" for name, each in table.items())]
    return "\n".join(lines) + "\n"


def _is_table(value: object) -> bool:
    return isinstance(value, dict) or (isinstance(value, list) and bool(value) and isinstance(value[0], dict))


def _key(name: str) -> str:
    return json.dumps(name)


def _value(value: object) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(name)} = {_value(each)}" for name, each in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    return json.dumps(value)


async def pour(
    frames: Sequence[bytes],
    source: Program,
    into: Sockaddr,
    sink: Program,
    *,
    lost: frozenset[int] = frozenset(),
    per_datagram: int = 1,
    window_bytes: int = 32768,
) -> None:
    """Send frames, and assert that they come out byte for byte and in order, all but those numbered in ``lost``.

    No more than ``window_bytes`` are on their way at a time: loopback has no brakes, only buffers that overflow.
    """
    assert not sink.received
    expected = b"".join(each for number, each in enumerate(frames) if number not in lost)
    due = 0
    for start in range(0, len(frames), per_datagram):
        numbers = range(start, min(start + per_datagram, len(frames)))
        source.send(b"".join(frames[number] for number in numbers), into)
        due += sum(len(frames[number]) for number in numbers if number not in lost)
        if due - len(sink.received) > window_bytes:
            await _until_received(sink, expected, due - window_bytes // 2)
    await _until_received(sink, expected, len(expected))
    assert_same(sink.received, expected)


async def _until_received(sink: Program, expected: bytes, amount: int) -> None:
    try:
        await sink.until(lambda: len(sink.received) >= amount)
    except TimeoutError:
        assert_same(sink.received, expected)


def assert_same(received: bytes | bytearray, expected: bytes) -> None:
    """Assert equality, and tell where the first difference is (not megabytes of it)."""
    if received != expected:
        at = next((n for n, (x, y) in enumerate(zip(received, expected, strict=False)) if x != y), len(received))
        raise AssertionError(
            f"{len(received)} bytes came, {len(expected)} were to come, and they differ from byte {at}:"
            f" {bytes(received[at : at + 20]).hex(' ')} instead of {expected[at : at + 20].hex(' ')}"
        )
