"""Each mistake in a file causes one problem, which names the key and what to write instead."""

from __future__ import annotations

import base64
import re
from pathlib import Path

import pytest

from tests.config.files import (
    BY_MESH,
    BY_SIK,
    ENDPOINT,
    GCS,
    GOOD,
    HEAD,
    KEY,
    LTE,
    MESH,
    OTHER_PEER,
    PEER,
    SIK,
    TOP,
    URL,
    link,
    load,
    member,
    networks,
    refused,
    relay,
    relays,
)
from uavlinkd.config import keys
from uavlinkd.config.load import load_config
from uavlinkd.config.model import ConfigError

# Lines of a peer, the key of the problem, and a part of its message.
_PEER_ROWS = [
    ('AllowedIPs = ["10.13.0.2/32"]', "AllowedIPs", "write role and system_ids"),
    ("budget_bits_s = 999", "budget_bits_s", "write 1000 or more, in bits a second, or 0 for no limit"),
    ("budget_bits_s = 4e3", "budget_bits_s", "whole number, without quotes: write budget_bits_s = 0"),
    ("coalesce_s = 0.51", "coalesce_s", "must be from 0 to 0.5"),
    ("alow_in = []", "alow_in", "did you mean allow_in?"),
    ('psk_file = "no.psk"', "psk_file", "uavlinkd psk"),
    ('psk_file = "drone0.key"', "psk_file", "holds this daemon's private key"),
    ("suites = []", "suites", 'is empty: write suites = ["x25519"]'),
    ("suites = ['x25519', 'x25519']", "suites", "names one twice"),
    ("suites = [2048]", "suites[0]", 'must be "x25519", "ffdhe2048"'),
    ('tag_bits = "128"', "tag_bits", "must be 64, 96 or 128"),
    ('confidential = "yes"', "confidential", "write confidential = true"),
    ('keepalive_s = "10"', "keepalive_s", "write keepalive_s = 10"),
    ("keepalive_s = inf", "keepalive_s", "must be from 0.1 to 3600"),
    ("keepalive_s = nan", "keepalive_s", "must be from 0.1 to 3600"),
    (f"keepalive_s = {'9' * 400}", "keepalive_s", "must be from 0.1 to 3600"),
    ('redundancy = "double"', "redundancy", 'must be "critical", "all" or "none"'),
    ('listen = ["0.0.0.0:1"]', "listen", "write it at the top of the file"),
    ('Endpoint = "10.0.0.1:1"', "Endpoint", "has a list, addresses = "),
    ('interface = "wlan0"', "interface", "write it in [[network]]"),
    ("colour = 'red'", "colour", "the keys are"),
    ("routing = 1", "routing", "write [routing], a section of its own"),
]
# Old and new text in the good file.
_CHANGE_ROWS = [
    ('name = "drone0"', "", "name", 'is missing: write name = "drone0"'),
    ('"drone0"', '"drone 0"', "name", "letters, digits"),
    ('"drone0.key"', '"other.key"', "private_key_file", "uavlinkd keygen --out"),
    ('"drone0.key"', '""', "private_key_file", "must name a file"),
    ('["0.0.0.0:5790"]', '"0.0.0.0:5790"', "listen", 'must be a list: write listen = ["0.0.0.0:5790"]'),
    ("0.0.0.0:5790", "0.0.0.0", "listen[0]", "write 0.0.0.0:5790"),
    ('["0.0.0.0:5790"]', '["0.0.0.0:5790", "127.0.0.1:5790"]', "listen", "has the port of listen too, 0.0.0.0:5790"),
    ("[[endpoint]]", "[endpoint]", "endpoint", "[[endpoint]]"),
    (f'url = "{URL}"', "", "endpoint[0].url (autopilot)", f'is missing: write url = "{URL}"'),
    ("14550", "5790", "endpoint[0].url (autopilot)", "has the port of listen too, 0.0.0.0:5790"),
    (URL, "udpout:127.0.0.1:5790", "endpoint[0].url (autopilot)", "has the port of listen too"),
    ("[[peer]]", "[[peers]]", "peers", "did you mean [[peer]]?"),
    ("swarm-member", "pilot", "peer[0].role (drone1)", "the roles are vehicle, "),
    ("system_ids", "#", "peer[0].system_ids (drone1)", "the systems that the peer may send as"),
    (KEY["drone1"], "A" * 40, "peer[0].public_key (drone1)", "is not a key: "),
    ("public_key", "#", "peer[0].public_key (drone1)", "what `uavlinkd pubkey` prints there"),
    ("10.13.0.2", "0.0.0.0", "peer[0].addresses[0] (drone1)", "every address of this machine"),
]
_AT_TOP_ROWS = [
    ("relay = true", "relay", "in [routing]"),
    ("tag_bits = 96", "tag_bits", "write it in [link] or [[peer]]"),
    (f'private_key = "{KEY["b"]}"', "private_key", "this file never contains a key"),
]
_URLS, _SECOND = "endpoint[1].url (gcs)", "endpoint[0] (autopilot)"
_PSK = 'psk_file = "pair.psk"'
_MEMBERS = member("drone1") + member("b")
_AS_PEER = relay(key=KEY["drone1"])
_ONE_ADDRESS = "is not one address of this machine"
# Whole files.
_FILE_ROWS = [
    (GOOD + "[[link]]\ntag_bits = 96\n", "link", "write [link]"),
    (f"peer = [1]\n{HEAD}{ENDPOINT}", "peer", "[[peer]]"),
    (link('role = "vehicle"'), "link.role", "write it in [[endpoint]] or [[peer]] or [[station]] or [[fleet_role]]"),
    ((GOOD + GCS).replace(URL, "serial:/dev/a:57600"), _URLS, f"is the device of {_SECOND} too"),
    (GOOD + GCS.replace("127.0.0.1", "0.0.0.0"), _URLS, "has the port of endpoint[0].url (autopilot) too"),
    ((GOOD + GCS).replace("udpin", "tcpin"), _URLS, "has the port of endpoint[0].url (autopilot) too"),
    (GOOD + GCS.replace("udpin", "udpout"), _URLS, "frames would loop"),
    ((GOOD + GCS).replace("udpin", "udpout"), _URLS, "arrive twice"),
    (GOOD + GCS.replace("gcs", "autopilot").replace("14550", "1"), "endpoint[1].name (autopilot)", f"of {_SECOND}"),
    (GOOD + PEER.replace(KEY["drone1"], KEY["b"]), "peer[1].name (drone1)", "is that of peer[0] (drone1) too"),
    (GOOD + PEER.replace('"drone1"', '"b"'), "peer[1].public_key (b)", "is that of peer[0] (drone1) too"),
    (TOP + ENDPOINT + OTHER_PEER, "peer[0].addresses (drone2)", "neither end could initiate"),
    # Networks.
    (networks(LTE + LTE.replace("wwan0", "wwan1")), "network[1].name (lte)", "is that of network[0] (lte) too"),
    (networks(LTE + LTE.replace("lte", "b")), "network[1].interface (b)", "is that of network[0] (lte) too"),
    (networks(MESH + MESH.replace("mesh", "b")), "network[1].address (b)", "is that of network[0] (mesh) too"),
    (networks(LTE + 'address = "10.0.0.5"\n'), "network[0] (lte)", "has no exit, or several"),
    (networks('[[network]]\nname = "lte"\n'), "network[0] (lte)", 'write one of interface = "wwan0"'),
    (networks(SIK + 'interface = "wwan0"\n', BY_SIK), "network[0] (sik)", "has no exit, or several"),
    (networks('[[network]]\ninterface = "wwan0"\n'), "network[0].name", 'write name = "lte"'),
    (networks(LTE.replace("wwan0", "eth0:1")), "network[0].interface (lte)", "must be a name"),
    *(
        (networks(MESH.replace("10.13.0.5", wrong)), "network[0].address (mesh)", _ONE_ADDRESS)
        for wrong in ("0.0.0.0", "10.13.0.5:5790", "224.0.0.1", "255.255.255.255", "::ffff:10.13.0.5", "fe80::5")
    ),
    (networks(LTE).replace("0.0.0.0:5790", "10.13.0.5:5790"), "listen", 'write "0.0.0.0:5790"'),
    (networks(LTE).replace("0.0.0.0:5790", "[::1]:5790"), "listen", 'write "[::]:5790"'),
    (networks(LTE).replace('90"]\n', '90", "0.0.0.0:5791"]\n', 1), "listen", "more than a port for each IP version"),
    *(
        (networks(sections, addresses), "peer[0].addresses (drone1)", says)
        for sections, addresses, says in (
            (LTE, f"[{BY_MESH}]", "the networks with addresses are lte, the networks with a serial line are none"),
            ("", f"[{BY_MESH}]", "the networks with addresses are none"),
            (LTE, '[{ network = "lte" }]', "the networks with addresses are lte"),
            (SIK, '[{ network = "sik" }, { address = "10.0.0.9:1", network = "sik" }]', "with a serial line are sik"),
        )
    ),
    *(
        (networks(MESH, f"[{written}]"), "peer[0].addresses[0] (drone1)", says)
        for written, says in (
            ('{ address = "10.13.0.9:5790" }', "must have two keys"),
            ('{ address = "10.13.0.9", network = "mesh" }', "has no port"),
            ('{ address = 5790, network = "mesh" }', "must be text"),
            ('{ address = "10.13.0.9:5790", network = "not a name" }', "must be a name"),
        )
    ),
    # Serial networks.
    (networks(SIK.replace(":57600", ""), BY_SIK), "network[0].serial (sik)", "needs a device and a baud rate"),
    (networks(SIK + "metered = true\n", BY_SIK), "network[0].metered (sik)", "leave it out"),
    (networks(SIK, '["sik"]'), "peer[0].addresses[0] (drone1)", 'end of a serial network is { network = "sik" }'),
    (networks(SIK, '["10.0.0.9:1"]'), "network[0].serial (sik)", 'addresses = [{ network = "sik" }]'),
    (
        networks(SIK + SIK.replace('"sik"', '"two"'), '[{ network = "sik" }, { network = "two" }]'),
        "network[1].serial (two)",
        "the device of network[0] (sik) too",
    ),
    (
        networks(SIK, BY_SIK, OTHER_PEER + f"addresses = {BY_SIK}\n"),
        "network[0].serial (sik)",
        "is named by peer[0] (drone1) and peer[1] (drone2)",
    ),
    (
        networks(SIK, BY_SIK, GCS.replace(URL, "serial:/dev/ttyUSB0:115200")),
        "network[0].serial (sik)",
        "the device of endpoint[1] (gcs) too",
    ),
    # Relays, and members of this one.
    (relays(relay() + relay("b") + relay("c") + relay("d")), "relay", "at most 3"),
    (relays(relay() + relay("vps", key=KEY["b"], addresses='["b:1"]')), "relay[1].name (vps)", "of relay[0] (vps)"),
    (relays(relay() + relay("b", key=KEY["vps"])), "relay[1].public_key (b)", "is that of relay[0] (vps) too"),
    (relays(relay(key=KEY["drone1"], addresses="[]")), "relay[0].addresses (vps)", "a relay never initiates"),
    (relays(_AS_PEER, 'relays = ["vps"]'), "peer[0].relays (drone1)", "or this peer itself"),
    (relays(relay(key=KEY["b"], more=member()), head=HEAD), "relay[0].public_key (vps)", "member[0] (b) too"),
    (relays(relay(addresses="[]")), "relay[0].addresses (vps)", "a relay never initiates"),
    (relays(SIK + relay(addresses=BY_SIK)), "relay[0].addresses (vps)", "has no address over IP"),
    (relays(relay(), 'relays = ["other"]'), "peer[0].relays (drone1)", 'the relays are "vps"'),
    (relays("", 'relays = ["vps"]', HEAD), "peer[0].relays (drone1)", "the relays are none"),
    (relays(relay(), "relays = []"), "peer[0].addresses (drone1)", "a [[relay]] that both ends use"),
    (GOOD + "[relay_server]\nbits_s = 1000\n", "relay_server", "no [[member]]"),
    (TOP + _MEMBERS, "listen", "no member could reach"),
    (HEAD + _MEMBERS + member("b", KEY["c"]), "member[2].name (b)", "is that of member[1] (b) too"),
    (HEAD + _MEMBERS + member("c", KEY["b"]), "member[2].public_key (c)", "is that of member[1] (b) too"),
    (GOOD + OTHER_PEER + member("drone2", KEY["c"]), "member[0].name (drone2)", "is that of peer[1] (drone2) too"),
]
_ROWS = [
    *((GOOD + lines + "\n", f"peer[0].{key} (drone1)", says) for lines, key, says in _PEER_ROWS),
    *((GOOD.replace(old, new), key, says) for old, new, key, says in _CHANGE_ROWS),
    *((f"{line}\n{GOOD}", key, says) for line, key, says in _AT_TOP_ROWS),
    *_FILE_ROWS,
]


