"""`fleet enroll`, with folders in place of hosts: what it runs there, what it says, and what a second run does."""

from __future__ import annotations

import io
import json
import os
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import pytest

from tests.fleet.conftest import Say
from tests.fleet.folders import create
from uavlinkd.authority.certificates import MemberRole
from uavlinkd.authority.enrolment import FleetError, fingerprint_of
from uavlinkd.cli import main
from uavlinkd.config.load import load_config
from uavlinkd.fleet import authority_key, machines
from uavlinkd.fleet.authority_key import Passphrase
from uavlinkd.fleet.manifest import FleetFileError, read_manifest
from uavlinkd.protocol.crypto import Secret
from uavlinkd.system.addresses import Address

Answer = tuple[int, str, str]
"""The exit status, the standard output and the standard error of a command."""


class Hosts:
    """Takes the place of :func:`subprocess.run`: commands of ssh run in this process, in a folder for each host."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.commands: list[tuple[str, str]] = []
        """Each host with a command that it was given."""
        self.answers: dict[str, Answer] = {}
        """What hosts answer in place of their own: by host, or by the first word of a command."""
        self.before: Callable[[int], None] = lambda number: None
        self.after: Callable[[int], None] = lambda number: None

    def home(self, host: str) -> Path:
        return self.folder / host

    def run(self, command: list[str], *, input: str, **_: object) -> subprocess.CompletedProcess[str]:
        """Run the command of ssh, or of this machine."""
        if command[0] == "ssh":
            ssh, end, target, text = command
            assert (ssh, end) == ("ssh", "--")
            host, words = target.rpartition("@")[2], shlex.split(text)
            self.commands.append((target, text))
        else:
            host, words = "laptop", ["uavlinkd", *command[3:]]
        self.before(len(self.commands))
        status, out, error = self._answer(host, [word for word in words if word not in ("sudo", "-n")], input)
        self.after(len(self.commands))
        return subprocess.CompletedProcess(command, status, out, error)

    def _answer(self, host: str, words: list[str], line: str) -> Answer:
        for subject in (host, " ".join(words[:2])):
            if subject in self.answers:
                return self.answers[subject]
        assert words[0] == "uavlinkd"
        home = self.home(host)
        out, error, here, stdin = io.StringIO(), io.StringIO(), Path.cwd(), sys.stdin
        os.chdir(home)
        sys.stdin = io.StringIO(line)
        try:
            with redirect_stdout(out), redirect_stderr(error):
                status = main([word.replace("/etc/", f"{home}/etc/") for word in words[1:]])
        finally:
            os.chdir(here)
            sys.stdin = stdin
        return status, out.getvalue(), error.getvalue()


@pytest.fixture
def hosts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Hosts:
    """The laptop, whose folder with a fleet is the working folder, and two vehicles."""
    hosts = Hosts(tmp_path)
    for host in ("laptop", "v7", "v8"):
        hosts.home(host).mkdir()
    monkeypatch.chdir(hosts.home("laptop"))
    monkeypatch.setattr(subprocess, "run", hosts.run)
    monkeypatch.setattr(shutil, "which", lambda program: f"/usr/bin/{program}")
    create(Path("fleet"), relays=(Address("relay.example.org", 5790),))
    return hosts


def certified(hosts: Hosts, name: str) -> bool:
    """Whether the fleet's folder and a vehicle have the same key and certificate."""
    config, member = load_config(hosts.home(name) / f"{name}.toml", {}), read_manifest(Path("fleet")).member(name)
    assert config.fleet is not None
    return config.public_key == member.public_key and config.fleet.own.certificate == member.certificate


def test_each_machine_is_enrolled_by_two_commands(hosts: Hosts, say: Say) -> None:
    """Its own words are shown; system ids follow each other; what passes is public."""
    said = say("fleet enroll pi@v7 pi@v8 --id 7 --url serial:/dev/ttyACM0:57600")
    assert hosts.commands == [
        ("pi@v7", "uavlinkd enroll v7 --config v7.toml"),
        ("pi@v7", "uavlinkd enroll --finish --config v7.toml --url serial:/dev/ttyACM0:57600"),
        ("pi@v8", "uavlinkd enroll v8 --config v8.toml"),
        ("pi@v8", "uavlinkd enroll --finish --config v8.toml --url serial:/dev/ttyACM0:57600"),
    ]
    assert certified(hosts, "v7")
    assert certified(hosts, "v8")
    fleet = read_manifest(Path("fleet"))
    assert [fleet.member(name).ids for name in ("v7", "v8")] == ["7", "8"]
    assert f"pi@v8: v8 is a member of fleet {fingerprint_of(fleet.authority.public)}" in said
    assert "compare" not in said  # this command does


