"""What ``check`` says about this machine: it looks, and binds, opens and writes nothing of the configuration."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.config.files import ADDRESSES, ENDPOINT, PEER, TOP, URL, load
from tests.needs import need
from uavlinkd.cli import main
from uavlinkd.io.sockets import Presence
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.ops import surroundings

Lacks = Callable[..., list[str]]


@pytest.fixture
def lacks(tmp_path: Path) -> Lacks:
    """Loads a file with these parts, and returns what the machine lacks for it."""

    def loading(
        listen: str = "", url: str = "", address: str = "127.0.0.1:9", control: str = "/tmp/drone0.sock"
    ) -> list[str]:
        text = f'{TOP}control_socket = "{control}"\nlisten = ["{listen or f"127.0.0.1:{free_port()}"}"]\n'
        text += ENDPOINT.replace(URL, url or f"udpin:127.0.0.1:{free_port()}")
        config = load(tmp_path, text + PEER.replace(ADDRESSES, f'["{address}"]'))
        return surroundings.look_around(config)

    return loading


def test_complete_machine_has_no_line(lacks: Lacks) -> None:
    """Free ports, existing folders, numeric addresses."""
    assert lacks() == []
    assert lacks(listen=f"0.0.0.0:{free_port()}", url=f"tcpin:0.0.0.0:{free_port()}") == []


def test_an_address_of_this_daemon_is_no_peers(lacks: Lacks, monkeypatch: pytest.MonkeyPatch) -> None:
    """It listens on every address. Another port is another software."""
    port = free_port()
    assert lacks(f"0.0.0.0:{port}", address=f"192.0.2.7:{port}") == []
    monkeypatch.setattr(surroundings, "look", lambda _, host: Presence(hosts=(host,)))
    assert lacks(f"0.0.0.0:{port}", address=f"192.0.2.7:{port}") == [
        f'peer "drone1": 192.0.2.7:{port} is an address of this daemon itself: write that of the other machine'
    ]
    assert lacks(f"0.0.0.0:{port}", address="192.0.2.7:9") == []


def test_control_socket(lacks: Lacks, monkeypatch: pytest.MonkeyPatch) -> None:
    """A missing folder, one without permission, and a path that is too long for a socket. systemd makes /run/NAME."""
    assert "mkdir -p /no/such" in lacks(control="/no/such/c.sock")[0]
    assert lacks(control="/run/no-such-service/control.sock") == []
    monkeypatch.setattr(os, "access", lambda path, _: str(path) != "/tmp")
    assert "may not write to /tmp" in lacks()[0]


def test_check_prints_it(lacks: Lacks, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The exit status stays 0: the file is valid."""
    lacks(url="serial:/dev/no-such-tty:57600")
    assert main(["check", "--config", str(tmp_path / "drone0.toml")]) == 0
    assert "this machine: endpoint" in (printed := capsys.readouterr().out)
    assert "/dev/no-such-tty is not there" in printed


def test_broadcast_addresses_of_this_machine(lacks: Lacks) -> None:
    """A peer and a client are one machine each."""
    need(sys.platform == "linux", "Linux")
    for line in lacks(url="udpout:127.255.255.255:14550", address="127.255.255.255:5790"):
        assert re.match(r'(endpoint|peer) ".*": 127.255.255.255:\d+ is a broadcast address: write the address', line)
