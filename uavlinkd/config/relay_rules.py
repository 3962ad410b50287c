"""Rules for a relay: ``[[member]]`` and ``[relay_server]``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from uavlinkd.config import checks
from uavlinkd.config.link_settings import link_of
from uavlinkd.config.model import RelayServer
from uavlinkd.config.problems import Problems, Values
from uavlinkd.config.schema import LinkSection, MemberSection, RelayServerSection
from uavlinkd.core import constants as c
from uavlinkd.core.crypto import Secret
from uavlinkd.core.settings import Link, PeerSettings, previous_of
from uavlinkd.relay.member_settings import MemberSettings, RelayLimits
from uavlinkd.system.addresses import Address

MOST_MEMBERS = 4000
"""Each has up to three sessions, of 65,535 indices."""


def members(
    problems: Problems, sections: Sequence[Values], peers: Sequence[Values], own: bytes | None, private: bytes | None
) -> None:
    """Each member has a key of its own. It may also be a peer: then one session serves both."""
    checks.names(problems, sections)
    checks.public_keys(problems, sections, own, private, "member")
    by_name = {peer.valid.get("name"): peer for peer in peers}
    by_key = {peer.valid.get("public_key"): peer for peer in peers}
    for section in sections:
        name, key = section.valid.get("name"), section.valid.get("public_key")
        if name is None or key is None:
            continue
        peer = by_key.get(key)
        if peer is not None:
            checks.of_peer(problems, section, peer)
        if (other := by_name.get(name)) is not None and other is not peer:
            problems.add(
                section.place.key("name"),
                f"is the name of {other.place.key('')} too, which has another key: write another name",
            )
    if len(sections) > MOST_MEMBERS:
        problems.add(
            "member", f"has more than {MOST_MEMBERS:,} sections: run several relays, each on a port of its own"
        )


def relay_server(
    problems: Problems, top: Values, server: Values, sections: Sequence[Values], *, has_frames: bool
) -> None:
    """A relay has members, which can reach it. A daemon that carries frames is a relay only if its file says so."""
    is_enabled = server.valid.get("enabled")
    if sections and not is_enabled and (has_frames or is_enabled is False) and "enabled" not in server.invalid:
        problems.add(
            server.place.key("enabled"),
            "is not true, but the file has a [[member]]: write [relay_server] and below it enabled = true,"
            " or remove the members",
        )
    if is_enabled and not sections:
        problems.add(
            server.place.key("enabled"),
            "is true, but the file has no [[member]]: write one with name and public_key for each daemon"
            " that may use this relay",
        )
    if sections and not top.valid.get("listen") and "listen" not in top.invalid:
        problems.add(
            "listen",
            'is empty, so no member could reach this relay: write listen = ["0.0.0.0:5790", "[::]:5790"]',
        )


def relay_server_of(
    server: Values, sections: Sequence[Values], psks: Sequence[Secret | None], link: Values
) -> RelayServer | None:
    """The relay of a valid configuration; None if it is not one."""
    if not sections:
        return None
    keys = RelayServerSection.model_construct(**server.valid)
    common = link_of(LinkSection.model_construct(**link.valid))
    common = replace(common, features=c.FEATURE_RECORDS)
    return RelayServer(
        members=tuple(
            member for section, psk in zip(sections, psks, strict=True) for member in _members(section, psk, common)
        ),
        limits=RelayLimits(keys.datagrams_s, keys.bits_s),
    )


def _members(section: Values, psk: Secret | None, link: Link) -> Iterator[MemberSettings]:
    """One, or two while its key changes: others ask for it by the key that they know."""
    keys = MemberSection.model_construct(**section.valid)
    peer = PeerSettings(keys.name, keys.public_key, psk, link, initiates=False)
    limits = RelayLimits(keys.datagrams_s, keys.bits_s)
    yield MemberSettings(peer, keys.max_peers, limits)
    if keys.previous_public_key is not None:
        yield MemberSettings(previous_of(peer, keys.previous_public_key), keys.max_peers, limits)


def advice(server: RelayServer, listen: Sequence[Address]) -> Iterator[str]:
    """Yield the warnings. ``listen``: empty if the relay listens on networks."""
    if listen and all(address.is_loopback for address in listen):
        yield "listen names only loopback: no member on another machine reaches this relay"
    if len(server.members) == 1:
        yield "there is only one [[member]]: a relay connects two"
