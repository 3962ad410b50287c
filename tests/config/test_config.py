"""The configuration: what a file means, and everything that is said about one that means nothing."""

from __future__ import annotations

import base64
import dataclasses
import os
import pickle
import re
import shutil
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import all as mavlink

from uavlinkd.config import keys
from uavlinkd.system.addresses import Address
from uavlinkd.config import Config, ConfigError, Recording, Routing, load_config
from uavlinkd.config.schema import (
    EndpointSection,
    LinkSection,
    MetricsSection,
    PolicySection,
    RecordingSection,
    RoutingSection,
)
from uavlinkd.core.constants import DEFAULT_ENVELOPE_LIMIT, MIN_ENVELOPE_LIMIT
from uavlinkd.core.settings import Link, Timers
from uavlinkd.core.suites import SUITES_BY_NAME
from uavlinkd.mavlink.egress.budgeted import EgressSettings
from uavlinkd.mavlink.frames import Frame, SplitCounters, split_payload
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.mavlink.policy.settings import KEYS
from uavlinkd.mavlink.policy.roles import ROLES

EXAMPLES = Path(__file__).parents[2] / "configs"
Load = Callable[[str], Config]
Refused = Callable[[str], dict[str, str]]


def _public() -> str:
    return keys.public_key_text(keys.generate_private_key())


_ONE, _TWO = _public(), _public()
_TOP = 'name = "drone0"\nprivate_key_file = "drone0.key"\n'
_LISTEN = 'listen = ["0.0.0.0:5790"]\n'
_ENDPOINT = '[[endpoint]]\nname = "autopilot"\nurl = "udpin:127.0.0.1:14550"\n'
_PEER = (
    f'[[peer]]\nname = "drone1"\npublic_key = "{_ONE}"\naddresses = ["10.13.0.2:5790"]\n'
    'role = "swarm-member"\nsystem_ids = [2]\n'
)
_OTHER_PEER = f'[[peer]]\nname = "drone2"\npublic_key = "{_TWO}"\nrole = "swarm-member"\nsystem_ids = [3]\n'
_GOOD = _TOP + _LISTEN + _ENDPOINT + _PEER


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a private key and a PSK."""
    keys.write_secret_file(tmp_path / "drone0.key", keys.generate_private_key())
    keys.write_secret_file(tmp_path / "pair.psk", keys.generate_psk())
    return tmp_path


@pytest.fixture
def load(folder: Path) -> Load:
    """Loads a text as the file drone0.toml in that folder."""

    def loading(text: str) -> Config:
        path = folder / "drone0.toml"
        path.write_text(text)
        return load_config(path, {})

    return loading


@pytest.fixture
def refused(load: Load) -> Refused:
    """Loads a text that has problems; gives messages by key."""

    def refusing(text: str) -> dict[str, str]:
        with pytest.raises(ConfigError) as caught:
            load(text)
        assert str(caught.value).count("\n") == len(caught.value.problems) - 1
        return {problem.key: problem.message for problem in caught.value.problems}

    return refusing


def test_ten_lines_are_enough(load: Load, folder: Path) -> None:
    """What is left out has the specification's defaults; the keys are loaded."""
    config = load(_GOOD)
    private = (folder / "drone0.key").read_text()
    assert (config.name, config.path) == ("drone0", folder / "drone0.toml")
    assert keys.encode_key(config.private_key.reveal()) == private.strip()
    assert keys.encode_key(config.public_key) == keys.public_key_text(private)
    assert config.listen == (Address("0.0.0.0", 5790),)
    assert [(endpoint.name, str(endpoint.url)) for endpoint in config.endpoints] == [
        ("autopilot", "udpin:127.0.0.1:14550")
    ]
    (peer,) = config.peers
    assert (peer.name, peer.settings.public_key, peer.settings.psk) == ("drone1", keys.decode_key(_ONE), None)
    assert peer.addresses == (Address("10.13.0.2", 5790),)
    assert peer.settings.link == Link()
    assert (config.log.level, config.log.format) == ("info", "auto")
    assert config.warnings == ()


def test_peer_inherits_key_by_key(load: Load) -> None:
    """A peer's own keys come before those of [link], and those before the defaults."""
    config = load(
        f"{_TOP}{_LISTEN}[link]\nsuites = ['ffdhe2048', 'x25519']\ntag_bits = 96\nrekey_after_s = 60\n"
        f"{_ENDPOINT}{_PEER}"
        f"tag_bits = 256\nconfidential = true\nkeepalive_s = 20\npsk_file = 'pair.psk'\n"
        f"[[peer]]\nname = 'observer'\npublic_key = '{_TWO}'\nsuites = ['mlkem768']\nmac_key_bits = 512\n"
        "max_envelope_bytes = 320\nrole = 'observer'\nsystem_ids = [254]\n"
    )
    first, second = (peer.settings for peer in config.peers)
    assert first.link == Link(
        suites=(SUITES_BY_NAME["ffdhe2048"], SUITES_BY_NAME["x25519"]),
        confidential=True,
        tag_bytes=32,
        timers=Timers(rekey_after_s=60, keepalive_s=20),
    )
    assert second.link == Link(
        suites=(SUITES_BY_NAME["mlkem768"],),
        tag_bytes=12,
        mac_key_bits=512,
        max_envelope=MIN_ENVELOPE_LIMIT,
        timers=Timers(rekey_after_s=60),
    )
    assert first.psk is not None
    assert config.peers[1].addresses == ()


@pytest.mark.parametrize("field", [field.name for field in dataclasses.fields(Timers)])
def test_every_timer_reaches_the_core(load: Load, field: str) -> None:
    """A key of the configuration changes the core's setting of the same name and no other."""
    value = getattr(Timers(), field) * 1.125
    (peer,) = load(f"{_GOOD}{field} = {value}\n").peers
    assert peer.settings.link.timers == dataclasses.replace(Timers(), **{field: value})


def test_every_suite_can_be_named(load: Load) -> None:
    """The names are the specification's, and their order is kept."""
    names = list(reversed(SUITES_BY_NAME))
    (peer,) = load(f"{_GOOD}suites = {names}\n").peers
    assert [suite.name for suite in peer.settings.link.suites] == names


def test_defaults_are_the_cores() -> None:
    """What the schema says without a file is what the core says without a configuration."""
    section = LinkSection()
    assert {name: getattr(section, name) for name in Timers.__slots__} == dataclasses.asdict(Timers())
    assert (section.tag_bits, section.mac_key_bits, section.confidential) == (
        8 * Link().tag_bytes,
        Link().mac_key_bits,
        Link().confidential,
    )
    assert (tuple(section.suites), section.max_envelope_bytes) == (Link().suites, DEFAULT_ENVELOPE_LIMIT)


def test_control_socket_stands_beside_the_file(load: Load, folder: Path) -> None:
    """Relative to the file, wherever the daemon is started; an absolute path as it is; none unless named."""
    assert load(_GOOD).control_socket is None
    assert load(f'control_socket = "drone0.sock"\n{_GOOD}').control_socket == folder / "drone0.sock"
    assert load(f'control_socket = "/run/drone0.sock"\n{_GOOD}').control_socket == Path("/run/drone0.sock")


def test_routing_section_is_read(load: Load) -> None:
    """Without one, peers do not reach each other through here, and a frame for nobody known goes to all."""
    assert load(_GOOD).routing == Routing(relay=False, unknown_targets="flood")
    changed = load(f'{_GOOD}[routing]\nrelay = true\nunknown_targets = "drop"\n')
    assert changed.routing == Routing(relay=True, unknown_targets="drop")


