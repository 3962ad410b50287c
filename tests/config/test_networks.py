"""``[[network]]``, the addresses that name one, and the redundancy of a link."""

from __future__ import annotations

import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from uavlinkd.config import Config, ConfigError, NetworkConfig, PeerAddress, keys
from uavlinkd.config.changes import compare
from uavlinkd.config.load import load_config
from uavlinkd.config.network_rules import used_networks
from uavlinkd.core.constants import PROBE_IDLE_S
from uavlinkd.core.settings import Redundancy
from uavlinkd.endpoints.url import SerialUrl
from uavlinkd.system.addresses import Address

Load = Callable[..., Config]
Refused = Callable[..., dict[str, str]]
LTE = NetworkConfig("lte", interface="wwan0", metered=True, budget_bits_s=256_000)
MESH = NetworkConfig("mesh", address="10.13.0.5")
_LTE = '[[network]]\nname = "lte"\ninterface = "wwan0"\nmetered = true\nbudget_bits_s = 256000\n'
_MESH = '[[network]]\nname = "mesh"\naddress = "10.13.0.5"\n'
_EXACT = '{ address = "10.13.0.9:5790", network = "mesh" }'


@pytest.fixture
def load(tmp_path: Path) -> Load:
    """Loads a file with these networks, addresses of the peer, and other keys."""
    keys.write_secret_file(tmp_path / "drone0.key", keys.generate_private_key())
    public = keys.public_key_text(keys.generate_private_key())

    def loading(
        networks: str = _LTE + _MESH,
        addresses: str = f'["203.0.113.7:5790", {_EXACT}]',
        *,
        listen: str = '["0.0.0.0:5790"]',
        link: str = "",
        peer: str = "",
    ) -> Config:
        path = tmp_path / "drone0.toml"
        path.write_text(
            f'name = "drone0"\nprivate_key_file = "drone0.key"\nlisten = {listen}\n[link]\n{link}\n{networks}'
            f'[[endpoint]]\nname = "autopilot"\nurl = "udpin:127.0.0.1:14550"\n'
            f'[[peer]]\nname = "drone1"\npublic_key = "{public}"\naddresses = {addresses}\n'
            f'role = "vehicle"\nsystem_ids = [2]\n{peer}\n'
        )
        return load_config(path, {})

    return loading


@pytest.fixture
def refused(load: Load) -> Refused:
    """Loads a file that has problems; returns the messages by key."""

    def refusing(*arguments: str, **options: str) -> dict[str, str]:
        with pytest.raises(ConfigError) as caught:
            load(*arguments, **options)
        return {problem.key: problem.message for problem in caught.value.problems}

    return refusing


def test_networks_and_their_addresses_are_read(load: Load) -> None:
    """An address may name a network; the others are for each network of their family."""
    config = load()
    assert config.networks == (LTE, MESH)
    assert config.warnings == ()
    anywhere, exact = config.peers[0].addresses
    assert (anywhere, exact) == (
        PeerAddress(Address("203.0.113.7", 5790)),
        PeerAddress(Address("10.13.0.9", 5790), "mesh"),
    )
    assert (str(anywhere), str(exact)) == ("203.0.113.7:5790", "10.13.0.9:5790 on mesh")
    assert list(used_networks(config.networks, anywhere)) == [LTE, MESH]
    assert list(used_networks(config.networks, exact)) == [MESH]
    assert (LTE.exit, MESH.exit) == ("interface wwan0", "address 10.13.0.5")
    assert load("", '["10.13.0.9:5790"]').networks == ()


@pytest.mark.parametrize(
    ("address", "used"),
    [
        ("drone1.test", [LTE, MESH]),
        ("2001:db8::1", [LTE]),
        ("fe80::1%wwan0", [LTE]),
        ("fe80::1%wlan0", []),
        ("fe80::1%7", [LTE]),  # which interface has this number shows only on the machine
    ],
)
def test_address_is_used_on_networks_that_can_have_it(address: str, used: list[NetworkConfig]) -> None:
    """By family, and by the interface of a link-local address."""
    assert list(used_networks([LTE, MESH], PeerAddress(Address(address, 5790)))) == used


def test_families_of_a_network() -> None:
    """An interface may have both, an address has one."""
    v6 = NetworkConfig("v6", address="2001:db8::5")
    assert LTE.families == (socket.AF_INET, socket.AF_INET6)
    assert (MESH.families, v6.families) == ((socket.AF_INET,), (socket.AF_INET6,))


