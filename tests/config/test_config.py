"""The configuration: the meaning of a valid file, and its warnings."""

from __future__ import annotations

import dataclasses
import pickle
import re
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import all as mavlink

from tests.config.files import (
    BY_MESH,
    BY_SIK,
    ENDPOINT,
    GOOD,
    HEAD,
    KEY,
    LTE,
    MESH,
    OTHER_PEER,
    PEER,
    SIK,
    URL,
    link,
    load,
    member,
    networks,
    relay,
    relays,
)
from tests.samples import heartbeat
from uavlinkd.config import keys
from uavlinkd.config.load import load_config
from uavlinkd.config.model import ConfigError, NetworkConfig, PeerAddress
from uavlinkd.io.url import SerialUrl
from uavlinkd.mavlink.egress.peer_egress import EgressSettings
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.settings import Link, Redundancy, Timers
from uavlinkd.protocol.suites import SUITES_BY_NAME
from uavlinkd.system.addresses import Address


def test_ten_lines_are_enough(tmp_path: Path) -> None:
    """Other keys have the specification's defaults; the key files are loaded."""
    config = load(tmp_path, GOOD)
    private = (tmp_path / "drone0.key").read_text()
    assert (config.name, config.path) == ("drone0", tmp_path / "drone0.toml")
    assert keys.encode_key(config.private_key.reveal()) == private.strip()
    assert keys.encode_key(config.public_key) == keys.public_key_text(private)
    assert config.listen == (Address("0.0.0.0", 5790),)
    assert [(endpoint.name, str(endpoint.url)) for endpoint in config.endpoints] == [("autopilot", URL)]
    (peer,) = config.peers
    assert (peer.name, peer.settings.public_key) == ("drone1", keys.decode_key(KEY["drone1"]))
    assert peer.addresses == (PeerAddress(Address("10.13.0.2", 5790)),)
    assert (peer.settings.link, peer.settings.psk, peer.egress) == (Link(), None, EgressSettings())
    assert (config.log.level, config.log.format, config.relays_frames) == ("info", "auto", False)
    assert (config.control_socket, config.networks) == (None, ())
    assert config.warnings == ()


def test_every_section_is_read(tmp_path: Path) -> None:
    """File names are relative to the file, and the working directory does not matter."""
    config = load(
        tmp_path,
        f'control_socket = "a.sock"\n{HEAD}{ENDPOINT}radio_status = true\nstatus_text = true\n{PEER}[routing]\n'
        'relay = true\n[log]\nlevel = "debug"\nformat = "json"\n',
    )
    assert config.control_socket == tmp_path / "a.sock"
    assert (config.endpoints[0].radio_status, config.endpoints[0].status_text) == (True, True)
    assert config.relays_frames
    assert (config.log.level, config.log.format) == ("debug", "json")
    assert config.warnings == ()
    assert load(tmp_path, f'control_socket = "/run/a.sock"\n{GOOD}').control_socket == Path("/run/a.sock")


def test_peer_inherits_key_by_key(tmp_path: Path) -> None:
    """A peer's own keys come before those of [link], and those before the defaults."""
    config = load(
        tmp_path,
        link(
            "suites = ['ffdhe2048', 'x25519']\ntag_bits = 96\nrekey_after_s = 60\nbudget_bits_s = 1000\n"
            "coalesce_s = 0.5\nredundancy = 'all'"
        )
        + "tag_bits = 128\nconfidential = true\nkeepalive_s = 20\npsk_file = 'pair.psk'\nmax_age_s = 60\n"
        + f"budget_bits_s = 1_000_000_000\nidle_probe_s = 0\n{OTHER_PEER}suites = ['mlkem768']\n"
        "max_envelope_bytes = 320\ncoalesce_s = 0\nredundancy = 'none'\n",
    )
    first, second = config.peers
    assert first.settings.link == Link(
        suites=(SUITES_BY_NAME["ffdhe2048"], SUITES_BY_NAME["x25519"]),
        confidential=True,
        tag_bytes=16,
        timers=Timers(rekey_after_s=60, keepalive_s=20),
        redundancy=Redundancy.ALL,
        idle_probe_s=0,
    )
    assert second.settings.link == Link(
        suites=(SUITES_BY_NAME["mlkem768"],),
        tag_bytes=12,
        max_envelope=c.MIN_ENVELOPE_LIMIT,
        timers=Timers(rekey_after_s=60),
        redundancy=Redundancy.NONE,
    )
    assert first.settings.psk is not None
    assert [peer.egress for peer in config.peers] == [
        EgressSettings(10**9, 0.5, 60.0),
        EgressSettings(1000, 0.0, 1.0),
    ]


