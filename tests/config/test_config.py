"""The configuration: the meaning of a valid file, and the problems and warnings of others."""

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

from uavlinkd.config import Config, ConfigError, PeerAddress, Recording, Routing, keys
from uavlinkd.config.changes import compare
from uavlinkd.config.load import load_config
from uavlinkd.config.schema import (
    EndpointSection,
    LinkSection,
    MetricsSection,
    PolicySection,
    RecordingSection,
    RoutingSection,
)
from uavlinkd.core import constants as c
from uavlinkd.core.constants import DEFAULT_ENVELOPE_LIMIT, MIN_ENVELOPE_LIMIT
from uavlinkd.core.settings import Link, Timers
from uavlinkd.core.suites import SUITES_BY_NAME
from uavlinkd.mavlink.egress.budgeted import EgressSettings
from uavlinkd.mavlink.frames import Frame, SplitCounters, split_payload
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.mavlink.policy.roles import ROLES
from uavlinkd.mavlink.policy.settings import KEYS
from uavlinkd.relay.member_settings import RelayLimits
from uavlinkd.system.addresses import Address

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
    """Loads a text that has problems; returns the messages by key."""

    def refusing(text: str) -> dict[str, str]:
        with pytest.raises(ConfigError) as caught:
            load(text)
        assert str(caught.value).count("\n") == len(caught.value.problems) - 1
        return {problem.key: problem.message for problem in caught.value.problems}

    return refusing


def test_ten_lines_are_enough(load: Load, folder: Path) -> None:
    """Other keys have the specification's defaults; the key files are loaded."""
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
    assert peer.addresses == (PeerAddress(Address("10.13.0.2", 5790)),)
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
    """The defaults of the schema are those of the core."""
    section = LinkSection()
    assert {name: getattr(section, name) for name in Timers.__slots__} == dataclasses.asdict(Timers())
    assert (section.tag_bits, section.mac_key_bits, section.confidential) == (
        8 * Link().tag_bytes,
        Link().mac_key_bits,
        Link().confidential,
    )
    assert (tuple(section.suites), section.max_envelope_bytes) == (Link().suites, DEFAULT_ENVELOPE_LIMIT)


def test_control_socket_is_relative_to_the_file(load: Load, folder: Path) -> None:
    """The working directory does not matter. An absolute path is used unchanged. Off by default."""
    assert load(_GOOD).control_socket is None
    assert load(f'control_socket = "drone0.sock"\n{_GOOD}').control_socket == folder / "drone0.sock"
    assert load(f'control_socket = "/run/drone0.sock"\n{_GOOD}').control_socket == Path("/run/drone0.sock")


def test_routing_section_is_read(load: Load) -> None:
    """Without one, the daemon does not relay between peers, and a frame for an unknown target goes to all."""
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


def test_a_changed_budget_keeps_the_link(load: Load) -> None:
    """The interval depends on the budget, and a session continues when it changes."""
    before, after = (load(f"{_GOOD}budget_bits_s = {budget}\n").peers[0] for budget in (4000, 8000))
    assert before.settings.link.verify_interval_s != after.settings.link.verify_interval_s
    assert before.settings == after.settings


def test_metrics_are_off_unless_an_address_is_named(load: Load) -> None:
    """An address turns them on, and loopback causes no warning."""
    assert load(_GOOD).metrics is None
    config = load(f'{_GOOD}[metrics]\nlisten = "127.0.0.1:9790"\n')
    assert (config.metrics, config.warnings) == (Address("127.0.0.1", 9790), ())


def test_recording_is_off_unless_a_folder_is_named(load: Load, folder: Path) -> None:
    """A folder turns it on, relative to the file; the other keys have defaults."""
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
    """The keys of [link] apply to peers, not to endpoints."""
    config = load(
        f"{_TOP}{_LISTEN}[link]\nmax_age_s = 5\n{_ENDPOINT}max_age_s = 0.1\nradio_status = true\n"
        f'[[endpoint]]\nname = "gcs"\nurl = "tcpin:127.0.0.1:5760"\n{_PEER}'
    )
    assert [(endpoint.max_age_s, endpoint.radio_status) for endpoint in config.endpoints] == [
        (0.1, True),
        (1.0, False),
    ]
    assert config.peers[0].egress.max_age_s == 5


def _heartbeat(system: int, kind: int = mavlink.MAV_TYPE_QUADROTOR) -> Frame:
    message = mavlink.MAVLink_heartbeat_message(kind, 3, 0, 0, 4, 3)
    return _frame(message.pack(mavlink.MAVLink(None, srcSystem=system, srcComponent=1)))


def _frame(raw: bytes) -> Frame:
    (frame,) = split_payload(bytes(raw), SplitCounters())
    return frame


def test_policy_reaches_the_gate(load: Load) -> None:
    """A policy limits a peer or an endpoint to its systems and messages; an endpoint without one sends anything."""
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
    """A policy has state, and a configuration has none: a second policy starts with its whole rate."""
    peer = load(f"{_GOOD}rate_in = {{ HEARTBEAT = 1 }}\n").peers[0]
    first, second = peer.make_policy(), peer.make_policy()
    assert [first.incoming.check(_heartbeat(2), 0.0) for _ in range(3)] == [None, None, Refusal.RATE_LIMITED]
    assert second.incoming.check(_heartbeat(2), 0.0) is None
    assert not second.incoming.refused