@pytest.mark.parametrize(("text", "key", "says"), _ROWS, ids=[f"{key}: {says}" for _, key, says in _ROWS])
def test_problem_is_named_with_what_to_write(tmp_path: Path, text: str, key: str, says: str) -> None:
    """No other problem follows from it."""
    problems = refused(tmp_path, text)
    assert says in problems.get(key, f"not among {problems}")
    # A key that has another name is also missing under its own.
    assert all(other == key or "is missing" in message for other, message in problems.items()), problems


# u-coordinates whose multiples by 8 vanish, from their definition: 0 (order 2 on the curve), 1 and -1 (order 4).
_PRIME = 2**255 - 19


@pytest.mark.parametrize("number", [0, 1, _PRIME - 1, _PRIME, _PRIME + 1, 2**255, 2**255 + 1])
def test_public_key_of_low_order_is_refused(tmp_path: Path, number: int) -> None:
    """With such a point everyone knows the shared secret, in any encoding."""
    text = GOOD.replace(KEY["drone1"], base64.b64encode(number.to_bytes(32, "little")).decode())
    assert "low order" in refused(tmp_path, text)["peer[0].public_key (drone1)"]


def test_second_spelling_of_a_point_is_refused(tmp_path: Path) -> None:
    """The same point with its unused bit set would look like another peer."""
    number = int.from_bytes(keys.decode_key(KEY["drone1"]), "little") | 2**255
    text = GOOD.replace(KEY["drone1"], base64.b64encode(number.to_bytes(32, "little")).decode())
    assert "not a public key of X25519" in refused(tmp_path, text)["peer[0].public_key (drone1)"]