@pytest.mark.parametrize("key", ["rekey_after_s", "reject_after_s", "retry_max_s", "keepalive_s", "lost_after_s"])
def test_every_timer_reaches_the_core(tmp_path: Path, key: str) -> None:
    """A key changes the core's setting of the same name, and ``lost_after_s`` the times before it in proportion."""
    expected = {key: getattr(Timers(), key) * 1.125}
    (peer,) = load(tmp_path, f"{GOOD}{key} = {expected[key]}\n").peers
    if key == "lost_after_s":
        expected |= {"echo_after_s": 1.125 * c.ECHO_AFTER_S, "handshake_after_s": 1.125 * c.HANDSHAKE_AFTER_S}
    assert peer.settings.link.timers == dataclasses.replace(Timers(), **expected)


@pytest.mark.parametrize(
    ("keys", "reject_after_s", "coalesce_s"),
    [("reject_after_s = 9", 123.0, 0.0), ("coalesce_s = 0.5\nmax_age_s = 0.2", 180.0, 0.1)],
)
def test_key_that_needs_another_is_kept_in_proportion(
    tmp_path: Path, keys: str, reject_after_s: float, coalesce_s: float
) -> None:
    """Old keys are kept until new ones can be made, and no frame becomes too old by waiting for others."""
    (peer,) = load(tmp_path, f"{GOOD}{keys}\n").peers
    assert (peer.settings.link.timers.reject_after_s, peer.egress.coalesce_s) == (reject_after_s, coalesce_s)


def test_freshness_is_verified_within_a_share_of_the_budget(tmp_path: Path) -> None:
    """Each second, or as often as a twentieth of the budget carries a request and its reply over IPv6.

    A change of the budget keeps the link.
    """
    budgets = (4000, 8000, 1_000_000)
    slow, other, fast = (load(tmp_path, f"{GOOD}budget_bits_s = {budget}\n").peers[0].settings for budget in budgets)
    assert slow.link.verify_interval_s == 8 * (13 + 17 + 2 * (7 + 16 + 48)) / (0.05 * 4000)
    assert slow.link.verify_interval_s != other.link.verify_interval_s
    assert slow == other
    assert fast.link.verify_interval_s == Link().verify_interval_s == 1.0


def test_policy_reaches_the_gate(tmp_path: Path) -> None:
    """A policy limits a peer or an endpoint to its systems and messages; an endpoint without one sends anything."""
    tablet_keys = 'system_ids = [254]\nrole = "observer"\n'
    tablet_section = ENDPOINT.replace("autopilot", "tablet").replace("14550", "14551") + tablet_keys
    config = load(tmp_path, f"{GOOD}rate_in = {{ HEARTBEAT = 1 }}\n{tablet_section}")
    peer = config.peers[0].make_policy()
    checked = [peer.incoming.check(heartbeat(system=2), 0.0) for _ in range(3)]
    assert checked == [None, None, Refusal.RATE_LIMITED]
    assert peer.incoming.check(heartbeat(system=1), 0.0) is Refusal.FOREIGN_SYSTEM
    assert (
        peer.incoming.check(heartbeat(system=2, kind=mavlink.MAV_TYPE_GCS), 0.0) is Refusal.GROUND_STATION_NOT_ALLOWED
    )
    autopilot, tablet = (endpoint.make_policy() for endpoint in config.endpoints)
    assert autopilot.incoming.check(heartbeat(system=1), 0.0) is None
    assert tablet.incoming.check(heartbeat(system=254), 0.0) is Refusal.MESSAGE_NOT_ALLOWED
    assert tablet.incoming.check(heartbeat(system=2), 0.0) is Refusal.FOREIGN_SYSTEM
    again = config.peers[0].make_policy()  # with its own counters, and its whole rate
    assert again.incoming.check(heartbeat(system=2), 0.0) is None
    assert not again.incoming.refused


def test_policy_data_is_compared_and_never_changed(tmp_path: Path) -> None:
    """On reload the daemon detects whether a peer's policy has changed. TOML has two ways to write a table."""
    text = f'{GOOD}allow_in = ["PING"]\n'
    first, second, other = (
        load(tmp_path, text + rates).peers[0].policy
        for rates in ("rate_in = { PING = 1 }\n", "[peer.rate_in]\nPING = 1\n", "rate_in = { PING = 2 }\n")
    )
    assert first == second
    assert first != other
    with pytest.raises(TypeError):
        first["role"] = "operator"  # type: ignore[index]
    with pytest.raises(TypeError):
        first["rate_in"]["PING"] = 9  # type: ignore[index]
    assert first["allow_in"] == ("PING",)


