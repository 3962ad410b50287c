"""The output of ``uavlinkd check``: all facts for a review, and no secret."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.console import Console

from tests.config.files import load
from uavlinkd.config import Config, keys
from uavlinkd.mavlink.policy.roles import ROLES
from uavlinkd.ops.topology import print_topology

_PUBLIC = [keys.public_key_text(keys.generate_private_key()) for _ in range(2)]
_FILE = f"""
name = "drone0"
private_key_file = "drone0.key"
listen = ["0.0.0.0:5790"]
[[endpoint]]
name = "autopilot"
url = "udpin:127.0.0.1:14550"
[[endpoint]]
name = "tablet"
url = "udpin:0.0.0.0:14551"
[[peer]]
name = "drone1"
public_key = "{_PUBLIC[0]}"
addresses = ["10.13.0.2:5790", "drone1.local:5790"]
psk_file = "pair.psk"
role = "swarm-member"
system_ids = [2]
[[peer]]
name = "observer"
public_key = "{_PUBLIC[1]}"
role = "observer"
system_ids = [254]
suites = ["mlkem768", "x25519"]
confidential = true
"""


def _printed(config: Config) -> str:
    file = io.StringIO()
    print_topology(config, Console(file=file))
    return file.getvalue()


def _line(printed: str, start: str) -> str:
    return next(line for line in printed.splitlines() if line.startswith(start))


def test_identity_is_printed(tmp_path: Path) -> None:
    """The output has the name, the whole public key, and the listening addresses."""
    config = load(tmp_path, _FILE)
    printed = _printed(config)
    assert _line(printed, "name").split() == ["name", "drone0"]
    assert _line(printed, "public key").endswith(keys.encode_key(config.public_key))
    assert "0.0.0.0:5790" in _line(printed, "listens on")
    assert "open to the network" in _line(printed, "listens on")


def test_networks_are_printed_with_what_they_are_used_for(tmp_path: Path) -> None:
    """Of a configuration for another machine: the addresses of peers that each network is for, and the port."""
    networks = (
        '[[network]]\nname = "lte"\ninterface = "wwan0"\nmetered = true\nbudget_bits_s = 256000\n'
        '[[network]]\nname = "wired"\naddress = "2001:db8::5"\n'
    )
    printed = " ".join(_printed(load(tmp_path, _FILE.replace("[[endpoint]]", f"{networks}[[endpoint]]", 1))).split())
    assert "listens on port 5790 (IPv4) of each network" in printed
    addresses = "used for drone1 10.13.0.2:5790, drone1 drone1.local:5790"
    assert f"lte interface wwan0, metered, 256,000 bits/s {addresses}" in printed
    assert "wired address 2001:db8::5, not metered, no budget used for drone1 drone1.local:5790" in printed


def test_open_endpoint_is_marked(tmp_path: Path) -> None:
    """An endpoint that the network reaches differs from others in the table, and causes a warning."""
    printed = _printed(load(tmp_path, _FILE))
    assert _line(printed, "autopilot").endswith("this machine")
    assert _line(printed, "tablet").endswith("THE NETWORK")
    assert 'warning: endpoint "tablet" listens beyond loopback' in printed
    assert "No warnings" not in printed


def _policies(printed: str) -> dict[str, str]:
    """The printed policies by the names of their peers and endpoints, with single spaces."""
    parts = printed.split("\nPolicy of ")[1:]
    return {part.split("\n")[0]: " ".join(part.split("\n\n")[0].split()[1:]) for part in parts}


def test_each_peer_and_endpoint_is_printed_with_its_role(tmp_path: Path) -> None:
    """A line has the name and the system ids. A peer that may send everything is highlighted."""
    printed = _printed(
        load(tmp_path, _FILE.replace('role = "observer"\nsystem_ids = [254]', 'role = "all"\nsystem_ids = "all"'))
    )
    summary = printed.split("Roles\n")[1].split("\n\n")[0]
    rows = [line.split() for line in summary.splitlines()[2:]]
    unlimited = ["may", "send", "everything", "except", "SETUP_SIGNING", "any"]
    assert rows == [
        ["peer", "drone1", "swarm-member", "2"],
        ["peer", "observer", "all:", *unlimited[2:], "system"],
        ["endpoint", "autopilot", *unlimited],
        ["endpoint", "tablet", *unlimited],
    ]
    assert list(_policies(printed)) == ["drone1", "observer"]


def test_equal_policies_are_printed_once(tmp_path: Path) -> None:
    """Peers and endpoints with other system ids but the same rules share a table."""
    same = _FILE.replace('role = "observer"', 'role = "swarm-member"')
    same = same.replace(':14550"', ':14550"\nrole = "observer"\nsystem_ids = [1]')
    assert list(_policies(_printed(load(tmp_path, same)))) == ["drone1, observer", "autopilot"]
    different = same.replace("system_ids = [254]", 'system_ids = [254]\ndeny_in = ["HOME_POSITION"]')
    assert list(_policies(_printed(load(tmp_path, different)))) == ["drone1", "observer", "autopilot"]


@pytest.mark.parametrize("role", ROLES)
def test_plain_output_has_a_hundred_columns(tmp_path: Path, role: str) -> None:
    """The table of every role fits without horizontal scrolling."""
    printed = _printed(load(tmp_path, _FILE.replace('role = "observer"', f'role = "{role}"')))
    assert max(map(len, printed.splitlines())) <= 100
    assert "…" not in printed


def test_no_secret_is_printed(tmp_path: Path) -> None:
    """The output has neither the private key nor a PSK, in any encoding."""
    printed = _printed(load(tmp_path, _FILE))
    for name in ("drone0.key", "pair.psk"):
        text = (tmp_path / name).read_text().strip()
        assert text not in printed
        assert text[:8] not in printed
        assert keys.decode_key(text).hex() not in printed


@pytest.mark.parametrize(
    ("section", "title"),
    [
        pytest.param('[[relay]]\naddresses = ["relay.example.org:5790"]', "Relays", id="relay"),
        pytest.param("[[member]]", "Members of this relay, and their limits", id="member"),
    ],
)
def test_key_of_a_relay_or_member_is_printed_whole(tmp_path: Path, section: str, title: str) -> None:
    """The user compares it with what the other machine printed. What may be a private key is not printed."""
    public, private = keys.public_key_text(keys.generate_private_key()), keys.generate_private_key()
    for key in (public, private):
        printed = _printed(load(tmp_path, f'{_FILE}{section}\nname = "vps"\npublic_key = "{key}"\n'))
        rows = printed.partition(title)[2]
        assert (public in rows) is (key == public)
        assert ("(private?)" in rows) is (key == private)
        assert private[:8] not in printed