def test_policy_data_is_compared_and_never_changed(load: Load) -> None:
    """On reload the daemon detects whether a peer's policy has changed. The data is immutable."""
    text = f'{_GOOD}allow_in = ["PING"]\nrate_in = {{ PING = 1 }}\n'
    first, second = load(text).peers[0].policy, load(text).peers[0].policy
    assert first == second
    assert first != load(text.replace("PING = 1", "PING = 2")).peers[0].policy
    with pytest.raises(TypeError):
        first["role"] = "operator"  # type: ignore[index]
    with pytest.raises(TypeError):
        first["rate_in"]["PING"] = 9  # type: ignore[index]
    assert first["allow_in"] == ("PING",)


def test_policy_may_have_a_table_of_its_own(load: Load) -> None:
    """TOML has two ways to write a table, and both are read."""
    inline = load(f"{_GOOD}rate_in = {{ ATTITUDE = 10, telemetry = 2.5 }}\n")
    below = load(f"{_GOOD}[peer.rate_in]\nATTITUDE = 10\ntelemetry = 2.5\n")
    assert inline.peers[0].policy == below.peers[0].policy


@pytest.mark.parametrize("url", ["udpin:127.0.0.1:1", "udpout:127.0.0.1:1", "tcp:127.0.0.1:1", "tcpin:127.0.0.1:1"])
def test_every_kind_of_endpoint_is_carried(load: Load, url: str) -> None:
    """The four kinds of network endpoints, each together with a serial one."""
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
    """A file name in the configuration may name a credential, for the private key and for PSKs."""
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


def test_remedy_for_a_missing_key_fits_its_kind(tmp_path: Path) -> None:
    """A PSK is copied from the peer; a service's key belongs to root; a unit's folder is suggested."""
    path = tmp_path / "drone0.toml"
    path.write_text(f'{_GOOD}psk_file = "pair.psk"\n')

    def problems(environ: dict[str, str]) -> list[str]:
        with pytest.raises(ConfigError) as caught:
            load_config(path, environ)
        return [str(problem) for problem in caught.value.problems]

    private, psk = problems({})
    assert f"make it with `uavlinkd keygen --out {tmp_path}/drone0.key`" in private
    assert "copy it from the peer, or make it on one of the two with `uavlinkd psk --out" in psk
    assert "--keys" not in private + psk
    for folder in ("keys", "drone0"):
        (tmp_path / folder).mkdir()
        assert all(f"add `--keys {tmp_path}/{folder}` to `uavlinkd check`" in problem for problem in problems({}))
        (tmp_path / folder).rmdir()
    credentials = tmp_path / "credentials"
    credentials.mkdir()
    for problem in problems({"CREDENTIALS_DIRECTORY": str(credentials)}):
        assert "LoadCredential=" in problem
        assert "next start" in problem
        assert "keygen" not in problem
        assert "uavlinkd psk" not in problem


_GCS = _ENDPOINT.replace("autopilot", "gcs")
_GCS_ANYWHERE = _GCS.replace("127.0.0.1", "0.0.0.0")
_HEAD = _TOP + _LISTEN
_URL = "udpin:127.0.0.1:14550"
_FIRST_URL, _SECOND_URL = "endpoint[0].url (autopilot)", "endpoint[1].url (gcs)"


def _changed(change: str | tuple[str, str]) -> str:
    """The good file with a text at its end, with one text in place of another, or (``""``) with one at its start."""
    if isinstance(change, str):
        return change if _TOP in change else _GOOD + change
    old, new = change
    return _GOOD.replace(old, new) if old else new + _GOOD


