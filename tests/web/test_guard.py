"""Who may look at the page: requests of other sites, other names, proxies and strangers, at a real socket."""

from __future__ import annotations

import asyncio
import ssl
from base64 import b64encode
from pathlib import Path

import pytest

from tests.tls_files import CERTIFICATE, TLS_KEY, write_tls_files
from tests.web.served import HASH, PASSWORD, Served, basic, is_answered, page_of
from uavlinkd.config.tls_files import load_tls
from uavlinkd.web import guard
from uavlinkd.web.guard import HEADERS, WRONG_AT_ONCE

STRANGER = "127.0.0.2"
TARGETS = ("/", "/peer/drone1", "/events", "/page.js", "/absent")


async def test_a_browser_gets_the_page_and_its_events(page: Served) -> None:
    """Each answer has the headers that keep other content out."""
    own = f"http://{page.address}"
    for target in ("/", "/peer/drone1", "/page.js", "/page.css", "/icon.svg"):
        reply = await page.ask(target, Sec_Fetch_Site="same-origin")
        assert reply.status == 200
        assert {name: reply.headers[name.lower()] for name in HEADERS} == HEADERS
    async with page.events(Origin=own, Sec_Fetch_Site="same-origin", Sec_Fetch_Mode="cors") as events:
        assert (await events.until(is_answered))["daemon"] == "ground"


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "https://attacker.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:1"},
        {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "no-cors", "Sec_Fetch_Dest": "image"},
        {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "navigate", "Sec_Fetch_Dest": "iframe"},
        {"Sec_Fetch_Site": "same-site", "Sec_Fetch_Mode": "no-cors", "Sec_Fetch_Dest": "script"},
        {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "cors", "Accept": "text/event-stream"},
    ],
    ids=["origin", "hidden-origin", "other-port", "image", "frame", "script", "event-source"],
)
async def test_another_sites_page_gets_nothing(page: Served, headers: dict[str, str]) -> None:
    """A browser on this machine would send its requests."""
    for target in TARGETS:
        reply = await page.ask(target, **headers)
        assert reply.status == 403
        assert reply.body == b"another site's page asked for this one\n"
        assert {name: reply.headers[name.lower()] for name in HEADERS} == HEADERS


@pytest.mark.parametrize("origin", ["https://attacker.example", "null", None])
async def test_a_form_of_another_site_does_nothing(page: Served, origin: str | None) -> None:
    """Each browser says where a form comes from."""
    form = page.request(
        "/", "POST", Content_Type="application/x-www-form-urlencoded", Content_Length="3", Origin=origin
    )
    reply = await page.exchange(form.replace(b"\r\n\r\n", b"\r\nConnection: close\r\n\r\na=b"))
    assert reply.split(b" ")[1] == b"403"


@pytest.mark.parametrize(
    "host",
    [
        *("attacker.example", "attacker.example:8790", "127.0.0.1.attacker.example", "localhost.attacker.example"),
        *("[::1].attacker.example", "[::1", "[localhost]", "127.0.0.1:80.attacker.example", "localhost:x"),
        *("localhost.", "", "2130706433", "0x7f.0.0.1", "127.1", "links.example", "attacker.example#127.0.0.1"),
    ],
)
async def test_a_name_of_another_site_does_not_lead_here(page: Served, host: str) -> None:
    """DNS rebinding: the attacker's name resolves to this machine, and its script reads answers as its own."""
    for target in ("/", "/events"):
        assert (await page.ask(target, Host=host)).status == 421


async def test_two_hosts_or_none_are_no_host(page: Served) -> None:
    """A proxy and the page could each believe another one."""
    assert (await page.ask(Host=None)).status == 0, "HTTP/1.1 needs one"
    twice = page.request(Connection="close").replace(b"\r\n\r\n", b"\r\nHost: attacker.example\r\n\r\n")
    assert not (await page.exchange(twice)).startswith(b"HTTP/1.1 200")


@pytest.mark.parametrize(
    "host", ["127.0.0.1", "127.0.0.1:80", "LocalHost:9", "10.0.0.7:443", "[::1]:8790", "[fe80::1]"]
)
async def test_numbers_and_localhost_lead_here(page: Served, host: str) -> None:
    """A tunnel may have another port than the page. No name server answers for a number."""
    assert (await page.ask(Host=host)).status == 200


