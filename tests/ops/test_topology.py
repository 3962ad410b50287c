"""The output of ``uavlinkd check``: all facts for a review, and no secret."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.console import Console

from uavlinkd.config import Config, EndpointConfig, keys
from uavlinkd.config.advice import exposure
from uavlinkd.config.load import load_config
from uavlinkd.endpoints.url import SerialUrl
from uavlinkd.mavlink.policy.roles import ROLES
from uavlinkd.ops.topology import describe, print_topology

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


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the key files."""
    keys.write_secret_file(tmp_path / "drone0.key", keys.generate_private_key())
    keys.write_secret_file(tmp_path / "pair.psk", keys.generate_psk())
    return tmp_path


def _load(folder: Path, text: str) -> Config:
    (folder / "drone0.toml").write_text(text)
    return load_config(folder / "drone0.toml", {})


def _printed(config: Config) -> str:
    file = io.StringIO()
    print_topology(config, Console(file=file))
    return file.getvalue()


def _line(printed: str, start: str) -> str:
    return next(line for line in printed.splitlines() if line.startswith(start))


def test_identity_is_printed(folder: Path) -> None:
    """The output has the name, the whole public key, and the listening addresses."""
    config = _load(folder, _FILE)
    printed = _printed(config)
    assert _line(printed, "name").split() == ["name", "drone0"]
    assert _line(printed, "public key").endswith(keys.encode_key(config.public_key))
    assert "0.0.0.0:5790" in _line(printed, "listens on")
    assert "open to the network" in _line(printed, "listens on")


@pytest.mark.parametrize(
    ("listen", "says"), [('["127.0.0.1:5790"]', "this machine only"), ("[]", "it connects to its peers")]
)
def test_daemon_that_the_network_cannot_reach_is_not_open(folder: Path, listen: str, says: str) -> None:
    """It listens on loopback only, or connects only."""
    text = _FILE.split('[[peer]]\nname = "observer"', maxsplit=1)[0].replace('["0.0.0.0:5790"]', listen)
    line = _line(_printed(_load(folder, text)), "listens on")
    assert says in line
    assert "open" not in line


def test_each_peer_has_a_line(folder: Path) -> None:
    """Name, start of the key, addresses, suites, mode and PSK."""
    printed = _printed(_load(folder, _FILE))
    first, second = _line(printed, "drone1 "), _line(printed, "observer ")
    assert "(it connects)" not in first
    for part in (_PUBLIC[0][:8], "10.13.0.2:5790", "x25519", "authentic, 128-bit tag", "yes"):
        assert part in first
    assert "drone1.local:5790" in printed
    for part in (_PUBLIC[1][:8], "(it connects)", "mlkem768 x25519", "encrypted", "no"):
        assert part in second


def test_networks_are_printed_with_what_they_are_used_for(folder: Path) -> None:
    """Of a configuration for another machine: the addresses of peers that each network is for, and the port."""
    networks = (
        '[[network]]\nname = "lte"\ninterface = "wwan0"\nmetered = true\nbudget_bits_s = 256000\n'
        '[[network]]\nname = "wired"\naddress = "2001:db8::5"\n'
    )
    printed = " ".join(_printed(_load(folder, _FILE.replace("[[endpoint]]", f"{networks}[[endpoint]]", 1))).split())
    assert "listens on port 5790 (IPv4) of each network" in printed
    addresses = "used for drone1 10.13.0.2:5790, drone1 drone1.local:5790"
    assert f"lte interface wwan0, metered, 256,000 bits/s {addresses}" in printed
    assert "wired address 2001:db8::5, not metered, no budget used for drone1 drone1.local:5790" in printed


def test_sizes_are_those_of_the_wire(folder: Path) -> None:
    """Five to seven bytes of header and the tag; peers with equal sizes share a line."""
    printed = _printed(_load(folder, _FILE + "max_envelope_bytes = 500\n"))
    sizes = printed.split("Bytes in a datagram\n")[1].split("\n\n")[0].splitlines()
    assert len(sizes) == 2
    assert "envelopes up to 1,232, adding 21-23" in sizes[0]
    assert "envelopes up to 500, adding 21-23" in sizes[1]
    shorter = _printed(_load(folder, _FILE.replace("confidential = true", "").replace('"mlkem768", ', "")))
    assert "every peer  envelopes up to 1,232, adding 21-23" in shorter
    short_tag = _printed(_load(folder, _FILE.replace("[[endpoint]]", "[link]\ntag_bits = 64\n[[endpoint]]", 1)))
    assert "adding 13-15" in short_tag


def test_chosen_mac_key_length_is_printed(folder: Path) -> None:
    """The default length is not."""
    chosen = _printed(_load(folder, _FILE.replace("psk_file", "mac_key_bits = 512\npsk_file")))
    assert "512-bit" in _line(chosen, "drone1 ")
    assert "512-bit" not in _printed(_load(folder, _FILE))