def test_pace_is_inherited_key_by_key(load: Load) -> None:
    """Budget, delay and age come from the peer, else from [link], else they are the egress's own defaults."""
    config = load(
        f"{_TOP}{_LISTEN}[link]\nbudget_bits_s = 1000\ncoalesce_s = 0.5\n"
        f"{_ENDPOINT}{_PEER}budget_bits_s = 1_000_000_000\nmax_age_s = 60\n{_OTHER_PEER}coalesce_s = 0\n"
    )
    assert [peer.egress for peer in config.peers] == [
        EgressSettings(budget_bits_s=10**9, coalesce_s=0.5, max_age_s=60.0),
        EgressSettings(budget_bits_s=1000, coalesce_s=0.0, max_age_s=1.0),
    ]
    assert load(f"{_TOP}[link]\nbudget_bits_s = 0\n{_ENDPOINT}{_PEER}").peers[0].egress == EgressSettings()


def test_freshness_is_verified_within_a_share_of_the_budget(load: Load) -> None:
    """Each second, or as often as a twentieth of the budget carries a request and its reply over IPv6."""
    config = load(f"{_TOP}{_LISTEN}{_ENDPOINT}{_PEER}budget_bits_s = 4000\n{_OTHER_PEER}budget_bits_s = 1_000_000\n")
    slow, fast = (peer.settings.link.verify_interval_s for peer in config.peers)
    assert slow == 8 * (13 + 17 + 2 * (7 + 16 + 48)) / (0.05 * 4000)
    assert fast == Link().verify_interval_s == load(_GOOD).peers[0].settings.link.verify_interval_s == 1.0


def test_other_budget_is_no_other_link(load: Load) -> None:
    """The interval follows from it, and a session goes on while it changes."""
    before, after = (load(f"{_GOOD}budget_bits_s = {budget}\n").peers[0] for budget in (4000, 8000))
    assert before.settings.link.verify_interval_s != after.settings.link.verify_interval_s
    assert before.settings == after.settings


def test_metrics_are_off_unless_an_address_is_named(load: Load) -> None:
    """An address is the switch, and loopback gives no warning."""
    assert load(_GOOD).metrics is None
    config = load(f'{_GOOD}[metrics]\nlisten = "127.0.0.1:9790"\n')
    assert (config.metrics, config.warnings) == (Address("127.0.0.1", 9790), ())


def test_recording_is_off_unless_a_folder_is_named(load: Load, folder: Path) -> None:
    """The folder is the switch, and stands beside the file; the rest has defaults."""
    assert load(_GOOD).recording is None
    assert load(f"{_GOOD}[recording]\nmax_files = 2\n").recording is None
    assert load(f'{_GOOD}[recording]\nfolder = "flights"\n').recording == Recording(
        folder / "flights", 64_000_000, 100, 1_000_000_000
    )
    changed = (
        f"{_GOOD}[recording]\nfolder = '/srv/f'\nmax_file_bytes = 10_000\nmax_files = 2\nmin_free_bytes = 100_000"
    )
    assert load(changed).recording == Recording(Path("/srv/f"), 10_000, 2, 100_000)


def test_endpoint_has_an_age_and_a_radio_status_of_its_own(load: Load) -> None:
    """What [link] says of peers is not an endpoint's."""
    config = load(
        f"{_TOP}{_LISTEN}[link]\nmax_age_s = 5\n{_ENDPOINT}max_age_s = 0.1\nradio_status = true\n"
        f'[[endpoint]]\nname = "gcs"\nurl = "tcpin:127.0.0.1:5760"\n{_PEER}'
    )
    assert [(each.max_age_s, each.radio_status) for each in config.endpoints] == [(0.1, True), (1.0, False)]
    assert config.peers[0].egress.max_age_s == 5


def _heartbeat(system: int, kind: int = mavlink.MAV_TYPE_QUADROTOR) -> Frame:
    message = mavlink.MAVLink_heartbeat_message(kind, 3, 0, 0, 4, 3)
    return _frame(message.pack(mavlink.MAVLink(None, srcSystem=system, srcComponent=1)))


def _frame(raw: bytes) -> Frame:
    (frame,) = split_payload(bytes(raw), SplitCounters())
    return frame


def test_policy_reaches_the_gate(load: Load) -> None:
    """A peer speaks as what the file says it is; an endpoint's keys mean the same; who has none says anything."""
    config = load(
        f'{_GOOD}rate_in = {{ HEARTBEAT = 1 }}\n[[endpoint]]\nname = "tablet"\nurl = "udpin:127.0.0.1:14551"\n'
        'system_ids = [254]\nrole = "observer"\n'
    )
    peer = config.peers[0].make_policy()
    assert peer.incoming.check(_heartbeat(2), 0.0) is None
    assert peer.incoming.check(_heartbeat(1), 0.0) is Refusal.FOREIGN_SYSTEM
    assert peer.incoming.check(_heartbeat(2, mavlink.MAV_TYPE_GCS), 0.0) is Refusal.GROUND_STATION_NOT_ALLOWED
    autopilot, tablet = (endpoint.make_policy() for endpoint in config.endpoints)
    assert autopilot.incoming.check(_heartbeat(1), 0.0) is None
    assert tablet.incoming.check(_heartbeat(254), 0.0) is Refusal.MESSAGE_NOT_ALLOWED
    assert tablet.incoming.check(_heartbeat(2), 0.0) is Refusal.FOREIGN_SYSTEM


def test_each_policy_made_counts_for_itself(load: Load) -> None:
    """A policy has state, and a configuration none: the second one made starts with its whole rate."""
    peer = load(f"{_GOOD}rate_in = {{ HEARTBEAT = 1 }}\n").peers[0]
    first, second = peer.make_policy(), peer.make_policy()
    assert [first.incoming.check(_heartbeat(2), 0.0) for _ in range(3)] == [None, None, Refusal.RATE_LIMITED]
    assert second.incoming.check(_heartbeat(2), 0.0) is None
    assert not second.incoming.refused


def test_policy_data_is_compared_and_never_changed(load: Load) -> None:
    """On reload the daemon sees whether a peer's policy is another one; nobody changes it in between."""
    text = f'{_GOOD}allow_in = ["PING"]\nrate_in = {{ PING = 1 }}\n'
    first, second = load(text).peers[0].policy, load(text).peers[0].policy
    assert first == second
    assert first != load(text.replace("PING = 1", "PING = 2")).peers[0].policy
    with pytest.raises(TypeError):
        first["role"] = "operator"  # type: ignore[index]
    with pytest.raises(TypeError):
        first["rate_in"]["PING"] = 9  # type: ignore[index]
    assert first["allow_in"] == ("PING",)


def test_policy_may_stand_in_a_table_of_its_own(load: Load) -> None:
    """TOML has two ways to write a table, and both are read."""
    inline = load(f"{_GOOD}rate_in = {{ ATTITUDE = 10, telemetry = 2.5 }}\n")
    below = load(f"{_GOOD}[peer.rate_in]\nATTITUDE = 10\ntelemetry = 2.5\n")
    assert inline.peers[0].policy == below.peers[0].policy


@pytest.mark.parametrize("url", ["udpin:127.0.0.1:1", "udpout:127.0.0.1:1", "tcp:127.0.0.1:1", "tcpin:127.0.0.1:1"])
def test_every_kind_of_endpoint_is_carried(load: Load, url: str) -> None:
    """The network's four kinds, and beside each of them the serial one."""
    serial = '[[endpoint]]\nname = "radio"\nurl = "serial:/dev/ttyACM0:57600"\n'
    config = load(_GOOD.replace("udpin:127.0.0.1:14550", url) + serial)
    assert [str(endpoint.url) for endpoint in config.endpoints] == [url, "serial:/dev/ttyACM0:57600"]
    assert config.warnings == ()


def test_log_section_is_read(load: Load) -> None:
    """Level and format as written."""
    config = load(f'{_GOOD}[log]\nlevel = "debug"\nformat = "json"\n')
    assert (config.log.level, config.log.format) == ("debug", "json")


def test_nothing_of_a_configuration_changes_or_shows_a_secret(load: Load, folder: Path) -> None:
    """It is frozen, prints without its keys, and cannot be pickled with them."""
    config = load(f'{_GOOD}psk_file = "pair.psk"\n')
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.name = "other"  # type: ignore[misc]
    for name in ("drone0.key", "pair.psk"):
        text = (folder / name).read_text().strip()
        for shown in (text, repr(keys.decode_key(text)), keys.decode_key(text).hex()):
            assert shown not in repr(config)
    with pytest.raises(TypeError):
        pickle.dumps(config)


