"""The output of ``uavlinkd check``: a screen if all is well, what is left of an example, whole keys, no secret."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from tests.config.files import load
from tests.config.fleets import bulletin, certificate, contact, fleet, load_member, member_file
from tests.ops.schema import golden
from tests.test_readmes import ROOT
from uavlinkd.authority.certificates import MemberRole
from uavlinkd.cli import main
from uavlinkd.config import keys
from uavlinkd.config.advice import EXAMPLE_KEYS
from uavlinkd.config.model import Config
from uavlinkd.mavlink import dialect
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.gate import Gate, Refusal
from uavlinkd.mavlink.policy.roles import ROLES
from uavlinkd.ops import CHECK_SCHEMA
from uavlinkd.ops.check import judge, report
from uavlinkd.system.terminal import FAILED, OK, WRONG

_PUBLIC = [keys.public_key_text(keys.generate_private_key()) for _ in range(2)]
_FILE = f"""
name = "drone0"
private_key_file = "drone0.key"
listen = ["0.0.0.0:5790"]
control_socket = "drone0.sock"
[[endpoint]]
name = "autopilot"
url = "udpin:127.0.0.1:14550"
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
_TABLET = '[[endpoint]]\nname = "tablet"\nurl = "udpin:0.0.0.0:14551"\n'


def _printed(config: Config, *, is_verbose: bool = False) -> str:
    return "\n".join(report(config, judge(config), 80, is_verbose=is_verbose))


def _line(printed: str, start: str) -> str:
    return next(line for line in printed.splitlines() if line.startswith(start))


def test_a_good_file_fills_at_most_one_screen(tmp_path: Path) -> None:
    """The verdict, who this daemon is, each peer and endpoint. Of fifty peers it counts those that have no room."""
    printed = _printed(load(tmp_path, _FILE))
    assert printed.splitlines()[0] == "drone0.toml is ready: no warnings."
    peer = _line(printed, "peer drone1")
    assert peer.split(maxsplit=2)[2] == (
        "10.13.0.2:5790, drone1.local:5790; swarm-member, system 2; x25519, 128-bit tag, PSK"
    )
    assert _line(printed, "peer observer").endswith("; observer, system 254; mlkem768 x25519, encrypted")
    assert "it connects, to an address of this machine with port 5790" in printed
    section = '[[peer]]\nname = "p{0}"\npublic_key = "{1}"\nrole = "swarm-member"\nsystem_ids = [{0}]\n'
    public = (keys.public_key_text(keys.generate_private_key()) for _ in range(50))
    many = "".join(section.format(number, key) for number, key in enumerate(public, 10))
    printed = _printed(load(tmp_path, _FILE + many))
    assert sum(-(-max(1, len(line)) // 80) for line in printed.splitlines()) <= 24
    assert re.search(r"--verbose shows \d\d more rows, ", printed)
    assert "peer p59" in _printed(load(tmp_path, _FILE + many), is_verbose=True)


def test_fleet_is_shown_for_a_review(tmp_path: Path) -> None:
    """Who this daemon is in its fleet, whom it knows from the start, and what members of each role may send."""
    sections = fleet(news=bulletin(3)) + contact() + contact(MemberRole.RELAY, "r1")
    config = load_member(tmp_path, member_file(sections))
    for line in (
        r"fleet +[a-z2-7]{8}; bulletin 3 in this file, or a newer one",
        r"certificate +v7: vehicle, system id 7, serial 7",
        r"contact gs +operator, at gs\.example\.org:5790",
        r"contact r1 +relay, used as a relay, at r1\.example\.org:5790",
        r"members: operator +operator, systems of their certificates; this daemon connects to them",
        r"members: vehicle +swarm-member, systems of their certificates; they connect",
    ):
        assert re.search(rf"^{line}$", _printed(config), re.MULTILINE), line
    assert "\nPolicy of members: observer\n" in _printed(config, is_verbose=True)
    station = certificate(MemberRole.OPERATOR, "gs2", (250, 254))
    assert "gs2: operator, system ids 250-254, serial 7" in _printed(
        load_member(tmp_path, member_file(fleet(station)))
    )


def test_warnings_are_first_and_each_is_a_line(tmp_path: Path) -> None:
    """For `grep`, as each row. A URL is never broken."""
    url = f"serial:/dev/serial/by-id/usb-{'Pixhawk_' * 20}if00:57600"
    config = load(tmp_path, _FILE.replace("udpin:127.0.0.1:14550", url) + _TABLET)
    printed = _printed(config)
    assert f"{url}, open to the wire;" in _line(printed, "endpoint autopilot")
    assert "open to THE NETWORK" in _line(printed, "endpoint tablet")
    assert [line[9:] for line in printed.splitlines() if line.startswith("warning: ")] == list(config.warnings)
    assert printed.startswith('warning: endpoint "tablet": plain MAVLink leaves this machine')


def test_a_station_is_behind_its_key(tmp_path: Path) -> None:
    """It is an endpoint; stations have a port of their own."""
    keys.write_secret_file(tmp_path / "stations.key", keys.generate_private_key())
    station = f'name = "tablet"\npublic_key = "{keys.public_key_text(keys.generate_private_key())}"\n'
    sections = f'[stations]\nprivate_key_file = "stations.key"\n[[station]]\n{station}address = "10.66.0.2"\n'
    printed = _printed(load(tmp_path, f'{_FILE}{sections}role = "operator"\nsystem_ids = [255]\n'))
    assert "station:10.66.0.2, open to the holder of its key; operator, system 255" in _line(printed, "endpoint tab")
    assert "0.0.0.0:51820 (UDP)" in _line(printed, "stations")


@pytest.mark.parametrize(
    ("wrong", "left"),
    [
        pytest.param((_PUBLIC[0], min(EXAMPLE_KEYS)), 'peer "drone1": public_key is of an example', id="key"),
        pytest.param(("drone1.local", "gcs.example.org"), 'peer "drone1": gcs.example.org:5790 is a name', id="name"),
    ],
)
def test_what_is_left_of_an_example_is_a_failure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], wrong: tuple[str, str], left: str
) -> None:
    """It is the first line, and the exit status is 1: the daemon could run, and no link would come up."""
    load(tmp_path, _FILE)
    path = tmp_path / "drone0.toml"
    for text, status in (_FILE, OK), (_FILE.replace(*wrong), FAILED):
        path.write_text(text)
        assert main(["check", "--config", str(path)]) == status
        assert capsys.readouterr().out.startswith(f"example: {left}") is (status == FAILED)


