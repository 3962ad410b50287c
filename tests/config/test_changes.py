"""A reload: which changes of a file a running daemon makes, and which need a restart."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.config.files import (
    BY_MESH,
    GCS,
    GOOD,
    HEAD,
    HTTPS,
    KEY,
    LTE,
    MESH,
    OTHER_PEER,
    SIK,
    URL,
    load,
    member,
    networks,
    relay,
    relays,
)
from tests.tls_files import write_tls_files
from uavlinkd.config import keys
from uavlinkd.config.changes import compare
from uavlinkd.config.model import ConfigError

_AT = 'addresses = ["10.13.0.9:5790"]'
_AS_PEER = relay(key=KEY["drone1"], addresses="[]")
_ROWS = [
    (GOOD, GOOD, {}),
    (GOOD, GOOD + OTHER_PEER, {"peers_added": ["drone2"]}),
    (GOOD + OTHER_PEER, GOOD, {"peers_removed": ["drone2"]}),
    (GOOD, GOOD + "rate_in = { PING = 0 }\n", {"peers_changed": ["drone1"]}),
    (GOOD, GOOD + "tag_bits = 96\n", {"peers_removed": ["drone1"], "peers_added": ["drone1"]}),
    (GOOD, GOOD + 'redundancy = "all"\n', {"peers_removed": ["drone1"], "peers_added": ["drone1"]}),
    (networks(LTE + MESH), networks(LTE + MESH, f"[{BY_MESH}]"), {"peers_changed": ["drone1"]}),
    (GOOD, GOOD.replace("[[peer]]", "rate_in = { PING = 0 }\n[[peer]]"), {"endpoints_changed": ["autopilot"]}),
    (
        HEAD + member("b") + member("c"),
        HEAD + member("drone1", KEY["b"]) + member("c") + member("d"),
        {"members_removed": ["b"], "members_added": ["drone1", "d"]},
    ),
]


@pytest.mark.parametrize(("before", "after", "changes"), _ROWS, ids=[" ".join(changes) for *_, changes in _ROWS])
def test_changes_are_found(tmp_path: Path, before: str, after: str, changes: dict[str, list[str]]) -> None:
    """Of peers, members and the policies of endpoints, by name."""
    assert compare(load(tmp_path, before), load(tmp_path, after)).summary == changes


@pytest.mark.parametrize(
    ("before", "after", "key"),
    [
        (GOOD, GOOD.replace('"drone0"', '"other"'), "name"),
        (GOOD, GOOD.replace("drone0.key", "other.key"), "private_key_file"),
        (GOOD, GOOD.replace("0.0.0.0:5790", "0.0.0.0:5791"), "listen"),
        (networks(SIK, '["a:1", { network = "sik" }]'), GOOD, "network"),
        (GOOD, f'control_socket = "a"\n{GOOD}', "control_socket"),
        (GOOD, GOOD + '[log]\nlevel = "debug"\n', "log"),
        (GOOD, GOOD + "[routing]\nrelay = true\n", "routing"),
        (GOOD, GOOD + member("c"), "member"),
        (GOOD + member("c"), GOOD + member("c") + HTTPS, "relay_server.https"),
        (GOOD + GCS.replace("14550", "1"), GOOD, "endpoint"),
        (GOOD, GOOD.replace(URL, "udpin:127.0.0.1:1"), "endpoint"),
        (GOOD, GOOD.replace("[[peer]]", "radio_status = true\n[[peer]]"), "endpoint"),
        (relays(relay()), relays(relay(addresses='["other.example.org:5790"]')), "relay"),
        (relays("", _AT), relays(_AS_PEER, _AT), "relay"),
        (relays(_AS_PEER, _AT), relays(_AS_PEER, f"{_AT}\nretry_max_s = 3"), "relay"),
    ],
)
def test_other_changes_need_a_restart(tmp_path: Path, before: str, after: str, key: str) -> None:
    """The problem names the key and the remedy."""
    keys.write_secret_file(tmp_path / "other.key", keys.generate_private_key())
    write_tls_files(tmp_path)
    with pytest.raises(ConfigError) as caught:
        compare(load(tmp_path, before), load(tmp_path, after))
    assert [problem.key for problem in caught.value.problems] == [key]
    assert "restart the daemon" in str(caught.value)
