"""What tshark shows with ``configs/wireshark/uavlink.lua``, of two nodes of the core without a network."""

from __future__ import annotations

import os
import random
import shutil
import struct
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import pytest
from pymavlink.generator import mavgen

from tests.needs import need
from tests.protocol.harness import AT_A, AT_B, FRAME, PLAIN, Pair, datagrams, exhaust, only
from uavlinkd.protocol import handshake, wire
from uavlinkd.protocol.cookie import MacKeys
from uavlinkd.protocol.crypto import KeyPair
from uavlinkd.protocol.settings import Link, PeerSettings
from uavlinkd.protocol.suites import SUITES, Suite
from uavlinkd.protocol.wire import TAG_LENGTHS, Probe, RefusalReport, Refused

_FILE_HEADER = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 101)
"""libpcap's file header; 101 is LINKTYPE_RAW: each packet begins with its IP header."""

HEARTBEAT = bytes.fromhex("fd090000000101000000000000000203510403") + b"\x00\x00"
"""A MAVLink 2 HEARTBEAT of system 1; its checksum is not checked."""


class Sent(NamedTuple):
    """One datagram and its direction."""

    from_a: bool
    datagram: bytes


def write(path: Path, packets: Iterable[Sent], port: int = 5790) -> Path:
    """Write UDP datagrams between two addresses as a capture, one per millisecond."""
    with path.open("wb") as file:
        file.write(_FILE_HEADER)
        for number, (from_a, datagram) in enumerate(packets):
            source, target = (AT_A, AT_B) if from_a else (AT_B, AT_A)
            packet = _ip_packet(source.host, target.host, port, datagram)
            file.write(struct.pack("<IIII", number // 1000, number % 1000 * 1000, len(packet), len(packet)) + packet)
    return path


def _ip_packet(source: str, target: str, port: int, datagram: bytes) -> bytes:
    hosts = b"".join(bytes(map(int, host.split("."))) for host in (source, target))
    udp = struct.pack(">HHHH", port, port, 8 + len(datagram), 0) + datagram
    return struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0) + hosts + udp


def conversation(link: Link = PLAIN) -> list[Sent]:
    """A handshake, then a frame, two frames, a long counter, a keepalive, and each control record."""
    pair = Pair(link, link)
    initiation = pair.initiation(0.0)
    response = only(datagrams(pair.b.receive(initiation, 0.0)))
    confirmation = only(datagrams(pair.a.receive(response, 0.0)))
    pair.b.receive(confirmation, 0.0)
    sent = [Sent(True, initiation), Sent(False, response), Sent(True, confirmation)]
    records = (
        wire.Echo(False, 0x01020304, 5, 6),
        wire.Echo(True, 0x01020304, 7, 8, 9),
        RefusalReport((Refused(76, 400, 4, 3), Refused(0, 0, 1, 70000))),
        wire.Close(),
    )
    probes = (
        Probe(0x0A0B0C0D, 0, 11, 10).encode(),
        Probe(0, 0x0A0B0C0D, 12, 10).encode(),
        Probe(0x0A0B0C0D, 0x01020304, 13, 10).encode(FRAME + HEARTBEAT),
        Probe(0x0A0B0C0D, 0, 14, 10).encode(padding=100),
    )
    payloads = [HEARTBEAT, HEARTBEAT + FRAME, b"", *(record.encode() for record in records), *probes]
    sent += [Sent(True, pair.a.envelope(1.0, payload)) for payload in payloads]
    pair.a.session.send_counter = 2**16
    return [*sent, Sent(True, pair.a.envelope(1.0, HEARTBEAT))]


def cookie_reply() -> list[Sent]:
    pair = Pair()
    exhaust(pair.b, 0.0)
    initiation = pair.initiation(0.0)
    reply = only(datagrams(pair.b.receive(initiation, 0.0), wire.COOKIE))
    return [Sent(True, initiation), Sent(False, reply)]


def with_tag(tag_bytes: int) -> Link:
    """Links with this tag length."""
    return replace(PLAIN, tag_bytes=tag_bytes)


CONFIDENTIAL = replace(PLAIN, confidential=True)


SCRIPT = Path(__file__).parents[2] / "configs/wireshark/uavlink.lua"
ROOT = Path(os.environ.get("UAVLINKD_TSHARK_ROOT", "/"))
"""The root folder of the system whose tshark runs: this one, or that of another Debian release."""
PROBE_FIELDS = ("flags", "question", "answer", "sent", "received")
FIELDS = (
    *("type", "suite", "counter", "record", "tag_bytes", "mode", "frame.msgid", "frame.system", "token", "fresh"),
    *(f"probe.{field}" for field in PROBE_FIELDS),
    *("refused.msgid", "refused.command", "refused.reason", "refused.total"),
)
RECORDS = ["1", "2", "6", "5", "3", "3", "3", "3"]


@pytest.fixture
def folder() -> Iterator[Path]:
    need((ROOT / "usr/bin/tshark").exists(), "tshark")
    with tempfile.TemporaryDirectory(dir=ROOT / "tmp") as name:
        folder = Path(name)
        folder.chmod(0o755)
        shutil.copy(SCRIPT, folder)
        yield folder


def inside(path: Path) -> str:
    return f"/{path.relative_to(ROOT)}"


def tshark(folder: Path, capture: Path, *options: str) -> str:
    """What tshark prints of a capture. Two passes, so that later packets help to infer the tag of earlier ones."""
    as_other = []
    if os.getuid() == 0:  # as root, tshark ignores scripts; only root may change the root folder
        as_other = ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups"]
        if len(ROOT.parts) > 1:
            as_other = ["chroot", "--userspec=65534:65534", str(ROOT)]
    scripts = [option for script in sorted(folder.glob("*.lua")) for option in ("-X", f"lua_script:{inside(script)}")]
    done = subprocess.run(
        [*as_other, "/usr/bin/tshark", "-2", "-n", "-r", inside(capture), *scripts, *options],
        capture_output=True,
        text=True,
        check=False,
        env={"PATH": os.environ["PATH"], "HOME": inside(folder), "LC_ALL": "C.UTF-8"},
    )
    assert done.returncode == 0, done.stderr
    assert "Lua" not in done.stderr, done.stderr
    assert "Lua Error" not in done.stdout
    return done.stdout


def rows(folder: Path, packets: list[Sent], *options: str, port: int = 5790) -> list[dict[str, str]]:
    """The fields of each packet that have a value."""
    capture = write(folder / "capture.pcap", packets, port)
    columns = [option for field in FIELDS for option in ("-e", f"uavlink.{field}")]
    lines = tshark(folder, capture, "-T", "fields", "-E", "separator=|", *columns, *options).splitlines()
    return [{field: value for field, value in zip(FIELDS, line.split("|"), strict=True) if value} for line in lines]


@pytest.mark.parametrize("tag_bytes", TAG_LENGTHS)
def test_envelopes_with_every_tag_length(folder: Path, tag_bytes: int) -> None:
    """Counters, frames and control records are readable without a key, and the tag's length is inferred."""
    packets = rows(folder, conversation(with_tag(tag_bytes)))

    assert [packet["type"] for packet in packets] == ["0x01", "0x02", *["0x40"] * 12, "0x41"]
    envelopes = packets[2:]
    assert [int(envelope["counter"]) for envelope in envelopes] == [*range(12), 2**16]
    assert {envelope["tag_bytes"] for envelope in envelopes} == {str(tag_bytes)}
    assert {envelope["mode"] for envelope in envelopes} == {"authenticated (inferred)"}
    assert [envelope.get("frame.msgid", "") for envelope in envelopes][1:3] == ["0", "0,0"]
    assert envelopes[1]["frame.system"] == "1"
    assert [envelope["record"] for envelope in envelopes if "record" in envelope][-8:] == RECORDS
    assert envelopes[4]["token"] == "01020304"
    assert envelopes[5]["fresh"] == "9"
    report = envelopes[6]
    shown = [report[f"refused.{field}"] for field in ("msgid", "command", "reason", "total")]
    assert shown == ["76,0", "400,0", "4,1", "3,70000"]


def test_probes(folder: Path) -> None:
    """A question, an answer, both with frames behind them, and a question with padding."""
    probes = [packet for packet in rows(folder, conversation()) if packet.get("record") == "3"]
    shown = [[probe[f"probe.{field}"] for field in PROBE_FIELDS] for probe in probes]
    assert shown == [
        ["0", "0x0a0b0c0d", "0x00000000", "11", "10"],
        ["0", "0x00000000", "0x0a0b0c0d", "12", "10"],
        ["1", "0x0a0b0c0d", "0x01020304", "13", "10"],
        ["2", "0x0a0b0c0d", "0x00000000", "14", "10"],
    ]
    assert [probe.get("frame.msgid") for probe in probes] == [None, None, "0,0", None]
    assert {probe["tag_bytes"] for probe in probes} == {"16"}


@pytest.mark.parametrize("suite", SUITES.values(), ids=lambda suite: suite.name)
def test_handshakes_on_any_port(folder: Path, suite: Suite) -> None:
    """A handshake message of any suite shows the protocol, and the envelopes that follow are read too."""
    packets = rows(folder, conversation(replace(PLAIN, suites=(suite,))), port=40000)

    assert [packet.get("type") for packet in packets[:3]] == ["0x01", "0x02", "0x40"]
    assert packets[0]["suite"] == packets[1]["suite"] == str(suite.number)
    assert packets[-1]["type"] == "0x41"


@pytest.mark.parametrize("link", [PLAIN, with_tag(8), CONFIDENTIAL], ids=["tag 16", "tag 8", "confidential"])
def test_encrypted_record(folder: Path, link: Link) -> None:
    """It is named where other envelopes show the tag length, and not in confidential mode."""
    packets = conversation(link)
    header = packets[2].datagram[:3] + bytes([0, 40])
    packets.append(Sent(True, header + b"\x07" + bytes(17 + 16 + link.tag_bytes)))
    shown = rows(folder, packets)[-1]
    if link.confidential:
        assert ("record" not in shown, shown["mode"]) == (True, "confidential (inferred)")
    else:
        assert (shown["record"], shown["tag_bytes"]) == ("7", str(link.tag_bytes))


@pytest.mark.parametrize("suite", [SUITES[0], SUITES[16]], ids=lambda suite: suite.name)
def test_initiation_with_a_certificate(folder: Path, suite: Suite) -> None:
    """Its length shows it, on any port, and the encrypted part is as long as it is."""
    link = replace(PLAIN, suites=(suite,))
    alpha, bravo = KeyPair(bytes([1]) * 32), KeyPair(bytes([2]) * 32)
    peer = PeerSettings("bravo", bravo.public, None, link)
    long = handshake.initiate(alpha, peer, 9, 0, random.Random(1).randbytes, bytes(wire.CERTIFICATE_BYTES))
    short = handshake.initiate(alpha, peer, 9, 0, random.Random(1).randbytes)
    packets = [Sent(True, MacKeys(bravo.public).add_macs(each.message, None)) for each in (long, short)]
    capture = write(folder / "capture.pcap", packets, 40000)
    lines = tshark(folder, capture, "-T", "fields", "-e", "_ws.col.Info", "-e", "uavlink.sealed_payload").splitlines()
    name = f"Handshake Initiation, {suite.name}, sender 0x0009"
    infos, payloads = zip(*(line.split("\t") for line in lines), strict=True)
    assert infos == (f"{name}, with a certificate", name)
    assert [len(payload) // 2 for payload in payloads] == [131, 31]


def test_cookie_reply(folder: Path) -> None:
    """It has a nonce and an encrypted cookie."""
    capture = write(folder / "capture.pcap", cookie_reply())
    text = tshark(folder, capture, "-V")
    assert "Cookie Reply to 0x" in text
    assert "Encrypted cookie: " in text
    assert "(no cookie)" in text  # the initiation


def test_confidential_envelopes(folder: Path) -> None:
    """Nothing is readable but index and counter, and the dissector says that it infers the mode."""
    envelopes = rows(folder, conversation(CONFIDENTIAL))[2:]
    modes = [envelope["mode"] for envelope in envelopes]
    assert modes.count("confidential (inferred)") >= len(modes) - 1  # an empty payload fits every mode
    assert not any("frame.msgid" in envelope or "record" in envelope for envelope in envelopes)

    chosen = rows(folder, conversation(CONFIDENTIAL), "-o", "uavlink.tag:confidential")[2:]
    assert {envelope["mode"] for envelope in chosen} == {"confidential"}


def test_preference_sets_the_tag_length(folder: Path) -> None:
    """A wrong choice shows too: the frames then end elsewhere."""
    right = rows(folder, conversation(with_tag(8)), "-o", "uavlink.tag:8 bytes")[3]
    assert (right["tag_bytes"], right["mode"], right["frame.msgid"]) == ("8", "authenticated", "0")
    wrong = rows(folder, conversation(with_tag(8)), "-o", "uavlink.tag:16 bytes")[3]
    assert wrong["tag_bytes"] == "16"
    assert "frame.msgid" not in wrong


def test_port_preference(folder: Path) -> None:
    """Envelopes without a handshake in the capture are read on the port of the preference only."""
    envelopes = conversation()[3:5]
    assert not any(rows(folder, envelopes, port=40001))
    assert all(rows(folder, envelopes, "-o", "uavlink.port:40001", port=40001))


def test_frames_reach_the_mavlink_dissector(folder: Path) -> None:
    """The dissector that pymavlink generates shows the fields of the frames, also of two in one envelope."""
    xml = Path(mavgen.__file__).parents[1] / "dialects/v20/minimal.xml"
    options = mavgen.Opts(str(folder / "mavlink"), wire_protocol="2.0", language="WLua", validate=False)
    assert mavgen.mavgen(options, [str(xml)])
    assert (folder / "mavlink.lua").exists()

    capture = write(folder / "capture.pcap", conversation())
    text = tshark(folder, capture, "-V")
    assert text.count("Payload: HEARTBEAT") >= 3
    assert "Envelope to 0x" in text


def test_mutated_packets_raise_no_error(folder: Path) -> None:
    """Any bytes are dissected without a Lua error."""
    rng = random.Random(17)
    packets = [*conversation(), *conversation(CONFIDENTIAL), *cookie_reply()]
    mutated = []
    for _ in range(3000):
        from_a, datagram = rng.choice(packets)
        changed = bytearray(datagram[: rng.randrange(len(datagram) + 1)] if rng.random() < 0.5 else datagram)
        for _ in range(rng.randrange(4)):
            if changed:
                changed[rng.randrange(len(changed))] = rng.randrange(256)
        mutated.append(Sent(from_a, bytes(changed)))
    text = tshark(folder, write(folder / "capture.pcap", mutated), "-V")
    assert "Malformed uavlink message" in text
