"""``uavlinkd web``: its options, the password's file, and its process."""

from __future__ import annotations

import asyncio
import re
import signal
import socket
import ssl
import subprocess
import sys
from pathlib import Path

import pytest

from tests.tls_files import write_tls_files
from tests.waiting import PATIENCE_S
from tests.web.served import Served, basic, is_answered, peaceful
from uavlinkd.cli import main
from uavlinkd.lab.child_processes import end_with_parent
from uavlinkd.lab.sim.loopback_ports import free_port
from uavlinkd.ops.control import ControlServer
from uavlinkd.protocol.crypto import sha256
from uavlinkd.system.addresses import Address
from uavlinkd.system.terminal import FAILED, OK, WRONG

pytestmark = pytest.mark.usefixtures("undone_settings")
WITHOUT_EXTRA = "import sys; sys.modules[{!r}] = None; from uavlinkd.cli import main; sys.exit(main())"


def web(*options: str) -> int:
    return main(["web", *options])


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with files for each option."""
    monkeypatch.chdir(tmp_path)
    write_tls_files(tmp_path)
    write_tls_files(tmp_path, "other.crt", "other.key")
    for name, text in (
        ("good", "sha256:" + 64 * "0"),
        ("short", "sha256:00"),
        ("plain", "abcdef"),
        ("bad", "sha256:x"),
    ):
        (tmp_path / name).touch(0o600)
        (tmp_path / name).write_text(text + "\n")
    (tmp_path / "open").write_text("sha256:" + 64 * "0")
    (tmp_path / "open").chmod(0o644)
    return tmp_path


# The password.


def test_a_new_password_is_printed_once_and_its_hash_is_kept(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """120 random bits in groups of six characters. Only the owner reads the file."""
    assert web("--new-password", "--password-file", "page.password") == OK
    out, err = capsys.readouterr()
    (password,) = re.findall(r"password: ((?:[a-z2-7]{6}-){3}[a-z2-7]{6})\n", out)
    assert out.count(password) == 1
    assert err == ""
    file = here / "page.password"
    assert file.stat().st_mode & 0o777 == 0o600
    assert file.read_text() == f"sha256:{sha256(password.replace('-', '').encode()).hex()}\n"
    assert web("--new-password", "--password-file", "another") == OK
    assert password not in capsys.readouterr().out


def test_a_password_file_is_never_overwritten(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nor is a password printed that no file has."""
    before = (here / "good").read_text()
    for name in ("good", "absent/page.password"):
        assert web("--new-password", "--password-file", name) == FAILED
        out, err = capsys.readouterr()
        assert out == ""
        assert name in err
    assert (here / "good").read_text() == before
    assert web("--new-password") == WRONG
    assert "--password-file FILE" in capsys.readouterr().err


# Refusals.

MAKES_ONE = "`uavlinkd web --new-password --password-file FILE` makes one"
TLS = "--certificate tls.crt --key tls.key"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--listen 0.0.0.0:8790", "ssh -L 8790:127.0.0.1:8790 HOST"),
        ("--listen [::]:8790", MAKES_ONE),
        ("--listen 192.0.2.1:9000 --password-file good", "--certificate and --key"),
        (f"--listen 192.0.2.1:9000 {TLS}", MAKES_ONE),
        ("--listen [2001:db8::1]:9000 --name drone --password-file good", "ssh -L 9000:127.0.0.1:9000 HOST"),
        ("--listen drone0.example:8790", "--listen"),
        ("--listen 8790", "--listen"),
        ("--listen 127.0.0.1:0", "port from 1 to 65535"),
        ("--listen [::ffff:127.0.0.1]:8790", "write 127.0.0.1:8790"),
        ("--name drone", MAKES_ONE),
        ("--certificate tls.crt", "write both"),
        ("--key tls.key", "write both"),
        ("--listen 0.0.0.0:8790 --password-file good --certificate tls.crt", "write both"),
        ("--password-file absent", MAKES_ONE),
        ("--password-file short", MAKES_ONE),
        ("--password-file plain", MAKES_ONE),
        ("--password-file bad", MAKES_ONE),
        ("--password-file open", "open"),
        ("--password-file .", "."),
        ("--certificate tls.crt --key other.key", "is not that of the certificate"),
        ("--certificate absent.crt --key tls.key", "absent.crt"),
        ("--certificate tls.key --key tls.crt", "PEM"),
    ],
)
def test_wrong_options_are_refused_with_a_remedy(
    here: Path, capsys: pytest.CaptureFixture[str], options: str, said: str
) -> None:
    """Before anything listens. No line has the content of a file."""
    assert web("--socket", "absent.sock", *options.split()) == WRONG
    out, err = capsys.readouterr()
    assert out == ""
    assert said in err
    assert err.count("\n") == 1
    assert not [text for text in ("sha256:", "abcdef", "PRIVATE") if text in err]


@pytest.mark.parametrize("missing", ["starlette", "uvicorn"])
@pytest.mark.long
def test_a_missing_extra_is_named(missing: str) -> None:
    """With the command that installs it. Help needs none of it."""
    for options, status in (((), FAILED), (("--help",), OK)):
        command = [sys.executable, "-c", WITHOUT_EXTRA.format(missing), "web", "--socket", "absent.sock", *options]
        ended = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
        assert ended.returncode == status
        if status == FAILED:
            assert ended.stderr.count("\n") == 1
            assert f"({missing}" in ended.stderr
            assert "pip install '.[web]'" in ended.stderr


def test_an_address_in_use_is_an_error(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        assert web("--socket", "absent.sock", "--listen", f"127.0.0.1:{port}") == FAILED
    assert "cannot listen on" in capsys.readouterr().err


# The process.


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.long
async def test_the_process_says_where_it_is_and_nothing_more(
    here: Path, capsys: pytest.CaptureFixture[str], number: signal.Signals
) -> None:
    """While a browser looks, wrong passwords and garbage arrive, and connections are replaced. It ends with 0."""
    assert web("--new-password", "--password-file", "page.password") == OK
    password = capsys.readouterr().out.split()[1]
    daemon, port = ControlServer(here / "daemon.sock", peaceful), free_port()
    await daemon.start()
    options = ["--socket", "daemon.sock", "--listen", f"127.0.0.1:{port}", "--password-file", "page.password"]
    process = await asyncio.create_subprocess_exec(
        *end_with_parent(sys.executable, "-m", "uavlinkd", "web", *options, *TLS.split()),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.STDOUT,
    )
    assert process.stdout is not None
    try:
        async with asyncio.timeout(PATIENCE_S):
            line = await process.stdout.readline()
        assert line.decode() == f"the page is at https://127.0.0.1:{port}/ until Ctrl-C\n"
        client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        client.check_hostname, client.verify_mode = False, ssl.CERT_NONE
        page = Served(Address("127.0.0.1", port), client)
        plain = Served(page.address, None)
        async with page.events(Authorization=basic(password)) as events:
            await events.until(is_answered)
            assert (await page.ask(Authorization=basic("wrong"))).status == 401
            assert (await page.ask(f"/{password}", Authorization=basic(password))).status == 404
            await page.exchange(page.request("/", "POST", Transfer_Encoding="chunked") + b"zz\r\n")
            await plain.exchange(f"garbage {password}\r\n\r\n".encode())
            for _ in range(200):
                _, writer = await plain.connect("127.0.0.2")
                writer.transport.abort()
            await events.next()
            process.send_signal(number)
            async with asyncio.timeout(PATIENCE_S):
                rest = await process.stdout.read()
                assert await process.wait() == 0
        assert rest.decode() == ""
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
        await daemon.stop()
