"""Replaces keys and other machines' addresses in a text by pseudonyms: the same value always has the same one."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable
from typing import Final

_KEY_VALUE: Final = re.compile(
    r"""(?ix) (\b (?: \w*key | psk | presharedkey | secret | password | token | passphrase ) \\*["']? \s* [=:] \s* )
        ( \\+"[^"\n]*" | "(?:\\.|[^"\\\n])*" | '[^'\n]*' | [^\s,;\#}\]"'\\]{16,} )"""
)
"""A value behind the name of a key. In files and in JSON, also in JSON within JSON."""
_KEY: Final = re.compile(
    r"(?<![A-Za-z0-9+/_-])(?:[A-Za-z0-9+/]{43}=|[A-Za-z0-9_-]{43}=|[A-Za-z0-9+/]{86}==|(?:0[xX])?[0-9A-Fa-f]{64}"
    r"|(?:[0-9A-Fa-f]{2}[: ]){31,}[0-9A-Fa-f]{2})"
    r"(?![A-Za-z0-9+/=_-])"
)
"""32 or 64 bytes as base64 or hexadecimal digits, or at least 32 bytes as pairs of digits."""
_LONG: Final = re.compile(r"[A-Za-z0-9+/_-]{40,88}={0,2}")
"""What may be a damaged key, if it has letters of both kinds and digits."""
_IPV4: Final = re.compile(r"(?<![\w.])\d{1,3}(?:\.\d{1,3}){3}(?![\w]|\.\d)")
_IPV6: Final = re.compile(
    r"(?<![\w:.])[0-9A-Fa-f:]{0,45}:[0-9A-Fa-f:]{0,45}(?:\d{1,3}(?:\.\d{1,3}){3})?(?:%[\w.-]+)?(?![\w:])"
)
_HARMLESS: Final = frozenset({"", "true", "false", "null", "none"})


class Redactor:
    """Replaces values in texts. Use one for all texts that belong together."""

    def __init__(self, own_addresses: Iterable[str] = ()) -> None:
        """``own_addresses``: of this machine. They stay readable, as loopback does."""
        self._own = {_normal(address) for address in own_addresses}
        self._keys: dict[str, str] = {}
        self._peers: dict[str, str] = {}
        self._others: dict[str, str] = {}

    def add_peer(self, host: str) -> None:
        """An address or host name of a peer, which is replaced by ``peer-address-N``."""
        host = host.strip("[]").lower()
        if host and not self._is_readable(_normal(host)):
            self._peers.setdefault(_normal(host), f"peer-address-{len(self._peers) + 1}")

    def redact(self, text: str) -> str:
        text = _KEY.sub(lambda match: self._key(match[0]), text)
        text = _KEY_VALUE.sub(lambda match: match[1] + self._value(match[2]), text)
        text = _LONG.sub(lambda match: self._key(match[0]) if _is_mixed(match[0]) else match[0], text)
        text = _IPV4.sub(lambda match: self._address(match[0]), text)
        text = _IPV6.sub(lambda match: self._address(match[0]), text)
        for host, name in sorted(self._peers.items(), key=lambda item: -len(item[0])):
            if _ip(host) is None:
                text = re.sub(rf"(?i)(?<![\w.-]){re.escape(host)}(?![\w-])", name, text)
        return text

    def _key(self, key: str) -> str:
        return self._keys.setdefault(key.rstrip("="), f"key-{len(self._keys) + 1}")

    def _value(self, value: str) -> str:
        quote = value[: len(value) - len(value.lstrip("\"'\\"))]
        bare = value.strip("\"'\\")
        if bare.lower() in _HARMLESS or re.fullmatch(r"key-\d+|\d{1,12}(\.\d+)?|[\[{].*", bare):
            return value
        return f"{quote}{self._key(bare)}{quote}"

    def _address(self, text: str) -> str:
        if _ip(text) is None:
            return text
        address = _normal(text)
        if address in self._peers:
            return self._peers[address]
        if self._is_readable(address):
            return text
        return self._others.setdefault(address, f"address-{len(self._others) + 1}")

    def _is_readable(self, address: str) -> bool:
        if (number := _ip(address)) is None:
            return address == "localhost"
        return number.is_loopback or number.is_unspecified or address in self._own


def _is_mixed(text: str) -> bool:
    return bool(re.search("[a-z]", text) and re.search("[A-Z]", text) and re.search("[0-9]", text))


def _ip(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """An address without its zone."""
    try:
        return ipaddress.ip_address(text.partition("%")[0])
    except ValueError:
        return None


def _normal(text: str) -> str:
    """An address in its one short form; another text in small letters."""
    return str(_ip(text) or text.lower())
