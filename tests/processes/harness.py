"""Real daemons as processes on loopback, with MAVLink clients and a relay.

::

    async with Stage() as stage:  # or the fixture `stage`
        a, b, into, ground = await stage.one_way()  # linked daemons, a udpin of a, a UDP socket with a memory at b
        autopilot = await stage.client()
        autopilot.send(frame(1), into)
        await ground.until(lambda: ground.received == frame(1))

When the stage ends, each daemon must have ended cleanly, none may have written a traceback or anything else that is
not a log line, and no output may contain a secret.
"""

from __future__ import annotations

import asyncio
import signal
import tempfile
from base64 import b64encode, urlsafe_b64encode
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from tests.ops.schema import log_names
from tests.processes.process import DaemonProcess
from tests.processes.relay import Relay
from tests.processes.udp import Client, Sockaddr, open_client
from uavlinkd.config import keys
from uavlinkd.lab.sim.loopback_ports import free_port


class Stage:
    """Everything that a test starts, and its end."""

    def __init__(self) -> None:
        self.daemons: list[DaemonProcess] = []
        self.secrets: list[str] = []
        """Keys in base64 that no output may contain."""
        self._clients: list[Client | Relay] = []
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

    async def one_way(self, **link: object) -> tuple[DaemonProcess, DaemonProcess, Sockaddr, Client]:
        """A linked pair, the endpoint "autopilot" of the first one, and the client that the second one sends to."""
        a, b = self.pair(**link)
        into, ground = a.add_endpoint("autopilot"), await self.client()
        b.add_endpoint("ground", f"udpout:{ground}")
        await self.start(a, b)
        return a, b, into, ground

    async def client(self, host: str = "127.0.0.1", port: int = 0) -> Client:
        client = await open_client(host, port)
        self._clients.append(client)
        return client

    async def relay(self) -> Relay:
        """A network between two daemons."""
        relay = Relay()
        await relay.open()
        self._clients.append(relay)
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
            for client in self._clients:
                client.close()
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
        assert daemon.is_planted or "Traceback" not in said, f"{daemon.name} raised an exception"
        for secret in self.secrets:
            for form in secret_forms(secret):
                assert form not in said, f"{daemon.name} printed a secret"
        if daemon.exit_status in (0, -signal.SIGKILL) and daemon.events():
            assert daemon.plain_lines == [], f"{daemon.name} wrote a line that is not a log line"
        assert log_names.check_lines(daemon.events()) == [], "declare these in tests/ops/schema/log.json"
        assert all(next(iter(line)) == "event" for line in daemon.events())


def secret_forms(secret: str) -> list[str]:
    """The forms of a key in text, whole or its first half."""
    raw = keys.decode_key(secret)
    forms = [secret.rstrip("="), raw.hex(), repr(raw)[2:-1], str(list(raw))[1:-1]]
    forms += [urlsafe_b64encode(raw).decode().rstrip("="), urlsafe_b64encode(raw[:15]).decode()]
    forms += [b64encode(raw[:15]).decode(), raw[:16].hex(), repr(raw[:16])[2:-1], raw.hex(" "), raw.hex(":")]
    return forms + [form.upper() for form in forms if form == form.lower()]