@pytest.mark.parametrize(
    ("section", "place"),
    [
        (PEER.replace(KEY["drone1"], "OWN"), "peer[0].public_key (drone1)"),
        (PEER + relay(key="OWN"), "relay[0].public_key (vps)"),
        (PEER + member() + member("c", "OWN"), "member[1].public_key (c)"),
    ],
    ids=["peer", "relay", "member"],
)
def test_own_key_belongs_to_no_other(tmp_path: Path, section: str, place: str) -> None:
    """A copied line would stop the daemon at its start."""
    load(tmp_path, GOOD)
    public = keys.public_key_text((tmp_path / "drone0.key").read_text())
    problems = refused(tmp_path, f"{HEAD}{ENDPOINT}{section}".replace("OWN", public))
    assert "this daemon's own key: write what `uavlinkd pubkey` prints" in problems[place]


def test_every_problem_is_listed_at_once(tmp_path: Path) -> None:
    """One run reports all problems, also those between values while other values are invalid."""
    problems = refused(
        tmp_path,
        """
        name = "drone 0"
        private_key_file = "none.key"
        listen = ["0.0.0.0:5790", "127.0.0.1:5790"]
        [link]
        suites = ["modp1024"]
        max_age_s = 99
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
        [[peer]]
        name = "b"
        addresses = ["10.0.0.256:1"]
        psk_file = "none.psk"
        """,
    )
    assert set(problems) == {
        *("name", "private_key_file", "listen", "link.suites[0]", "link.max_age_s", "link.colour"),
        *("endpoint[0].url (a)", "endpoint[1].name (a)", "endpoint[1].url (a)", "peer[0].public_key (b)"),
        *("peer[0].role (b)", "peer[0].system_ids (b)", "peer[1].name (b)"),
        *("peer[1].public_key (b)", "peer[1].addresses[0] (b)", "peer[1].psk_file (b)"),
        *("peer[1].role (b)", "peer[1].system_ids (b)"),
    }