def test_nothing_of_a_configuration_changes_or_shows_a_secret(tmp_path: Path) -> None:
    """It is frozen, prints without its keys, and cannot be pickled with them."""
    config = load(tmp_path, f'{GOOD}psk_file = "pair.psk"\n')
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.name = "other"  # type: ignore[misc]
    for name in ("drone0.key", "pair.psk"):
        text = (tmp_path / name).read_text().strip()
        for shown in (text, repr(keys.decode_key(text)), keys.decode_key(text).hex()):
            assert shown not in repr(config)
    with pytest.raises(TypeError):
        pickle.dumps(config)


@pytest.mark.parametrize("prefix", ["", "keys_"])
def test_keys_come_from_systemd_where_there_is_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, prefix: str
) -> None:
    """A file name may name a credential. The environment is an argument, not that of the process."""
    credentials = tmp_path / "credentials"
    credentials.mkdir()
    for name in ("drone0.key", "pair.psk"):
        keys.write_secret_file(credentials / f"{prefix}{name}", keys.generate_psk())
        (credentials / f"{prefix}{name}").chmod(0o440)  # as systemd's access list shows
    path = tmp_path / "drone0.toml"
    path.write_bytes(b"\xef\xbb\xbf" + f'{GOOD}psk_file = "pair.psk"\n'.encode())  # some editors write such a mark
    config = load_config(path, {"CREDENTIALS_DIRECTORY": str(credentials)})
    private = (credentials / f"{prefix}drone0.key").read_text().strip()
    assert keys.encode_key(config.private_key.reveal()) == private
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(credentials))
    with pytest.raises(ConfigError, match="no such file"):
        load_config(path, {})


# Networks.

_LTE = NetworkConfig("lte", interface="wwan0", metered=True, budget_bits_s=256_000)
_MESH = NetworkConfig("mesh", address="10.13.0.5")


def test_networks_and_their_addresses_are_read(tmp_path: Path) -> None:
    """An address may name a network; the others are for each network of their family."""
    config = load(tmp_path, networks(LTE + MESH, f'["203.0.113.7:5790", {BY_MESH}]'))
    assert config.networks == (_LTE, _MESH)
    assert config.warnings == ()
    anywhere, exact = config.peers[0].addresses
    assert exact == PeerAddress(Address("10.13.0.9", 5790), "mesh")
    assert (str(anywhere), str(exact)) == ("203.0.113.7:5790", "10.13.0.9:5790 on mesh")
    assert (_LTE.exit, _MESH.exit) == ("interface wwan0", "address 10.13.0.5")


def test_serial_network_beside_others(tmp_path: Path) -> None:
    """Only the peer at its other end uses it, and it has no addresses."""
    config = load(tmp_path, networks(LTE + SIK, '["203.0.113.7:5790", { network = "sik" }]'))
    lte, sik = config.networks
    assert sik.serial == SerialUrl("/dev/ttyUSB0", 57600)
    assert sik.exit == "serial /dev/ttyUSB0 at 57600 baud"
    by_lte, by_sik = config.peers[0].addresses
    assert (by_sik.is_serial, str(by_sik), str(by_sik.address)) == (True, "serial network sik", "serial")
    assert (lte.serial, by_lte.is_serial) == (None, False)
    assert config.has_ip_networks
    assert config.warnings == ()


@pytest.mark.parametrize(
    ("baud", "written", "air", "sent"),
    [
        (57600, "", 24_000, 9_600),
        (9600, "", 3_840, 1_536),
        (115200, "", 24_000, 9_600),
        (57600, "air_bits_s = 4000\n", 4_000, 1_600),
        (921600, "air_bits_s = 200000\n", 200_000, 80_000),
        (9600, "air_bits_s = 200000\n", 200_000, 7_680),
        (57600, "budget_bits_s = 2000\n", 24_000, 2_000),
    ],
)
def test_rate_of_the_radio(tmp_path: Path, baud: int, written: str, air: int, sent: int) -> None:
    """The default follows the baud rate; each end sends 40 %, and at most what its line and its budget allow."""
    (sik,) = load(tmp_path, networks(SIK.replace("57600", str(baud)) + written, BY_SIK)).networks
    assert (sik.air_bits_s, sik.budget_bits_s, sik.families) == (air, sent, ())


# Relays, and members of this one.


