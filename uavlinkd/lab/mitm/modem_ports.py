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
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from random import Random
from time import monotonic
from typing import Final

import structlog

from uavlinkd.lab.mitm.anatomy import DatagramKind
from uavlinkd.lab.mitm.attack import NEVER, AttackError, Direction, Intervention, Operation
from uavlinkd.lab.mitm.journal import Journal
from uavlinkd.lab.mitm.line_attacks import LineAttack, LineAttacker, parse_line_attack
from uavlinkd.lab.mitm.modem import ModemEnd, ModemLink, ModemSettings
from uavlinkd.ops.control import ControlServer

MODEM_REQUESTS: Final = (
    '"statistics", "pull END", "plug END", "hold END [SECONDS]", "release END", "inject END HEX",'
    ' "set key=value ...", "attack none", "attack NAME,key=value ..." or "stop", where END is left or right'
)
MAX_REQUEST_BYTES = 8192
LOG_DETAIL = 1000
_PSEUDO_TERMINALS = "/dev/pts/"
TICK_S = 0.001
"""An event loop may fire a timer up to one clock tick early."""


@dataclass(frozen=True, slots=True)
class PortSettings:
    """The settings of emulated modems on pseudo-terminals."""

    left: Path
    """The symbolic link that is the left host's device. It exists while the modem is plugged in."""
    right: Path
    modem: ModemSettings = field(default_factory=ModemSettings)
    attacks: tuple[LineAttack, ...] = ()
    seed: int = 0
    log: Path | None = None
    control_socket: Path | None = None

    def device(self, end: ModemEnd) -> Path:
        """The symbolic link of an end."""
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
            values[key] = {"true": True, "false": False}[value] if types[key] is bool else types[key](value)
        except (KeyError, ValueError):
            raise ValueError(f"{key} must be {types[key].__name__}, not {value!r}") from None
    return replace(settings, **values)  # type: ignore[arg-type]