@pytest.mark.parametrize("in_a_folder", [False, True])
def test_keys_come_from_systemd_where_there_is_no_file(tmp_path: Path, in_a_folder: bool) -> None:
    """A credential's name stands where a file's would, for the private key and for PSKs; or a folder's."""
    credentials = tmp_path / "credentials"
    credentials.mkdir()
    for name in ("drone0.key", "pair.psk"):
        keys.write_secret_file(credentials / name, keys.generate_psk())
        (credentials / name).chmod(0o440)  # as systemd's access list shows
        if in_a_folder:
            (credentials / name).rename(credentials / f"keys_{name}")
    path = tmp_path / "drone0.toml"
    path.write_text(f'{_GOOD}psk_file = "pair.psk"\n')
    config = load_config(path, {"CREDENTIALS_DIRECTORY": str(credentials)})
    private = next(credentials.glob("*drone0.key"))
    assert keys.encode_key(config.private_key.reveal()) == private.read_text().strip()
    with pytest.raises(ConfigError, match="no file"):
        load_config(path, {})


def test_a_key_that_is_not_there_is_not_to_be_made_where_it_does_harm(tmp_path: Path) -> None:
    """A PSK is the peer's; a service's key belongs to root and is handed over; a unit's folder is found."""
    path = tmp_path / "drone0.toml"
    path.write_text(f'{_GOOD}psk_file = "pair.psk"\n')

    def told(environ: dict[str, str]) -> list[str]:
        with pytest.raises(ConfigError) as caught:
            load_config(path, environ)
        return [str(each) for each in caught.value.problems]

    private, psk = told({})
    assert f"make it with `uavlinkd keygen --out {tmp_path}/drone0.key`" in private
    assert "it is the same as the peer's: copy that, or, on one of the two, `uavlinkd psk --out" in psk
    assert "--keys" not in private + psk
    for folder in ("keys", "drone0"):
        (tmp_path / folder).mkdir()
        assert all(f"add `--keys {tmp_path}/{folder}` to `uavlinkd check`" in each for each in told({}))
        (tmp_path / folder).rmdir()
    credentials = tmp_path / "credentials"
    credentials.mkdir()
    for each in told({"CREDENTIALS_DIRECTORY": str(credentials)}):
        assert "LoadCredential=" in each
        assert "restart" in each
        assert "keygen" not in each
        assert "uavlinkd psk" not in each


