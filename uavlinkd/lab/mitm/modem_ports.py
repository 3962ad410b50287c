"""The emulated modems behind two pseudo-terminals, in real time. Daemons use them as serial devices.

A pseudo-terminal has no line rate, so bytes are read no faster than the modeled line carries them. A host that does
not read loses bytes, as on a UART: the emulator never waits for it.
"""

from __future__ import annotations

import asyncio
import os
import pty
import tty
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from time import monotonic

from uavlinkd.lab.mitm.attack_service import Service
from uavlinkd.lab.mitm.line_attacks import LineAttack, LineAttacker
from uavlinkd.lab.mitm.modem import ModemEnd, ModemLink, ModemSettings

_PSEUDO_TERMINALS = "/dev/pts/"


@dataclass(frozen=True, slots=True)
class PortSettings:
    """The settings of emulated modems on pseudo-terminals."""

    left: Path
    """The symbolic link that is the left host's device. It exists while the modem is plugged in."""
    right: Path
    modem: ModemSettings = field(default_factory=ModemSettings)
    seed: int = 0

    def device(self, end: ModemEnd) -> Path:
        return self.left if end is ModemEnd.LEFT else self.right


class ModemPorts(Service):
    """Two pseudo-terminals joined by a :class:`.ModemLink`."""

    kind = "modem"

    def __init__(self, settings: PortSettings) -> None:
        super().__init__(settings.seed)
        self.settings = settings
        self.link = ModemLink(settings.modem, Random(f"modem {settings.seed}"))  # noqa: S311  not a secret
        self._masters: dict[ModemEnd, int] = {}
        self._slaves: dict[ModemEnd, int] = {}
        self._full: set[ModemEnd] = set()  # ends whose kernel accepts no more; not read until it does

    async def start(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._began_at = monotonic()
        try:
            for end in ModemEnd:
                self._open_device(end)
        except BaseException:
            await self._close()
            raise
        rng = Random(f"line {self.seed}")  # noqa: S311  not a secret
        self.attacker = LineAttacker(self.link, rng, self.count)
        devices = {str(end): str(self.settings.device(end)) for end in ModemEnd}
        self.event("started", seed=self.seed, devices=devices)
        self.arm()

    # What a test does.

    def pull(self, end: ModemEnd) -> None:
        """Pull a modem out: its device vanishes, and a daemon that has it open gets an error."""
        if end in self._masters:
            self.link.pull(end, monotonic())
            self._close_device(end)
            self._arm_after("pulled", end)

    def plug(self, end: ModemEnd) -> None:
        """Put a modem back: there is a new device of the same name.

        Raises:
            OSError: the symbolic link cannot be made.
        """
        if end not in self._masters:
            self._open_device(end)
            self.link.plug(end, monotonic())
            self._arm_after("plugged", end)

    def change_attacks(self, attacks: Sequence[LineAttack]) -> None:
        now = monotonic()
        self.attacker.change(attacks, now)
        self.log.info("attacks_changed", attacks=self.attacker.names)
        self.arm()

    def _arm_after(self, name: str, end: ModemEnd) -> None:
        self.event(name, end=str(end), device=str(self.settings.device(end)))
        self.arm()

    # Devices.

    def _open_device(self, end: ModemEnd) -> None:
        device = self.settings.device(end)
        master, slave = pty.openpty()
        try:
            tty.setraw(slave)
            os.set_blocking(master, False)
            if device.is_symlink() and os.readlink(device).startswith(_PSEUDO_TERMINALS):
                device.unlink()  # left by a process that was killed
            device.symlink_to(os.ttyname(slave))
        except BaseException:
            os.close(master)
            os.close(slave)
            raise
        # The emulator keeps the slave open: otherwise the master fails whenever a daemon closes the device.
        self._masters[end], self._slaves[end] = master, slave
        self._loop.add_reader(master, self._on_readable, end)

    def _close_device(self, end: ModemEnd) -> None:
        self._full.discard(end)
        self._loop.remove_reader(self._masters[end])
        with suppress(OSError):
            self.settings.device(end).unlink()
        os.close(self._slaves.pop(end))
        os.close(self._masters.pop(end))

    async def _close(self) -> None:
        for end in list(self._masters):
            self._close_device(end)

    # Bytes.

    def _on_readable(self, end: ModemEnd) -> None:
        now = monotonic()
        master = self._masters[end]
        room = self.link.settings.host_bytes - self.link.unwritten(end, now)
        if room <= 0:  # read again when the line has carried something
            self._full.add(end)
            self._loop.remove_reader(master)
        else:
            with suppress(BlockingIOError):
                self.link.write(end, os.read(master, room), now)
        self.arm()

    def _advance(self) -> None:
        now = monotonic()
        self.attacker.due(now)
        for end, data in self.link.advance(now):
            self.attacker.observe(end, data)
            if end in self._masters:
                self._hand_over(end, data)

    def _hand_over(self, end: ModemEnd, data: bytes) -> None:
        with suppress(OSError):  # the host does not read, and its kernel holds no more
            os.write(self._masters[end], data)

    def next_deadline(self) -> float:
        deadline = min(self.link.next_deadline(), self.attacker.next_deadline())
        if self._full:  # the line carries half of what the kernel holds
            settings = self.link.settings
            deadline = min(deadline, monotonic() + 5 * settings.host_bytes / settings.line_baud)
        return deadline

    def act(self, now: float) -> None:
        self._advance()
        for end in list(self._full):
            if self.link.unwritten(end, now) <= self.link.settings.host_bytes // 2:
                self._full.discard(end)
                self._loop.add_reader(self._masters[end], self._on_readable, end)