def test_second_run_keeps_the_key_and_says_so(hosts: Hosts, say: Say) -> None:
    """The machine gets its present line, by one command; another identity needs --replace."""
    say("fleet enroll pi@v7 --id 7")
    before = read_manifest(Path("fleet"))
    hosts.commands.clear()
    url = "udpin:127.0.0.1:14999"
    say(f"fleet enroll pi@v7 --url {url}")
    endpoints = tomllib.loads((hosts.home("v7") / "v7.toml").read_text())["endpoint"]
    assert [(one["url"], one["system_ids"]) for one in endpoints] == [(url, [7])]
    hosts.commands.clear()
    assert "v7 is a member already: it keeps its key" in say("fleet enroll pi@v7 --id 7")
    assert hosts.commands == [("pi@v7", "uavlinkd enroll --finish --config v7.toml")]
    assert read_manifest(Path("fleet")) == before
    assert "v7 is vehicle, system id 7: --replace changes that" in say("fleet enroll pi@v7 --id 8")
    assert "The former key, v7.key, was deleted." in say("fleet enroll pi@v7 --id 8 --replace")
    assert certified(hosts, "v7")
    assert read_manifest(Path("fleet")).bulletin.revoked == (2,)


def test_new_card_needs_replace(hosts: Hosts, say: Say) -> None:
    """A machine without its key gets no certificate by accident: the error says how it gets one."""
    say("fleet enroll v7")
    for path in hosts.home("v7").iterdir():
        path.unlink()
    error = say("fleet enroll v7")
    assert "there is no v7.key" in error
    assert "for another machine, card or folder, add --replace" in error
    say("fleet enroll v7 --replace")
    assert certified(hosts, "v7")


def test_this_machine_is_enrolled_without_ssh(hosts: Hosts, say: Say) -> None:
    """The station, by the same command; it is an operator unless a role is named."""
    say("fleet enroll gs --here --address 10.13.0.254:5790")
    assert hosts.commands == []
    assert read_manifest(Path("fleet")).member("gs").role is MemberRole.OPERATOR
    config = load_config(Path("gs.toml"), {})
    assert (config.name, list(map(str, config.listen))) == ("gs", ["0.0.0.0:5790"])


def test_one_passphrase_is_asked_for_all(hosts: Hosts, say: Say, monkeypatch: pytest.MonkeyPatch) -> None:
    """And none if all are members already. A wrong one ends the command, and nothing is signed."""
    asked: list[str] = []
    refusal: list[FleetFileError] = [FleetFileError("the passphrase is wrong")]
    load_key = authority_key.load_key

    def ask(what: str) -> Secret:
        asked.append(what)
        return Secret(b"correct horse battery staple")

    def load(file: Path, ask: Passphrase) -> Secret:
        ask(str(file))
        for error in refusal:
            raise error
        return load_key(file, ask)

    monkeypatch.setattr("uavlinkd.fleet.actions.passphrase_from", lambda _: ask)
    monkeypatch.setattr(authority_key, "load_key", load)
    assert say("fleet enroll v7 v8").count("the passphrase is wrong") == 1
    assert len(read_manifest(Path("fleet")).members) == 1
    assert hosts.commands == []
    refusal.clear()
    for _ in range(2):
        say("fleet enroll v7 v8")
    assert asked == ["fleet/authority.pem"] * 2


@pytest.mark.parametrize(
    ("answer", "remedy"),
    [
        ((255, "", "ssh: connect to host v7 port 22: No route to host"), "First make `ssh pi@v7` work"),
        ((255, "", "pi@v7: Permission denied (publickey)."), "First make `ssh pi@v7` work"),
        ((127, "", "bash: line 1: uavlinkd: command not found"), "Install uavlinkd there"),
        ((2, "", "uavlinkd: error: there is no 'enroll': invalid choice"), "Install the version of uavlinkd"),
        ((0, "", ""), "not a whole line of `uavlinkd enroll NAME`"),
        ((1, "", "sudo: a password is required"), "--service needs root@HOST"),
    ],
)
def test_failure_is_named_by_the_hosts_own_words(hosts: Hosts, say: Say, answer: Answer, remedy: str) -> None:
    """With what to do. The other machine is enrolled; a second run enrolls the one that is left."""
    hosts.answers["v7"] = answer
    error = say("fleet enroll pi@v7 pi@v8")
    assert error.startswith("refused: ")
    assert answer[2] in error
    assert remedy in error
    assert certified(hosts, "v8")
    assert [member.name for member in read_manifest(Path("fleet")).members] == ["relay", "v8"]
    hosts.answers.clear()
    say("fleet enroll pi@v7 pi@v8")
    assert certified(hosts, "v7")