# Text in place of the ten lines -> the key that is named, and a part of what is said.
_REFUSED = {
    "no name": (_GOOD.replace('name = "drone0"', ""), "name", 'is missing: write name = "drone0"'),
    "name with a space": (_GOOD.replace('"drone0"', '"drone 0"'), "name", "letters, digits"),
    "name is a number": (_GOOD.replace('"drone0"', "0"), "name", "text in quotes"),
    "private key missing": (
        _GOOD.replace('"drone0.key"', '"other.key"'),
        "private_key_file",
        "uavlinkd keygen --out",
    ),
    "private key is a folder": (_GOOD.replace('"drone0.key"', '"."'), "private_key_file", "not a regular file"),
    "private key file unnamed": (_GOOD.replace('"drone0.key"', '""'), "private_key_file", "must name a file"),
    "listen is text": (_GOOD.replace('["0.0.0.0:5790"]', '"0.0.0.0:5790"'), "listen", 'listen = ["0.0.0.0:5790"]'),
    "listen has no port": (_GOOD.replace("0.0.0.0:5790", "0.0.0.0"), "listen[0]", "write 0.0.0.0:5790"),
    "listen is a name": (_GOOD.replace("0.0.0.0:5790", "drone0.local:5790"), "listen[0]", "numeric"),
    "listen twice": (
        _GOOD.replace('["0.0.0.0:5790"]', '["0.0.0.0:5790", "127.0.0.1:5790"]'),
        "listen",
        "cannot listen on at once",
    ),
    "link in double brackets": (_GOOD + "[[link]]\ntag_bits = 96\n", "link", "write [link]"),
    "log is text": ('log = "info"\n' + _GOOD, "log", "write [log]"),
    "log level": (_GOOD + '[log]\nlevel = "verbose"\n', "log.level", "'debug', 'info', 'warning' or 'error'"),
    "endpoint in single brackets": (_GOOD.replace("[[endpoint]]", "[endpoint]"), "endpoint", "[[endpoint]]"),
    "peers are numbers": (f"peer = [1]\n{_TOP}{_LISTEN}{_ENDPOINT}", "peer", "[[peer]]"),
    "endpoint without url": (
        _GOOD.replace('url = "udpin:127.0.0.1:14550"', ""),
        "endpoint[0].url (autopilot)",
        'url = "udpin:127.0.0.1:14550"',
    ),
    "endpoint of another program": (_GOOD.replace("udpin:", "udp:"), "endpoint[0].url (autopilot)", "udpout:127"),
    "serial device given twice": (
        _GOOD.replace("udpin:127.0.0.1:14550", "serial:/dev/ttyACM0:57600")
        + '[[endpoint]]\nname = "radio"\nurl = "serial:/dev/ttyACM0:115200"\n',
        "endpoint[1].url (radio)",
        "is the device of endpoint[0] (autopilot) too",
    ),
    "two servers on one port": (
        _GOOD.replace("udpin", "tcpin")
        + _ENDPOINT.replace("autopilot", "gcs").replace("udpin", "tcpin").replace("127.0.0.1", "0.0.0.0"),
        "endpoint[1].url (gcs)",
        "listens where endpoint[0] (autopilot) does",
    ),
    "mavlink-router's port": (
        _GOOD.replace("[[peer]]", "Port = 14550\n[[peer]]"),
        "endpoint[0].Port (autopilot)",
        'write url = "udpin:127.0.0.1:14550"',
    ),
    "mavlink-router's baud": (
        _GOOD.replace("[[peer]]", "Baud = 57600\n[[peer]]"),
        "endpoint[0].Baud (autopilot)",
        'write url = "serial:/dev/ttyACM0:57600"',
    ),
    "mavlink-router's filter": (_GOOD + "BlockMsgIdIn = [76]\n", "peer[0].BlockMsgIdIn (drone1)", "write deny_in"),
    "WireGuard's addresses": (
        _GOOD + 'AllowedIPs = ["10.13.0.2/32"]\n',
        "peer[0].AllowedIPs (drone1)",
        "write role and system_ids",
    ),
    "log level at the top": ('log_level = "debug"\n' + _GOOD, "log_level", "write [log]"),
    "endpoint's age": (
        _GOOD.replace("[[peer]]", "max_age_s = 0.09\n[[peer]]"),
        "endpoint[0].max_age_s (autopilot)",
        "0.1 or more",
    ),
    "endpoint's radio status": (
        _GOOD.replace("[[peer]]", "radio_status = 1\n[[peer]]"),
        "endpoint[0].radio_status (autopilot)",
        "write radio_status = true",
    ),
    "endpoint's policy": (
        _GOOD.replace("[[peer]]", 'deny_in = ["shells"]\n[[peer]]'),
        "endpoint[0].deny_in[0] (autopilot)",
        "did you mean 'shell'?",
    ),
    "relay in quotes": (_GOOD + '[routing]\nrelay = "no"\n', "routing.relay", "write relay = true"),
    "unknown targets": (
        _GOOD + '[routing]\nunknown_targets = "ask"\n',
        "routing.unknown_targets",
        "'flood' or 'drop'",
    ),
    "routing in double brackets": (_GOOD + "[[routing]]\nrelay = true\n", "routing", "write [routing]"),
    "routing key at the top": ("relay = true\n" + _GOOD, "relay", "in [routing]"),
    "policy in link": (
        f'{_TOP}{_LISTEN}[link]\nrole = "vehicle"\n{_ENDPOINT}{_PEER}',
        "link.role",
        "in a [[peer]] or an [[endpoint]]",
    ),
    "budget of a modem's letters": (
        _GOOD + "budget_bits_s = 999\n",
        "peer[0].budget_bits_s (drone1)",
        "write 1000 or more, in bits a second, or 0 for no limit",
    ),
    "budget negative": (_GOOD + "budget_bits_s = -1\n", "peer[0].budget_bits_s (drone1)", "0 or more"),
    "budget too large": (
        _GOOD + "budget_bits_s = 1_000_000_001\n",
        "peer[0].budget_bits_s (drone1)",
        "write 1000000000 or less",
    ),
    "budget broken": (_GOOD + "budget_bits_s = 4e3\n", "peer[0].budget_bits_s (drone1)", "whole number"),
    "coalescing for ever": (_GOOD + "coalesce_s = 0.51\n", "peer[0].coalesce_s (drone1)", "0.5 or less"),
    "age for ever": (_GOOD + "max_age_s = 61\n", "peer[0].max_age_s (drone1)", "60 or less"),
    "old before it goes": (
        _GOOD + "coalesce_s = 0.2\nmax_age_s = 0.2\n",
        "peer[0].max_age_s (drone1)",
        "more than coalesce_s (0.2)",
    ),
    "role unknown": (_GOOD.replace("swarm-member", "pilot"), "peer[0].role (drone1)", "the roles are vehicle, "),
    "systems left out": (_GOOD.replace("system_ids", "#"), "peer[0].system_ids (drone1)", "which systems"),
    "system zero": (_GOOD.replace("[2]", "[2, 0]"), "peer[0].system_ids[1] (drone1)", "no system from 1 to 255"),
    "message misspelt": (
        _GOOD + 'allow_in = ["PING", "telemetry", "ATITUDE"]\n',
        "peer[0].allow_in[2] (drone1)",
        "did you mean 'ATTITUDE'?",
    ),
    "command misspelt": (
        _GOOD + 'deny_in = ["MAV_CMD_NAV_TAKEOF"]\n',
        "peer[0].deny_in[0] (drone1)",
        "did you mean 'MAV_CMD_NAV_TAKEOFF'?",
    ),
    "rate of nothing": (_GOOD + "rate_out = { ATTITUDE = 0 }\n", "peer[0].rate_out.ATTITUDE (drone1)", "is no rate"),
    "list is text": (_GOOD + 'allow_out = "telemetry"\n', "peer[0].allow_out (drone1)", "is no list"),
    "flag in quotes": (_GOOD + 'mavlink1 = "no"\n', "peer[0].mavlink1 (drone1)", "write mavlink1 = true or"),
    "policy key misspelt": (_GOOD + "alow_in = []\n", "peer[0].alow_in (drone1)", "did you mean allow_in?"),
    "control socket unnamed": ('control_socket = ""\n' + _GOOD, "control_socket", "must name a file"),
    "endpoint names alike": (
        _GOOD + _ENDPOINT.replace("14550", "14551"),
        "endpoint[1].name (autopilot)",
        "name of endpoint[0] (autopilot)",
    ),
    "endpoints on one port": (
        _GOOD + _ENDPOINT.replace("autopilot", "gcs").replace("127.0.0.1", "0.0.0.0"),
        "endpoint[1].url (gcs)",
        "listens where endpoint[0] (autopilot) does",
    ),
    "endpoint on the link's port": (
        _GOOD.replace("14550", "5790"),
        "endpoint[0].url (autopilot)",
        "on which peers are listened for",
    ),
    "endpoint into the link's port": (
        _GOOD.replace("udpin:127.0.0.1:14550", "udpout:127.0.0.1:5790"),
        "endpoint[0].url (autopilot)",
        "own port for peers",
    ),
    "endpoint into another": (
        _GOOD + _ENDPOINT.replace("autopilot", "gcs").replace("udpin", "udpout"),
        "endpoint[1].url (gcs)",
        "frames would go round",
    ),
    "endpoint sends twice": (
        _GOOD.replace("udpin", "udpout") + _ENDPOINT.replace("autopilot", "gcs").replace("udpin", "udpout"),
        "endpoint[1].url (gcs)",
        "arrive twice",
    ),
    "peer without key": (
        _GOOD.replace("public_key", "#"),
        "peer[0].public_key (drone1)",
        "what `uavlinkd pubkey` prints on the peer",
    ),
    "peer key too short": (_GOOD.replace(_ONE, "AAAA"), "peer[0].public_key (drone1)", "is no key"),
    "peer names alike": (
        _GOOD + _PEER.replace(_ONE, _TWO),
        "peer[1].name (drone1)",
        "is the name of peer[0] (drone1) too",
    ),
    "peer keys alike": (
        _GOOD + _PEER.replace("drone1", "drone2"),
        "peer[1].public_key (drone2)",
        "is the key of peer[0] (drone1) too",
    ),
    "peer address without port": (_GOOD.replace(".2:5790", ".2"), "peer[0].addresses[0] (drone1)", "10.13.0.2:5790"),
    "peer address is a wildcard": (
        _GOOD.replace("10.13.0.2", "0.0.0.0"),
        "peer[0].addresses[0] (drone1)",
        "every address of this machine",
    ),
    "peer address is ours": (
        _GOOD.replace("10.13.0.2", "localhost"),
        "peer[0].addresses (drone1)",
        "where this daemon listens",
    ),
    "peer address twice": (
        _GOOD.replace('["10.13.0.2:5790"]', '["a:1", "a:1"]'),
        "peer[0].addresses (drone1)",
        "names an address twice",
    ),
    "nobody can call": (
        _GOOD.replace(_LISTEN, "").replace('addresses = ["10.13.0.2:5790"]', ""),
        "peer[0].addresses (drone1)",
        "neither end could call",
    ),
    "psk missing": (_GOOD + 'psk_file = "no.psk"\n', "peer[0].psk_file (drone1)", "uavlinkd psk"),
    "psk is the private key": (
        _GOOD + 'psk_file = "drone0.key"\n',
        "peer[0].psk_file (drone1)",
        "holds this daemon's private key",
    ),
    "no suite": (_GOOD + "suites = []\n", "peer[0].suites (drone1)", 'write ["x25519"]'),
    "suite twice": (_GOOD + "suites = ['x25519', 'x25519']\n", "peer[0].suites (drone1)", "twice"),
    "suite in capitals": (_GOOD + "suites = ['X25519']\n", "peer[0].suites[0] (drone1)", "write one of x25519"),
    "suite unknown": (_GOOD + "suites = ['mlkem512']\n", "peer[0].suites[0] (drone1)", "is no suite"),
    "tag in bytes": (_GOOD + "tag_bits = 16\n", "peer[0].tag_bits (drone1)", "64, 96, 128 or 256"),
    "tag in quotes": (_GOOD + 'tag_bits = "128"\n', "peer[0].tag_bits (drone1)", "64, 96, 128 or 256"),
    "mac key": (_GOOD + "mac_key_bits = 4096\n", "peer[0].mac_key_bits (drone1)", "256, 512, 1024 or 2048"),
    "confidential in quotes": (
        _GOOD + 'confidential = "yes"\n',
        "peer[0].confidential (drone1)",
        "write confidential = true",
    ),
    "envelope too small": (
        _GOOD + "max_envelope_bytes = 319\n",
        "peer[0].max_envelope_bytes (drone1)",
        "320 or more",
    ),
    "envelope too large": (
        _GOOD + "max_envelope_bytes = 65001\n",
        "peer[0].max_envelope_bytes (drone1)",
        "65000 or less",
    ),
    "envelope broken": (
        _GOOD + "max_envelope_bytes = 500.5\n",
        "peer[0].max_envelope_bytes (drone1)",
        "whole number",
    ),
    "timer in quotes": (_GOOD + 'keepalive_s = "10"\n', "peer[0].keepalive_s (drone1)", "write keepalive_s = 10"),
    "timer true": (_GOOD + "keepalive_s = true\n", "peer[0].keepalive_s (drone1)", "write keepalive_s = 10"),
    "timer infinite": (_GOOD + "keepalive_s = inf\n", "peer[0].keepalive_s (drone1)", "finite"),
    "timer no number": (_GOOD + "keepalive_s = nan\n", "peer[0].keepalive_s (drone1)", "finite"),
    "timer negative": (_GOOD + "keepalive_s = -1\n", "peer[0].keepalive_s (drone1)", "0.1 or more"),
    "timer in milliseconds": (_GOOD + "keepalive_s = 10000\n", "peer[0].keepalive_s (drone1)", "3600 or less"),
    "echo after handshake": (
        _GOOD + "echo_after_s = 1.0\n",
        "peer[0].handshake_after_s (drone1)",
        "more than echo_after_s (1)",
    ),
    "lost before handshake": (
        _GOOD + "lost_after_s = 1.0\n",
        "peer[0].lost_after_s (drone1)",
        "more than handshake_after_s (1)",
    ),
    "retries shrink": (
        _GOOD + "retry_min_s = 2\nretry_max_s = 1\n",
        "peer[0].retry_max_s (drone1)",
        "no less than retry_min_s (2)",
    ),
    "no time to rekey": (
        _GOOD + "rekey_after_s = 120\nretry_max_s = 10\nreject_after_s = 139\n",
        "peer[0].reject_after_s (drone1)",
        "140 or more",
    ),
    "disorder in link": (
        f"{_TOP}{_LISTEN}[link]\nlost_after_s = 1\n{_ENDPOINT}{_PEER}",
        "link.lost_after_s",
        "more than handshake_after_s (1)",
    ),
    "disorder between peer and link": (
        f"{_TOP}{_LISTEN}[link]\nlost_after_s = 8\n{_ENDPOINT}{_PEER}handshake_after_s = 9\n",
        "peer[0].lost_after_s (drone1)",
        "more than handshake_after_s (9)",
    ),
    "metrics without port": (_GOOD + '[metrics]\nlisten = "127.0.0.1"\n', "metrics.listen", "127.0.0.1:5790"),
    "metrics of a name": (_GOOD + '[metrics]\nlisten = "drone0.local:9790"\n', "metrics.listen", "numeric"),
    "metrics at an endpoint's port": (
        _GOOD.replace("udpin", "tcpin") + '[metrics]\nlisten = "127.0.0.1:14550"\n',
        "metrics.listen",
        "is where endpoint[0] (autopilot) listens",
    ),
    "recording at the top": ('folder = "flights"\n' + _GOOD, "folder", "in [recording]"),
    "recording unnamed": (_GOOD + '[recording]\nfolder = ""\n', "recording.folder", "must name a file"),
    "recording in tiny files": (_GOOD + "[recording]\nmax_file_bytes = 9999\n", "recording.max_file_bytes", "10000"),
    "recording in broken files": (
        _GOOD + "[recording]\nmax_file_bytes = 1e6\n",
        "recording.max_file_bytes",
        "max_file_bytes = 64_000_000",
    ),
    "recording fills the disk": (_GOOD + "[recording]\nmin_free_bytes = 0\n", "recording.min_free_bytes", "100000"),
    "recording with fewer files than peers": (
        _GOOD + _OTHER_PEER + '[recording]\nfolder = "flights"\nmax_files = 2\n',
        "recording.max_files",
        "more than the number of peers, each of which has a file: write 3",
    ),
    "misspelt key": (
        "confidental = true\n".join((_GOOD, "")),
        "peer[0].confidental (drone1)",
        "did you mean confidential?",
    ),
    "camel case": (
        _GOOD.replace("public_key", "PublicKey"),
        "peer[0].PublicKey (drone1)",
        "did you mean public_key?",
    ),
    "plural section": (_GOOD.replace("[[peer]]", "[[peers]]"), "peers", "did you mean [[peer]]?"),
    "key of another section": ("tag_bits = 96\n" + _GOOD, "tag_bits", "in [link] or in a [[peer]]"),
    "top key below a section": (_GOOD + 'listen = ["0.0.0.0:1"]\n', "peer[0].listen (drone1)", "at the top"),
    "key of WireGuard": (_GOOD + 'Endpoint = "10.0.0.1:1"\n', "peer[0].Endpoint (drone1)", "addresses"),
    "key in the file": (f'private_key = "{_TWO}"\n{_GOOD}', "private_key", "a key never stands in this file"),
    "key not thought of": (_GOOD + "colour = 'red'\n", "peer[0].colour (drone1)", "the keys are"),
}


