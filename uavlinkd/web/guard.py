"""Who may look: the host of a request, the page that it comes from, and the password."""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Callable, Mapping
from ipaddress import ip_address
from typing import Final

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from uavlinkd.protocol.crypto import equal, sha256
from uavlinkd.protocol.limits import SourceLimiter, source_of

WRONG_PER_S: Final = 1 / 10
WRONG_AT_ONCE: Final = 10
"""Limits on wrong passwords of one source: an address, or a /64 of IPv6. The right one is always accepted: strangers
behind the same proxy or NAT must not lock its owner out, and 120 random bits are not guessed."""
_HOST: Final = re.compile(r"(?:\[([0-9a-f:.]+)\]|([^\[\]:]+))(?::[0-9]*)?")
"""RFC 9110, section 7.2: an IPv6 address in brackets, or a name or IPv4 address; then perhaps a port."""
_OF_PROXIES: Final = ("forwarded", "via", "x-real-ip")
HEADERS: Final[Mapping[str, str]] = {
    # Nothing from elsewhere, no inline script or style, no frame around it, and no text that becomes markup.
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self';"
    " connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none';"
    " require-trusted-types-for 'script'; trusted-types 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


class Guard:
    """Passes a request to ``app`` if it may be answered. ``names``: host names by which browsers may call the page.

    Without a password only this machine may look, so a request that a proxy passed on is refused.
    """

    def __init__(
        self, app: ASGIApp, names: frozenset[str], password_hash: bytes | None, clock: Callable[[], float]
    ) -> None:
        self._app = app
        self._names = names
        self._password_hash = password_hash
        self._clock = clock
        self._wrong = SourceLimiter(WRONG_PER_S, WRONG_AT_ONCE)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(HEADERS)
            await send(message)

        answer = self._refusal(Headers(scope=scope), scope)
        await (self._app if answer is None else answer)(scope, receive, send_guarded)

    def _refusal(self, headers: Headers, scope: Scope) -> PlainTextResponse | None:
        hosts = headers.getlist("host")
        if len(hosts) != 1 or not is_addressed(hosts[0], self._names):
            return _refuse(421, "this page has another name: start `uavlinkd web` with --name for each of its names")
        if not _is_own_page(headers, f"{scope['scheme']}://{hosts[0]}", scope["method"] in ("GET", "HEAD")):
            return _refuse(403, "another site's page asked for this one")
        if self._password_hash is None:
            if is_passed_on(headers, scope["http_version"]):
                return _refuse(403, "behind a proxy this page needs a password: --password-file FILE")
            return None
        return self._password_refusal(headers.get("authorization"), scope)

    def _password_refusal(self, credentials: str | None, scope: Scope) -> PlainTextResponse | None:
        """RFC 7617. The user name is free. A browser keeps the password; it is in no address and in no cookie."""
        challenge = {"WWW-Authenticate": 'Basic realm="uavlinkd", charset="UTF-8"'}
        if credentials is None:
            return _refuse(401, "this page has a password", challenge)
        if equal(sha256(_password(credentials)), self._password_hash or b""):
            return None
        if not self._wrong.take(source_of(scope["client"][0] if scope["client"] else ""), self._clock()):
            return _refuse(429, "too many wrong passwords: wait a minute", {"Retry-After": "60"})
        return _refuse(401, "this is not the password", challenge)


def is_addressed(host: str, names: frozenset[str]) -> bool:
    """Whether a Host header names this machine by number, as localhost, or by one of its names.

    Another site's page can make a name of its own resolve to this address (DNS rebinding), but no number.
    """
    match = _HOST.fullmatch(host.lower())
    if match is None:
        return False
    name = match[1] or match[2]
    if name == "localhost" or name in names:
        return True
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


def is_passed_on(headers: Headers, http_version: str) -> bool:
    """Whether a proxy sent the request. A browser speaks HTTP/1.1; nginx may add no header, but speaks HTTP/1.0."""
    return http_version == "1.0" or any(name in _OF_PROXIES or name.startswith("x-forwarded-") for name in headers)


def _is_own_page(headers: Headers, own: str, is_read: bool) -> bool:
    """Whether the browser sent the request for this page itself, or because a person followed a link to it.

    A request that changes something has an origin in every browser: without one it is refused.
    """
    if headers.get("origin", own if is_read else None) != own:
        return False
    is_link = headers.get("sec-fetch-mode") == "navigate" and headers.get("sec-fetch-dest") == "document"
    return headers.get("sec-fetch-site", "none") in ("none", "same-origin") or is_link


def _password(credentials: str) -> bytes:
    """The password of an Authorization header, without hyphens and capital letters, which a person may add.

    It is empty, which is never right, if there is none.
    """
    scheme, _, encoded = credentials.partition(" ")
    if scheme.lower() != "basic":
        return b""
    try:
        typed = base64.b64decode(encoded, validate=True).partition(b":")[2]
        return typed.translate(None, b"- ").lower()
    except (binascii.Error, ValueError):
        return b""


def _refuse(status: int, text: str, headers: Mapping[str, str] | None = None) -> PlainTextResponse:
    """It ends the connection: a stranger that reads no answers must not hold one with many requests."""
    return PlainTextResponse(text + "\n", status, {**(headers or {}), "Connection": "close"})
