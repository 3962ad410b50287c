"""``uavlinkd signing``: the key with which an autopilot and the daemon beside it sign MAVLink.

The daemon hands the key to the autopilot; this command keeps it in a file. The file is written before, and deleted
only if the daemon says that the autopilot does not have its key. A command that was killed is run again: it uses the
same key.
"""

from __future__ import annotations

import argparse
import json
import os
import tomllib
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from uavlinkd.config import keys
from uavlinkd.config.edit import environ_of, replace_valid, trial
from uavlinkd.config.load import load_config, read_toml
from uavlinkd.config.model import LINK_ID
from uavlinkd.io.url import EndpointKind
from uavlinkd.ops.commands import control_socket
from uavlinkd.ops.control import ControlError, ask
from uavlinkd.system.folders import sync_folder
from uavlinkd.system.terminal import OK, CommandError, UsageError, printable

_TIMEOUT_S: Final = 60.0
"""Limit for the daemon's answer: the autopilot is asked several times."""
_KEY: Final = "signing_key_file"
_ACTIONS: Final = {
    "setup": "give the autopilot a key, so that it takes signed frames only",
    "rotate": "give the autopilot another key",
    "clear": "take the key from the autopilot, so that it takes frames of anyone again",
}
_OPEN: Final = (
    " It takes unsigned frames at this port too, as ArduPilot does on USB: a sender that reaches this port needs no"
    " key."
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "MAVLink message signing between the daemon and the autopilot beside it, which must be on and disarmed. Only"
        " these two have the key: stations and peers speak unsigned, under their roles."
    )
    actions = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, text in _ACTIONS.items():
        action = actions.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        action.set_defaults(command=_run, action=name, socket=None)
        action.add_argument("--config", metavar="FILE", type=Path, required=True, help="the daemon's configuration")
        action.add_argument("--endpoint", metavar="NAME", help="(default: autopilot, or the only endpoint)")
        action.add_argument("--keys", metavar="DIR", type=Path, help="for a service: the folder of its keys")


class _Place:
    """The endpoint of a command: its daemon, its section in the file, and the files of its key."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.path, self.keys = options.config, options.keys
        endpoints = load_config(self.path, environ_of(self.keys)).endpoints
        names = [one.name for one in endpoints if one.url.kind is not EndpointKind.STATION]
        self.endpoint = names[0] if len(names) == 1 and not options.endpoint else options.endpoint or "autopilot"
        if self.endpoint not in names:
            listed = ", ".join(names) or "none"
            raise UsageError(f"{self.path}: which endpoint has the autopilot? Use --endpoint NAME, one of: {listed}")
        self.socket = control_socket(options)
        self._table = read_toml(self.path)
        self._section: dict[str, Any] = next(one for one in self._table["endpoint"] if one["name"] == self.endpoint)
        self.is_written = _KEY in self._section
        self.name: str = self._section.get(_KEY, f"{self.endpoint}.key")
        folder = self.path.absolute().parent if self.keys is None or "/" in self.name else self.keys
        self.file, self.new, self.old = (folder / f"{self.name}{which}" for which in ("", ".new", ".old"))

    def text(self, name: str | None) -> str:
        """The configuration with the line that names a key file, or without it. Raises CommandError."""
        changed = {key: value for key, value in self._section.items() if key != _KEY}
        changed |= {} if name is None else {_KEY: name}
        sections = [changed if one is self._section else one for one in self._table["endpoint"]]
        expected = self._table | {"endpoint": sections}
        lines = self.path.read_text(encoding="utf-8").splitlines(keepends=True)
        line = [] if name is None else [f"{_KEY} = {json.dumps(name)}\n"]
        for at in range(len(lines)):
            text = "".join((*lines[: at + len(line)], *line, *lines[at + 1 :]))
            with suppress(tomllib.TOMLDecodeError):
                if tomllib.loads(text) == expected:
                    return text
        wish = "delete this key" if name is None else "write each [[endpoint]] as a section of its own"
        raise CommandError(f"{self.path}: {_KEY} of {self.endpoint}: no line can be changed, so nothing was: {wish}")

    def ask(self, action: str, key: str = "") -> dict[str, Any]:
        """The daemon's answer: an empty ``problem`` if it is done. Raises ControlError."""
        link_id = self._section.get("signing_link_id", LINK_ID)
        request = {"action": action, "endpoint": self.endpoint, "key": key, "link_id": link_id}
        try:
            return ask(self.socket, f"signing {json.dumps(request)}", _TIMEOUT_S)
        except (ControlError, KeyboardInterrupt) as error:
            reason = str(error) or "the daemon was not stopped, and may go on"
            raise ControlError(f"{reason}. What the autopilot has is not known: run this command again") from None

    def keep_old(self) -> None:
        """Copy the key that is replaced or cleared: whoever deceived the daemon on the cable cost no visit then."""
        if os.path.lexists(self.file):
            self.old.unlink(missing_ok=True)
            keys.write_secret_file(self.old, self.file.read_text())


def _run(options: argparse.Namespace) -> int:
    place = _Place(options)
    ask(place.socket, "status")  # no file is made if no daemon answers
    try:
        print(printable(f"{place.endpoint}: {_clear(place) if options.action == 'clear' else _give(place, options)}"))
    except OSError as error:
        raise CommandError(f"{error.filename}: {error.strerror}: mend that, and run this command again") from None
    return OK


def _give(place: _Place, options: argparse.Namespace) -> str:
    if options.action == "rotate" and not place.is_written:
        raise UsageError(f"{place.path}: {place.endpoint} has no key: run `uavlinkd signing setup`")
    # A key in force is never sent again: an autopilot without it may be somebody else.
    is_made = not os.path.lexists(place.new) and (place.is_written or not os.path.lexists(place.file))
    if is_made:
        keys.write_secret_file(place.new, keys.generate_psk())
    used = place.new if os.path.lexists(place.new) else place.file
    try:
        if not place.is_written:
            with trial(place.path, place.text(used.name), place.keys):
                pass
        key = keys.encode_key(keys.read_secret_file(used).reveal())
    except CommandError:
        if is_made:
            used.unlink()
        raise
    answer = place.ask(options.action, key)
    if problem := answer["problem"]:
        if answer["is_changed"] is not False:
            problem = f"{problem}. The autopilot may have the key in {used}"
        elif is_made:
            used.unlink()
        raise CommandError(f"{place.endpoint}: {problem}")
    if used == place.new:
        place.keep_old()
        used.replace(place.file)
        sync_folder(place.file.parent)
    if not place.is_written:
        replace_valid(place.path, place.text(place.name), place.keys)
    text = f"system {answer['system']} and the daemon sign, with the key in {place.file}. No restart is needed."
    return f"{text}{_OPEN if answer['accepts_unsigned'] else ''}"


def _clear(place: _Place) -> str:
    if not place.is_written and not os.path.lexists(place.file):
        advice = "if `uavlinkd signing setup` was interrupted, run it again"
        raise UsageError(f"{place.path}: {place.endpoint} has no key: {advice}")
    text = place.text(None) if place.is_written else ""
    if problem := place.ask("clear")["problem"]:
        raise CommandError(f"{place.endpoint}: {problem}")
    if place.is_written:
        replace_valid(place.path, text, place.keys)
    place.keep_old()
    place.file.unlink(missing_ok=True)
    sync_folder(place.file.parent)
    return f"the autopilot has no key, and takes frames of anyone who reaches it. {place.old} has the last key."