# Lines added to the peer, the key of the problem, and a part of its message.
_PEER_REFUSED = [
    ("BlockMsgIdIn = [76]", "BlockMsgIdIn", "write deny_in"),
    ('AllowedIPs = ["10.13.0.2/32"]', "AllowedIPs", "write role and system_ids"),
    ("budget_bits_s = 999", "budget_bits_s", "write 1000 or more, in bits a second, or 0 for no limit"),
    ("budget_bits_s = -1", "budget_bits_s", "0 or more"),
    ("budget_bits_s = 1_000_000_001", "budget_bits_s", "write 1000000000 or less"),
    ("budget_bits_s = 4e3", "budget_bits_s", "whole number"),
    ("coalesce_s = 0.51", "coalesce_s", "0.5 or less"),
    ("max_age_s = 61", "max_age_s", "60 or less"),
    ("coalesce_s = 0.2\nmax_age_s = 0.2", "max_age_s", "more than coalesce_s (0.2)"),
    ('allow_in = ["PING", "telemetry", "ATITUDE"]', "allow_in[2]", "did you mean 'ATTITUDE'?"),
    ("rate_out = { ATTITUDE = 0 }", "rate_out.ATTITUDE", "not a rate"),
    ("alow_in = []", "alow_in", "did you mean allow_in?"),
    ('psk_file = "no.psk"', "psk_file", "uavlinkd psk"),
    ('psk_file = "drone0.key"', "psk_file", "holds this daemon's private key"),
    ("suites = []", "suites", 'write ["x25519"]'),
    ("suites = ['x25519', 'x25519']", "suites", "twice"),
    ("suites = ['X25519']", "suites[0]", "write one of x25519"),
    ("suites = ['mlkem512']", "suites[0]", "is not a suite"),
    ("tag_bits = 16", "tag_bits", "64, 96, 128 or 256"),
    ('tag_bits = "128"', "tag_bits", "64, 96, 128 or 256"),
    ("mac_key_bits = 4096", "mac_key_bits", "256, 512, 1024 or 2048"),
    ('confidential = "yes"', "confidential", "write confidential = true"),
    ("max_envelope_bytes = 319", "max_envelope_bytes", "320 or more"),
    ("max_envelope_bytes = 65001", "max_envelope_bytes", "65000 or less"),
    ("max_envelope_bytes = 500.5", "max_envelope_bytes", "whole number"),
    ('keepalive_s = "10"', "keepalive_s", "write keepalive_s = 10"),
    ("keepalive_s = true", "keepalive_s", "write keepalive_s = 10"),
    ("keepalive_s = inf", "keepalive_s", "finite"),
    ("keepalive_s = nan", "keepalive_s", "finite"),
    ("keepalive_s = -1", "keepalive_s", "0.1 or more"),
    ("keepalive_s = 10000", "keepalive_s", "3600 or less"),
    ("echo_after_s = 1.0", "handshake_after_s", "more than echo_after_s (1)"),
    ("lost_after_s = 1.0", "lost_after_s", "more than handshake_after_s (1)"),
    ("retry_min_s = 2\nretry_max_s = 1", "retry_max_s", "at least retry_min_s (2)"),
    ("rekey_after_s = 120\nretry_max_s = 10\nreject_after_s = 139", "reject_after_s", "140 or more"),
    ('listen = ["0.0.0.0:1"]', "listen", "at the top"),
    ('Endpoint = "10.0.0.1:1"', "Endpoint", "addresses"),
    ("colour = 'red'", "colour", "the keys are"),
]
# Change of the file -> the key that the problem names, and a part of its message.
_REFUSED: list[tuple[str | tuple[str, str], str, str]] = [
    (('name = "drone0"', ""), "name", 'is missing: write name = "drone0"'),
    (('"drone0"', '"drone 0"'), "name", "letters, digits"),
    (('"drone0"', "0"), "name", "text in quotes"),
    (('"drone0.key"', '"other.key"'), "private_key_file", "uavlinkd keygen --out"),
    (('"drone0.key"', '"."'), "private_key_file", "not a regular file"),
    (('"drone0.key"', '""'), "private_key_file", "must name a file"),
    (('["0.0.0.0:5790"]', '"0.0.0.0:5790"'), "listen", 'listen = ["0.0.0.0:5790"]'),
    (("0.0.0.0:5790", "0.0.0.0"), "listen[0]", "write 0.0.0.0:5790"),
    (("0.0.0.0:5790", "drone0.local:5790"), "listen[0]", "numeric"),
    (('["0.0.0.0:5790"]', '["0.0.0.0:5790", "127.0.0.1:5790"]'), "listen", "cannot listen on at once"),
    ("[[link]]\ntag_bits = 96\n", "link", "write [link]"),
    (("", 'log = "info"\n'), "log", "write [log]"),
    ('[log]\nlevel = "verbose"\n', "log.level", "'debug', 'info', 'warning' or 'error'"),
    (("[[endpoint]]", "[endpoint]"), "endpoint", "[[endpoint]]"),
    (f"peer = [1]\n{_HEAD}{_ENDPOINT}", "peer", "[[peer]]"),
    (('url = "udpin:127.0.0.1:14550"', ""), _FIRST_URL, 'url = "udpin:127.0.0.1:14550"'),
    (("udpin:", "udp:"), _FIRST_URL, "udpout:127"),
    (
        _GOOD.replace(_URL, "serial:/dev/a:57600") + _GCS.replace(_URL, "serial:/dev/a:115200"),
        _SECOND_URL,
        "is the device of endpoint[0] (autopilot) too",
    ),
    ((_GOOD + _GCS_ANYWHERE).replace("udpin", "tcpin"), _SECOND_URL, "listens where endpoint[0] (autopilot) does"),
    (("[[peer]]", "Port = 14550\n[[peer]]"), "endpoint[0].Port (autopilot)", 'write url = "udpin:127.0.0.1:14550"'),
    (
        ("[[peer]]", "Baud = 57600\n[[peer]]"),
        "endpoint[0].Baud (autopilot)",
        'write url = "serial:/dev/ttyACM0:57600"',
    ),
    (("", 'log_level = "debug"\n'), "log_level", "write [log]"),
    (("[[peer]]", "max_age_s = 0.09\n[[peer]]"), "endpoint[0].max_age_s (autopilot)", "0.1 or more"),
    (("[[peer]]", "radio_status = 1\n[[peer]]"), "endpoint[0].radio_status (autopilot)", "write radio_status = true"),
    (("[[peer]]", 'deny_in = ["shells"]\n[[peer]]'), "endpoint[0].deny_in[0] (autopilot)", "did you mean 'shell'?"),
    ('[routing]\nrelay = "no"\n', "routing.relay", "write relay = true"),
    ('[routing]\nunknown_targets = "ask"\n', "routing.unknown_targets", "'flood' or 'drop'"),
    ("[[routing]]\nrelay = true\n", "routing", "write [routing]"),
    (("", "relay = true\n"), "relay", "in [routing]"),
    (f'{_HEAD}[link]\nrole = "vehicle"\n{_ENDPOINT}{_PEER}', "link.role", "in a [[peer]] or an [[endpoint]]"),
    (("swarm-member", "pilot"), "peer[0].role (drone1)", "the roles are vehicle, "),
    (("system_ids", "#"), "peer[0].system_ids (drone1)", "which systems"),
    (("", 'control_socket = ""\n'), "control_socket", "must name a file"),
    (_GOOD + _ENDPOINT.replace("14550", "14551"), "endpoint[1].name (autopilot)", "name of endpoint[0] (autopilot)"),
    (_GOOD + _GCS_ANYWHERE, _SECOND_URL, "listens where endpoint[0] (autopilot) does"),
    (("14550", "5790"), _FIRST_URL, "has the port that `listen` has for peers"),
    (("udpin:127.0.0.1:14550", "udpout:127.0.0.1:5790"), _FIRST_URL, "own port for peers"),
    (_GOOD + _GCS.replace("udpin", "udpout"), _SECOND_URL, "frames would loop"),
    ((_GOOD + _GCS).replace("udpin", "udpout"), _SECOND_URL, "arrive twice"),
    (("public_key", "#"), "peer[0].public_key (drone1)", "what `uavlinkd pubkey` prints on the peer"),
    ((_ONE, "AAAA"), "peer[0].public_key (drone1)", "is not a key"),
    (_GOOD + _PEER.replace(_ONE, _TWO), "peer[1].name (drone1)", "is the name of peer[0] (drone1) too"),
    (_GOOD + _PEER.replace("drone1", "drone2"), "peer[1].public_key (drone2)", "is the key of peer[0] (drone1) too"),
    ((".2:5790", ".2"), "peer[0].addresses[0] (drone1)", "10.13.0.2:5790"),
    (("10.13.0.2", "0.0.0.0"), "peer[0].addresses[0] (drone1)", "every address of this machine"),
    (("10.13.0.2", "localhost"), "peer[0].addresses (drone1)", "where this daemon listens"),
    (('["10.13.0.2:5790"]', '["a:1", "a:1"]'), "peer[0].addresses (drone1)", "names an address twice"),
    (_TOP + _ENDPOINT + _PEER.replace("addresses", "#"), "peer[0].addresses (drone1)", "neither end could initiate"),
    (f"{_HEAD}[link]\nlost_after_s = 1\n{_ENDPOINT}{_PEER}", "link.lost_after_s", "more than handshake_after_s (1)"),
    (
        f"{_HEAD}[link]\nlost_after_s = 8\n{_ENDPOINT}{_PEER}handshake_after_s = 9\n",
        "peer[0].lost_after_s (drone1)",
        "more than handshake_after_s (9)",
    ),
    ('[metrics]\nlisten = "127.0.0.1"\n', "metrics.listen", "127.0.0.1:5790"),
    ('[metrics]\nlisten = "drone0.local:9790"\n', "metrics.listen", "numeric"),
    (
        _GOOD.replace("udpin", "tcpin") + '[metrics]\nlisten = "127.0.0.1:14550"\n',
        "metrics.listen",
        "is where endpoint[0] (autopilot) listens",
    ),
    (("", 'folder = "flights"\n'), "folder", "in [recording]"),
    ('[recording]\nfolder = ""\n', "recording.folder", "must name a file"),
    ("[recording]\nmax_file_bytes = 9999\n", "recording.max_file_bytes", "10000"),
    ("[recording]\nmax_file_bytes = 1e6\n", "recording.max_file_bytes", "max_file_bytes = 64_000_000"),
    ("[recording]\nmin_free_bytes = 0\n", "recording.min_free_bytes", "100000"),
    (
        _GOOD + _OTHER_PEER + '[recording]\nfolder = "flights"\nmax_files = 2\n',
        "recording.max_files",
        "more than the number of peers, each of which has a file: write 3",
    ),
    ("confidental = true\n", "peer[0].confidental (drone1)", "did you mean confidential?"),
    (("public_key", "PublicKey"), "peer[0].PublicKey (drone1)", "did you mean public_key?"),
    (("[[peer]]", "[[peers]]"), "peers", "did you mean [[peer]]?"),
    (("", "tag_bits = 96\n"), "tag_bits", "in [link] or in a [[peer]]"),
    (("", f'private_key = "{_TWO}"\n'), "private_key", "this file never contains a key"),
    *((f"{lines}\n", f"peer[0].{key} (drone1)", says) for lines, key, says in _PEER_REFUSED),
]