def test_open_endpoint_is_marked(folder: Path) -> None:
    """An endpoint that the network reaches differs from others in the table, and causes a warning."""
    printed = _printed(_load(folder, _FILE))
    assert _line(printed, "autopilot").endswith("this machine")
    assert _line(printed, "tablet").endswith("THE NETWORK")
    assert 'warning: endpoint "tablet" listens beyond loopback' in printed
    assert "No warnings" not in printed


def test_serial_port_is_not_open() -> None:
    """The network does not reach it."""
    assert exposure(EndpointConfig("autopilot", SerialUrl("/dev/ttyACM0", 57600))) == "wire"


def test_every_warning_is_printed_whole(folder: Path) -> None:
    """Long warnings are folded, not cut."""
    config = _load(folder, _FILE)
    printed = " ".join(_printed(config).split())
    assert len(config.warnings) == 2
    for warning in config.warnings:
        assert f"warning: {' '.join(warning.split())}" in printed


def test_configuration_without_warnings_is_reported(folder: Path) -> None:
    """The output says that there are no warnings."""
    text = _FILE.replace("0.0.0.0:14551", "127.0.0.1:14551").replace('"mlkem768", ', "")
    assert _printed(_load(folder, text)).endswith("No warnings.\n")


def test_empty_sections_are_left_out(folder: Path) -> None:
    """A daemon without peers and endpoints has two warnings and no empty table."""
    printed = _printed(_load(folder, _FILE.split("[[endpoint]]", maxsplit=1)[0]))
    assert "Peers" not in printed
    assert "Local endpoints" not in printed
    assert printed.count("warning:") == 2


def test_routing_is_printed(folder: Path) -> None:
    """The output has the rule between peers, and the rule for unknown systems."""
    text = " ".join(_printed(_load(folder, _FILE)).split())
    assert "routing between peers and endpoints only; a frame for an unknown system goes to all others" in text
    changed = '[routing]\nrelay = true\nunknown_targets = "drop"\n[[endpoint]]'
    text = " ".join(_printed(_load(folder, _FILE.replace("[[endpoint]]", changed, 1))).split())
    assert (
        "routing between peers and endpoints, and from peer to peer; a frame for an unknown system is dropped" in text
    )


def test_budget_is_printed_once_for_peers_that_share_it(folder: Path) -> None:
    """A line has budget, delay and age, and the peers that have these values."""
    assert "every peer  each frame at once" in _printed(_load(folder, _FILE))
    slow = "budget_bits_s = 64000\ncoalesce_s = 0.25\nmax_age_s = 2.5\npsk_file"
    printed = _printed(_load(folder, _FILE.replace("psk_file", slow)))
    lines = printed.split("Sending to a peer\n")[1].split("\n\n")[0].splitlines()
    assert lines == [
        "drone1    up to 64,000 bits/s; up to 0.25 s to share an envelope; dropped after 2.5 s",
        "observer  each frame at once",
    ]


def test_endpoint_is_printed_with_age_and_radio_status(folder: Path) -> None:
    """Each endpoint has its own values."""
    text = _FILE.replace(':14550"', ':14550"\nmax_age_s = 0.5\nradio_status = true')
    printed = _printed(_load(folder, text))
    assert _line(printed, "autopilot").split()[2:5] == ["0.5", "s", "yes"]
    assert _line(printed, "tablet").split()[2:5] == ["1", "s", "no"]


def _policies(printed: str) -> dict[str, str]:
    """The printed policies by the names of their peers and endpoints, with single spaces."""
    parts = printed.split("\nPolicy of ")[1:]
    return {part.split("\n")[0]: " ".join(part.split("\n\n")[0].split()[1:]) for part in parts}


def test_coalescing_without_a_budget_is_printed(folder: Path) -> None:
    """Frames wait although there is no budget."""
    printed = _printed(_load(folder, _FILE.replace("psk_file", "coalesce_s = 0.1\npsk_file")))
    assert "drone1    no budget; up to 0.1 s to share an envelope; dropped after 1 s" in printed


def test_policy_without_exceptions_has_no_table(folder: Path) -> None:
    """If everything but signing passes in both directions, two lines are enough."""
    text = _FILE.replace('role = "swarm-member"', 'role = "all"')
    policy = _policies(_printed(_load(folder, text)))["drone1"]
    assert policy.startswith("both directions heartbeat, position, telemetry, ")
    assert policy.endswith("HEARTBEAT no direction signing")


