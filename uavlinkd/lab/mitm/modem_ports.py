"""The emulated modems behind two pseudo-terminals, in real time. Daemons use them as serial devices.

A pseudo-terminal has no line rate, so bytes are read no faster than the modeled line carries them. A host that does
not read loses bytes, as on a UART: the emulator never waits for it.
"""

from __future__ import annotations

import asyncio
import os
import pty
import tty
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from random import Random
from time import monotonic
from typing import Final

from uavlinkd.lab.mitm.attack_service import RunSettings, Service
from uavlinkd.lab.mitm.line_attacks import LineAttack, LineAttacker, parse_line_attack
from uavlinkd.lab.mitm.modem import ModemEnd, ModemLink, ModemSettings

MODEM_REQUESTS: Final = (
    '"statistics", "pull END", "plug END", "set key=value ...", "attack none", "attack NAME,key=value ..." or "stop",'
    " where END is left or right"
)
_PSEUDO_TERMINALS = "/dev/pts/"


@dataclass(frozen=True, slots=True)
class PortSettings(RunSettings):
    """The settings of emulated modems on pseudo-terminals."""

    left: Path
    """The symbolic link that is the left host's device. It exists while the modem is plugged in."""
    right: Path
    modem: ModemSettings = field(default_factory=ModemSettings)
    attacks: tuple[LineAttack, ...] = ()

    def device(self, end: ModemEnd) -> Path:
        return self.left if end is ModemEnd.LEFT else self.right


def parse_modem(text: str, settings: ModemSettings) -> ModemSettings:
    """Parse ``key=value,key=value`` with the fields of :class:`.ModemSettings`, and change those.

    Raises:
        ValueError: the text is malformed, or a value is out of range.
    """
    types = {one.name: type(getattr(settings, one.name)) for one in fields(settings)}
    values: dict[str, object] = {}
    for pair in text.split(","):
        key, _, value = (part.strip() for part in pair.partition("="))
        if key not in types:
            raise ValueError(f"there is no setting {key!r} of a modem: choose one of {', '.join(types)}")
        try:
            values[key] = types[key](value)
        except ValueError:
            raise ValueError(f"{key} must be {types[key].__name__}, not {value!r}") from None
    return replace(settings, **values)  # type: ignore[arg-type]


class ModemPorts(Service):
    """Two pseudo-terminals joined by a :class:`.ModemLink`."""

    kind = "modem"

    def __init__(self, settings: PortSettings) -> None:
        super().__init__(settings)
        self.settings = settings
        self.link = ModemLink(settings.modem, Random(f"modem {settings.seed}"))  # noqa: S311  not a secret
        self.stalled: Counter[ModemEnd] = Counter()
        """Bytes lost because the host of an end did not read."""
        self._masters: dict[ModemEnd, int] = {}
        self._slaves: dict[ModemEnd, int] = {}
        self._full: set[ModemEnd] = set()  # ends whose kernel accepts no more; not read until it does

    async def start(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._began_at = now = monotonic()
        await self._open()
        try:
            for end in ModemEnd:
                self._open_device(end)
        except BaseException:
            await self._close()
            self.journal.close()
            raise
        rng = Random(f"line {self.settings.seed}")  # noqa: S311  not a secret
        self.attacker = LineAttacker(self.link, rng, self.journal.add)
        self.attacker.change(self.settings.attacks, now)
        devices = {str(end): str(self.settings.device(end)) for end in ModemEnd}
        self.event("started", seed=self.settings.seed, devices=devices, attacks=self.attacker.names)
        self.arm()

    # What an operator or a test does.

    def pull(self, end: ModemEnd) -> None:
        """Pull a modem out: its device vanishes, and a daemon that has it open gets an error."""
        if end in self._masters:
            self.link.pull(end, monotonic())
            self._close_device(end)
            self._plugged("pulled", end)

    def plug(self, end: ModemEnd) -> None:
        """Put a modem back: there is a new device of the same name.

        Raises:
            OSError: the symbolic link cannot be made.
        """
        if end not in self._masters:
            self._open_device(end)
            self.link.plug(end, monotonic())
            self._plugged("plugged", end)

    def inject(self, end: ModemEnd, data: bytes) -> None:
        """Put bytes on the line to the host of an end, as a modem's own reports."""
        self.link.inject(end, data, monotonic())
        self.arm()

    def change_modem(self, settings: ModemSettings) -> None:
        """Change the modems and the air: rates, errors, losses."""
        self._advance()
        self.link.settings = settings
        self.event("changed", settings=asdict(settings))
        self.arm()

    def change_attacks(self, attacks: Sequence[LineAttack]) -> None:
        now = monotonic()
        self.attacker.change(attacks, now)
        self.journal.event("attacks_changed", now, attacks=self.attacker.names)
        self.arm()

    def statistics(self) -> dict[str, object]:
        now = monotonic()
        return {
            **super().statistics(),
            "attacks": self.attacker.names,
            "modems": {
                str(end): {
                    "device": str(self.settings.device(end)),
                    "is_plugged": self.link.is_plugged(end),
                    "queued_bytes": self.link.queued(end, now),
                    "packets": self.link.packets[end],
                    "bytes": {str(fate): count for fate, count in self.link.bytes[end].items() if count},
                    "not_read_bytes": self.stalled[end],
                }
                for end in ModemEnd
            },
            "settings": asdict(self.link.settings),
        }

    # Requests on the control socket.

    def answer(self, request: str) -> dict[str, object]:
        try:
            return super().answer(request)
        except OSError as error:
            return {"refused": f"cannot make the device: {error.strerror or error}"}

    def request(self, words: list[str]) -> dict[str, object] | None:
        match words:
            case ["statistics"]:
                return self.statistics()
            case ["stop"]:
                self.stopping.set()
            case ["pull", end]:
                self.pull(_end(end))
            case ["plug", end]:
                self.plug(_end(end))
            case ["set", *pairs] if pairs:
                self.change_modem(parse_modem(",".join(pairs), self.link.settings))
            case ["attack", "none"]:
                self.change_attacks(())
            case ["attack", *texts] if texts:
                self.change_attacks([parse_line_attack(text) for text in texts])
            case _:
                raise ValueError(f"there is no request {' '.join(words)!r}: write {MODEM_REQUESTS}")
        return None

    def _plugged(self, name: str, end: ModemEnd) -> None:
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
        await super()._close()

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
        try:
            written = os.write(self._masters[end], data)
        except OSError:  # the host does not read, and its kernel holds no more
            written = 0
        self.stalled[end] += len(data) - written

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


def _end(text: str) -> ModemEnd:
    try:
        return ModemEnd(text)
    except ValueError:
        raise ValueError(f"{text!r} is not an end: write left or right") from None