@pytest.mark.parametrize(("change", "key", "says"), _REFUSED, ids=[f"{key}: {says}" for _, key, says in _REFUSED])
def test_problem_is_named_with_what_to_write(
    refused: Refused, change: str | tuple[str, str], key: str, says: str
) -> None:
    """Each mistake causes one problem: it names the key and what to write instead."""
    problems = refused(_changed(change))
    assert says in problems.get(key, f"not among {problems}")
    # A key that has another name is also missing under its own.
    assert all(other == key or "is missing" in message for other, message in problems.items()), problems


@pytest.mark.parametrize(
    "name",
    [
        *("modp768", "modp1024", "MODP-1024", "ffdhe512", "ffdhe1024", "dh1024"),
        *("dh_1024", "dhe768", "group1", "group2", "1024"),
    ],
)
def test_small_diffie_hellman_group_is_refused_with_the_reason(refused: Refused, name: str) -> None:
    """Under any common name: one computation in advance breaks all exchanges in a group of 1024 bits or less."""
    for message in (
        refused(f'{_GOOD}suites = ["x25519", "{name}"]\n')["peer[0].suites[1] (drone1)"],
        refused(f'{_TOP}{_LISTEN}[link]\nsuites = ["{name}"]\n{_ENDPOINT}{_PEER}')["link.suites[0]"],
    ):
        assert re.search(r"(512|768|1024) bits.*refused.*Logjam.*ffdhe2048", message)


def test_small_group_as_a_number_is_refused_with_the_reason(refused: Refused) -> None:
    """A size alone is understood as well."""
    assert "Logjam" in refused(f"{_GOOD}suites = [1024]\n")["peer[0].suites[0] (drone1)"]


def test_larger_unknown_group_is_not_called_breakable(refused: Refused) -> None:
    """The message names the reason only where it applies."""
    for name in ("modp2048", "ffdhe1025", "group14", "p256"):
        message = refused(f'{_GOOD}suites = ["{name}"]\n')["peer[0].suites[0] (drone1)"]
        assert "Logjam" not in message
        assert "is not a suite" in message


# u-coordinates whose multiples by 8 vanish, from their definition: 0 (order 2 on the curve), 1 and -1 (order 4).
_PRIME = 2**255 - 19