async def test_a_name_leads_here_if_it_was_given(locked: Served) -> None:
    """In any case, and with any port."""
    for host, status in (("Links.Example", 200), ("links.example:8443", 200), ("other.example", 421)):
        assert (await locked.ask(Host=host, Authorization=basic(PASSWORD))).status == status


@pytest.mark.parametrize(
    "header",
    ["X-Forwarded-For", "Forwarded", "Via", "X-Real-IP", "X-Forwarded-Host", "x-forwarded-proto"],
)
async def test_no_proxy_publishes_a_page_without_a_password(page: Served, locked: Served, header: str) -> None:
    """With a password it may."""
    assert (await page.ask("/events", **{header: "10.0.0.1"})).status == 403
    assert (await locked.ask(**{header: "10.0.0.1"}, Authorization=basic(PASSWORD))).status == 200


async def test_nginx_as_it_is_by_default_publishes_no_page(page: Served, locked: Served) -> None:
    """It calls the page by its number, adds no header, and speaks HTTP/1.0."""
    assert b" 403 " in await page.exchange(page.request("/", version="1.0", Connection="close"))
    passed_on = locked.request("/", version="1.0", Connection="close", Authorization=basic(PASSWORD))
    assert b" 200 " in await locked.exchange(passed_on)


@pytest.mark.parametrize(
    "credentials",
    [
        *(None, "", "Basic", "Basic ", "Basic !!!", "Basic ====", "Basic \xff\xfe", f"Bearer {PASSWORD}"),
        *(basic(""), basic("wrong"), basic(PASSWORD + "a"), basic(PASSWORD[:-1]), basic("", PASSWORD)),
        *(PASSWORD, f"Basic {PASSWORD}", f"Basic {b64encode(PASSWORD.encode()).decode()}", f"Basic {HASH.hex()}"),
        basic(HASH.hex()),
    ],
)
async def test_without_the_password_there_is_nothing(locked: Served, credentials: str | None) -> None:
    """No answer says more than that."""
    for target in TARGETS:
        reply = await locked.ask(target, Authorization=credentials)
        assert (reply.status, reply.headers["www-authenticate"][:5]) == (401, "Basic")
        assert reply.body in (b"this page has a password\n", b"this is not the password\n")


async def test_wrong_passwords_have_a_limit_for_each_source(monkeypatch: pytest.MonkeyPatch) -> None:
    """The right password is accepted all the time: strangers must not lock its owner out."""
    now = [1000.0]
    monkeypatch.setattr("uavlinkd.web.page.monotonic", lambda: now[0])
    async with page_of(password_hash=HASH) as page:
        statuses = [(await page.ask(Authorization=basic(f"wrong{n}"), source=STRANGER)).status for n in range(15)]
        assert statuses == WRONG_AT_ONCE * [401] + (15 - WRONG_AT_ONCE) * [429]
        waits = await page.ask(Authorization=basic("wrong"), source=STRANGER)
        assert (waits.status, waits.headers["retry-after"]) == (429, "60")
        assert (await page.ask(Authorization=basic("wrong"))).status == 401, "another source has its own limit"
        assert (await page.ask(source=STRANGER)).status == 401, "a new browser asks for the password"
        assert (await page.ask(Authorization=basic(PASSWORD), source=STRANGER)).status == 200
        now[0] += 1 / guard.WRONG_PER_S
        assert (await page.ask(Authorization=basic("wrong"), source=STRANGER)).status == 401


async def test_the_guard_is_the_same_by_tls(tmp_path: Path) -> None:
    """The page's own origin has https then."""
    write_tls_files(tmp_path)
    client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    client.check_hostname, client.verify_mode = False, ssl.CERT_NONE
    tls = load_tls(tmp_path / CERTIFICATE, tmp_path / TLS_KEY)
    async with page_of(password_hash=HASH, tls=tls, trusted=client) as page:
        async with page.events(Authorization=basic(PASSWORD), Origin=f"https://{page.address}") as events:
            assert (await events.until(is_answered))["daemon"] == "ground"
        for origin, status in ((f"https://{page.address}", 200), (f"http://{page.address}", 403)):
            assert (await page.ask(Origin=origin, Authorization=basic(PASSWORD))).status == status
        assert (await page.ask()).status == 401
        reader, writer = await asyncio.open_connection(page.address.host, page.address.port)
        writer.write(page.request())
        with pytest.raises((ConnectionError, asyncio.IncompleteReadError)):
            await reader.readexactly(1000)
        writer.close()
