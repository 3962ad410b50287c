"""The certificate of a relay that is reached by TLS: found beside the file, usable, or a problem with its remedy."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.config.files import GOOD, HTTPS, load, member, refused
from tests.tls_files import CERTIFICATE, TLS_KEY, write_tls_files
from uavlinkd.config.load import load_config
from uavlinkd.config.model import HttpsServer
from uavlinkd.config.tls_files import load_tls
from uavlinkd.system.addresses import Address

_RELAY = GOOD + member()
_FILES = f'certificate = "{CERTIFICATE}", key = "{TLS_KEY}"'
_TLS = f'{_RELAY}[relay_server]\nhttps = {{ listen = "0.0.0.0:443", {_FILES} }}\n'
Break = Callable[[Path], object]


def _unlink(name: str) -> Break:
    def unlink(folder: Path) -> None:
        (folder / name).unlink()

    return unlink


def _make_pipe(folder: Path) -> None:
    (folder / TLS_KEY).unlink()
    os.mkfifo(folder / TLS_KEY)


def test_files_are_beside_the_configuration(tmp_path: Path) -> None:
    """An expired certificate serves too."""
    write_tls_files(tmp_path)
    config = load(tmp_path, _TLS)
    assert config.relay_server is not None
    https = config.relay_server.https
    assert https == HttpsServer(Address("0.0.0.0", 443), tmp_path / CERTIFICATE, tmp_path / TLS_KEY)
    load_tls(tmp_path / CERTIFICATE, tmp_path / TLS_KEY)


def test_credentials_of_systemd_come_first(tmp_path: Path) -> None:
    """Also if the files beside the configuration cannot be used."""
    write_tls_files(tmp_path)
    (tmp_path / "service").mkdir()
    write_tls_files(tmp_path / "service", key=f"keys_{TLS_KEY}")
    load(tmp_path, _TLS)
    (tmp_path / TLS_KEY).write_text("")
    config = load_config(tmp_path / "drone0.toml", {"CREDENTIALS_DIRECTORY": str(tmp_path / "service")})
    assert config.relay_server is not None
    assert config.relay_server.https is not None
    assert config.relay_server.https.key == tmp_path / "service" / f"keys_{TLS_KEY}"


_BROKEN: list[tuple[Break, str]] = [
    (_unlink(CERTIFICATE), "is not a file that this user sees: `openssl req"),
    (_unlink(TLS_KEY), f"{TLS_KEY} is not a file that this user sees"),
    (lambda folder: (folder / CERTIFICATE).write_text("x"), "are not a certificate and its key, in PEM"),
    (lambda folder: (folder / TLS_KEY).write_text("x"), "are not a certificate and its key, in PEM"),
    (lambda folder: write_tls_files(folder, "other.pem"), "is not that of the certificate"),
    (lambda folder: write_tls_files(folder, passphrase=b"secret"), "without a passphrase"),
    (_make_pipe, "is not a file that this user sees"),
]


@pytest.mark.parametrize(("break_it", "says"), _BROKEN, ids=[says for _, says in _BROKEN])
def test_files_that_cannot_be_used_are_a_problem(tmp_path: Path, break_it: Break, says: str) -> None:
    """The daemon asks for no passphrase, and does not wait for a writer."""
    write_tls_files(tmp_path)
    break_it(tmp_path)
    problems = refused(tmp_path, _TLS)
    assert list(problems) == ["relay_server.https"]
    assert says in problems["relay_server.https"]


@pytest.mark.parametrize(
    ("https", "says"),
    [
        ("true", 'write { listen = "0.0.0.0:443", certificate'),
        ('{ listen = "127.0.0.1:5443" }', "a web server can no longer stand before the relay"),
        (f'{{ listen = "127.0.0.1:1", {_FILES}, port = 443 }}', "needs listen, certificate and key"),
        (f'{{ listen = "relay.example.org:443", {_FILES} }}', "listen must be a numeric address"),
        (f"{{ listen = 443, {_FILES} }}", "listen must be text"),
        ('{ listen = "127.0.0.1:1", certificate = "a", key = "" }', "key must name a file"),
    ],
)
def test_table_is_checked(tmp_path: Path, https: str, says: str) -> None:
    """The message shows what to write."""
    problems = refused(tmp_path, f"{_RELAY}[relay_server]\nhttps = {https}\n")
    assert says in problems["relay_server.https"]


def test_its_port_is_its_own(tmp_path: Path) -> None:
    """Two cannot listen on one."""
    write_tls_files(tmp_path)
    tcp = '[[endpoint]]\nname = "tcp"\nurl = "tcpin:127.0.0.1:5443"\n'
    assert (
        "has the port of endpoint[1].url (tcp) too" in refused(tmp_path, _RELAY + tcp + HTTPS)["relay_server.https"]
    )