@pytest.mark.parametrize("case", _REFUSED)
def test_problem_is_named_with_what_to_write(refused: Refused, case: str) -> None:
    """Each mistake is found alone: under its key, with what to write instead, and with nothing else."""
    text, key, says = _REFUSED[case]
    problems = refused(text)
    assert says in problems.get(key, f"not among {problems}")
    # A key that has another name is also missing under its own.
    assert all(other == key or "is missing" in message for other, message in problems.items()), problems


@pytest.mark.parametrize(
    "name",
    [
        "modp768",
        "modp1024",
        "MODP-1024",
        "ffdhe512",
        "ffdhe1024",
        "dh1024",
        "dh_1024",
        "dhe768",
        "group1",
        "group2",
        "1024",
    ],
)
def test_small_diffie_hellman_group_is_refused_with_the_reason(refused: Refused, name: str) -> None:
    """Whatever it is called: groups of 1024 bits and less are broken in advance, for everybody at once."""
    for message in (
        refused(f'{_GOOD}suites = ["x25519", "{name}"]\n')["peer[0].suites[1] (drone1)"],
        refused(f'{_TOP}{_LISTEN}[link]\nsuites = ["{name}"]\n{_ENDPOINT}{_PEER}')["link.suites[0]"],
    ):
        assert re.search(r"(512|768|1024) bits.*refused.*Logjam.*ffdhe2048", message)


def test_small_group_as_a_number_is_refused_with_the_reason(refused: Refused) -> None:
    """A size alone is understood as well."""
    assert "Logjam" in refused(f"{_GOOD}suites = [1024]\n")["peer[0].suites[0] (drone1)"]


def test_larger_unknown_group_is_not_called_breakable(refused: Refused) -> None:
    """The reason is given only where it holds."""
    for name in ("modp2048", "ffdhe1025", "group14", "p256"):
        message = refused(f'{_GOOD}suites = ["{name}"]\n')["peer[0].suites[0] (drone1)"]
        assert "Logjam" not in message
        assert "is no suite" in message


# u-coordinates whose multiples by 8 vanish, from their definition: 0 (order 2 on the curve), 1 and -1 (order 4).
_PRIME = 2**255 - 19


@pytest.mark.parametrize("number", [0, 1, _PRIME - 1, _PRIME, _PRIME + 1, 2**255, 2**255 + 1])
def test_public_key_of_low_order_is_refused(refused: Refused, number: int) -> None:
    """With such a point everybody knows the shared secret, however it is written."""
    text = base64.b64encode(number.to_bytes(32, "little")).decode()
    assert "low order" in refused(_GOOD.replace(_ONE, text))["peer[0].public_key (drone1)"]


def test_second_spelling_of_a_point_is_refused(refused: Refused) -> None:
    """The same point with its unused bit set would pass for another peer."""
    number = int.from_bytes(keys.decode_key(_ONE), "little") | 2**255
    text = base64.b64encode(number.to_bytes(32, "little")).decode()
    assert "no key that X25519 gives" in refused(_GOOD.replace(_ONE, text))["peer[0].public_key (drone1)"]


def test_own_keys_are_no_peers(refused: Refused, folder: Path) -> None:
    """Neither our public key, nor, by an accident worse, our private one."""
    private = (folder / "drone0.key").read_text().strip()
    own = refused(_GOOD.replace(_ONE, keys.public_key_text(private)))
    assert "own key" in own["peer[0].public_key (drone1)"]
    leaked = refused(_GOOD.replace(_ONE, private))
    assert "private key" in leaked["peer[0].public_key (drone1)"]
    assert private not in str(leaked)