@pytest.mark.parametrize("number", [0, 1, _PRIME - 1, _PRIME, _PRIME + 1, 2**255, 2**255 + 1])
def test_public_key_of_low_order_is_refused(refused: Refused, number: int) -> None:
    """With such a point everyone knows the shared secret, in any encoding."""
    text = base64.b64encode(number.to_bytes(32, "little")).decode()
    assert "low order" in refused(_GOOD.replace(_ONE, text))["peer[0].public_key (drone1)"]


def test_second_spelling_of_a_point_is_refused(refused: Refused) -> None:
    """The same point with its unused bit set would look like another peer."""
    number = int.from_bytes(keys.decode_key(_ONE), "little") | 2**255
    text = base64.b64encode(number.to_bytes(32, "little")).decode()
    assert "not a public key of X25519" in refused(_GOOD.replace(_ONE, text))["peer[0].public_key (drone1)"]


def test_own_keys_are_refused_for_peers(refused: Refused, folder: Path) -> None:
    """This daemon's public key and, by a worse accident, its private key."""
    private = (folder / "drone0.key").read_text().strip()
    own = refused(_GOOD.replace(_ONE, keys.public_key_text(private)))
    assert "own key" in own["peer[0].public_key (drone1)"]
    leaked = refused(_GOOD.replace(_ONE, private))
    assert "private key" in leaked["peer[0].public_key (drone1)"]
    assert private not in str(leaked)


def test_hub_needs_no_endpoint(load: Load) -> None:
    """A daemon that relays between two peers or more works without clients."""
    assert load(f"{_TOP}{_LISTEN}{_PEER}{_OTHER_PEER}[routing]\nrelay = true\n").warnings == ()


def test_peer_with_a_name_for_address_may_be_anywhere(load: Load) -> None:
    """There is no warning about an address that only a resolver knows, nor about a peer on this machine."""
    local = _GOOD.replace("0.0.0.0", "127.0.0.1")
    assert load(local.replace("10.13.0.2", "drone1.local")).warnings == ()
    assert load(local.replace("10.13.0.2:5790", "127.0.0.1:5791")).warnings == ()


def test_every_problem_is_listed_at_once(refused: Refused) -> None:
    """One run reports all problems, also those between values while other values are invalid."""
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
        *("name", "private_key_file", "listen", "link.suites[0]", "link.handshake_after_s", "link.colour"),
        *("endpoint[0].url (a)", "endpoint[1].name (a)", "endpoint[1].url (a)", "peer[0].public_key (b)"),
        *("peer[0].retry_max_s (b)", "peer[0].role (b)", "peer[0].system_ids (b)", "peer[1].name (b)"),
        *("peer[1].public_key (b)", "peer[1].addresses[0] (b)", "peer[1].psk_file (b)"),
        *("peer[1].role (b)", "peer[1].system_ids (b)"),
    }


def test_problem_of_link_is_not_repeated_for_every_peer(refused: Refused) -> None:
    """A problem that a peer inherits is reported once, for [link]; an invalid value causes no second problem."""
    two = _PEER + _PEER.replace("drone1", "drone2").replace(_ONE, _TWO).replace("10.13.0.2", "10.13.0.3")
    assert set(refused(f"{_TOP}{_LISTEN}[link]\nlost_after_s = 0.5\n{two}")) == {"link.lost_after_s"}
    wrong = f'{_TOP}{_LISTEN}[link]\nlost_after_s = "long"\n{two}handshake_after_s = 5\n'
    assert set(refused(wrong)) == {"link.lost_after_s"}


def test_problem_reads_as_a_line(load: Load, folder: Path) -> None:
    """File, key with the section's name, the problem and what to write."""
    with pytest.raises(ConfigError) as caught:
        load(_GOOD.replace(".2:5790", ".2"))
    assert str(caught.value) == (
        f"{folder / 'drone0.toml'}: peer[0].addresses[0] (drone1): has no port: write 10.13.0.2:5790"
    )


_SECRET_TEXT = base64.b64encode(b"thirty-two bytes, to be secret!!").decode()


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
    """A key that was pasted by mistake appears neither in the output nor in the exception, not even in part."""
    with pytest.raises(ConfigError) as caught:
        load(text)
    for shown in (str(caught.value), repr(caught.value), repr(caught.value.problems)):
        for start in range(0, 36, 6):
            assert _SECRET_TEXT[start : start + 8] not in shown
        assert base64.b64decode(_SECRET_TEXT).hex() not in shown
    assert caught.value.__cause__ is None
    assert caught.value.__suppress_context__ or caught.value.__context__ is None


def test_message_cannot_control_a_terminal(load: Load) -> None:
    """Escape sequences in keys and values stay in the file."""
    with pytest.raises(ConfigError) as caught:
        load(f'{_GOOD}"\\u001b[2J" = 1\npsk_file = "\\u001b[2J"\n'.replace('"drone0"', '"\\u001b[2J"'))
    assert len(caught.value.problems) == 3
    assert str(caught.value).replace("\n", "").isprintable()