def test_every_published_key_is_known() -> None:
    """The example keys that `check` knows are those of the files and pages that users copy."""
    pages = [*ROOT.glob("configs/*.toml"), ROOT / "uavlinkd/config/README.md", ROOT / "README.md"]
    published = {key for page in pages for key in re.findall(r'public_key = "([\w+/]{43}=)"', page.read_text())}
    assert published == EXAMPLE_KEYS


def test_json_has_the_declared_names(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of a good file, and of one with errors."""
    load(tmp_path, _FILE)
    path = tmp_path / "drone0.toml"
    facts = []
    for text, status in (_FILE + _TABLET, OK), (_FILE.replace("[254]", "[900]"), WRONG):
        path.write_text(text)
        assert main(["check", "--config", str(path), "--json"]) == status
        facts.append(json.loads(capsys.readouterr().out))
    assert facts[0]["warnings"]
    assert facts[1]["errors"]
    names = golden.names_of(*facts, also={"examples[]": "string", "this_machine[]": "string"})
    assert golden.differences("check", CHECK_SCHEMA, golden.load("check"), names) == []


def test_no_secret_is_printed(tmp_path: Path) -> None:
    """The output has neither the private key nor a PSK, in any encoding."""
    printed = _printed(load(tmp_path, _FILE), is_verbose=True)
    for name in ("drone0.key", "pair.psk"):
        text = (tmp_path / name).read_text().strip()
        assert text not in printed
        assert text[:8] not in printed
        assert keys.decode_key(text).hex() not in printed


@pytest.mark.parametrize(
    "section",
    [
        pytest.param('[[relay]]\naddresses = ["10.13.0.9:5790"]', id="relay"),
        pytest.param("[[member]]", id="member"),
        pytest.param('[[peer]]\nrole = "observer"\nsystem_ids = [9]', id="peer"),
    ],
)
def test_key_of_another_daemon_is_printed_whole(tmp_path: Path, section: str) -> None:
    """The user compares it with what the other machine printed. What may be a private key is not printed."""
    public, private = keys.public_key_text(keys.generate_private_key()), keys.generate_private_key()
    for key in (public, private):
        config = load(tmp_path, f'{_FILE}{section}\nname = "vps"\npublic_key = "{key}"\n')
        row = _line(_printed(config, is_verbose=True), f"{section.partition(']')[0].strip('[]')} vps ")
        assert (public in row) is (key == public)
        assert ("(private?)" in row) is (key == private)
        assert private[:8] not in row


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
    rows = [row for row in policy.describe() if row.subject in dialect.GROUPS]
    assert _read({row.subject: row.incoming for row in rows}) == _passing(policy.incoming)
    assert _read({row.subject: row.outgoing for row in rows}) == _passing(policy.outgoing)