def test_peer_with_a_name_for_address_may_be_anywhere(load: Load) -> None:
    """Nothing is said of a reach that only a resolver knows, nor of a peer that is here as we are."""
    local = _GOOD.replace("0.0.0.0", "127.0.0.1")
    assert load(local.replace("10.13.0.2", "drone1.local")).warnings == ()
    assert load(local.replace("10.13.0.2:5790", "127.0.0.1:5791")).warnings == ()


@pytest.mark.parametrize("name", ["drone0.key", "pair.psk"])
def test_key_file_that_others_can_read_is_refused(refused: Refused, folder: Path, name: str) -> None:
    """With the command that mends it; the same for the private key and for PSKs."""
    (folder / name).chmod(0o640)
    (message,) = refused(f'{_GOOD}psk_file = "pair.psk"\n').values()
    assert f"chmod 600 {folder / name}" in message


def test_every_problem_is_listed_at_once(refused: Refused) -> None:
    """One run tells all of them, also those between values while other values are wrong."""
    problems = refused(
        """
        name = "drone 0"
        private_key_file = "none.key"
        listen = ["0.0.0.0:5790", "127.0.0.1:5790"]
        [link]
        suites = ["modp1024"]
        echo_after_s = 2
        colour = "red"
        [[endpoint]]
        name = "a"
        url = "udp:1"
        [[endpoint]]
        name = "a"
        url = "udpin:127.0.0.1:5790"
        [[peer]]
        name = "b"
        public_key = "short"
        retry_min_s = 9
        [[peer]]
        name = "b"
        addresses = ["10.0.0.256:1"]
        psk_file = "none.psk"
        """
    )
    assert set(problems) == {
        "name",
        "private_key_file",
        "listen",
        "link.suites[0]",
        "link.handshake_after_s",
        "link.colour",
        "endpoint[0].url (a)",
        "endpoint[1].name (a)",
        "endpoint[1].url (a)",
        "peer[0].public_key (b)",
        "peer[0].retry_max_s (b)",
        "peer[0].role (b)",
        "peer[0].system_ids (b)",
        "peer[1].name (b)",
        "peer[1].public_key (b)",
        "peer[1].addresses[0] (b)",
        "peer[1].psk_file (b)",
        "peer[1].role (b)",
        "peer[1].system_ids (b)",
    }


def test_problem_of_link_is_not_repeated_for_every_peer(refused: Refused) -> None:
    """What a peer inherits is told once, where it stands; a wrong value makes no second problem."""
    two = _PEER + _PEER.replace("drone1", "drone2").replace(_ONE, _TWO).replace("10.13.0.2", "10.13.0.3")
    assert set(refused(f"{_TOP}{_LISTEN}[link]\nlost_after_s = 0.5\n{two}")) == {"link.lost_after_s"}
    wrong = f'{_TOP}{_LISTEN}[link]\nlost_after_s = "long"\n{two}handshake_after_s = 5\n'
    assert set(refused(wrong)) == {"link.lost_after_s"}


def test_problem_reads_as_a_line(load: Load, folder: Path) -> None:
    """File, key with the section's name, what is wrong and what to write."""
    with pytest.raises(ConfigError) as caught:
        load(_GOOD.replace(".2:5790", ".2"))
    assert str(caught.value) == (
        f"{folder / 'drone0.toml'}: peer[0].addresses[0] (drone1): has no port: write 10.13.0.2:5790"
    )


_SECRET_TEXT = base64.b64encode(b"thirty-two bytes nobody may see!").decode()


@pytest.mark.parametrize(
    "text",
    [
        f'private_key = "{_SECRET_TEXT}"\n{_GOOD}',
        _GOOD.replace("drone0.key", _SECRET_TEXT),
        _GOOD.replace("drone0.key", base64.b64decode(_SECRET_TEXT).hex()),
        _GOOD.replace("drone0.key", f"{_SECRET_TEXT} "),
        _GOOD.replace('"drone0"', f'"{_SECRET_TEXT}"'),
        _GOOD.replace("0.0.0.0:5790", _SECRET_TEXT),
        _GOOD.replace("udpin:127.0.0.1:14550", _SECRET_TEXT),
        _GOOD.replace("10.13.0.2:5790", _SECRET_TEXT),
        _GOOD.replace(_ONE, f"{_SECRET_TEXT}x"),
        _GOOD.replace(_ONE, _SECRET_TEXT[:-1]),
        f'{_GOOD}psk_file = "{_SECRET_TEXT}"\n',
        f'{_GOOD}psk_file = ["{_SECRET_TEXT}"]\n',
        f'{_GOOD}psk = "{_SECRET_TEXT}"\n',
        f'{_GOOD}suites = ["{_SECRET_TEXT}"]\n',
        f'{_GOOD}tag_bits = "{_SECRET_TEXT}"\n',
        f'{_GOOD}keepalive_s = "{_SECRET_TEXT}"\n',
        f'{_GOOD}confidential = "{_SECRET_TEXT}"\n',
        f'{_GOOD}"{_SECRET_TEXT}" = 1\n',
        _GOOD.replace("swarm-member", _SECRET_TEXT),
        _GOOD.replace("swarm-member", _SECRET_TEXT[:-1]),
        _GOOD.replace("swarm-member", base64.b64decode(_SECRET_TEXT).hex()),
        _GOOD.replace("[2]", f'"{_SECRET_TEXT}"'),
        _GOOD.replace("[2]", f'["{_SECRET_TEXT}"]'),
        f'{_GOOD}allow_in = "{_SECRET_TEXT}"\n',
        f'{_GOOD}allow_in = ["{_SECRET_TEXT}", ["{_SECRET_TEXT}"]]\n',
        f'{_GOOD}deny_in = ["command:{_SECRET_TEXT}"]\n',
        f'{_GOOD}mavlink1 = "{_SECRET_TEXT}"\n',
        f'{_GOOD}rate_in = "{_SECRET_TEXT}"\n',
        f'{_GOOD}rate_in = {{ "{_SECRET_TEXT}" = 1 }}\n',
        f'{_GOOD}rate_in = {{ ATTITUDE = {{ "{_SECRET_TEXT}" = 1 }} }}\n',
        _GOOD.replace("[[peer]]", f'role = "{_SECRET_TEXT}"\n[[peer]]'),
        f'{_GOOD}[routing]\nunknown_targets = "{_SECRET_TEXT}"\n',
        f'{_GOOD}budget_bits_s = "{_SECRET_TEXT}"\n',
        f'control_socket = "{_SECRET_TEXT}"\n{_GOOD}',
        f'{_GOOD}[log]\nlevel = "{_SECRET_TEXT}"\n',
        f'link = "{_SECRET_TEXT}"\n{_GOOD}',
        f'peer = "{_SECRET_TEXT}"\n{_TOP}',
        f"{_SECRET_TEXT}\n",
        f"PrivateKey = {_SECRET_TEXT}\n",
        f'["{_SECRET_TEXT}"]\n["{_SECRET_TEXT}"]\n',
        f'"{_SECRET_TEXT}" = 1\n"{_SECRET_TEXT}" = 2\n',
    ],
)
def test_no_message_repeats_a_key(load: Load, text: str) -> None:
    """Wherever a key was pasted by mistake, what is printed has no part of it, nor has the exception."""
    with pytest.raises(ConfigError) as caught:
        load(text)
    for shown in (str(caught.value), repr(caught.value), repr(caught.value.problems)):
        for start in range(0, 36, 6):
            assert _SECRET_TEXT[start : start + 8] not in shown
        assert base64.b64decode(_SECRET_TEXT).hex() not in shown
    assert caught.value.__cause__ is None
    assert caught.value.__suppress_context__ or caught.value.__context__ is None


