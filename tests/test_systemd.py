"""The units in systemd/, by systemd's own tools."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import pytest

from tests.namespaces import Namespace, NamespaceError, need_namespaces
from tests.needs import need
from uavlinkd.daemon.daemon import HOUSEKEEPING_S

UNITS = Path(__file__).parents[1] / "systemd"
NAMES = sorted(path.name for path in UNITS.glob("*.service"))
THRESHOLD = "20"
"""Of `systemd-analyze security`, in tenths: an exposure below 2.0."""


def analyze(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """``systemd-analyze``."""
    path = shutil.which("systemd-analyze")
    need(path is not None, "systemd-analyze, of Debian's package systemd")
    return subprocess.run([str(path), *map(str, arguments)], capture_output=True, text=True, check=False)


def settings(name: str) -> dict[str, list[str]]:
    """The settings of a unit by key, with %i replaced."""
    result: defaultdict[str, list[str]] = defaultdict(list)
    for line in (UNITS / name).read_text().splitlines():
        if line and not line.startswith(("#", "[")):
            key, _, value = line.partition("=")
            result[key].append(value)
    return result


@pytest.mark.parametrize("name", NAMES)
def test_unit_has_nothing_wrong(tmp_path: Path, name: str) -> None:
    """In a file system where it is installed as it says."""
    units = tmp_path / "etc/systemd/system"
    units.mkdir(parents=True)
    instance = name.replace("@", "@drone0")
    shutil.copy(UNITS / name, units / instance)
    for executable in ("opt/uavlinkd/bin/uavlinkd", "bin/sh"):
        (tmp_path / executable).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / executable).write_text("#!/bin/sh\n")
        (tmp_path / executable).chmod(0o755)
    for target in ("sysinit", "basic", "multi-user", "shutdown"):
        (units / f"{target}.target").write_text("[Unit]\nDescription=there\n")
    done = analyze("verify", "--man=no", f"--root={tmp_path}", instance)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize("name", NAMES)
def test_unit_is_hardened(name: str) -> None:
    """Its exposure, by systemd's measure."""
    done = analyze("security", "--offline=true", f"--threshold={THRESHOLD}", "--no-pager", UNITS / name)
    assert done.returncode == 0, done.stdout + done.stderr
    exposure = re.search(r"Overall exposure level for .*: (\d+\.\d)", done.stdout)
    assert exposure is not None
    assert float(exposure[1]) < 2.0


@pytest.mark.parametrize("name", ["uavlinkd.service", "uavlinkd@.service"])
def test_daemon_is_restarted_indefinitely(name: str) -> None:
    """Restarted indefinitely and quickly, by a watchdog of the event loop; and started without a network."""
    unit = settings(name)
    assert unit["Type"] == ["notify"]
    assert unit["NotifyAccess"] == ["main"]
    assert (unit["Restart"], unit["StartLimitIntervalSec"]) == (["always"], ["0"])
    assert unit["RestartSec"] == ["250ms"]
    watchdog = re.fullmatch(r"(\d+)s", unit["WatchdogSec"][0])
    assert watchdog is not None
    assert int(watchdog[1]) / 2 > 2 * HOUSEKEEPING_S  # notified in time although the timer is coarse
    assert not {"Requires", "BindsTo"} & set(unit)
    drivers = ["modprobe@cdc_acm.service modprobe@usbserial.service"]  # of those in DeviceAllow that are modules
    assert (unit["After"], unit["Wants"]) == (drivers, drivers)
    assert unit["ExecReload"] == ["/bin/sh -c 'kill -HUP $MAINPID'"]


@pytest.mark.parametrize("name", ["uavlinkd.service", "uavlinkd@.service"])
def test_keys_are_handed_over_and_serial_ports_allowed(name: str) -> None:
    """By systemd, to a user of the moment; of devices, serial ports alone."""
    unit = settings(name)
    assert (unit["DynamicUser"], unit["SupplementaryGroups"], unit["UMask"]) == (["yes"], ["dialout"], ["0077"])
    assert unit["LoadCredential"][0].startswith("keys:/etc/uavlinkd/")
    assert unit["DevicePolicy"] == ["closed"]
    assert all(re.fullmatch(r"char-tty[A-Z]+ rw", device) for device in unit["DeviceAllow"])
    assert not any("KEY" in variable.upper() for variable in unit["Environment"])


def test_instances_are_apart_and_otherwise_alike() -> None:
    """Each has a configuration, keys and folders of its own; nothing else differs from the single service."""
    one, many = settings("uavlinkd.service"), settings("uavlinkd@.service")
    differing = {key for key in one.keys() | many.keys() if one[key] != many[key]}
    assert differing == {"Description", "ExecStart", "LoadCredential", "RuntimeDirectory", "StateDirectory"}
    assert all("%i" in value for key in differing for value in many[key])


def test_relay_is_restarted_and_isolated_as_a_daemon_is() -> None:
    """With more memory and processor time, and without devices."""
    one, relay = settings("uavlinkd.service"), settings("uavlinkd-relay.service")
    differing = {key for key in one.keys() | relay.keys() if one[key] != relay[key]}
    assert differing == {
        *(
            "Description",
            "ExecStart",
            "LoadCredential",
            "RuntimeDirectory",
            "StateDirectory",
            "MemoryMax",
            "LimitNOFILE",
        ),
        *("CPUWeight", "Wants", "After", "SupplementaryGroups", "DevicePolicy", "DeviceAllow", "PrivateDevices"),
    }
    assert relay["PrivateDevices"] == ["yes"]
    assert relay["ExecStart"] == ["/opt/uavlinkd/bin/uavlinkd relay --config /etc/uavlinkd/relay.toml"]
    assert (relay["DynamicUser"], relay["LoadCredential"]) == (["yes"], ["keys:/etc/uavlinkd/relay"])


def test_relay_listens_on_port_443_with_the_setting_of_the_readme() -> None:
    """The service and the container have no capability, and other units of the machine are not touched."""
    need_namespaces()
    readme = (UNITS.parent / "uavlinkd/relay/README.md").read_text()
    setting = re.search(r"echo net\.ipv4\.(\w+)=(\d+) \|", readme)
    assert setting is not None
    assert settings("uavlinkd-relay.service")["AmbientCapabilities"] == [""]
    assert "cap_drop: [ALL]" in (UNITS.parent / "configs/compose.relay.yaml").read_text()
    listen = "import os; from socket import *; os.setuid(65534); create_server(('', 443))"
    listen += "; create_server(('::', 443), family=AF_INET6)"
    with Namespace() as host:
        with pytest.raises(NamespaceError, match="Permission denied"):
            host.run(sys.executable, "-c", listen)
        with host.entered():
            Path("/proc/sys/net/ipv4", setting[1]).write_text(setting[2])
        host.run(sys.executable, "-c", listen)
