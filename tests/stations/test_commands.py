"""``uavlinkd station add`` and ``remove``: the daemon's file before and after, and what is printed."""

from __future__ import annotations

import base64
import socket
import tomllib
from pathlib import Path

import cryptography.hazmat.primitives.serialization  # noqa: F401  a module without a specification stays loaded
import pytest

from tests.fleet.folders import create, join
from uavlinkd.cli import main
from uavlinkd.config import keys
from uavlinkd.config.load import load_config
from uavlinkd.config.model import ConfigError, EndpointConfig
from uavlinkd.fleet.signing import Identity
from uavlinkd.io.url import StationUrl
from uavlinkd.mavlink.policy.settings import PolicyError
from uavlinkd.system import services
from uavlinkd.system.addresses import Address

CONFIG = """name = "drone1"
private_key_file = "drone1.key"  # a comment that stays

[[endpoint]]
name = "autopilot"
url = "udpin:127.0.0.1:14550"
system_ids = [1]
"""


@pytest.fixture
def config(tmp_path: Path) -> Path:
    keys.write_secret_file(tmp_path / "drone1.key", keys.generate_private_key())
    path = tmp_path / "drone1.toml"
    path.write_text(CONFIG)
    return path


def test_station_is_added_and_removed(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The file keeps its comments; the printed text has a private key that fits the public one in the file."""
    command = ("station", "add", "tablet", "--config", str(config), "--at", "203.0.113.7")
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert config.read_text().startswith(CONFIG)
    loaded = load_config(config, {})
    (station,) = tomllib.loads(config.read_text())["station"]
    text = printed[printed.index("[Interface]") :]
    lines = dict(line.split(" = ", 1) for line in text.splitlines() if " = " in line)
    assert keys.public_key_text(lines["PrivateKey"]) == station["public_key"]
    assert loaded.stations is not None
    own = base64.b64encode(loaded.stations.private_key.reveal()).decode()
    assert lines["PublicKey"] == keys.public_key_text(own)
    assert (lines["Address"], lines["AllowedIPs"]) == ("10.66.0.2/32", "10.66.0.1/32")
    assert lines["Endpoint"] == "203.0.113.7:51820"
    assert lines["PrivateKey"] not in config.read_text()
    assert main(("station", "add", "second", "--config", str(config), "--at", "h")) == 0
    stations = tomllib.loads(config.read_text())["station"]
    assert [(one["address"], one["system_ids"]) for one in stations] == [("10.66.0.2", [255]), ("10.66.0.3", [254])]
    for name in ("tablet", "second"):
        assert main(("station", "remove", name, "--config", str(config))) == 0
    assert config.read_text() == CONFIG
    assert sorted(path.name for path in config.parent.iterdir()) == ["drone1.key", "drone1.toml", "stations.key"]


def test_station_of_a_fleets_ground_station(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its id is one of the certificate, which the error widens. The ground station keeps its own."""
    create(tmp_path / "fleet", at=(Address("192.0.2.1", 5790),), stations=1)
    config = tmp_path / "fleet" / "ground-station" / "ground-station.toml"
    monkeypatch.setattr(services, "FOLDER", config.parent)
    add = ("station", "add", "tab2", "--config", str(config), "--at", "h")
    assert main(add) == 2
    widen = "`uavlinkd fleet enroll --here ground-station --replace --id A-B`"
    assert f"whose certificate has 255 to 255: write one that no [[endpoint]] has; {widen}" in capsys.readouterr().err
    join(tmp_path / "fleet", "ground-station", Identity(ids=(253, 255)), replaces=True)
    assert main(add) == 0
    assert "Restart the daemon: sudo systemctl restart uavlinkd@ground-station\n" in capsys.readouterr().out
    table = tomllib.loads(config.read_text())
    assert [one["system_ids"] for one in (*table["endpoint"], *table["station"])] == [[255], [254]]


def test_key_of_a_tunnel_that_the_app_made(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """No private key is made, and none is printed."""
    public = keys.public_key_text(keys.generate_private_key())
    assert main(("station", "add", "tablet", "--config", str(config), "--at", "h", "--public-key", public)) == 0
    assert "that of the tunnel, which the app made" in capsys.readouterr().out
    assert tomllib.loads(config.read_text())["station"][0]["public_key"] == public


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("tablet", "--public-key", 'x"\nrole = "vehicle'), "drone1.toml: station[0].public_key (tablet)"),
        (("tablet", "--system-id", "1"), "has the system id of endpoint[0] (autopilot) too"),
        (("tablet", "--public-key", "short"), "drone1.toml: station[0].public_key (tablet)"),
        (("tablet", "--public-key", base64.b64encode(bytes(32)).decode()), "point of low order"),
        *((("tablet", "--at", at), "--at ") for at in ("a b", "h\nAllowedIPs = 0.0.0.0/0", "[::1]", "h:1")),
        *(
            ((name,), "drone1.toml: ")
            for name in ('a"\n[log]\nlevel = "debug', "a\\", "a\x7f", "\u202ea", "", "a\0b")
        ),
    ],
)
def test_invalid_station_changes_nothing(
    config: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], says: str
) -> None:
    """No section or key can be written by a name, a key or a host."""
    assert main(("station", "add", "--config", str(config), "--at", "h", *arguments)) == 2
    said = capsys.readouterr().err
    assert says in said
    assert ".trial" not in said
    assert config.read_text() == CONFIG


def test_range_with_the_system_of_the_vehicle_is_refused(config: Path) -> None:
    """Not only ids that are written one by one."""
    assert main(("station", "add", "tablet", "--config", str(config), "--at", "h")) == 0
    config.write_text(config.read_text().replace("system_ids = [255]", 'system_ids = [255, "1-20"]'))
    with pytest.raises(ConfigError, match="has the system id of endpoint"):
        load_config(config, {})


def test_station_without_a_policy_passes_nothing() -> None:
    """Also if a check of the file were missing: what is open for an endpoint is closed for a station."""
    station = EndpointConfig("tablet", StationUrl("10.66.0.2", (14550,), bytes(32)))
    with pytest.raises(PolicyError):
        station.make_policy()


def test_address_of_ipv6_has_brackets(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(("station", "add", "tablet", "--config", str(config), "--at", "2001:db8::1")) == 0
    assert "Endpoint = [2001:db8::1]:51820" in capsys.readouterr().out


def test_invalid_file_is_named_before_anything_is_made(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config.write_text(CONFIG + '[stations]\nnetwork = "any"\nprivate_key_file = "stations.key"\n')
    assert main(("station", "add", "tablet", "--config", str(config), "--at", "h")) == 2
    assert "stations.network" in capsys.readouterr().err
    assert not (config.parent / "stations.key").exists()


def test_names_that_are_taken_or_absent(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    add = ("station", "add", "tablet", "--config", str(config), "--at", "h")
    assert main(add) == 0
    assert main(add) == 2
    assert main(("station", "remove", "other", "--config", str(config))) == 2
    assert "has no station other" in capsys.readouterr().err


def test_own_address_behind_the_nat_of_a_carrier(
    config: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without ``--at`` the code would name it, and no station reaches it."""
    monkeypatch.setattr(socket.socket, "connect", lambda sock, address: None)
    monkeypatch.setattr(socket.socket, "getsockname", lambda sock: ("100.64.7.2", 9))
    assert main(("station", "add", "tablet", "--config", str(config))) == 1
    assert "behind a carrier's NAT" in capsys.readouterr().err
    assert config.read_text() == CONFIG
