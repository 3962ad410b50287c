"""The output of ``uavlinkd check``: what is open to the network, whole keys, no secret, and what passes."""

from __future__ import annotations

import contextlib
import io
import re
from pathlib import Path

import pytest

from tests.config.files import load
from tests.config.fleets import bulletin, certificate, contact, fleet, load_member, member_file
from uavlinkd.authority.certificates import MemberRole
from uavlinkd.config import keys
from uavlinkd.config.model import Config
from uavlinkd.mavlink import dialect
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.gate import Gate, Refusal
from uavlinkd.mavlink.policy.roles import ROLES
from uavlinkd.ops.topology import print_topology, table_rows

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


def _printed(config: Config, columns: int | None = None) -> str:
    """What it prints, with policies folded to so many columns."""
    with contextlib.redirect_stdout(io.StringIO()) as file:
        print_topology(config, columns=columns)
    return file.getvalue()


def _line(printed: str, start: str) -> str:
    return next(line for line in printed.splitlines() if line.startswith(start))


def test_fleet_is_shown_for_a_review(tmp_path: Path) -> None:
    """Who this daemon is in its fleet, whom it knows from the start, and what members of each role may send."""
    sections = fleet(news=bulletin(3)) + contact() + contact(MemberRole.RELAY, "r1")
    printed = _printed(load_member(tmp_path, member_file(sections)))
    for line in (
        r"fingerprint +[a-z2-7]{8}",
        r"certificate +v7: vehicle, system id 7, serial 7",
        r"bulletin +number 3 in this file, or a newer one",
        r"contact +gs: operator, at gs\.example\.org:5790",
        r"contact +r1: relay, used as a relay, at r1\.example\.org:5790",
        r"connects to +contacts, and members of the role operator",
        r"members +vehicle +swarm-member +of its certificate",
        r"Policy of members: observer",
    ):
        assert re.search(rf"^{line}$", printed, re.MULTILINE), line
    station = certificate(MemberRole.OPERATOR, "gs2", (250, 254))
    assert "gs2: operator, system ids 250-254, serial 7" in _printed(
        load_member(tmp_path, member_file(fleet(station)))
    )


def test_open_endpoint_is_marked_in_rows_of_one_line(tmp_path: Path) -> None:
    """Each row and warning is one line, for `grep`. A URL is never broken. Only policies are folded."""
    url = f"serial:/dev/serial/by-id/usb-{'Pixhawk_' * 20}if00:57600"
    config = load(tmp_path, _FILE.replace("udpin:127.0.0.1:14550", url))
    printed = _printed(config, columns=80)
    assert _line(printed, "autopilot").split() == ["autopilot", url, "no", "no", "wire"]
    assert _line(printed, "tablet").endswith("THE NETWORK")
    assert [line[9:] for line in printed.splitlines() if line.startswith("warning: ")] == list(config.warnings)
    assert 'warning: endpoint "tablet": plain MAVLink leaves this machine' in printed
    assert max(map(len, printed.partition("Policy of")[2].partition("warning:")[0].splitlines())) <= 80


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
        pytest.param('[[peer]]\nrole = "observer"\nsystem_ids = [9]', "Peers", id="peer"),
    ],
)
def test_key_of_another_daemon_is_printed_whole(tmp_path: Path, section: str, title: str) -> None:
    """The user compares it with what the other machine printed. What may be a private key is not printed."""
    public, private = keys.public_key_text(keys.generate_private_key()), keys.generate_private_key()
    for key in (public, private):
        config = load(tmp_path, f'{_FILE}{section}\nname = "vps"\npublic_key = "{key}"\n')
        rows = _printed(config, columns=40).partition(title)[2]
        assert (public in rows) is (key == public)
        assert ("(private?)" in rows) is (key == private)
        assert private[:8] not in rows


_POLICIES: dict[str, dict[str, object]] = {
    **{role: {"role": role} for role in ROLES},
    "all but commands": {"role": "all", "rate_in": {"commands": 0}, "rate_out": {"commands": 0, "shell": 0}},
    "nothing": {"allow_in": [], "allow_out": []},
    "a mission's half": {
        "allow_in": ["mission-reads", "PING", "PARAM_SET"],
        "rate_in": {"MISSION_ACK": 0},
        "allow_out": ["all"],
    },
    "some of telemetry": {
        "allow_in": ["telemetry"],
        "rate_in": {"position": 0, "STATUSTEXT": 0, "RAW_IMU": 0},
        "allow_out": ["files-read"],
    },
}


def _read(cells: dict[str, str]) -> set[str]:
    """The messages that pass, as a reader understands one side of a table."""
    passing: set[str] = set()
    refused: set[str] = set()
    for group, cell in cells.items():
        members = set(dialect.GROUPS[group])
        listed = set(re.findall(r"[A-Z][A-Z0-9_]+", cell.partition(" (")[0]))
        assert listed <= members
        if cell.startswith("only "):
            passing |= listed
        elif cell.startswith("all"):
            passing |= members - listed
        else:
            assert cell in ("none", "never")
            refused |= members
    return passing - refused


def _passing(gate: Gate) -> set[str]:
    ids = dialect.IDS
    return {name for name, msgid in ids.items() if not isinstance(gate.decide(msgid, is_known=True), Refusal)}


@pytest.mark.parametrize("case", _POLICIES)
def test_table_agrees_with_the_gates(case: str) -> None:
    """Read back, it allows what the gates allow."""
    data = {"system_ids": [1], **_POLICIES[case]}
    policy = Policy(data)
    rows = [row for row in table_rows(policy, data) if row.subject in dialect.GROUPS]
    assert _read({row.subject: row.incoming for row in rows}) == _passing(policy.incoming)
    assert _read({row.subject: row.outgoing for row in rows}) == _passing(policy.outgoing)
