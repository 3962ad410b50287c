"""``uavlinkd report``: one file for a support request, without keys and addresses of others."""

from __future__ import annotations

import asyncio
import builtins
from pathlib import Path

import pytest

from tests.daemon.harness import Stage, secret_forms
from tests.waiting import until
from uavlinkd.cli import main
from uavlinkd.config import keys
from uavlinkd.ops import support_report as report
from uavlinkd.ops.redaction import Redactor
from uavlinkd.system.terminal import FAILED, OK

KEY = "eZPBKM+9Oztdms1v2yiR+byync+zZsR87etuOX4heHE="
OTHER_KEY = "3NNFMbj2qtFyJqKVHtuuoixhFmd1DvyLQR2FuMwgtkY="


def test_same_value_has_the_same_pseudonym() -> None:
    """Keys and addresses can be compared, but not read."""
    redactor = Redactor()
    redactor.add_peer("10.13.0.2")
    redactor.add_peer("drone1.example")
    text = redactor.redact(f'"{KEY}" {OTHER_KEY} {KEY} 10.13.0.2:5790 Drone1.Example:5790 203.0.113.9 [fd00::2]:1')
    assert text == '"key-1" key-2 key-1 peer-address-1:5790 peer-address-2:5790 address-1 [address-2]:1'


HEX = keys.decode_key(KEY).hex()
PAIRS = [HEX[at : at + 2] for at in range(0, 64, 2)]


@pytest.mark.parametrize(
    ("text", "redacted"),
    [
        (f'public_key = "{KEY[:30]}"', 'public_key = "key-1"'),
        (f"PrivateKey = {KEY[:-1]}", "PrivateKey = key-1"),
        (f"PresharedKey={KEY}", "PresharedKey=key-1"),
        (f'{{"psk": "{KEY[:20]}"}}', '{"psk": "key-1"}'),
        (f"it came with {KEY[:-1]}", "it came with key-1"),
        (f'private_key = "{KEY}{KEY}"', 'private_key = "key-2"'),
        (f"{HEX} 0x{HEX} 0X{HEX.upper()}", "key-1 key-2 key-3"),
        (f"dump: {' '.join(PAIRS)}.", "dump: key-1."),
        (f"id {':'.join(PAIRS)}", "id key-1"),
        (r"{\"psk\": \"hunter2 secret\", \"name\": 1}", r"{\"psk\": \"key-1\", \"name\": 1}"),
        (r'psk = "hunter2\"secret" # x', 'psk = "key-1" # x'),
    ],
)
def test_keys_in_any_form_are_replaced(text: str, redacted: str) -> None:
    """Whole, damaged, without padding, in dumps, in TOML, JSON, JSON in JSON, WireGuard's format."""
    assert Redactor().redact(text) == redacted


@pytest.mark.parametrize(
    "text",
    [
        "2026-11-22T22:27:00.123456Z",
        'private_key_file = "drone0.key"',
        '"own_key_elsewhere": false',
        "127.0.0.1:14550 0.0.0.0:5790 [::]:5790 [::1]:5790",
        "10.13.0.1:5790 and fe80::1%wlan0",
        "Python 3.11.7, uavlinkd 0.1.0",
        "/usr/lib/python3/dist-packages/somewhere/deep/inside",
    ],
)
def test_harmless_text_stays(text: str) -> None:
    """Times, versions, file names, loopback and this machine's own addresses."""
    assert Redactor(["10.13.0.1", "fe80::1"]).redact(text) == text


async def test_report_of_a_running_pair_has_no_secret(monkeypatch: pytest.MonkeyPatch) -> None:
    """No key, PSK or address of a peer from configuration, status, log or check is in it."""
    async with Stage() as stage:
        a, b = stage.pair()
        addresses = ["203.0.113.7:5790", "[2001:db8::7]:5790", "drone1.invalid:5790"]
        a.config["peer"][0]["addresses"] += addresses
        exact = {"address": "203.0.113.99:5790", "network": "loopback"}
        a.config["listen"] = [f"0.0.0.0:{a.sockaddr[1]}"]
        a.config["network"] = [{"name": "loopback", "interface": "lo"}]
        a.config["peer"][0]["addresses"].append(exact)
        url = "wss://relay1.invalid/uavlink"
        a.config["relay"] = [{"name": "vps", "public_key": stage.daemon("vps").public_key, "addresses": [url]}]
        await stage.start(a, b)
        await a.until_logged("name_not_resolved")
        await a.until_logged("relay_not_connected")
        monkeypatch.setattr(report, "_log", lambda: "\n".join(a.lines))
        with a.config_file.open("a") as file:
            file.write(f"\n# once was {KEY} at 198.51.100.1\n")
        text = await asyncio.to_thread(report.make_report, [a.config_file], [a.folder / "control.sock"])
        for secret in [*stage.secrets, a.public_key, b.public_key, KEY]:
            assert not any(form in text for form in secret_forms(secret))
        for address in (
            "203.0.113.7",
            "203.0.113.99",
            "2001:db8::7",
            "drone1.invalid",
            "relay1.invalid",
            "198.51.100.1",
        ):
            assert address not in text
        titles = ("versions", "configuration", "check", "status", "log", "sockets", "network interfaces", "routes")
        assert all(f"## {title}" in text for title in titles)
        for part in (
            "peer-address-1:5790",
            "peer-address-3",
            '"state": "up"',
            "daemon_started",
            "uavlinkd 0.",
            '"loopback"',
        ):
            assert part in text
        await until(lambda: a.is_running)


def test_report_is_shown_and_confirmed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a terminal the user reads it and agrees; any other answer writes nothing."""
    monkeypatch.setattr(report, "make_report", lambda configs, sockets: "## versions\n")
    monkeypatch.setattr(report, "_is_terminal", lambda: True)
    path = tmp_path / "report.txt"
    arguments = ["report", "--socket", str(tmp_path / "absent.sock"), "--out", str(path)]
    for answer in ("", "n"):
        monkeypatch.setattr(builtins, "input", lambda prompt, answer=answer: answer)
        assert main(arguments) == FAILED
        assert "## versions" in capsys.readouterr().out
        assert not path.exists()
    monkeypatch.setattr(builtins, "input", lambda prompt: "y")
    assert main(arguments) == OK
    assert path.read_text() == "## versions\n"
    assert path.stat().st_mode & 0o777 == 0o600
    assert main(arguments) == FAILED  # an existing file is kept
    assert "report.txt: cannot be written" in capsys.readouterr().err


def test_without_a_terminal_it_needs_consent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A script has to say ``--yes``."""
    monkeypatch.setattr(report, "make_report", lambda configs, sockets: "## versions\n")
    path = tmp_path / "report.txt"
    arguments = ["report", "--socket", str(tmp_path / "absent.sock"), "--out", str(path)]
    assert main(arguments) == FAILED
    assert "add --yes" in capsys.readouterr().err
    assert main([*arguments, "--yes"]) == OK
    assert path.exists()


def test_a_section_is_redacted_before_it_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rest of a key that is cut has no form that shows what it is."""
    monkeypatch.setattr(report, "MAX_SECTION", 30)
    monkeypatch.setattr(report, "_log", lambda: f"public_key {KEY}")
    text = report.make_report([], [])
    assert KEY[-20:] not in text
    assert "public_key key-" in text