@pytest.mark.parametrize("number", [1, 2])
@pytest.mark.parametrize("moment", ["before", "after"])
@pytest.mark.parametrize("how", ["", "--replace"])
def test_interrupted_command_can_run_again(hosts: Hosts, say: Say, moment: str, number: int, how: str) -> None:
    """Before or after each command there: the second run repairs what was left, without a second certificate."""
    if how:
        say("fleet enroll v7")
        hosts.commands.clear()

    def interrupt(commands: int) -> None:
        if commands == number:
            raise KeyboardInterrupt

    setattr(hosts, moment, interrupt)
    assert say(f"fleet enroll v7 {how}").startswith("refused: ")
    setattr(hosts, moment, lambda _: None)
    was_signed = len(read_manifest(Path("fleet")).members) > 1 + bool(how)
    assert was_signed is (number == 2)
    say(f"fleet enroll v7 {'' if was_signed else how}")
    assert certified(hosts, "v7")
    assert len(read_manifest(Path("fleet")).members) == 2 + bool(how)
    assert [path.name for path in hosts.home("v7").iterdir() if path.suffix == ".key"] == [
        "v7.2.key" if how else "v7.key"
    ]


def test_machine_makes_no_key_that_the_fleet_would_not_sign(hosts: Hosts, say: Say) -> None:
    """The refusal comes before the first command there."""
    say("fleet enroll v7 --id 7")
    hosts.commands.clear()
    assert "would have the system id of v7, 7" in say("fleet enroll v8 --id 7")
    assert "a relay needs --address HOST:PORT" in say("fleet enroll v8 --role relay")
    assert hosts.commands == []


def test_machine_gets_its_own_name_only(hosts: Hosts, say: Say) -> None:
    """A captured machine could ask for the name, and so for the role, of another one."""
    say("fleet enroll v7")
    line = say("enroll gs")
    hosts.answers["uavlinkd enroll"] = (0, f"Welcome!\n{line}", "")
    assert "its line is of gs, not of v8: nothing was signed" in say("fleet enroll v8")
    assert "--name is of one machine" in say("fleet enroll v8 v9 --name v8")