@pytest.mark.parametrize(
    ("networks", "key", "says"),
    [
        (_LTE + _LTE.replace("wwan0", "wwan1"), "network[1].name (lte)", "the name of network[0] (lte) too"),
        (_LTE + _LTE.replace("lte", "b"), "network[1].interface (b)", "the interface of network[0] (lte) too"),
        (_MESH + _MESH.replace("mesh", "b"), "network[1].address (b)", "the address of network[0] (mesh) too"),
        (_LTE + 'address = "10.0.0.5"\n', "network[0].interface (lte)", "remove one of them"),
        ('[[network]]\nname = "lte"\n', "network[0].interface (lte)", 'write interface = "wwan0"'),
        ('[[network]]\ninterface = "wwan0"\n', "network[0].name", 'write name = "lte"'),
        (_LTE.replace("wwan0", "eth0:1"), "network[0].interface (lte)", "ip -brief link"),
        (_LTE.replace("wwan0", "more-than-15-bytes"), "network[0].interface (lte)", "ip -brief link"),
        (_LTE.replace('"wwan0"', "3"), "network[0].interface (lte)", "must be text"),
        (_LTE.replace("true", "1"), "network[0].metered (lte)", "write metered = true"),
        (_LTE.replace("256000", "999"), "network[0].budget_bits_s (lte)", "write 1000 or more"),
        (_LTE + "meterd = true\n", "network[0].meterd (lte)", "did you mean metered?"),
        (_MESH.replace("10.13.0.5", "0.0.0.0"), "network[0].address (mesh)", 'interface = "wlan0"'),
        (_MESH.replace("10.13.0.5", "10.13.0.5:5790"), "network[0].address (mesh)", "without a port"),
        (_MESH.replace("10.13.0.5", "drone0.test"), "network[0].address (mesh)", "not an IP address"),
        (_MESH.replace("10.13.0.5", "224.0.0.1"), "network[0].address (mesh)", "multicast"),
        (_MESH.replace("10.13.0.5", "255.255.255.255"), "network[0].address (mesh)", "broadcast"),
        (_MESH.replace("10.13.0.5", "::ffff:10.13.0.5"), "network[0].address (mesh)", 'write "10.13.0.5"'),
        (_MESH.replace("10.13.0.5", "fe80::5"), "network[0].address (mesh)", 'write "fe80::5%wlan0"'),
    ],
)
def test_problem_of_a_network_is_named_with_what_to_write(
    refused: Refused, networks: str, key: str, says: str
) -> None:
    """One problem per mistake: no other follows from it."""
    problems = refused(networks, '["203.0.113.7:5790"]')
    assert set(problems) == {key}
    assert says in problems[key]


@pytest.mark.parametrize(
    ("networks", "addresses", "says"),
    [
        (_LTE, f"[{_EXACT}]", 'a network for 10.13.0.9:5790 that this file does not have: write one of "lte"'),
        ("", f"[{_EXACT}]", "add a [[network]] of that name, or write the address alone"),
        (_MESH, '["[2001:db8::1]:5790"]', "the networks of this file have no address of IPv6"),
        (_LTE + _MESH, f"[{_EXACT.replace('10.13.0.9', '[2001:db8::1]')}]", "that network has no address of IPv6"),
        (_LTE, '["[fe80::1%wlan0]:5790"]', "valid on the interface wlan0 only"),
        (_MESH, f'["10.13.0.9:5790", {_EXACT}]', "with a network and without"),
        (_MESH, f"[{_EXACT}, {_EXACT}]", "names an address twice"),
    ],
)
def test_problem_of_an_address_is_named(refused: Refused, networks: str, addresses: str, says: str) -> None:
    """An address that no network can reach is an error, not a warning."""
    (message,) = refused(networks, addresses).values()
    assert says in message


@pytest.mark.parametrize(
    ("written", "says"),
    [
        ('{ address = "10.13.0.9:5790" }', "must have two keys"),
        ('{ address = "10.13.0.9:5790", network = "mesh", metered = true }', "must have two keys"),
        ('{ address = "0.0.0.0:5790", network = "mesh" }', "every address of this machine"),
        ('{ address = "10.13.0.9", network = "mesh" }', "has no port"),
        ('{ address = 5790, network = "mesh" }', "must be text"),
        ('{ address = "10.13.0.9:5790", network = "not a name" }', "must be a name"),
        ("5790", "must be text"),
    ],
)
def test_problem_of_a_table_in_addresses_is_named(refused: Refused, written: str, says: str) -> None:
    """With the place of the entry."""
    problems = refused(_MESH, f"[{written}]")
    assert says in problems["peer[0].addresses[0] (drone1)"]


