"""Files, and datagrams as the attacker's own tools parse them: each reader raises only its own error."""

from __future__ import annotations

import atexit
import base64
import contextlib
import tempfile
import tomllib
import zlib
from pathlib import Path
from typing import Final

from tests.fuzz.engine import Run, Script
from uavlinkd.authority import enrolment
from uavlinkd.authority.enrolment import FleetError
from uavlinkd.config.keys import KeyFileError, decode_key, encode_key, read_secret_file
from uavlinkd.config.load import load_config
from uavlinkd.config.model import Config, ConfigError
from uavlinkd.fleet.manifest import FILE_NAME, read_manifest, write_manifest
from uavlinkd.lab.mitm import anatomy
from uavlinkd.lab.mitm.proxy_settings import ProxySettings, SettingsError, load_proxy_settings
from uavlinkd.protocol import wire
from uavlinkd.protocol.crypto import sha256
from uavlinkd.protocol.suites import SUITES

SECRET: Final = encode_key(bytes(range(7, 39)))
"""A private key, which a person may paste into the wrong place."""
PUBLIC: Final = "Ya1BcyCMNCoxhVU/dI5z9wlfOD9PHricYw/gaSC3swU="
CONFIGS: Final = Path(__file__).resolve().parents[2] / "configs"
WORDS: Final = tuple(
    word.encode()
    for word in (
        *("[link]\n", "[[peer]]\n", "\n[peer]\n", "\n[endpoint]\n", "[[endpoint]]\n", "[routing]\n"),
        *("[recording]\n", "[log]\n", "[peer]\n", "[endpoint]\n"),
        *("name = ", "public_key = ", "addresses = ", "url = ", "suites = ", "system_ids = ", "role = ", "listen = "),
        *("psk_file = ", "tag_bits = ", "rate_in = {", "allow_in = [", "allow_out = [", "keepalive_s = "),
        *("budget_bits_s = ", "true", "nan", "inf", "-1", "1e999", "9" * 40, '"', "'''", "[[", "{", "}", "]"),
        *("\n", ","),
        *("=", "\\u0000", "\0", "1979-05-27T07:32:00Z", "udpin:", "udpout:[::]:1", "serial:/dev/x:1", "tcpin:"),
        *("[fe80::1%x]:1", f'"{SECRET}"', "[[member]]\n", 'kind = "drone"', "{name}", "{n:1000}", "{n.real}"),
        *("[[attack]]\n", "[[radio]]\n", "[[link]]\n"),
    )
)


def _folder() -> Path:
    """A folder with the files that the configurations name; it is deleted with the process."""
    folder = tempfile.TemporaryDirectory(prefix="uavlinkd-fuzz-")
    atexit.register(folder.cleanup)
    path = Path(folder.name)
    for name in ("drone0.key", "drone1.key", "ground-station.key", "observer.key"):
        (path / name).touch(mode=0o600)
        (path / name).write_text(SECRET + "\n")
    (path / "pair.psk").touch(mode=0o600)
    (path / "pair.psk").write_text(encode_key(bytes(range(9, 41))) + "\n")
    return path


def make_config() -> Run:
    """The daemon's configuration: a valid one, or a ConfigError that repeats no key and names a remedy."""
    folder = _folder()
    file = folder / "fuzz.toml"

    def run(data: bytes) -> None:
        file.write_bytes(data)
        try:
            config = load_config(file, {})
        except ConfigError as error:
            problems, message = error.problems, str(error)
        else:
            problems, message = (), ""
        assert SECRET not in message, "a key is repeated"
        assert all(problem.message for problem in problems), "a problem without a message"
        if message:
            return
        assert tomllib.loads(data.decode("utf-8-sig"))
        assert isinstance(config, Config)
        assert SECRET not in repr(config), "a key can be read"
        for peer in config.peers:
            peer.make_policy()

    return run


def make_mitm() -> Run:
    """The settings of the man in the middle."""
    file = _folder() / "fuzz.toml"

    def run(data: bytes) -> None:
        file.write_bytes(data)
        with contextlib.suppress(SettingsError):
            assert isinstance(load_proxy_settings(file), ProxySettings)

    return run


def make_manifest() -> Run:
    """The fleet's manifest: writing and reading it again returns the same."""
    folder = _folder()

    def run(data: bytes) -> None:
        (folder / FILE_NAME).write_bytes(data)
        try:
            fleet = read_manifest(folder)
        except FleetError:
            return
        (folder / FILE_NAME).write_text(write_manifest(fleet), encoding="utf-8")
        assert read_manifest(folder) == fleet, "a manifest that changes when it is written"

    return run


