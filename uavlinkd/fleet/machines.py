"""A machine that one command enrolls: `uavlinkd enroll` runs there by the operator's own ssh, or on this machine.

ssh decides where the machine is, who logs in and whether its host key is known, from the operator's configuration and
agent. Only public lines pass; the private key stays there. Each failure has the machine's own words.
"""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Final

from uavlinkd.authority.certificates import NAME
from uavlinkd.authority.enrolment import WORD, FleetError, Request, parse_request
from uavlinkd.system.terminal import CommandError

LINK_WAIT_S: Final = 30.0
"""How long a started daemon may take until its first link is up."""
SETTLED_S: Final = 6.0
"""The age from which a daemon's findings name an absent autopilot, which was silent for 5 s then."""
_POLL_S: Final = 1.0
_UNITS: Final = "/opt/uavlinkd/lib/systemd/system"  # where pip puts them; a package's are where systemd looks
_FAILED_SSH: Final = 255  # ssh(1): an error of ssh itself; else the status is that of the command there
_REMEDIES: Final = (
    (r"a password is required|sudo: (command )?not found", "--service needs root@HOST, or sudo without a password"),
    (r"Failed to link unit", "Install uavlinkd there in /opt/uavlinkd, or its package"),
    (r"not found|Unknown command", "Install uavlinkd there, with its link in /usr/local/bin"),
    (r"invalid choice|unrecognized arguments", "Install the version of uavlinkd there that is here"),
)
"""What to do about words of a shell, sudo, systemctl or another version, which name no remedy for this command."""


def name_of(target: str) -> str:
    """The member's name that an ssh target suggests: `v7` of `pi@v7.local`. Raises FleetError if there is none."""
    host = target.rpartition("@")[2]
    name = host.partition(".")[0].lower()
    if not NAME.fullmatch(name) or re.fullmatch(r"[\d.]+", host):
        raise FleetError(f"{target} does not name its member: add --name NAME")
    return name


@dataclass(frozen=True)
class Machine:
    """A machine that becomes a member of a fleet."""

    name: str
    target: str | None
    """The destination of ssh. None: this machine."""
    unit: str = ""
    """Its service, which has the files below /etc/uavlinkd. Empty: they are in the folder where commands run."""

    @property
    def _config(self) -> str:
        return f"{self._of_service}.toml" if self.unit else f"{self.name}.toml"

    @property
    def _of_service(self) -> str:
        """The folder of the service's keys: `relay` of `uavlinkd-relay`, `v7` of `uavlinkd@v7`."""
        return f"/etc/uavlinkd/{self.unit.removeprefix('uavlinkd')[1:]}"

    @property
    def _files(self) -> tuple[str, ...]:
        return ("--config", self._config, *(("--keys", self._of_service) if self.unit else ()))

    def request(self) -> Request:
        """What the machine asks to be signed; it makes its private key if it has none for this."""
        said = self._run(*self._uavlinkd, "enroll", self.name, *self._files)
        lines = [line for line in said.splitlines() if line.startswith(WORD)]  # a shell may print a greeting
        request = parse_request(lines[-1] if lines else "")
        if request.name != self.name:  # a captured machine could ask for the role of another
            raise FleetError(f"its line is of {request.name}, not of {self.name}: nothing was signed")
        return request

    def finish(self, line: str, url: str | None) -> str:
        """Give the machine its signed line, and return what it says about that."""
        url_words = () if url is None else ("--url", url)
        return self._run(*self._uavlinkd, "enroll", "--finish", *self._files, *url_words, line=line)

    def start_service(self) -> None:
        """Start the service, now and at each boot; a daemon that runs starts again, with its new files."""
        if not self._run("systemctl", "cat", self.unit, accepted=(0, 1)):
            template = "".join(self.unit.partition("@")[:2])
            self._run("systemctl", "link", f"{_UNITS}/{template}.service")
        self._run("systemctl", "enable", self.unit)
        try:
            self._run("systemctl", "restart", self.unit)
        except CommandError as error:
            last = ("journalctl", f"_SYSTEMD_UNIT={self.unit}.service", "--lines=1", "--output=cat")
            raise CommandError(
                f"{error}\nIts log ends with: {self._run(*last, accepted=range(256)).strip()}"
            ) from None

    def wait_for_link(self) -> tuple[list[str], list[str]]:
        """The names of the peers whose links are up, once there are any, else of the relays; and endpoints' problems.

        Raises CommandError with the status there if nothing is up.
        """
        status, give_up_at = (*self._uavlinkd, "status", "--config", self._config), time.monotonic() + LINK_WAIT_S
        while True:
            up: dict[str, list[str]] = {"peers": [], "relays": []}
            age_s, problems = 0.0, list[str]()
            with suppress(ValueError, LookupError, TypeError, AttributeError):  # the daemon does not answer yet
                facts = json.loads(self._run(*status, "--json", accepted=(0, 1)))
                up = {kind: [name for name, one in facts[kind].items() if one["state"] == "up"] for kind in up}
                found = [one for one in facts["findings"] if one["subject"] == "endpoint"]
                problems = [f"{one['name']}: {one['text']}: {one['remedy']}" for one in found]
                age_s = float(facts["process"]["uptime_s"])
            if (up["peers"] and age_s >= SETTLED_S) or time.monotonic() >= give_up_at:
                break
            time.sleep(_POLL_S)
        if names := up["peers"] or up["relays"]:
            return names, problems
        said = self._run(*status, accepted=(0, 1))
        raise CommandError(f"it is enrolled and its service runs, without a link for {LINK_WAIT_S:.0f} s:\n{said}")

    def _run(self, *words: str, line: str = "", accepted: Collection[int] = (0,)) -> str:
        """Run a command there, and return what it printed. Raises CommandError with its own words if it fails."""
        return self._call(*(self._sudo if self.unit else ()), *words, line=line, accepted=accepted)

    def _call(self, *words: str, line: str = "", accepted: Collection[int] = (0,)) -> str:
        """Run a command there as the user that logs in."""
        if self.target is not None:
            if shutil.which("ssh") is None:
                raise CommandError("ssh is not installed here: install it, or carry each line by hand")
            command: tuple[str, ...] = ("ssh", "--", self.target, shlex.join(words))
        else:
            command = words
        try:
            done = subprocess.run(  # noqa: S603  the operator's own command
                command, input=line, capture_output=True, encoding="utf-8", errors="replace", check=False
            )
        except OSError as error:
            raise CommandError(f"{command[0]}: {error.strerror}") from None
        if done.returncode in accepted:
            return done.stdout
        said = done.stderr.strip() or done.stdout.strip() or f"exit status {done.returncode}"
        if self.target is not None and done.returncode == _FAILED_SSH:
            raise CommandError(f"{said}\nFirst make `ssh {self.target}` work, then run this command again")
        remedies = [f"\n{remedy}" for pattern, remedy in _REMEDIES if re.search(pattern, said)]
        raise CommandError(f"`{shlex.join(words)}` failed there:\n{said}{''.join(remedies[:1])}")

    @property
    def _uavlinkd(self) -> tuple[str, ...]:
        """The program: on this machine it may not be in the PATH."""
        return (sys.executable, "-m", "uavlinkd") if self.target is None else ("uavlinkd",)

    @cached_property
    def _sudo(self) -> tuple[str, ...]:
        """Root's rights, which a service's files need. Through ssh, sudo has no terminal to ask on."""
        if self._call("id", "-u").split()[-1:] == ["0"]:  # the configuration of ssh may name the user
            return ()
        return ("sudo",) if self.target is None else ("sudo", "-n")