@pytest.mark.parametrize(
    ("key", "says"),
    [('interface = "wlan0"', 'a [[network]] "mesh" with this'), ('address = "10.0.0.1:5790"', "addresses, a list")],
)
def test_key_of_a_network_in_a_peer_is_explained(refused: Refused, key: str, says: str) -> None:
    """Where it belongs."""
    (message,) = refused(peer=key).values()
    assert says in message


@pytest.mark.parametrize(
    ("listen", "says"),
    [
        ('["10.13.0.5:5790"]', 'write "0.0.0.0:5790"'),
        ('["[::1]:5790"]', 'write "[::]:5790"'),
        ('["0.0.0.0:5790", "0.0.0.0:5791"]', "two ports for IPv4"),
    ],
)
def test_listen_has_only_ports_where_there_are_networks(refused: Refused, listen: str, says: str) -> None:
    """The networks decide where the daemon listens, so a host there would have no effect."""
    assert says in refused(listen=listen)["listen"]


def test_listen_of_both_families_is_accepted(load: Load) -> None:
    """One port for each; also none, to initiate only. No warning about the families of `listen`."""
    assert load(listen='["0.0.0.0:5790", "[::]:5791"]').warnings == ()
    assert load(addresses='["[2001:db8::1]:5790"]').warnings == ()
    assert load(listen="[]").listen == ()


def test_address_of_two_peers_is_one_address_only_on_one_network(load: Load) -> None:
    """Two networks may both have a machine with the same private address."""
    public = keys.public_key_text(keys.generate_private_key())

    def warnings(network: str) -> tuple[str, ...]:
        other = (
            f'[[peer]]\nname = "drone2"\npublic_key = "{public}"\nrole = "vehicle"\nsystem_ids = [3]\n'
            f'addresses = [{{ address = "10.13.0.9:5790", network = "{network}" }}]\n'
        )
        return load(peer=other).warnings

    assert warnings("lte") == ()
    (warning,) = warnings("mesh")
    assert "share the address 10.13.0.9:5790" in warning


def test_redundancy_is_inherited(load: Load) -> None:
    """Critical frames by default; a peer's own value comes before that of [link]."""
    assert load().peers[0].settings.link.redundancy is Redundancy.CRITICAL
    assert load(link='redundancy = "all"').peers[0].settings.link.redundancy is Redundancy.ALL
    own = load(link='redundancy = "all"', peer='redundancy = "none"')
    assert own.peers[0].settings.link.redundancy is Redundancy.NONE


def test_interval_of_probes_along_idle_paths_is_read(load: Load, refused: Refused) -> None:
    """In seconds; 0 for none."""
    assert load().peers[0].settings.link.idle_probe_s == PROBE_IDLE_S
    assert load(peer="idle_probe_s = 0").peers[0].settings.link.idle_probe_s == 0
    assert "write 0 or more" in refused(link="idle_probe_s = -1")["link.idle_probe_s"]


def test_other_redundancy_is_refused(refused: Refused) -> None:
    """The message lists the values."""
    assert "'critical', 'all' or 'none'" in refused(link='redundancy = "double"')["link.redundancy"]


def test_reload_changes_addresses_and_no_network(load: Load) -> None:
    """The session continues with other addresses. Networks need a restart, and the message says so."""
    old = load()
    changes = compare(old, load(addresses=f"[{_EXACT}]"))
    assert [peer.name for peer in changes.changed_peers] == ["drone1"]
    assert (changes.added_peers, changes.removed_peers) == ((), ())
    changes = compare(old, load(peer='redundancy = "all"'))  # as every other key of [link]
    assert changes.removed_peers == ("drone1",)
    with pytest.raises(ConfigError) as caught:
        compare(old, load(_LTE + _MESH.replace("0.5", "0.6")))
    (problem,) = caught.value.problems
    assert (problem.key, "restart" in problem.message) == ("network", True)


_SIK = '[[network]]\nname = "sik"\nserial = "/dev/ttyUSB0:57600"\n'
_BY_SIK = '[{ network = "sik" }]'


def test_serial_network_beside_others(load: Load) -> None:
    """Only the peer at its other end uses it, and it has no addresses."""
    config = load(_LTE + _SIK, '["203.0.113.7:5790", { network = "sik" }]')
    lte, sik = config.networks
    assert sik.serial == SerialUrl("/dev/ttyUSB0", 57600)
    assert (sik.air_bits_s, sik.budget_bits_s, sik.families) == (24_000, 9_600, ())
    assert sik.exit == "serial /dev/ttyUSB0 at 57600 baud"
    by_lte, by_sik = config.peers[0].addresses
    assert (by_sik.is_serial, str(by_sik), str(by_sik.address)) == (True, "serial network sik", "serial")
    assert list(used_networks(config.networks, by_lte)) == [lte]
    assert list(used_networks(config.networks, by_sik)) == [sik]
    assert config.has_ip_networks
    assert config.warnings == ()


