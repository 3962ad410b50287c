"""What ``check`` says about networks on this machine. tests/daemon/test_two_networks.py has real routes."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.config import files
from tests.config.files import ADDRESSES, PEER, TOP
from tests.needs import need
from uavlinkd.config import Config
from uavlinkd.ops import network_report
from uavlinkd.ops.network_report import look_at_networks

Load = Callable[[str], Config]
_LOOPBACK = '[[network]]\nname = "loopback"\ninterface = "lo"\n'


@pytest.fixture
def load(tmp_path: Path) -> Load:
    """Loads a file with a network and this address of the peer."""
    need(sys.platform == "linux", "Linux")
    return lambda address: files.load(tmp_path, TOP + _LOOPBACK + PEER.replace(ADDRESSES, f'["{address}"]'))


def test_without_the_tool_for_routes_nothing_is_said_about_them(load: Load, monkeypatch: pytest.MonkeyPatch) -> None:
    """No route is reported as missing."""
    monkeypatch.setattr(network_report, "_IP", None)
    report = look_at_networks(load("203.0.113.7:5790"), {})
    assert report.lacks == ["there is no `ip` here, so routes were not checked: install iproute2"]
    assert (report.errors, report.reaches[0].unreached) == ([], [])


def test_name_is_reached_at_one_of_its_addresses(load: Load) -> None:
    """A name that does not resolve is neither reached nor unreached: another line reports it."""
    need(network_report._IP is not None, "iproute2")
    config = load("drone1.test:5790")
    (reach,) = look_at_networks(config, {"drone1.test": ["127.0.0.1"]}).reaches
    assert (reach.reached, reach.unreached) == (["drone1 drone1.test:5790"], [])
    (reach,) = look_at_networks(config, {"drone1.test": []}).reaches
    assert (reach.reached, reach.unreached) == ([], [])
