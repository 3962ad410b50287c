"""``uavlinkd signing``: the key with which an autopilot and the daemon beside it sign MAVLink.

The daemon hands the key to the autopilot; this command keeps it in a file. The file is written before, and deleted
only if the daemon says that the autopilot does not have its key. A command that was killed is run again: it uses the
same key.
"""

from __future__ import annotations

import argparse
import json
import os
import re
from pathlib import Path
from typing import Any, Final

from uavlinkd.config import keys
from uavlinkd.config.edit import environ_of, replace_valid, trial
from uavlinkd.config.load import load_config, read_toml
from uavlinkd.config.model import LINK_ID, Config
from uavlinkd.io.url import EndpointKind
from uavlinkd.ops.commands import control_socket
from uavlinkd.ops.control import ControlError, ask
from uavlinkd.system.folders import sync_folder
from uavlinkd.system.terminal import OK, CommandError, UsageError, printable

_TIMEOUT_S: Final = 60.0
"""Limit for the daemon's answer: the autopilot is asked several times."""
_KEY: Final = "signing_key_file"
_LINE: Final = re.compile(rf"^[ \t]*{_KEY}[ \t]*=.*\n", re.MULTILINE)
_SECTION: Final = re.compile(r"[ \t]*\[\[[ \t]*endpoint[ \t]*\]\]")
_ACTIONS: Final = {
    "setup": "give the autopilot a key, so that it takes signed frames only",
    "rotate": "give the autopilot another key",
    "clear": "take the key from the autopilot, so that it takes frames of anyone again",
}
_ANOTHER_FORM: Final = "the daemon's answer has another form than this version expects: restart the daemon"
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
    """The endpoint of a command: its daemon, its section in the file, its key's file and the file of a new key."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.path, self._keys = options.config, options.keys
        config = load_config(self.path, environ_of(self._keys))
        self.endpoint = _endpoint(config, options.endpoint)
        self.socket = control_socket(options)
        self._table = read_toml(self.path)
        self._section: dict[str, Any] = next(one for one in self._table["endpoint"] if one["name"] == self.endpoint)
        self.is_written = _KEY in self._section
        self.name: str = self._section.get(_KEY, f"{self.endpoint}.key")
        folder = self.path.absolute().parent
        if self._keys is not None and "/" not in self.name:
            folder = self._keys
        self.file, self.new = folder / self.name, folder / f"{self.name}{keys.NEW_KEY}"

    def check(self, name: str | None) -> None:
        """Raises CommandError if the file would not be valid with the line of a key file, or without it."""
        written = {key: value for key, value in self._section.items() if key != _KEY}
        expected = written | ({} if name is None else {_KEY: name})
        sections = [expected if one is self._section else one for one in self._table["endpoint"]]
        with trial(self.path, self._text(name), self._keys) as (new, _):
            if read_toml(new) != self._table | {"endpoint": sections}:
                wish = f", or delete {_KEY} there yourself" if name is None else ""
                raise CommandError(
                    f"{self.path}: cannot be changed by this command, so nothing was changed: write each [[endpoint]]"
                    f" as a section with its name on a line of its own{wish}"
                )

    def write(self, name: str | None) -> None:
        replace_valid(self.path, self._text(name), self._keys)

    def _text(self, name: str | None) -> str:
        """The configuration with the line that names a key file, or without it."""
        blocks = re.split(
            r"^(?=[ \t]*\[)", self.path.read_text(encoding="utf-8").rstrip("\n") + "\n", flags=re.MULTILINE
        )
        here = re.compile(rf"""^([ \t]*)name[ \t]*=[ \t]*["']{re.escape(self.endpoint)}["'].*\n""", re.MULTILINE)
        for number, block in enumerate(blocks):
            if _SECTION.match(block) and (match := here.search(block)):
                line = "" if name is None else f"{match[1]}{_KEY} = {json.dumps(name)}\n"
                blocks[number] = _LINE.sub("", block[: match.end()]) + line + _LINE.sub("", block[match.end() :])
        return "".join(blocks)

    def ask(self, action: str, key: str = "") -> dict[str, Any]:
        """The daemon's answer: an empty ``problem`` if it is done. Raises ControlError."""
        link_id = self._section.get("signing_link_id", LINK_ID)
        request = {"action": action, "endpoint": self.endpoint, "key": key, "link_id": link_id}
        try:
            answer = ask(self.socket, f"signing {json.dumps(request)}", _TIMEOUT_S)
        except ControlError as error:
            raise ControlError(f"{error}. What the autopilot has is not known: run this command again") from None
        return {"problem": _ANOTHER_FORM, "is_changed": None} | answer


def _endpoint(config: Config, name: str | None) -> str:
    names = [one.name for one in config.endpoints if one.url.kind is not EndpointKind.STATION]
    if name is None:
        name = names[0] if len(names) == 1 else "autopilot"
    if name not in names:
        listed = ", ".join(names) or "none"
        raise UsageError(f"{config.path}: which endpoint has the autopilot? Write --endpoint NAME, one of: {listed}")
    return name


def _run(options: argparse.Namespace) -> int:
    place = _Place(options)
    try:
        if options.action == "clear":
            _clear(place)
        else:
            _give(place, is_rotation=options.action == "rotate")
    except OSError as error:
        raise CommandError(f"{error.filename}: {error.strerror}: mend that, and run this command again") from None
    return OK


def _give(place: _Place, *, is_rotation: bool) -> None:
    ask(place.socket, "status")  # no file is made if no daemon answers
    if is_rotation and not place.is_written:
        raise UsageError(f"{place.path}: {place.endpoint} has no key: run `uavlinkd signing setup`")
    # A key in force is never sent again: an autopilot without it may be somebody else.
    is_made = not os.path.lexists(place.new) and (place.is_written or not os.path.lexists(place.file))
    if is_made:
        keys.write_secret_file(place.new, keys.generate_psk())
    used = place.new if os.path.lexists(place.new) else place.file
    try:
        if not place.is_written:
            place.check(used.name)
        key = keys.encode_key(keys.read_secret_file(used).reveal())
    except CommandError:
        if is_made:
            used.unlink()
        raise
    answer = place.ask("rotate" if is_rotation else "setup", key)
    if problem := answer["problem"]:
        if answer["is_changed"] is not False:
            problem = f"{problem}. The autopilot may have the key in {used}"
        elif is_made:
            used.unlink()
        raise CommandError(f"{place.endpoint}: {problem}")
    if used == place.new:
        used.replace(place.file)
        sync_folder(place.file.parent)
    if not place.is_written:
        place.write(place.name)
    text = f"{place.endpoint}: system {answer.get('system')} and the daemon sign, with the key in {place.file}."
    print(printable(f"{text} No restart is needed.{_OPEN if answer.get('accepts_unsigned') else ''}"))


def _clear(place: _Place) -> None:
    files = [file for file in (place.file, place.new) if os.path.lexists(file)]
    if not (place.is_written or files):
        raise UsageError(f"{place.path}: {place.endpoint} has no key")
    place.check(None)
    status = ask(place.socket, "status").get("endpoints", {}).get(place.endpoint, {})
    signs = status.get("signing") is not None
    if signs and (problem := place.ask("clear")["problem"]):
        raise CommandError(f"{place.endpoint}: {problem}")
    if place.is_written:
        place.write(None)
    if not signs:
        listed = " and ".join(map(str, files))
        raise CommandError(
            f"{place.endpoint}: the daemon does not sign there, and no line names a key any more: delete {listed} if"
            " the autopilot has no key; if it has, `uavlinkd signing setup` uses that key again"
        )
    for file in files:
        file.unlink()
    sync_folder(place.file.parent)
    print(printable(f"{place.endpoint}: the autopilot has no key, and takes frames of anyone who reaches it."))
