"""``[[relay]]``, and which peers use which relays."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable
from pathlib import Path

import pytest

from uavlinkd.config import Config, ConfigError, PeerAddress, keys
from uavlinkd.config.changes import compare
from uavlinkd.config.load import load_config
from uavlinkd.core import constants as c
from uavlinkd.system.addresses import Address

KEY = {
    name: keys.public_key_text(b64encode(bytes((number,)) * 32).decode())
    for number, name in enumerate(("drone1", "vps", "b", "c", "d"), 1)
}
"""The same in every worker: they are parts of the names of tests."""

PREVIOUS = f'previous_public_key = "{KEY["vps"]}"'
PSK = 'psk_file = "pair.psk"'
MEMBER = f'[relay_server]\nenabled = true\n[[member]]\nname = "b"\npublic_key = "{KEY["b"]}"\n'

Load = Callable[..., Config]


def relay(name: str = "vps", *, key: str = "", addresses: str = "", more: str = "") -> str:
    """A section."""
    at = addresses or f'["{"relay" if name == "vps" else name}.example.org:5790"]'
    return f'[[relay]]\nname = "{name}"\npublic_key = "{key or KEY[name]}"\naddresses = {at}\n{more}\n'


@pytest.fixture
def load(tmp_path: Path) -> Load:
    """Loads a file with these relays, and other keys in the section of its peer."""
    keys.write_secret_file(tmp_path / "drone0.key", keys.generate_private_key())

    def loading(relays: str = relay(), peer: str = "", link: str = "confidential = true", top: str = "") -> Config:
        path = tmp_path / "drone0.toml"
        path.write_text(
            f'name = "drone0"\nprivate_key_file = "drone0.key"\n{top}\n[link]\n{link}\n{relays}\n'
            f'[[endpoint]]\nname = "autopilot"\nurl = "udpin:127.0.0.1:14550"\n'
            f'[[peer]]\nname = "drone1"\npublic_key = "{KEY["drone1"]}"\nrole = "vehicle"\nsystem_ids = [2]\n{peer}\n'
        )
        return load_config(path, {})

    return loading


def test_peer_with_a_relay_needs_no_address(load: Load) -> None:
    """Neither does this daemon need to listen. By default a peer uses all relays."""
    config = load(relay() + relay("b"))
    assert [one.name for one in config.relays] == ["vps", "b"]
    assert config.relays[0].settings.name == "relay vps"
    assert config.relays[0].settings.link.features & c.FEATURE_RECORDS
    assert config.relays[0].addresses == (PeerAddress(Address("relay.example.org", 5790)),)
    assert config.peers[0].relays == ("vps", "b")
    assert config.peers[0].is_called
    assert config.warnings == ()


@pytest.mark.parametrize(("written", "used"), [('["b"]', ("b",)), ('["b", "vps"]', ("vps", "b")), ("[]", ())])
def test_peer_uses_the_relays_that_it_names(load: Load, written: str, used: tuple[str, ...]) -> None:
    """In the order of the file."""
    config = load(relay() + relay("b"), f'relays = {written}\naddresses = ["10.13.0.2:5790"]')
    assert config.peers[0].relays == used


def test_relay_inherits_the_suites(load: Load) -> None:
    """Otherwise a recording of the handshakes with it would be the weakest part."""
    config = load(link='confidential = true\nsuites = ["ffdhe2048"]')
    assert config.relays[0].settings.link.suites[0].name == "ffdhe2048"


def test_owner_of_the_relay_could_read_frames(load: Load) -> None:
    """The file says so, unless the link is confidential or uses no relay."""
    (warning,) = load(link="").warnings
    assert "the owner of the relay cannot alter their frames, but can read them" in warning
    assert load(link="", peer='relays = []\naddresses = ["10.13.0.2:5790"]').warnings == ()


@pytest.mark.parametrize(
    ("relays", "peer", "key", "says"),
    [
        (relay() + relay("b") + relay("c") + relay("d"), "", "relay", "at most 3"),
        (relay() + relay("vps", key=KEY["b"]), "", "relay[1].name (vps)", "the name of relay[0] (vps) too"),
        (relay() + relay("b", key=KEY["vps"]), "", "relay[1].public_key (b)", "each relay has its own"),
        (relay(), PREVIOUS, "peer[0].previous_public_key (drone1)", "is the key of relay[0] (vps)"),
        (relay(more=PREVIOUS), "", "relay[0].previous_public_key (vps)", "is its current key"),
        (
            relay("b", more=PREVIOUS) + relay("c", more=PREVIOUS),
            "",
            "relay[1].previous_public_key (c)",
            "of relay[0]",
        ),
        (relay(key=KEY["drone1"], more=PSK), "", "relay[0].psk_file (vps)", "because peer[0] (drone1) has the same"),
        (relay(key=KEY["drone1"], more=PREVIOUS), "", "relay[0].previous_public_key (vps)", "write it there only"),
        (relay(key=KEY["drone1"], addresses="[]"), "", "relay[0].addresses (vps)", "a relay never initiates"),
        (relay(key=KEY["drone1"]), 'relays = ["vps"]', "peer[0].relays (drone1)", "which has this peer's key"),
        (relay(key=KEY["b"], more=MEMBER), "", "relay[0].public_key (vps)", "the key of member[0] (b) too"),
        (relay(addresses="[]"), "", "relay[0].addresses (vps)", "a relay never initiates"),
        (relay(addresses='[{ network = "sik" }]'), "", "relay[0].addresses (vps)", "reached over IP"),
        (
            relay() + relay("b", addresses='["b.example.org:5790", "relay.example.org:5790"]'),
            "",
            "relay[1].addresses (b)",
            "relay.example.org:5790, an address of relay[0] (vps) too, which has another key",
        ),
        (relay(more='address = "1.2.3.4:5790"'), "", "relay[0].address (vps)", "write addresses, a list"),
        (relay(key="abc"), "", "relay[0].public_key (vps)", "what `uavlinkd pubkey` prints there"),
        (relay(more="mtu = 1"), "", "relay[0].mtu (vps)", "is not known"),
        (relay(), 'relays = ["other"]', "peer[0].relays (drone1)", 'write one of "vps"'),
        ("", 'relays = ["vps"]', "peer[0].relays (drone1)", "add a [[relay]] of that name"),
        (relay(), "relays = []", "peer[0].addresses (drone1)", "and remove relays = []"),
    ],
)
def test_problem_is_named_with_what_to_write(load: Load, relays: str, peer: str, key: str, says: str) -> None:
    """Each with its key."""
    with pytest.raises(ConfigError) as caught:
        load(relays, peer)
    assert any(problem.key == key and says in problem.message for problem in caught.value.problems)


def test_relay_without_a_peer_has_no_effect(tmp_path: Path) -> None:
    """A relay does not use others."""
    keys.write_secret_file(tmp_path / "vps.key", keys.generate_private_key())
    path = tmp_path / "vps.toml"
    members = "".join(f'[[member]]\nname = "{name}"\npublic_key = "{KEY[name]}"\n' for name in ("c", "drone1"))
    top = 'name = "vps"\nprivate_key_file = "vps.key"\nlisten = ["0.0.0.0:5790"]\n'
    path.write_text(f"{top}{members}{relay('b')}")
    assert load_config(path, {}).warnings == ('relay "b" has no effect: there is no [[peer]] that it leads to',)


def test_own_key_is_not_a_relay(load: Load, tmp_path: Path) -> None:
    """It would be this daemon."""
    own = keys.public_key_text((tmp_path / "drone0.key").read_text().strip())
    with pytest.raises(ConfigError, match="is this daemon's own key"):
        load(relay(key=own))


def test_relay_may_be_a_peer_too(load: Load) -> None:
    """Both have the addresses of the two sections. The peer is not reached along itself."""
    at = 'addresses = ["10.13.0.9:5790", "relay.example.org:5790"]'
    config = load(relay(key=KEY["drone1"]) + relay("b"), at)
    peer, (own, other) = config.peers[0], config.relays
    assert [str(address) for address in peer.addresses] == ["10.13.0.9:5790", "relay.example.org:5790"]
    assert own.addresses == peer.addresses
    assert (own.peer, other.peer) == ("drone1", None)
    assert peer.relays == ("b",)


@pytest.mark.parametrize(
    ("relays", "peer"),
    [
        pytest.param(relay(key=KEY["drone1"]), "", id="of-the-relay"),
        pytest.param(relay(key=KEY["drone1"], addresses="[]"), 'addresses = ["10.13.0.9:5790"]', id="of-the-peer"),
    ],
)
def test_addresses_of_a_peer_and_relay_are_written_once(load: Load, relays: str, peer: str) -> None:
    """In one of its sections. Its session carries records although it uses no relay."""
    config = load(relays, peer)
    assert config.peers[0].addresses == config.relays[0].addresses
    assert len(config.peers[0].addresses) == 1
    assert config.peers[0].relays == ()
    assert config.peers[0].settings.link.features & c.FEATURE_RECORDS


def test_relay_of_a_peer_is_reached_over_ip(load: Load) -> None:
    """The serial network is the peer's alone."""
    network = '[[network]]\nname = "sik"\nserial = "/dev/ttyUSB0:57600"\n'
    config = load(relay(key=KEY["drone1"]) + network, 'addresses = [{ network = "sik" }]')
    assert len(config.peers[0].addresses) == 2
    assert [str(address) for address in config.relays[0].addresses] == ["relay.example.org:5790"]


