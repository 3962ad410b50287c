"""What ``check`` says about this machine: it looks, and binds, opens and writes nothing of the configuration."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.config.files import ADDRESSES, ENDPOINT, PEER, TOP, URL, load
from uavlinkd.cli import main
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
        return surroundings.lacks(load(tmp_path, text + PEER.replace(ADDRESSES, f'["{address}"]')))

    return loading


def test_complete_machine_has_no_line(lacks: Lacks) -> None:
    """Free ports, existing folders, numeric addresses."""
    assert lacks() == []
    assert lacks(listen=f"0.0.0.0:{free_port()}", url=f"tcpin:0.0.0.0:{free_port()}") == []


def test_missing_address_and_interface(lacks: Lacks) -> None:
    """TEST-NET-1 is on no machine."""
    port = free_port()  # not 5790: a daemon of another test may have it at all addresses
    (line,) = lacks(listen=f"192.0.2.7:{port}")
    assert "192.0.2.7 is not an address of this machine now" in line
    assert f'write "0.0.0.0:{port}"' in line
    (line,) = lacks(address="[fe80::1%no-such-if]:5790")
    assert "no network interface no-such-if" in line


def test_name_without_address(lacks: Lacks) -> None:
    """RFC 2606 reserves `.invalid`: no resolver knows a name there. A slow one does not delay `check` for long."""
    (line,) = lacks(address="drone1.invalid:5790")
    assert line.startswith('peer "drone1": drone1.invalid has no address here now')
    assert "getent hosts drone1.invalid" in line


def test_serial_devices(lacks: Lacks, tmp_path: Path) -> None:
    """A missing one, a file, and one without permission. None is opened: that can reset an autopilot."""
    (line,) = lacks(url="serial:/dev/no-such-tty:57600")
    assert "/dev/no-such-tty is not there now: plug it in, or write another device" in line
    (tmp_path / "file").touch()
    (line,) = lacks(url=f"serial:{tmp_path}/file:57600")
    assert "is not a serial device" in line
    assert lacks(url="serial:/dev/ptmx:57600") == []


def test_control_socket(lacks: Lacks, monkeypatch: pytest.MonkeyPatch) -> None:
    """A missing folder, one without permission, and a path that is too long for a socket. systemd makes /run/NAME."""
    assert "mkdir -p /no/such" in lacks(control="/no/such/c.sock")[0]
    assert lacks(control="/run/no-such-service/control.sock") == []
    assert "may have 107" in lacks(control=f"/tmp/{'x' * 30}/{'y' * 30}/{'z' * 30}.{'u' * 30}")[0]
    monkeypatch.setattr(os, "access", lambda path, _: str(path) != "/tmp")
    assert "may not write to /tmp" in lacks()[0]


def test_check_prints_it_unless_the_file_is_for_another_machine(
    lacks: Lacks, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The exit status stays 0: the file is valid."""
    lacks(url="serial:/dev/no-such-tty:57600")
    for options, is_shown in ([], True), (["--elsewhere"], False):
        assert main(["check", "--config", str(tmp_path / "drone0.toml"), *options]) == 0
        assert ("/dev/no-such-tty is not there" in " ".join(capsys.readouterr().out.split())) == is_shown