def test_service_is_started_and_its_link_awaited(hosts: Hosts, say: Say, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files are where the unit has them, the unit is linked if there is none, and root restarts the daemon."""
    status: dict[str, Any] = {
        "peers": {"gs": {"state": "up"}, "v8": {"state": "waiting"}},
        "relays": {"relay": {"state": "up"}},
        "findings": [],
        "process": {"uptime_s": 7.0},
    }
    hosts.answers |= {f"systemctl {verb}": (0, "", "") for verb in ("cat", "link", "enable", "restart")}
    hosts.answers["uavlinkd status"] = (1, json.dumps(status), "")
    hosts.answers["id -u"] = (0, "1000\n", "")
    assert "v7 has a link with gs\n" in say("fleet enroll pi@v7 --service")
    assert (hosts.home("v7") / "etc/uavlinkd/v7/v7.key").exists()
    assert (hosts.home("v7") / "etc/uavlinkd/v7.toml").exists()
    files = "--config /etc/uavlinkd/v7.toml --keys /etc/uavlinkd/v7"
    assert [command for _, command in hosts.commands] == [
        "id -u",
        f"sudo -n uavlinkd enroll v7 {files}",
        f"sudo -n uavlinkd enroll --finish {files}",
        "sudo -n systemctl cat uavlinkd@v7",
        "sudo -n systemctl link /opt/uavlinkd/lib/systemd/system/uavlinkd@.service",
        "sudo -n systemctl enable uavlinkd@v7",
        "sudo -n systemctl restart uavlinkd@v7",
        "sudo -n uavlinkd status --config /etc/uavlinkd/v7.toml --json",
    ]
    hosts.answers["systemctl cat"] = (0, "[Unit]", "")
    monkeypatch.setattr(machines, "LINK_WAIT_S", 0.0)
    status["peers"]["gs"]["state"] = "waiting"
    hosts.answers["uavlinkd status"] = (1, json.dumps(status), "")
    assert "v7 has a link with relay\n" in say("fleet enroll pi@v7 --service")
    no_device = {"subject": "endpoint", "name": "autopilot", "text": "it cannot be opened", "remedy": "plug it in"}
    status["findings"] = [{"subject": "peer", "name": "gs", "text": "slow", "remedy": "wait"}, no_device]
    hosts.answers["uavlinkd status"] = (1, json.dumps(status), "")
    assert say("fleet enroll pi@v7 --service").endswith("pi@v7: autopilot: it cannot be opened: plug it in\n")
    hosts.answers["uavlinkd status"] = (1, "0 of 1 peers up", "")
    hosts.commands.clear()
    assert "without a link for 0 s:\n0 of 1 peers up" in say("fleet enroll pi@v7 --service")
    assert not [command for _, command in hosts.commands if "systemctl link" in command]
    hosts.answers["systemctl restart"] = (1, "", "Job for uavlinkd@v7.service failed. See journalctl.")
    hosts.answers["journalctl _SYSTEMD_UNIT=uavlinkd@v7.service"] = (0, "v7.toml: link.suites: is empty\n", "")
    said = say("fleet enroll pi@v7 --service")
    assert said.endswith("failed. See journalctl.\nIts log ends with: v7.toml: link.suites: is empty\n")
    hosts.answers["systemctl cat"] = (1, "", "No files found for uavlinkd@v7.service.")
    hosts.answers["systemctl link"] = (1, "", "Failed to link unit: No such file")
    assert "Install uavlinkd there in /opt/uavlinkd, or its package" in say("fleet enroll pi@v7 --service")


def test_relay_has_a_unit_of_its_own(hosts: Hosts, say: Say) -> None:
    """Its files have the names that the unit has; root needs no sudo, also if ssh's configuration names it."""
    hosts.home("relay.example.net").mkdir()
    hosts.answers["id -u"] = (0, "Welcome!\n0\n", "")
    hosts.answers |= {f"systemctl {verb}": (0, "", "") for verb in ("cat", "link", "enable", "restart")}
    say("fleet enroll relay.example.net --name relay2 --role relay --address relay.example.net:5790 --service")
    files = "--config /etc/uavlinkd/relay.toml --keys /etc/uavlinkd/relay"
    assert [command for _, command in hosts.commands] == [
        "id -u",
        f"uavlinkd enroll relay2 {files}",
        f"uavlinkd enroll --finish {files}",
        "systemctl cat uavlinkd-relay",
        "systemctl link /opt/uavlinkd/lib/systemd/system/uavlinkd-relay.service",
        "systemctl enable uavlinkd-relay",
        "systemctl restart uavlinkd-relay",
    ]
    table = tomllib.loads((hosts.home("relay.example.net") / "etc/uavlinkd/relay.toml").read_text())
    assert table["control_socket"] == "/run/uavlinkd/relay/control.sock"


@pytest.mark.parametrize(
    ("target", "name"), [("v7", "v7"), ("pi@v7", "v7"), ("pi@V7.local", "v7"), ("a@b@drone-1.example.org", "drone-1")]
)
def test_name_is_the_hosts(target: str, name: str) -> None:
    """Up to the first dot."""
    assert machines.name_of(target) == name


@pytest.mark.parametrize("target", ["10.13.0.7", "pi@192.0.2.7", "ssh://pi@v7:2222", "pi@2001:db8::7", "v_7", "pi@"])
def test_address_names_no_member(target: str) -> None:
    """Then the operator does."""
    with pytest.raises(FleetError, match="add --name NAME"):
        machines.name_of(target)


def test_ssh_is_the_one_in_the_path(tmp_path: Path, say: Say, monkeypatch: pytest.MonkeyPatch) -> None:
    """A program of this name gets the host and one command, and its standard error is shown."""
    monkeypatch.chdir(tmp_path)
    create(Path("fleet"), relays=(Address("relay.example.org", 5790),))
    program = tmp_path / "ssh"
    program.write_text('#!/bin/sh\nprintf "%s|" "$@" >&2; exit 255\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    assert "pi@v7: --|pi@v7|uavlinkd enroll v7 --config v7.toml|\n" in say("fleet enroll pi@v7 --id 7")
    monkeypatch.setenv("PATH", str(tmp_path / "nothing"))
    assert "ssh is not installed here" in say("fleet enroll pi@v8")