@pytest.mark.parametrize(
    ("section", "key"),
    [
        pytest.param(relay(key="OWN"), "relay[0].public_key (vps)", id="relay"),
        pytest.param(
            f'[relay_server]\nenabled = true\n[[member]]\nname = "b"\npublic_key = "{KEY["b"]}"\n'
            '[[member]]\nname = "c"\npublic_key = "OWN"\n',
            "member[1].public_key (c)",
            id="member",
        ),
    ],
)
def test_own_previous_key_is_neither_relay_nor_member(load: Load, tmp_path: Path, section: str, key: str) -> None:
    """A copied line would otherwise stop the daemon at its start."""
    previous = keys.generate_private_key()
    keys.write_secret_file(tmp_path / "old.key", previous)
    top = 'previous_private_key_file = "old.key"\nlisten = ["127.0.0.1:5790"]'
    with pytest.raises(ConfigError) as caught:
        load(section.replace("OWN", keys.public_key_text(previous)), top=top)
    assert any(problem.key == key and "own" in problem.message for problem in caught.value.problems)


def test_relay_whose_key_changes_is_accepted_with_both(load: Load) -> None:
    """The previous one makes a new link to it; to leave it out does not."""
    before, both = load(), load(relay(more=f'previous_public_key = "{KEY["c"]}"'))
    assert both.relays[0].previous_public_key == keys.decode_key(KEY["c"])
    assert compare(before, both).removed_relays == ("vps",)
    assert [one.name for one in compare(both, before).changed_relays] == ["vps"]