def test_peer_with_a_relay_needs_no_address(tmp_path: Path) -> None:
    """Neither does this daemon need to listen. By default a peer uses all relays. They have the suites of [link]."""
    config = load(tmp_path, relays('[link]\nsuites = ["ffdhe2048"]\n' + relay() + relay("b")))
    assert [one.name for one in config.relays] == ["vps", "b"]
    assert config.relays[0].settings.name == "relay vps"
    assert config.relays[0].settings.link.features & c.FEATURE_RECORDS
    assert config.relays[0].settings.link.suites[0].name == "ffdhe2048"
    assert config.relays[0].addresses == (PeerAddress(Address("relay.example.org", 5790)),)
    assert config.peers[0].relays == ("vps", "b")
    assert config.peers[0].is_called
    assert config.warnings == ()


def test_relay_needs_members_and_little_else(tmp_path: Path) -> None:
    """Members have the same limits, and the core's feature for records."""
    config = load(tmp_path, HEAD + member() + "[relay_server]\nmember_bits_s = 90_000\n")
    assert config.warnings == ()
    assert config.is_only_relay
    assert config.relay_server is not None
    (one,) = config.relay_server.members
    assert (one.name, one.most_peers, one.bits_s) == ("b", 256, 90_000)
    assert one.peer.link.features & c.FEATURE_RECORDS
    assert config.relay_server.bits_s == 10**10


# Warnings.

_TWO = GOOD + OTHER_PEER
_WARNED = [
    (GOOD.replace("127.0.0.1", "0.0.0.0"), r"plain MAVLink leaves this machine \(udpin:0\.0\.0\.0.*arm.*parameters"),
    (GOOD.replace("udpin:127.0.0.1", "tcp:10.0.0.9"), r"\(tcp:10\.0\.0\.9.*any sender.*write 127\.0\.0\.1$"),
    (
        GOOD.replace("127.0.0.1", "0.0.0.0").replace("[[peer]]", 'role = "observer"\n[[peer]]'),
        r"any sender.*send what its policy passes",
    ),
    (
        f'{GOOD}psk_file = "pair.psk"\n{OTHER_PEER}psk_file = "pair.psk"\n',
        "have the same PSK.*make one for each pair with `uavlinkd psk`",
    ),
    (_TWO.replace("swarm-member", "all"), r'^peer "drone1", peer "drone2": role = "all": it may send every message'),
    (GOOD.replace("[2]", '["all"]'), r'^peer "drone1": system_ids is "all"'),
    (GOOD.replace("[[peer]]", 'system_ids = "all"\n[[peer]]'), r'^endpoint "autopilot": system_ids is "all"'),
    (
        _TWO.replace("[2]", '["1-3"]').replace("[3]", "[1, 3, 4]"),
        r'^peer "drone1" and peer "drone2" may send as the same system 1, 3:',
    ),
    (
        GOOD.replace('14550"', '14550"\nsystem_ids = [2]'),
        r'^peer "drone1" and endpoint "autopilot" may send as the same system 2:',
    ),
    (
        _TWO.replace("swarm-member", "vehicle") + "[routing]\nrelay = true\n",
        r'relay = true.*"drone1", peer "drone2".*writes to another vehicle.*accept only the operator.s system_ids$',
    ),
    (relays(relay()).replace("confidential = true", ""), "its owner cannot alter the frames, but can read them"),
]


@pytest.mark.parametrize(("text", "says"), _WARNED, ids=[says for _, says in _WARNED])
def test_warning_is_given_once(tmp_path: Path, text: str, says: str) -> None:
    """One sentence for each case, and the configuration is valid."""
    (warning,) = load(tmp_path, text).warnings
    assert re.search(says, warning)


@pytest.mark.parametrize(
    "text",
    [
        *(
            f"{GOOD}{line}\n"
            for line in (
                *("tag_bits = 96", "max_envelope_bytes = 1452", "suites = ['ffdhe8192']"),
                *("budget_bits_s = 1000", "[routing]\nrelay = true", 'allow_in = ["commands"]'),
                '[[endpoint]]\nname = "companion"\nurl = "tcp:127.0.0.1:5760"\nsystem_ids = [1]\nrole = "vehicle"',
            )
        ),
        relays(relay(), 'relays = []\naddresses = ["10.13.0.2:5790"]', HEAD).replace("confidential = true", ""),
    ],
)
def test_no_warning_without_a_reason(tmp_path: Path, text: str) -> None:
    """The last value before each warning, and unusual files that are right."""
    assert load(tmp_path, text).warnings == ()