def test_message_controls_no_terminal(load: Load) -> None:
    """Escape sequences in keys and values stay in the file."""
    with pytest.raises(ConfigError) as caught:
        load(f'{_GOOD}"\\u001b[2J" = 1\npsk_file = "\\u001b[2J"\n'.replace('"drone0"', '"\\u001b[2J"'))
    assert len(caught.value.problems) == 3
    assert str(caught.value).replace("\n", "").isprintable()


@pytest.mark.parametrize(
    ("content", "line", "column", "says"),
    [
        (b"name = drone0\n", 1, 8, "text must be in quotes"),
        (b'name = "drone0"\nlisten = ["0.0.0.0:5790"\n', 3, 1, "Unclosed array"),
        (b'name = "a"\nname = "b"\n', 2, 11, "Cannot overwrite a value"),
        (b"[link]\n[link]\n", 2, 6, "Cannot declare twice"),
        (b'name = "drone\xff"\n', 1, 14, "UTF-8"),
        (b"\nx = 1\nname = True\n", 3, 8, "true and false in small letters"),
    ],
)
def test_syntax_error_has_its_line_and_column(
    folder: Path, content: bytes, line: int, column: int, says: str
) -> None:
    """In the form that editors open: FILE:LINE:COLUMN."""
    path = folder / "drone0.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        load_config(path, {})
    (problem,) = caught.value.problems
    assert problem.file.startswith(f"{path}:{line}:")
    if says != "Cannot overwrite a value":  # whose column differs between versions of Python
        assert problem.file == f"{path}:{line}:{column}"
    assert says in problem.message


@pytest.mark.parametrize("content", ["x = " + "[" * 100_000, "x = " + "9" * 100_000, "#" * (1 << 20) + "\n"])
def test_file_that_no_parser_takes_is_a_problem_too(load: Load, content: str) -> None:
    """Neither depth, nor length of a number or of the file, raises anything else."""
    with pytest.raises(ConfigError):
        load(content)


@pytest.mark.parametrize("value", [hex(1 << 40_000), f"[{hex(1 << 40_000)}]", f'["{"9" * 40_000}"]', "[2024-01-01]"])
@pytest.mark.parametrize("key", ["system_ids", "allow_in", "rate_in", "mavlink1"])
def test_value_that_no_policy_takes_is_a_problem_too(load: Load, key: str, value: str) -> None:
    """Neither a number of ten thousand digits nor a date raises anything else, or fills a screen."""
    with pytest.raises(ConfigError) as caught:
        load(f"{_GOOD.replace('system_ids', '#')}{key} = {value}\n")
    assert len(str(caught.value)) < 1000


def test_file_that_cannot_be_read_is_named(folder: Path) -> None:
    """A missing file and a folder are told apart."""
    with pytest.raises(ConfigError, match=r"none\.toml: cannot be read: No such file"):
        load_config(folder / "none.toml", {})
    with pytest.raises(ConfigError, match="cannot be read: Is a directory"):
        load_config(folder, {})


def test_byte_order_mark_is_no_mistake(folder: Path) -> None:
    """Some editors write one."""
    path = folder / "drone0.toml"
    path.write_bytes(b"\xef\xbb\xbf" + _GOOD.encode())
    assert load_config(path, {}).name == "drone0"


# Text -> a part of the one warning it gives.
_WARNED = {
    "open endpoint": (_GOOD.replace("127.0.0.1", "0.0.0.0"), r"listens beyond loopback.*stranger.*arm.*parameters"),
    "open IPv6 endpoint": (_GOOD.replace("127.0.0.1", "[::]"), "listens beyond loopback"),
    "sending endpoint": (_GOOD.replace("udpin:127.0.0.1", "udpout:10.0.0.9"), "sends beyond this machine"),
    "open metrics": (
        _GOOD + '[metrics]\nlisten = "0.0.0.0:9790"\n',
        r'metrics\.listen is beyond loopback.*who is linked with whom.*listen = "127\.0\.0\.1:9790"',
    ),
    "no endpoint": (_TOP + _LISTEN + _PEER, r"no \[\[endpoint\]\]"),
    "no peer": (_TOP + _LISTEN + _ENDPOINT, r"no \[\[peer\]\]"),
    "short tag": (_GOOD + "tag_bits = 64\n", "tags of 64 bits with drone1"),
    "short tag for all": (
        f"{_TOP}{_LISTEN}[link]\ntag_bits = 64\n{_ENDPOINT}{_PEER}{_OTHER_PEER}",
        "with every peer:",
    ),
    "long MAC key": (_GOOD + "mac_key_bits = 1024\n", r"over 512 bits.*RFC 2104"),
    "tag of a confidential link": (_GOOD + "confidential = true\ntag_bits = 64\n", "mean nothing with drone1"),
    "large envelope": (_GOOD + "max_envelope_bytes = 1453\n", "envelopes over 1,452 bytes"),
    "mlkem768": (_GOOD + "suites = ['mlkem768']\n", r"mlkem768.*1,3\d\d bytes.*1,280"),
    "mlkem1024": (_GOOD + "suites = ['x25519', 'mlkem1024']\n", r"mlkem1024.*1,7\d\d bytes.*fragments"),
    "peer of another family": (_GOOD.replace("10.13.0.2", "[2001:db8::2]"), r'add "\[::\]:5790"'),
    "link on loopback": (_GOOD.replace("0.0.0.0", "127.0.0.1"), "neither reaches the other"),
    "one address for two": (
        _GOOD + _OTHER_PEER + 'addresses = ["10.13.0.2:5790"]\n',
        "10.13.0.2:5790 in common",
    ),
    "one PSK for two": (
        f'{_GOOD}psk_file = "pair.psk"\n{_OTHER_PEER}psk_file = "pair.psk"\n',
        "have the same PSK",
    ),
    "open server": (
        _GOOD.replace("udpin:127.0.0.1", "tcpin:0.0.0.0"),
        r"listens beyond loopback.*stranger.*tcpin:127\.0\.0\.1:14550",
    ),
    "open endpoint with a policy": (
        _GOOD.replace("127.0.0.1", "0.0.0.0").replace("[[peer]]", 'role = "observer"\n[[peer]]'),
        r"stranger.*say and hear what its policy lets through",
    ),
    "connection into the network": (
        _GOOD.replace("udpin:127.0.0.1", "tcp:10.0.0.9"),
        r"connects beyond this machine.*speak to every peer with any message",
    ),
    "peer trusted with everything": (
        _GOOD.replace("swarm-member", "all"),
        r'^peer "drone1": role = "all": it may send every message',
    ),
    "two peers trusted with everything": (
        (_GOOD + _OTHER_PEER).replace("swarm-member", "all"),
        r'^peer "drone1", peer "drone2": role = "all"',
    ),
    "peer trusted with every system": (_GOOD.replace("[2]", '["all"]'), r'^peer "drone1": system_ids is "all"'),
    "command denied that may travel unseen": (
        _GOOD + 'allow_in = ["commands", "files"]\ndeny_in = ["MAV_CMD_NAV_PATHPLANNING"]\n',
        r'^peer "drone1": deny_in.*FILE_TRANSFER_PROTOCOL',
    ),
    "the same at an endpoint": (
        _GOOD.replace("[[peer]]", 'deny_in = ["MAV_CMD_NAV_PATHPLANNING"]\n[[peer]]'),
        r'^endpoint "autopilot": deny_in',
    ),
    "command denied whose effect stays possible": (
        _GOOD + 'allow_in = ["manual", "MAV_CMD_COMPONENT_ARM_DISARM"]\ndeny_in = ["MAV_CMD_COMPONENT_ARM_DISARM"]\n',
        r"arming and disarming stays possible by RC_CHANNELS_OVERRIDE, MANUAL_CONTROL: denial is best effort",
    ),
    "endpoint trusted with every system in so many words": (
        _GOOD.replace("[[peer]]", 'system_ids = "all"\n[[peer]]'),
        r'^endpoint "autopilot": system_ids is "all"',
    ),
    "one system for two peers": (
        _GOOD.replace("[2]", '["1-3"]') + _OTHER_PEER.replace("[3]", "[1, 3, 4]"),
        r'^peer "drone1" and peer "drone2" may speak as the same systems 1, 3:',
    ),
    "one system for three": (
        (_GOOD + _OTHER_PEER).replace("[3]", "[2]").replace('14550"', '14550"\nsystem_ids = [2]'),
        r'^peer "drone1", peer "drone2" and endpoint "autopilot" may speak as the same system 2:',
    ),
    "vehicles relayed to vehicles": (
        (_GOOD + _OTHER_PEER).replace("swarm-member", "vehicle") + "[routing]\nrelay = true\n",
        r'relay = true.*"drone1", "drone2".*write to another vehicle',
    ),
    "handshake that takes longer than its retry": (
        _GOOD + "budget_bits_s = 9000\nsuites = ['ffdhe8192']\nretry_max_s = 1\n",
        r"handshake with ffdhe8192 takes 1\.1 s at 9,000 bits/s.*retry_max_s = 3$",
    ),
}