def test_relay_of_a_peer_follows_it(load: Load) -> None:
    """Another role is another relay, and so is one whose peer gets a new link. Other features need no new link."""
    at = 'addresses = ["10.13.0.9:5790"]'
    plain, both = load("", at), load(relay(key=KEY["drone1"], addresses="[]"), at)
    added = compare(plain, both)
    assert [one.name for one in added.changed_peers] == ["drone1"]
    assert not added.added_peers
    assert not added.removed_peers
    assert compare(both, plain).removed_relays == ("vps",)
    fast = load(relay(key=KEY["drone1"], addresses="[]"), f"{at}\nretry_max_s = 3")
    changes = compare(both, fast)
    assert changes.removed_peers == ("drone1",)
    assert changes.removed_relays == ("vps",)
    assert [one.name for one in changes.added_relays] == ["vps"]


def test_changes_of_relays_are_found(load: Load) -> None:
    """Another address is a change; another key is another relay."""
    before = load(relay() + relay("b"))
    same = load(relay() + relay("b"))
    assert not compare(before, same).summary()
    after = load(relay(addresses='["other.example.org:5790"]') + relay("c"))
    changes = compare(before, after)
    assert changes.removed_relays == ("b",)
    assert [one.name for one in changes.added_relays] == ["c"]
    assert [one.name for one in changes.changed_relays] == ["vps"]
    assert [one.name for one in changes.changed_peers] == ["drone1"]