_SECRET = base64.b64encode(b"thirty-two bytes, to be secret!!").decode()
_HEX = base64.b64decode(_SECRET).hex()


@pytest.mark.parametrize(
    "text",
    [
        *(GOOD.replace("drone0.key", text) for text in (_SECRET, _HEX, f"{_SECRET} ")),
        *(GOOD.replace(KEY["drone1"], text) for text in (f"{_SECRET}x", _SECRET[:-1])),
        *(GOOD.replace("swarm-member", text) for text in (_SECRET, _SECRET[:-1], _HEX)),
        *(GOOD.replace(text, _SECRET) for text in ("0.0.0.0:5790", URL, "10.13.0.2:5790")),
        GOOD.replace('"drone0"', f'"{_SECRET}"'),
        *(GOOD.replace("[2]", text) for text in (f'"{_SECRET}"', f'["{_SECRET}"]')),
        *(
            f'{GOOD}{key} = "{_SECRET}"\n'
            for key in (
                "psk_file",
                "psk",
                "tag_bits",
                "keepalive_s",
                "confidential",
                "allow_in",
                "mavlink1",
                "rate_in",
            )
        ),
        *(f'{GOOD}{key} = ["{_SECRET}"]\n' for key in ("psk_file", "suites")),
        f'{GOOD}"{_SECRET}" = 1\n',
        f'{GOOD}allow_in = ["{_SECRET}", ["{_SECRET}"]]\n',
        f'{GOOD}allow_in = ["command:{_SECRET}"]\n',
        f'{GOOD}rate_in = {{ "{_SECRET}" = 1 }}\n',
        f'{GOOD}rate_in = {{ ATTITUDE = {{ "{_SECRET}" = 1 }} }}\n',
        *(f'{key} = "{_SECRET}"\n{GOOD}' for key in ("private_key", "control_socket", "link")),
        f'{GOOD}[log]\nlevel = "{_SECRET}"\n',
        f'peer = "{_SECRET}"\n{TOP}',
        f"{_SECRET}\n",
        f"PrivateKey = {_SECRET}\n",
        f'["{_SECRET}"]\n["{_SECRET}"]\n',
        f'"{_SECRET}" = 1\n"{_SECRET}" = 2\n',
    ],
)
def test_no_message_repeats_a_key(tmp_path: Path, text: str) -> None:
    """A key that was pasted by mistake appears neither in the output nor in the exception, not even in part."""
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, text)
    for shown in (str(caught.value), repr(caught.value), repr(caught.value.problems)):
        assert not any(_SECRET[start : start + 8] in shown for start in range(0, 36, 6))
        assert _HEX not in shown
    assert caught.value.__cause__ is None
    assert caught.value.__suppress_context__ or caught.value.__context__ is None