def make_key() -> Run:
    """A key file: 32 bytes in their only spelling, or a KeyFileError that does not repeat them."""
    file = _folder() / "drone0.key"

    def run(data: bytes) -> None:
        file.write_bytes(data)
        text = data.decode("ascii", errors="replace")
        try:
            secret, message = read_secret_file(file), ""
        except KeyFileError as error:
            secret, message = None, str(error)
        assert len(text.strip()) < 8 or text.strip() not in message, "a key is repeated"
        if secret is None:
            return
        assert encode_key(secret.reveal()) == text.strip(), "a key with two spellings"
        assert decode_key(text) == secret.reveal()

    return run


def make_enrolment() -> Run:
    """The two lines of an enrolment, the reply also with a right checksum: what a file can have, or a FleetError."""

    def run(data: bytes) -> None:
        text = data.decode("latin-1")
        packed = zlib.compress(data, 1)
        whole = base64.b64encode(packed + sha256(packed)[: enrolment.CHECK_BYTES]).decode().rstrip("=")
        with contextlib.suppress(enrolment.FleetError):
            assert enrolment.parse_request(text).line().split() == text.split(), "a request with two spellings"
        for line in (text.strip(), whole):
            with contextlib.suppress(enrolment.FleetError):
                reply = enrolment.parse_reply(line)
                assert enrolment.parse_reply(reply.line()) == reply, "a reply that changes when it is written"
                assert reply.certificate.name, "a reply without a certificate"

    return run


def make_anatomy() -> Run:
    """The parts of a datagram in the man in the middle: together they are the datagram; no exception."""

    def run(data: bytes) -> None:
        script = Script(data)
        while script:
            size = script.word() & 0x1FF
            datagram = script.take(size)
            if size & 1 and datagram:
                suite = list(SUITES.values())[datagram[0] % len(SUITES)]
                wanted = (wire.initiation_bytes if size & 2 else wire.response_bytes)(suite)
                kind = wire.INITIATION if size & 2 else wire.RESPONSE
                datagram = (bytes((kind, suite.number)) + datagram).ljust(wanted, b"\0")[:wanted]
            parts = anatomy.parts_of(datagram)
            if parts is not None:
                assert parts.join() == datagram, "the parts differ from the datagram"
                assert len(parts.ephemeral) == 32
            anatomy.has_cookie(datagram)
            envelope = anatomy.envelope_of(datagram)
            assert (envelope is not None) <= (anatomy.kind_of(datagram) is anatomy.DatagramKind.ENVELOPE)
            assert len(anatomy.message_ids(datagram)) * 8 <= len(datagram)
            changed = anatomy.with_mac1(datagram, bytes(32))
            assert len(changed) == len(datagram)
            assert changed[:-32] == datagram[:-32], "more than mac1 was changed"

    return run


def config_seeds() -> list[bytes]:
    """The configurations in the repository."""
    small = [
        'name = "a"\nprivate_key_file = "drone0.key"\nlisten = ["0.0.0.0:1"]\n',
        f'[[peer]]\nname = "b"\npublic_key = "{PUBLIC}"\nrole = "all"\nsystem_ids = [1]\n',
        f'psk_file = "{SECRET}"\n',
        '[[endpoint]]\nname = "e"\nurl = "tcpin:127.0.0.1:2"\n',
    ]
    whole = "".join((small[0], small[1], small[3]))
    shipped = [path.read_bytes() for path in sorted(CONFIGS.glob("*.toml")) if path.name != "mitm.toml"]
    return [*(text.encode() for text in (*small, whole)), *shipped, b"a = " + b"[" * 4000]


def mitm_seeds() -> list[bytes]:
    """The settings in the repository."""
    small = [
        '[[peer]]\nname = "a"\n[[peer]]\nname = "b"\n[[link]]\nbetween = ["a", "b"]\n'
        'listen = ["0.0.0.0:1", "0.0.0.0:2"]\n',
        '[[attack]]\nname = "replay-data"\nlimit = 5\n',
        '[[radio]]\nway = "both"\nloss = 0.5\n',
    ]
    return [*(text.encode() for text in (*small, "".join(small))), (CONFIGS / "mitm.toml").read_bytes()]
