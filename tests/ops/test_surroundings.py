"""What ``check`` says about this machine: it looks, and binds, opens and writes nothing of the configuration."""

from __future__ import annotations

import os
import socket
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from uavlinkd.cli import main
from uavlinkd.config import keys
from uavlinkd.config.load import load_config
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.ops import surroundings

Lacks = Callable[..., list[str]]


@pytest.fixture
def lacks(tmp_path: Path) -> Lacks:
    """Loads a file with these parts, and returns what the machine lacks for it."""
    keys.write_secret_file(tmp_path / "drone0.key", keys.generate_private_key())
    public = keys.public_key_text(keys.generate_private_key())

    def loading(
        listen: str = "", url: str = "", address: str = "127.0.0.1:9", more: str = "", control: str = ""
    ) -> list[str]:
        path = tmp_path / "drone0.toml"
        where = f'"{address}"' if ":" in address else f'{{ network = "{address}" }}'
        path.write_text(
            f'name = "drone0"\nprivate_key_file = "drone0.key"\ncontrol_socket = "{control or "/tmp/drone0.sock"}"\n'
            f'listen = ["{listen or f"127.0.0.1:{free_port()}"}"]\n{more}'
            f'[[endpoint]]\nname = "autopilot"\nurl = "{url or f"udpin:127.0.0.1:{free_port()}"}"\n'
            f'[[peer]]\nname = "drone1"\npublic_key = "{public}"\naddresses = [{where}]\n'
            'role = "vehicle"\nsystem_ids = [2]\n'
        )
        return surroundings.lacks(load_config(path, {}))

    return loading


@pytest.fixture
def short_folder() -> Iterator[Path]:
    """A folder whose path is short enough for a socket's."""
    with tempfile.TemporaryDirectory(prefix="machine-") as folder:
        yield Path(folder)


def test_complete_machine_has_no_line(lacks: Lacks) -> None:
    """Free ports, existing folders, numeric addresses."""
    assert lacks() == []
    assert lacks(listen=f"0.0.0.0:{free_port()}", url=f"tcpin:0.0.0.0:{free_port()}") == []


@pytest.mark.parametrize("kind", ["udp", "tcp", "metrics"])
def test_port_in_use_is_named_with_its_process(lacks: Lacks, kind: str) -> None:
    """The port is not bound for that: this process holds it all the time."""
    transport = socket.SOCK_DGRAM if kind == "udp" else socket.SOCK_STREAM
    with socket.socket(socket.AF_INET, transport) as sock:
        sock.bind(("127.0.0.1", 0))
        if kind != "udp":
            sock.listen()
        where = f"127.0.0.1:{sock.getsockname()[1]}"
        if kind == "udp":
            (line,) = lacks(listen=where)
        elif kind == "tcp":
            (line,) = lacks(url=f"tcpin:{where}")
        else:
            (line,) = lacks(more=f'[metrics]\nlisten = "{where}"\n')
    assert f"port {where.rpartition(':')[2]} is in use by" in line
    assert f"(process {os.getpid()})" in line


def test_daemon_that_runs_may_have_its_ports(lacks: Lacks, short_folder: Path) -> None:
    """It answers on the control socket of the file."""
    path = short_folder / "c.sock"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock, socket.socket(socket.AF_UNIX) as control:
        sock.bind(("127.0.0.1", 0))
        control.bind(str(path))
        control.listen()
        assert lacks(listen=f"127.0.0.1:{sock.getsockname()[1]}", control=str(path)) == []


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


def test_device_with_two_names(lacks: Lacks, tmp_path: Path) -> None:
    """A name below /dev/serial/by-id, and that of the kernel."""
    (tmp_path / "by-id").symlink_to("/dev/ptmx")
    named = f'[[network]]\nname = "sik"\nserial = "{tmp_path}/by-id:57600"\n'
    (line,) = lacks(url="serial:/dev/ptmx:57600", more=named, address="sik")
    assert line.startswith(f'network "sik": {tmp_path}/by-id is the device of endpoint "autopilot" too')


def test_device_without_permission(lacks: Lacks, monkeypatch: pytest.MonkeyPatch) -> None:
    """The group is named."""
    monkeypatch.setattr(os, "access", lambda path, _: str(path) != "/dev/ptmx")
    (line,) = lacks(url="serial:/dev/ptmx:57600")
    assert "group, often dialout" in line


def test_recording_folder(lacks: Lacks, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file in its place, a missing parent, no permission, and a full disk."""
    (tmp_path / "file").touch()
    little = "min_free_bytes = 100000\n"
    assert lacks(more=f'[recording]\nfolder = "new"\n{little}') == []
    assert "is not a folder" in lacks(more=f'[recording]\nfolder = "file"\n{little}')[0]
    assert "mkdir -p" in lacks(more=f'[recording]\nfolder = "a/b"\n{little}')[0]
    huge = "min_free_bytes = 1_000_000_000_000_000\n"
    assert "less than min_free_bytes" in lacks(more=f'[recording]\nfolder = "new"\n{huge}')[0]
    monkeypatch.setattr(os, "access", lambda path, _: path != tmp_path)
    assert "cannot be written by this user" in lacks(more=f'[recording]\nfolder = "new"\n{little}')[0]


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