def test_message_cannot_control_a_terminal(tmp_path: Path) -> None:
    """Escape sequences in keys and values stay in the file."""
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, f'{GOOD}"\\u001b[2J" = 1\npsk_file = "\\u001b[2J"\n'.replace('"drone0"', '"\\u001b[2J"'))
    assert len(caught.value.problems) == 3
    assert str(caught.value).replace("\n", "").isprintable()


@pytest.mark.parametrize("content", ["x = " + "[" * 100_000, "x = " + "9" * 100_000, "#" * (1 << 20) + "\n"])
def test_file_that_the_parser_refuses_is_a_problem(tmp_path: Path, content: str) -> None:
    """Deep nesting, a long number and a long file raise a ConfigError, and no other exception."""
    with pytest.raises(ConfigError):
        load(tmp_path, content)


@pytest.mark.parametrize("value", [hex(1 << 40_000), f"[{hex(1 << 40_000)}]", f'["{"9" * 40_000}"]', "[2024-01-01]"])
@pytest.mark.parametrize("key", ["system_ids", "allow_in", "rate_in", "mavlink1"])
def test_value_that_the_policy_refuses_is_a_problem(tmp_path: Path, key: str, value: str) -> None:
    """A number of ten thousand digits and a date raise a ConfigError with a short message."""
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, f"{GOOD.replace('system_ids', '#')}{key} = {value}\n")
    assert len(str(caught.value)) < 1000


def test_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    """The message distinguishes a missing file, a folder and a text that is not UTF-8."""
    with pytest.raises(ConfigError, match=r"none\.toml: cannot be read: No such file"):
        load_config(tmp_path / "none.toml", {})
    with pytest.raises(ConfigError, match="cannot be read: Is a directory"):
        load_config(tmp_path, {})
    (tmp_path / "a.toml").write_bytes(b'name = "drone\xff"\n')
    with pytest.raises(ConfigError, match=r"a\.toml:1:14: is not text in UTF-8"):
        load_config(tmp_path / "a.toml", {})


def test_remedy_for_a_missing_key_fits_its_kind(tmp_path: Path) -> None:
    """A PSK is copied from the peer; a service's key belongs to root; a unit's folder is named by an option."""
    path = tmp_path / "drone0.toml"
    path.write_text(f'{GOOD}psk_file = "pair.psk"\n')

    def problems(environ: dict[str, str]) -> list[str]:
        with pytest.raises(ConfigError) as caught:
            load_config(path, environ)
        return [str(problem) for problem in caught.value.problems]

    private, psk = problems({})
    assert f"make it with `uavlinkd keygen --out {tmp_path}/drone0.key`" in private
    assert "copy it from the peer, or make it on one of the two with `uavlinkd psk --out" in psk
    assert "a service's keys with `uavlinkd check --keys DIR`" in private
    (tmp_path / "drone0").mkdir()
    (tmp_path / "drone0" / "drone0.key").touch()
    assert f"the keys of its service are in {tmp_path}/drone0: add --keys {tmp_path}/drone0" in problems({})[0]
    for problem in problems({"CREDENTIALS_DIRECTORY": str(tmp_path / "credentials")}):
        assert re.search("LoadCredential=.*next start", problem)
        assert not re.search("keygen|uavlinkd psk", problem)