@pytest.mark.parametrize("case", _WARNED)
def test_what_a_person_should_know_is_said_once(load: Load, case: str) -> None:
    """One sentence for each, and the configuration is good."""
    text, says = _WARNED[case]
    (warning,) = load(text).warnings
    assert re.search(says, warning)


@pytest.mark.parametrize(
    "lines",
    [
        "tag_bits = 96",
        "mac_key_bits = 512",
        "max_envelope_bytes = 1452",
        "suites = ['ffdhe8192']",
        "budget_bits_s = 1000",
        'allow_in = ["commands"]\ndeny_in = ["MAV_CMD_NAV_PATHPLANNING"]',
        '[routing]\nrelay = true\nunknown_targets = "drop"',
        '[[endpoint]]\nname = "companion"\nurl = "tcp:127.0.0.1:5760"\nsystem_ids = [1]\nrole = "vehicle"',
    ],
)
def test_what_is_well_gives_no_warning(load: Load, lines: str) -> None:
    """The last value before each warning."""
    assert load(f"{_GOOD}{lines}\n").warnings == ()


_CALLED = {"slow-radio": "drone2"}  # files that are called for what they show


_OTHERS = {"mitm"}  # files of other programs, with tests of their own


@pytest.mark.parametrize(
    "path", sorted(each for each in EXAMPLES.glob("*.toml") if each.stem not in _OTHERS), ids=lambda path: path.stem
)
def test_example_is_good(tmp_path: Path, path: Path) -> None:
    """Each file in configs/ loads without a warning, beside the key files that it names."""
    copy = Path(shutil.copy(path, tmp_path))
    assert not list(tmp_path.glob("*.key"))
    keys.write_secret_file(
        tmp_path / tomllib.loads(path.read_text())["private_key_file"], keys.generate_private_key()
    )
    config = load_config(copy, {})
    assert (config.name, config.warnings) == (_CALLED.get(path.stem, path.stem), ())
    assert config.peers
    assert config.endpoints


def test_example_with_every_link_key_has_the_defaults() -> None:
    """What the ground station's file says of defaults is so, and it leaves none out."""
    table = tomllib.loads((EXAMPLES / "ground-station.toml").read_text())
    assert set(table["link"]) == set(LinkSection.model_fields)
    assert LinkSection.model_validate(table["link"]) == LinkSection()
    assert set(table["routing"]) == set(RoutingSection.model_fields)
    assert RoutingSection.model_validate(table["routing"]) == RoutingSection()
    off = {"metrics": {"listen"}, "recording": {"folder"}}  # what is off by default stands there as a comment
    for name, model in (("metrics", MetricsSection), ("recording", RecordingSection)):
        assert set(table[name]) == set(model.model_fields) - off[name]
        assert model.model_validate(table[name]) == model()
    (endpoint,) = table["endpoint"]
    assert set(endpoint) == set(EndpointSection.model_fields) - set(PolicySection.model_fields)
    written = EndpointSection.model_validate(endpoint)
    assert written == EndpointSection(name=written.name, url=endpoint["url"])


def test_what_is_off_in_the_example_can_be_switched_on(tmp_path: Path) -> None:
    """The lines of [metrics] and [recording] that are comments are good, and give no warning."""
    text = (EXAMPLES / "ground-station.toml").read_text()
    keys.write_secret_file(tmp_path / "ground-station.key", keys.generate_private_key())
    (tmp_path / "on.toml").write_text(re.sub(r"(?m)^# (?=(listen|folder) = )", "", text))
    config = load_config(tmp_path / "on.toml", {})
    assert config.metrics == Address("127.0.0.1", 9790)
    assert config.recording is not None
    assert config.recording.folder == tmp_path / "recordings"
    assert config.warnings == ()


def test_example_explains_every_policy_key() -> None:
    """Each stands in the ground station's file, in its comment if not in a peer."""
    words = set(re.findall(r"\w+", (EXAMPLES / "ground-station.toml").read_text()))
    assert set(PolicySection.model_fields) == set(KEYS)
    assert set(KEYS) <= words
    assert set(ROLES) <= set(re.findall(r"[\w-]+", (EXAMPLES / "ground-station.toml").read_text()))


def test_what_an_example_has_in_comments_is_good_too(tmp_path: Path) -> None:
    """The ground station and the observer of drone0.toml, once their lines are no comments."""
    text = (EXAMPLES / "drone0.toml").read_text()
    more = text[text.index("# [[peer]]") :]
    keys.write_secret_file(tmp_path / "drone0.key", keys.generate_private_key())
    (tmp_path / "drone0.toml").write_text(text + "\n" + re.sub(r"(?m)^# ?", "", more))
    config = load_config(tmp_path / "drone0.toml", {})
    assert [peer.name for peer in config.peers] == ["drone1", "ground-station", "observer"]
    assert config.warnings == ()


_README = Path(__file__).parents[2] / "README.md"
_BLOCKS = re.findall(r"^```toml\n(.*?)^```", _README.read_text(), re.DOTALL | re.MULTILINE)


def test_readme_has_a_configuration() -> None:
    """There is one to be tested below."""
    assert _BLOCKS


@pytest.mark.parametrize("text", _BLOCKS)
def test_configuration_in_the_readme_is_good(tmp_path: Path, text: str) -> None:
    """Copied as it is, beside the key files that it names, it loads."""
    table = tomllib.loads(text)
    keys.write_secret_file(tmp_path / table["private_key_file"], keys.generate_private_key())
    for peer in table.get("peer", []):
        if "psk_file" in peer:
            keys.write_secret_file(tmp_path / peer["psk_file"], keys.generate_psk())
    (tmp_path / "readme.toml").write_text(text)
    config = load_config(tmp_path / "readme.toml", {})
    assert config.peers
    assert config.endpoints


def test_examples_name_one_another() -> None:
    """Each pair of files agrees about its keys: a peer called drone1 has one key in all of them."""
    found: dict[str, set[str]] = {}
    for path in EXAMPLES.glob("*.toml"):
        for peer in tomllib.loads(path.read_text()).get("peer", []):
            found.setdefault(peer["name"], set()).add(peer["public_key"])
    assert {"drone0", "drone1"} <= set(found)
    assert all(len(known) == 1 for known in found.values())


def test_no_private_key_is_kept_with_the_examples() -> None:
    """Their keys were thrown away: a copied example cannot be spoken for by anybody."""
    assert [path.name for path in EXAMPLES.iterdir() if path.suffix in (".key", ".psk")] == []


def test_environment_is_the_callers(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process's own variables are not looked at behind the caller's back."""
    os.rename(folder / "drone0.key", folder / "moved")
    (folder / "elsewhere").mkdir()
    os.rename(folder / "moved", folder / "elsewhere" / "drone0.key")
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(folder / "elsewhere"))
    path = folder / "drone0.toml"
    path.write_text(_GOOD)
    with pytest.raises(ConfigError, match="there is no file"):
        load_config(path, {})
