"""Hosts that ssh reaches on loopback: each is a real sshd of its own, with a folder in which its commands run."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import TracebackType
from typing import Self

from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.sim.loopback_ports import free_port

SSHD = shutil.which("sshd", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/usr/local/sbin")
_FOR_PRIVILEGES = Path("/run/sshd")  # what Debian's unit makes for a server that root starts

_SERVER = """\
ListenAddress 127.0.0.1:{port}
HostKey {folder}/host_key
AuthorizedKeysFile {folder}/authorized_keys
PidFile none
UsePAM no
StrictModes no
PasswordAuthentication no
SetEnv PATH={commands}:/usr/bin:/bin
ForceCommand cd {folder}/home && exec sh -c "$SSH_ORIGINAL_COMMAND"
"""
_HOST = """\
Host {name}
    HostName 127.0.0.1
    Port {port}
    HostKeyAlias {name}
"""
_CLIENT = """\
Host *
    IdentityFile {folder}/user_key
    IdentitiesOnly yes
    UserKnownHostsFile {folder}/known_hosts
    StrictHostKeyChecking yes
    BatchMode yes
"""


class SshHosts:
    """Servers by name, and a folder ``client`` for the PATH: its `ssh` uses the configuration of this test's user."""

    def __init__(self, folder: Path, *names: str) -> None:
        self.folder = folder
        self.names = names
        self.client = folder / "client"
        self._servers: list[subprocess.Popen[bytes]] = []

    def home(self, name: str) -> Path:
        """The folder in which a host's commands run."""
        return self.folder / name / "home"

    def commands(self, name: str) -> Path:
        """The folder of a host's own commands, which is first in its PATH."""
        return self.folder / name / "bin"

    def __enter__(self) -> Self:
        assert SSHD is not None
        if os.geteuid() == 0:
            _FOR_PRIVILEGES.mkdir(mode=0o755, exist_ok=True)
        self.client.mkdir(parents=True)
        _make_key(self.folder / "user_key")
        known, hosts = "", ""
        for name in self.names:
            host, port = self.folder / name, free_port()
            self.home(name).mkdir(parents=True)
            self.commands(name).mkdir()
            (self.commands(name) / "uavlinkd").symlink_to(Path(sys.executable).parent / "uavlinkd")
            _make_key(host / "host_key")
            shutil.copy(self.folder / "user_key.pub", host / "authorized_keys")
            known += f"{name} {(host / 'host_key.pub').read_text()}"
            hosts += _HOST.format(name=name, port=port)
            (host / "sshd_config").write_text(_SERVER.format(port=port, folder=host, commands=self.commands(name)))
            server = end_with_parent(SSHD, "-D", "-E", str(host / "log"), "-f", str(host / "sshd_config"))
            self._servers.append(subprocess.Popen(server))
        (self.folder / "known_hosts").write_text(known)
        (self.folder / "config").write_text(hosts + _CLIENT.format(folder=self.folder))
        program = self.client / "ssh"
        program.write_text(f'#!/bin/sh\nexec {shutil.which("ssh")} -F {self.folder / "config"} "$@"\n')
        program.chmod(0o755)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for name, server in zip(self.names, self._servers, strict=True):
            server.terminate()
            server.wait()
            if error is not None:
                print((self.folder / name / "log").read_text())

    def answers(self, name: str) -> bool:
        """Whether a command runs there by now."""
        return subprocess.run([self.client / "ssh", name, "true"], capture_output=True, check=False).returncode == 0


def _make_key(path: Path) -> None:
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", path], check=True)