class ModemPorts:
    """Two pseudo-terminals joined by a :class:`.ModemLink`. Call :meth:`start` first and :meth:`stop` last."""

    def __init__(self, settings: PortSettings) -> None:
        self.settings = settings
        self.log = structlog.get_logger().bind(daemon="modem")
        self.link = ModemLink(settings.modem, Random(f"modem {settings.seed}"))  # noqa: S311  not a secret
        self.stalled: Counter[ModemEnd] = Counter()
        """Bytes lost because the host of an end did not read."""
        self.stopping = asyncio.Event()
        """Set by the request ``stop`` on the control socket."""
        self._masters: dict[ModemEnd, int] = {}
        self._slaves: dict[ModemEnd, int] = {}
        self._full: set[ModemEnd] = set()  # ends whose kernel accepts no more; not read until it does
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at = NEVER
        self._control: ControlServer | None = None

    async def start(self) -> None:
        """Create the devices and begin to carry bytes.

        Raises:
            OSError: a symbolic link or the log cannot be made.
            ControlError: the control socket cannot be used.
        """
        self._loop = asyncio.get_running_loop()
        self._began_at = now = monotonic()
        rng = Random(f"line {self.settings.seed}")  # noqa: S311  not a secret
        self.journal = Journal(self.settings.log, self.log, now, LOG_DETAIL)
        self.attacker = LineAttacker(self.link, rng, self.journal.add)
        self.attacker.change(self.settings.attacks, now)
        try:
            for end in ModemEnd:
                self._open(end)
            if self.settings.control_socket is not None:
                self._control = ControlServer(self.settings.control_socket, self._answer, MAX_REQUEST_BYTES)
                await self._control.start()
        except BaseException:
            self._close_all()
            self.journal.close()
            raise
        devices = {str(end): str(self.settings.device(end)) for end in ModemEnd}
        self.journal.event(
            "modem_started", now, seed=self.settings.seed, devices=devices, attacks=self.attacker.names
        )
        self._arm()

    async def stop(self) -> None:
        """Remove the devices and close the log."""
        if self._timer is not None:
            self._timer.cancel()
        statistics = self.statistics()
        self._close_all()
        if self._control is not None:
            await self._control.stop()
        self.journal.event("modem_stopped", monotonic(), **statistics)
        self.journal.close()

    # What an operator or a test does.

    def pull(self, end: ModemEnd) -> None:
        """Pull a modem out: its device vanishes, and a daemon that has it open gets an error."""
        if end in self._masters:
            self.link.pull(end, monotonic())
            self._close(end)
            self._event("modem_pulled", end)

    def plug(self, end: ModemEnd) -> None:
        """Put a modem back: there is a new device of the same name.

        Raises:
            OSError: the symbolic link cannot be made.
        """
        if end not in self._masters:
            self._open(end)
            self.link.plug(end, monotonic())
            self._event("modem_plugged", end)

    def hold(self, end: ModemEnd, seconds: float) -> None:
        """Hold back what is for the host of an end."""
        now = monotonic()
        self.link.hold(end, now + seconds, now)
        self._intervened("hold", Operation.HELD, end, 0, f"for {seconds:g} s")

    def release(self, end: ModemEnd) -> None:
        """Release what is held back for the host of an end."""
        self.link.release(end, monotonic())
        self._intervened("hold", Operation.RELEASED, end, 0, "")

    def inject(self, end: ModemEnd, data: bytes) -> None:
        """Put bytes on the line to the host of an end."""
        self.link.inject(end, data, monotonic())
        self._intervened("inject", Operation.INJECTED, end, len(data), "")

    def change_modem(self, settings: ModemSettings) -> None:
        """Change the modems and the air: rates, errors, losses."""
        self._advance()
        self.link.settings = settings
        self.journal.event("modem_changed", monotonic(), settings=_as_plain(settings))
        self._arm()

    def change_attacks(self, attacks: Sequence[LineAttack]) -> None:
        """Replace the attacks."""
        now = monotonic()
        self.attacker.change(attacks, now)
        self.journal.event("attacks_changed", now, attacks=self.attacker.names)
        self._arm()

    def statistics(self) -> dict[str, object]:
        """The counters of this run, as plain data. Bytes by end and fate."""
        now = monotonic()
        return {
            "seconds": round(now - self._began_at, 3),
            "seed": self.settings.seed,
            "attacks": self.attacker.names,
            "interventions": {
                f"{attack}: {operation}": count for (attack, operation), count in self.journal.counts.items()
            },
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
            "settings": _as_plain(self.link.settings),
        }

    # Requests on the control socket.

    def _answer(self, request: str) -> dict[str, object]:
        try:
            return self._request(request.split()) or {"done": request}
        except (AttackError, ValueError) as error:
            return {"refused": str(error)}
        except OSError as error:
            return {"refused": f"cannot make the device: {error.strerror or error}"}

    def _request(self, words: list[str]) -> dict[str, object] | None:
        match words:
            case ["statistics"]:
                return self.statistics()
            case ["stop"]:
                self.stopping.set()
            case ["pull", end]:
                self.pull(_end(end))
            case ["plug", end]:
                self.plug(_end(end))
            case ["hold", end]:
                self.hold(_end(end), NEVER)
            case ["hold", end, seconds]:
                self.hold(_end(end), float(seconds))
            case ["release", end]:
                self.release(_end(end))
            case ["inject", end, digits]:
                self.inject(_end(end), bytes.fromhex(digits))
            case ["set", *pairs] if pairs:
                self.change_modem(parse_modem(",".join(pairs), self.link.settings))
            case ["attack", "none"]:
                self.change_attacks(())
            case ["attack", *texts] if texts:
                self.change_attacks([parse_line_attack(text) for text in texts])
            case _:
                raise ValueError(f"there is no request {' '.join(words)!r}: write {MODEM_REQUESTS}")
        return None

    def _event(self, name: str, end: ModemEnd) -> None:
        self.journal.event(name, monotonic(), end=str(end), device=str(self.settings.device(end)))
        self._arm()

    def _intervened(self, name: str, operation: Operation, end: ModemEnd, size: int, detail: str) -> None:
        direction = Direction(end.other, end)
        self.journal.add(Intervention(monotonic(), name, operation, direction, 0, DatagramKind.OTHER, size, detail))
        self._arm()

    # Devices.

    def _open(self, end: ModemEnd) -> None:
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

    def _close(self, end: ModemEnd) -> None:
        self._full.discard(end)
        self._loop.remove_reader(self._masters[end])
        with suppress(OSError):
            self.settings.device(end).unlink()
        os.close(self._slaves.pop(end))
        os.close(self._masters.pop(end))

    def _close_all(self) -> None:
        for end in list(self._masters):
            self._close(end)

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
        self._arm()

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

    def _arm(self) -> None:
        """Set the timer to the next deadline."""
        now = monotonic()
        deadline = min(self.link.next_deadline(), self.attacker.next_deadline(), self.journal.next_flush())
        if self._full:  # the line carries half of what the kernel holds
            deadline = min(deadline, now + 5 * self.link.settings.host_bytes / self.link.settings.line_baud)
        if deadline < self._timer_at:
            if self._timer is not None:
                self._timer.cancel()
            self._timer_at = deadline
            self._timer = self._loop.call_later(max(0.0, deadline - now) + TICK_S, self._on_timer)

    def _on_timer(self) -> None:
        self._timer_at = NEVER
        self._advance()
        now = monotonic()
        for end in list(self._full):
            if self.link.unwritten(end, now) <= self.link.settings.host_bytes // 2:
                self._full.discard(end)
                self._loop.add_reader(self._masters[end], self._on_readable, end)
        self.journal.flush(now)
        self._arm()


def _end(text: str) -> ModemEnd:
    try:
        return ModemEnd(text)
    except ValueError:
        raise ValueError(f"{text!r} is not an end: write left or right") from None


def _as_plain(settings: ModemSettings) -> dict[str, object]:
    return {one.name: getattr(settings, one.name) for one in fields(settings)}