@pytest.mark.parametrize(
    ("content", "line", "column", "says"),
    [
        (b"name = drone0\n", 1, 8, "without quotation marks"),
        (b"x.y = \n", 1, 7, "not valid TOML here: Invalid value"),
        (b'name = "drone\xff"\n', 1, 14, "UTF-8"),
        (b"\nx = 1\nname = True\n", 3, 8, "true or false in small letters"),
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
    assert problem.file == f"{path}:{line}:{column}"
    assert says in problem.message


@pytest.mark.parametrize("content", ["x = " + "[" * 100_000, "x = " + "9" * 100_000, "#" * (1 << 20) + "\n"])
def test_file_that_the_parser_refuses_is_a_problem(load: Load, content: str) -> None:
    """Deep nesting, a long number and a long file raise a ConfigError, and no other exception."""
    with pytest.raises(ConfigError):
        load(content)


@pytest.mark.parametrize("value", [hex(1 << 40_000), f"[{hex(1 << 40_000)}]", f'["{"9" * 40_000}"]', "[2024-01-01]"])
@pytest.mark.parametrize("key", ["system_ids", "allow_in", "rate_in", "mavlink1"])
def test_value_that_the_policy_refuses_is_a_problem(load: Load, key: str, value: str) -> None:
    """A number of ten thousand digits and a date raise a ConfigError with a short message."""
    with pytest.raises(ConfigError) as caught:
        load(f"{_GOOD.replace('system_ids', '#')}{key} = {value}\n")
    assert len(str(caught.value)) < 1000


def test_file_that_cannot_be_read_is_named(folder: Path) -> None:
    """The message distinguishes a missing file and a folder."""
    with pytest.raises(ConfigError, match=r"none\.toml: cannot be read: No such file"):
        load_config(folder / "none.toml", {})
    with pytest.raises(ConfigError, match="cannot be read: Is a directory"):
        load_config(folder, {})


def test_byte_order_mark_is_accepted(folder: Path) -> None:
    """Some editors write one."""
    path = folder / "drone0.toml"
    path.write_bytes(b"\xef\xbb\xbf" + _GOOD.encode())
    assert load_config(path, {}).name == "drone0"


# Change of the file -> a part of its only warning.
_WARNED: list[tuple[str | tuple[str, str], str]] = [
    (("127.0.0.1", "0.0.0.0"), r"listens beyond loopback.*any sender.*arm.*parameters"),
    (("127.0.0.1", "[::]"), "listens beyond loopback"),
    (("udpin:127.0.0.1", "udpout:10.0.0.9"), "sends beyond this machine"),
    (
        '[metrics]\nlisten = "0.0.0.0:9790"\n',
        r'metrics\.listen is beyond loopback.*reads the links of this daemon.*listen = "127\.0\.0\.1:9790"',
    ),
    (_TOP + _LISTEN + _PEER, r"no \[\[endpoint\]\]"),
    (_TOP + _LISTEN + _ENDPOINT, r"no \[\[peer\]\]"),
    (_TOP + _LISTEN + _PEER + "[routing]\nrelay = true\n", r"no \[\[endpoint\]\]"),
    ("tag_bits = 64\n", "tags of 64 bits with drone1"),
    (f"{_HEAD}[link]\ntag_bits = 64\n{_ENDPOINT}{_PEER}{_OTHER_PEER}", "with every peer:"),
    ("mac_key_bits = 1024\n", r"over 512 bits.*RFC 2104"),
    ("confidential = true\ntag_bits = 64\n", "have no effect with drone1"),
    ("max_envelope_bytes = 1453\n", "envelopes over 1,452 bytes"),
    ("suites = ['mlkem768']\n", r"mlkem768.*1,3\d\d bytes.*1,280"),
    ("suites = ['x25519', 'mlkem1024']\n", r"mlkem1024.*1,7\d\d bytes.*fragments"),
    (("10.13.0.2", "[2001:db8::2]"), r'add "\[::\]:5790"'),
    (("0.0.0.0", "127.0.0.1"), "neither reaches the other"),
    (_GOOD + _OTHER_PEER + 'addresses = ["10.13.0.2:5790"]\n', "share the address 10.13.0.2:5790"),
    (f'{_GOOD}psk_file = "pair.psk"\n{_OTHER_PEER}psk_file = "pair.psk"\n', "have the same PSK"),
    (("udpin:127.0.0.1", "tcpin:0.0.0.0"), r"listens beyond loopback.*any sender.*tcpin:127\.0\.0\.1:14550"),
    (
        _GOOD.replace("127.0.0.1", "0.0.0.0").replace("[[peer]]", 'role = "observer"\n[[peer]]'),
        r"any sender.*send and receive what its policy passes",
    ),
    (("udpin:127.0.0.1", "tcp:10.0.0.9"), r"connects beyond this machine.*send to every peer any message"),
    (("swarm-member", "all"), r'^peer "drone1": role = "all": it may send every message'),
    ((_GOOD + _OTHER_PEER).replace("swarm-member", "all"), r'^peer "drone1", peer "drone2": role = "all"'),
    (("[2]", '["all"]'), r'^peer "drone1": system_ids is "all"'),
    (
        'allow_in = ["commands", "files"]\ndeny_in = ["MAV_CMD_NAV_PATHPLANNING"]\n',
        r'^peer "drone1": deny_in.*FILE_TRANSFER_PROTOCOL',
    ),
    (("[[peer]]", 'deny_in = ["MAV_CMD_NAV_PATHPLANNING"]\n[[peer]]'), r'^endpoint "autopilot": deny_in'),
    (
        'allow_in = ["manual", "MAV_CMD_COMPONENT_ARM_DISARM"]\ndeny_in = ["MAV_CMD_COMPONENT_ARM_DISARM"]\n',
        r"arming and disarming stays possible by RC_CHANNELS_OVERRIDE, MANUAL_CONTROL: denial is best effort",
    ),
    (("[[peer]]", 'system_ids = "all"\n[[peer]]'), r'^endpoint "autopilot": system_ids is "all"'),
    (
        _GOOD.replace("[2]", '["1-3"]') + _OTHER_PEER.replace("[3]", "[1, 3, 4]"),
        r'^peer "drone1" and peer "drone2" may send as the same systems 1, 3:',
    ),
    (
        (_GOOD + _OTHER_PEER).replace("[3]", "[2]").replace('14550"', '14550"\nsystem_ids = [2]'),
        r'^peer "drone1", peer "drone2" and endpoint "autopilot" may send as the same system 2:',
    ),
    (
        (_GOOD + _OTHER_PEER).replace("swarm-member", "vehicle") + "[routing]\nrelay = true\n",
        r'relay = true.*"drone1", "drone2".*writes to another vehicle.*accept only the operator.s system_ids$',
    ),
    (
        "budget_bits_s = 9000\nsuites = ['ffdhe8192']\nretry_max_s = 1\n",
        r"handshake with ffdhe8192 takes 1\.1 s at 9,000 bits/s.*retry_max_s = 3$",
    ),
]


@pytest.mark.parametrize(("change", "says"), _WARNED, ids=[says for _, says in _WARNED])
def test_warning_is_given_once(load: Load, change: str | tuple[str, str], says: str) -> None:
    """One sentence for each case, and the configuration is valid."""
    (warning,) = load(_changed(change)).warnings
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
def test_values_below_the_limit_cause_no_warning(load: Load, lines: str) -> None:
    """The last value before each warning."""
    assert load(f"{_GOOD}{lines}\n").warnings == ()


_NAMES = {
    "slow-radio": "drone2",
    "two-radios": "drone3",
    "lte-and-sik": "drone4",
    "behind-nat": "drone5",
    "station-that-relays": "station",
}  # files whose name describes their subject
_OTHERS = {"mitm"}  # configurations of other commands, with tests of their own


def _warnings(config: Config) -> list[str]:
    """The warnings, without those about the keys of the examples."""
    return [warning for warning in config.warnings if "the key of an example" not in warning]


@pytest.mark.parametrize(
    "path", sorted(path for path in EXAMPLES.glob("*.toml") if path.stem not in _OTHERS), ids=lambda path: path.stem
)
def test_example_is_valid(tmp_path: Path, path: Path) -> None:
    """Each file in configs/ loads without a warning, beside the key files that it names."""
    copy = Path(shutil.copy(path, tmp_path))
    assert not list(tmp_path.glob("*.key"))
    keys.write_secret_file(
        tmp_path / tomllib.loads(path.read_text())["private_key_file"], keys.generate_private_key()
    )
    config = load_config(copy, {})
    assert (config.name, _warnings(config)) == (_NAMES.get(path.stem, path.stem), [])
    assert config.is_only_relay or (config.peers and config.endpoints)


def test_example_with_every_link_key_has_the_defaults() -> None:
    """The ground station's file contains every default, with its value."""
    table = tomllib.loads((EXAMPLES / "ground-station.toml").read_text())
    assert set(table["link"]) == set(LinkSection.model_fields)
    assert LinkSection.model_validate(table["link"]) == LinkSection()
    assert set(table["routing"]) == set(RoutingSection.model_fields)
    assert RoutingSection.model_validate(table["routing"]) == RoutingSection()
    off = {"metrics": {"listen"}, "recording": {"folder"}}  # the file has these as comments
    for name, model in (("metrics", MetricsSection), ("recording", RecordingSection)):
        assert set(table[name]) == set(model.model_fields) - off[name]
        assert model.model_validate(table[name]) == model()
    (endpoint,) = table["endpoint"]
    assert set(endpoint) == set(EndpointSection.model_fields) - set(PolicySection.model_fields)
    written = EndpointSection.model_validate(endpoint)
    assert written == EndpointSection(name=written.name, url=endpoint["url"])


def test_what_is_off_in_the_example_can_be_switched_on(tmp_path: Path) -> None:
    """The commented lines of [metrics] and [recording] are valid and cause no warning."""
    text = (EXAMPLES / "ground-station.toml").read_text()
    keys.write_secret_file(tmp_path / "ground-station.key", keys.generate_private_key())
    (tmp_path / "on.toml").write_text(re.sub(r"(?m)^# (?=(listen|folder) = )", "", text))
    config = load_config(tmp_path / "on.toml", {})
    assert config.metrics == Address("127.0.0.1", 9790)
    assert config.recording is not None
    assert config.recording.folder == tmp_path / "recordings"
    assert _warnings(config) == []


def test_example_explains_every_policy_key() -> None:
    """The ground station's file has each key, in a peer or in its comment."""
    words = set(re.findall(r"\w+", (EXAMPLES / "ground-station.toml").read_text()))
    assert set(PolicySection.model_fields) == set(KEYS)
    assert set(KEYS) <= words
    assert set(ROLES) <= set(re.findall(r"[\w-]+", (EXAMPLES / "ground-station.toml").read_text()))


def test_commented_lines_of_an_example_are_valid(tmp_path: Path) -> None:
    """The ground station and the observer of drone0.toml, with their lines uncommented."""
    text = (EXAMPLES / "drone0.toml").read_text()
    more = text[text.index("# [[peer]]") :]
    keys.write_secret_file(tmp_path / "drone0.key", keys.generate_private_key())
    (tmp_path / "drone0.toml").write_text(text + "\n" + re.sub(r"(?m)^# ?", "", more))
    config = load_config(tmp_path / "drone0.toml", {})
    assert [peer.name for peer in config.peers] == ["drone1", "ground-station", "observer"]
    assert _warnings(config) == []


_PAGES = ("README.md", "uavlinkd/config/README.md")
_BLOCKS = [
    block
    for page in _PAGES
    for block in re.findall(r"^```toml\n(.*?)^```", (EXAMPLES.parent / page).read_text(), re.DOTALL | re.MULTILINE)
]


def test_each_page_has_a_configuration() -> None:
    """The test below reads one from each page."""
    assert len(_BLOCKS) == len(_PAGES)


@pytest.mark.parametrize("text", _BLOCKS)
def test_configuration_in_a_readme_is_valid(tmp_path: Path, text: str) -> None:
    """The loader accepts it as it is, beside the key files that it names."""
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
    """Each pair of files agrees about its keys: a peer with the name drone1 has one key in all of them."""
    keys_by_peer: dict[str, set[str]] = {}
    for path in EXAMPLES.glob("*.toml"):
        for peer in tomllib.loads(path.read_text()).get("peer", []):
            keys_by_peer.setdefault(peer["name"], set()).add(peer["public_key"])
    assert {"drone0", "drone1"} <= set(keys_by_peer)
    assert all(len(known) == 1 for known in keys_by_peer.values())


def test_no_private_key_is_kept_with_the_examples() -> None:
    """Their keys were deleted: no attacker can use the key of a copied example."""
    assert [path.name for path in EXAMPLES.iterdir() if path.suffix in (".key", ".psk")] == []


def test_environment_is_an_argument(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The loader uses only the environment that it is given, not that of the process."""
    os.rename(folder / "drone0.key", folder / "moved")
    (folder / "elsewhere").mkdir()
    os.rename(folder / "moved", folder / "elsewhere" / "drone0.key")
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(folder / "elsewhere"))
    path = folder / "drone0.toml"
    path.write_text(_GOOD)
    with pytest.raises(ConfigError, match="there is no file"):
        load_config(path, {})


# Relays.

_MEMBERS = f'[[member]]\nname = "drone1"\npublic_key = "{_ONE}"\n[[member]]\nname = "drone2"\npublic_key = "{_TWO}"\n'
_RELAY = _TOP + _LISTEN + _MEMBERS


def test_relay_needs_members_and_little_else(load: Load) -> None:
    """Members have the default limits, and the core's feature for records."""
    config = load(_RELAY + "max_peers = 7\ndatagrams_s = 8\nbits_s = 9000\n")
    assert config.warnings == ()
    assert config.is_only_relay
    assert config.relay_server is not None
    one, two = config.relay_server.members
    assert (one.name, one.most_peers, one.limits) == ("drone1", 256, RelayLimits(2000, 20_000_000))
    assert (two.name, two.most_peers, two.limits) == ("drone2", 7, RelayLimits(8, 9000))
    assert one.peer.link.features & c.FEATURE_RECORDS


def test_relay_on_loopback_alone_is_noticed(load: Load) -> None:
    """Members on other machines do not reach it. An address beyond loopback is enough."""
    (warning,) = load(_TOP + 'listen = ["127.0.0.1:5790", "[::1]:5790"]\n' + _MEMBERS).warnings
    assert "no member on another machine reaches this relay" in warning
    assert load(_TOP + 'listen = ["127.0.0.1:5790", "[::]:5790"]\n' + _MEMBERS).warnings == ()


def test_daemon_may_be_a_relay_too(load: Load) -> None:
    """A member that is also a peer has one session for both."""
    config = load(_GOOD + _MEMBERS + "[relay_server]\nenabled = true\n")
    assert config.relay_server is not None
    assert not config.is_only_relay
    assert config.peers[0].settings.link.features & c.FEATURE_RECORDS
    assert not load(_GOOD).peers[0].settings.link.features & c.FEATURE_RECORDS


@pytest.mark.parametrize(
    ("text", "key", "part"),
    [
        (_GOOD + _MEMBERS, "relay_server.enabled", "enabled = true"),
        (_RELAY + "[relay_server]\nenabled = false\n", "relay_server.enabled", "remove the members"),
        (_GOOD + "[relay_server]\nenabled = true\n", "relay_server.enabled", "no [[member]]"),
        (_TOP + _MEMBERS, "listen", "no member could reach"),
        (_RELAY.replace("drone2", "drone1"), "member[1].name (drone1)", "write another"),
        (_RELAY.replace(_TWO, _ONE), "member[1].public_key (drone2)", "each member has its own"),
        (_RELAY + "max_peers = 0\n", "member[1].max_peers (drone2)", "too small"),
        (_RELAY + "role = 'observer'\n", "member[1].role (drone2)", "does not belong here"),
        (
            _GOOD
            + _MEMBERS.replace("drone2", "drone1x").replace("drone1", "other", 1)
            + "[relay_server]\nenabled = true\n"
            + f'[[peer]]\nname = "drone1x"\npublic_key = "{_public()}"\nrole = "observer"\nsystem_ids = [4]\n',
            "member[1].name (drone1x)",
            "which has another key",
        ),
        (
            _GOOD
            + _MEMBERS.replace("[[member]]", '[[member]]\npsk_file = "pair.psk"', 1)
            + "[relay_server]\nenabled = true\n",
            "member[0].psk_file (drone1)",
            "write it there only",
        ),
        (
            _GOOD + f'previous_public_key = "{_TWO}"\n' + _MEMBERS + "[relay_server]\nenabled = true\n",
            "peer[0].previous_public_key (drone1)",
            "is the key of member[1] (drone2)",
        ),
    ],
)
def test_relay_with_a_mistake_is_refused(refused: Refused, text: str, key: str, part: str) -> None:
    """With the key, and what to write."""
    assert part in refused(text)[key]


def test_members_change_without_a_restart(load: Load) -> None:
    """Added, removed and changed ones are named; whether there is a relay needs a restart."""
    before = load(_RELAY)
    three = f'[[member]]\nname = "drone3"\npublic_key = "{_public()}"\n'
    now = load(_RELAY.replace('name = "drone1"', 'name = "drone4"') + "bits_s = 5000\n" + three)
    assert compare(before, now).summary() == {
        "members_removed": ["drone1"],
        "members_added": ["drone4", "drone3"],
        "members_changed": ["drone2"],
    }
    with pytest.raises(ConfigError, match="relay_server: cannot change while the daemon runs"):
        compare(load(_GOOD), load(_GOOD + _MEMBERS + "[relay_server]\nenabled = true\n"))