def test_each_peer_and_endpoint_is_printed_with_its_role(folder: Path) -> None:
    """A line has the name and the system ids. A peer that may send everything is highlighted."""
    printed = _printed(
        _load(folder, _FILE.replace('role = "observer"\nsystem_ids = [254]', 'role = "all"\nsystem_ids = "all"'))
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


def test_equal_policies_are_printed_once(folder: Path) -> None:
    """Peers and endpoints with other system ids but the same rules share a table."""
    same = _FILE.replace('role = "observer"', 'role = "swarm-member"')
    same = same.replace(':14550"', ':14550"\nrole = "observer"\nsystem_ids = [1]')
    assert list(_policies(_printed(_load(folder, same)))) == ["drone1, observer", "autopilot"]
    different = same.replace("system_ids = [254]", 'system_ids = [254]\ndeny_in = ["HOME_POSITION"]')
    assert list(_policies(_printed(_load(folder, different)))) == ["drone1", "observer", "autopilot"]


def test_metrics_and_recordings_are_printed(folder: Path) -> None:
    """The output has the URL of the metrics, and the folder of the recordings."""
    printed = _printed(
        _load(folder, _FILE + '[metrics]\nlisten = "127.0.0.1:9790"\n[recording]\nfolder = "flights"\n')
    )
    text = "".join(printed.split())  # long lines are folded
    assert "metricshttp://127.0.0.1:9790/metrics" in text
    assert f"recordings{folder / 'flights'}(keeps1GBofthedisk" in text
    plain = _printed(_load(folder, _FILE))
    assert "recordings" not in plain
    assert "metrics" not in plain


def test_policy_shows_what_passes_and_what_does_not(folder: Path) -> None:
    """Whole groups share a line; then come the exceptions, and the rates as in the file."""
    text = _FILE.replace(
        'role = "swarm-member"', 'role = "swarm-member"\nallow_in = ["commands"]\nrate_out = { position = 2.5 }'
    ).replace("[2]", '[2]\ndeny_in = ["MAV_CMD_DO_FLIGHTTERMINATION"]\nmavlink1 = false')
    policy = _policies(_printed(_load(folder, text)))["drone1"]
    both, rest = policy.split(" no direction ")
    assert both == "both directions heartbeat, position"
    neither, rest = rest.split(" otherwise ")
    assert {"parameters", "mission-reads", "shell", "signing", "MAVLink 1"} <= set(neither.split(", "))
    assert "commands" not in neither.split(", ")
    assert "commands all (by command: COMMAND_LONG," in rest
    assert "denied: MAV_CMD_DO_FLIGHTTERMINATION, -" in rest.replace("commands by number ", "")
    assert "MAV_CMD_DO_AUX_FUNCTION" in rest
    assert "rates HEARTBEAT 5/s, position 50/s, VFR_HUD position 2.5/s 250/s" in rest


@pytest.mark.parametrize("role", ROLES)
def test_plain_output_has_a_hundred_columns(folder: Path, role: str) -> None:
    """The table of every role fits without horizontal scrolling."""
    printed = _printed(_load(folder, _FILE.replace('role = "observer"', f'role = "{role}"')))
    assert max(map(len, printed.splitlines())) <= 100
    assert "…" not in printed


def test_plain_output_is_plain(folder: Path) -> None:
    """Without a terminal there are no control sequences, no trailing spaces, and no narrow columns."""
    printed = _printed(_load(folder, _FILE))
    assert "\x1b" not in printed
    assert all(line == line.rstrip() for line in printed.splitlines())
    assert "10.13.0.2:5790" in printed


def test_terminal_output_fits_the_terminal(folder: Path) -> None:
    """On 80 columns with colours, cells are folded and not cut."""
    console = Console(file=io.StringIO(), width=80, force_terminal=True, color_system="standard")
    with console.capture() as captured:
        print_topology(_load(folder, _FILE), console)
    plain = Console(file=io.StringIO(), width=80)
    with plain.capture() as uncoloured:
        plain.print(describe(_load(folder, _FILE)))
    assert "\x1b[" in captured.get()
    assert max(map(len, uncoloured.get().splitlines())) <= 80
    assert "…" not in uncoloured.get()


def test_no_secret_is_printed(folder: Path) -> None:
    """The output has neither the private key nor a PSK, in any encoding."""
    printed = _printed(_load(folder, _FILE))
    for name in ("drone0.key", "pair.psk"):
        text = (folder / name).read_text().strip()
        assert text not in printed
        assert text[:8] not in printed
        assert keys.decode_key(text).hex() not in printed


def test_standard_output_is_the_default(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without a console, the text goes to standard output, as into a file."""
    config = _load(folder, _FILE)
    print_topology(config)
    assert capsys.readouterr().out == _printed(config)


@pytest.mark.parametrize(
    ("section", "title"),
    [
        pytest.param('[[relay]]\naddresses = ["relay.example.org:5790"]', "Relays", id="relay"),
        pytest.param(
            "[relay_server]\nenabled = true\n[[member]]", "Members of this relay, and their limits", id="member"
        ),
    ],
)
def test_key_of_a_relay_or_member_is_printed_whole(folder: Path, section: str, title: str) -> None:
    """The user compares it with what the other machine printed. What may be a private key is not printed."""
    public, private = keys.public_key_text(keys.generate_private_key()), keys.generate_private_key()
    for key in (public, private):
        printed = _printed(_load(folder, f'{_FILE}{section}\nname = "vps"\npublic_key = "{key}"\n'))
        rows = printed.partition(title)[2]
        assert (public in rows) is (key == public)
        assert ("(private?)" in rows) is (key == private)
        assert private[:8] not in printed