def test_serial_network_alone_leaves_ip_as_it_is(load: Load) -> None:
    """Names and addresses are reached by the kernel's routes, and `listen` may name an address."""
    config = load(_SIK, '["gcs.example.org:5790", { network = "sik" }]', listen='["10.0.0.5:5790"]')
    assert not config.has_ip_networks
    assert list(used_networks(config.networks, config.peers[0].addresses[0])) == []
    assert load(_SIK, _BY_SIK, listen="[]").networks == config.networks


@pytest.mark.parametrize(
    ("baud", "written", "air", "sent"),
    [
        (57600, "", 24_000, 9_600),
        (9600, "", 3_840, 1_536),
        (57600, "air_bits_s = 4000\n", 4_000, 1_600),
        (921600, "air_bits_s = 200000\n", 200_000, 80_000),
    ],
)
def test_rate_of_the_radio(load: Load, baud: int, written: str, air: int, sent: int) -> None:
    """The default follows the baud rate; each end sends 40 %."""
    (sik,) = load(_SIK.replace("57600", str(baud)) + written, _BY_SIK).networks
    assert (sik.air_bits_s, sik.budget_bits_s) == (air, sent)


@pytest.mark.parametrize(
    ("networks", "addresses", "key", "message"),
    [
        (_SIK.replace(":57600", ""), _BY_SIK, "network[0].serial (sik)", "write /dev/ttyUSB0:57600"),
        (_SIK.replace("/dev", "serial:x"), _BY_SIK, "network[0].serial (sik)", "needs a device and a baud rate"),
        (_SIK.replace("57600", "115200"), _BY_SIK, "network[0].air_bits_s (sik)", "is missing: at 115200 baud"),
        (_SIK + "air_bits_s = 250000\n", _BY_SIK, "network[0].air_bits_s (sik)", "more than a line of 57600 baud"),
        (_LTE + "air_bits_s = 4000\n", '["10.0.0.9:5790"]', "network[0].air_bits_s (lte)", "budget_bits_s instead"),
        (_SIK + "metered = true\n", _BY_SIK, "network[0].metered (sik)", "leave it out"),
        (_SIK + "budget_bits_s = 4000\n", _BY_SIK, "network[0].budget_bits_s (sik)", "write air_bits_s"),
        (_SIK + 'interface = "wwan0"\n', _BY_SIK, "network[0].serial (sik)", "write two networks"),
        (_SIK + 'address = "10.0.0.5"\n', _BY_SIK, "network[0].serial (sik)", "write two networks"),
        (_SIK, '["sik"]', "peer[0].addresses[0] (drone1)", 'end of a serial network is { network = "sik" }'),
        (_SIK, "[]", "network[0].serial (sik)", 'addresses = [{ network = "sik" }]'),
        (_SIK + _LTE, '[{ network = "lte" }]', "peer[0].addresses (drone1)", "or the serial network"),
        (_SIK, '[{ address = "10.0.0.9:1", network = "sik" }]', "peer[0].addresses (drone1)", "has no addresses"),
        (
            _SIK + _SIK.replace('"sik"', '"two"'),
            '[{ network = "sik" }, { network = "two" }]',
            "network[1].serial (two)",
            "the device of network[0] (sik) too",
        ),
    ],
)
def test_problems_of_serial_networks(refused: Refused, networks: str, addresses: str, key: str, message: str) -> None:
    """Each with the key and what to write."""
    problems = refused(networks, addresses)
    assert message in problems.get(key, ""), problems


def test_line_has_one_peer(refused: Refused) -> None:
    """Another peer that names the same serial network is refused, and so is an endpoint on the device."""
    public = keys.public_key_text(keys.generate_private_key())
    second = f'[[peer]]\nname = "drone2"\npublic_key = "{public}"\naddresses = {_BY_SIK}\nrole = "vehicle"\n'
    problems = refused(_SIK, _BY_SIK, peer="\n" + second + "system_ids = [3]")
    assert "whose other end is peer[0] (drone1): a line has one peer" in problems["peer[1].addresses (drone2)"]
    endpoint = '[[endpoint]]\nname = "other"\nurl = "serial:/dev/ttyUSB0:115200"\n'
    problems = refused(_SIK, _BY_SIK, peer="\n" + endpoint)
    assert "the device of endpoint[1] (other) too" in problems["network[0].serial (sik)"]
