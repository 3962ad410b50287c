"""Rules for a relay: ``[[member]]`` and ``[relay_server]``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from uavlinkd.config import checks
from uavlinkd.config.link_settings import link_of
from uavlinkd.config.model import RelayServer
from uavlinkd.config.pasted_keys import is_example
from uavlinkd.config.problems import Problems, Values
from uavlinkd.config.schema import LinkSection, MemberSection, RelayServerSection
from uavlinkd.core import constants as c
from uavlinkd.core.crypto import Secret
from uavlinkd.core.settings import Link, PeerSettings
from uavlinkd.relay.member_settings import MemberSettings, RelayLimits

MOST_MEMBERS = 4000
"""Each has up to three sessions, of 65,535 indices."""
_RETRY_MAX_S = 60.0
"""A member that is away initiates by itself when it is back."""


def members(
    problems: Problems, sections: Sequence[Values], peers: Sequence[Values], own: bytes | None, private: bytes | None
) -> None:
    """Each member has a key of its own. It may also be a peer: then one session serves both."""
    checks.names(problems, sections)
    checks.public_keys(problems, sections, own, private)
    by_name = {peer.valid.get("name"): peer for peer in peers}
    by_key = {peer.valid.get("public_key"): peer for peer in peers}
    previous = {peer.valid.get("previous_public_key"): peer for peer in peers}
    for section in sections:
        name, key = section.valid.get("name"), section.valid.get("public_key")
        if name is None or key is None:
            continue
        peer = by_key.get(key)
        if peer is not None and "psk_file" in section.valid:
            problems.add(
                section.place.key("psk_file"),
                f"has no effect, because {peer.place.key('')} has this key: write the PSK there only",
            )
        if (other := by_name.get(name)) is not None and other is not peer:
            problems.add(
                section.place.key("name"),
                f"is the name of {other.place.key('')} too, which has another key: write another name",
            )
        if (other := previous.get(key)) is not None:
            problems.add(
                section.place.key("public_key"),
                f"is the previous key of {other.place.key('')}: write its new key",
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
    common = replace(common, features=c.FEATURE_RECORDS, timers=replace(common.timers, retry_max_s=_RETRY_MAX_S))
    return RelayServer(
        members=tuple(_member(section, psk, common) for section, psk in zip(sections, psks, strict=True)),
        limits=RelayLimits(keys.datagrams_s, keys.bits_s),
    )


def _member(section: Values, psk: Secret | None, link: Link) -> MemberSettings:
    keys = MemberSection.model_construct(**section.valid)
    return MemberSettings(
        peer=PeerSettings(keys.name, keys.public_key, psk, link),
        most_peers=keys.max_peers,
        limits=RelayLimits(keys.datagrams_s, keys.bits_s),
    )


def advice(server: RelayServer) -> Iterator[str]:
    """Yield the warnings."""
    if examples := [member.name for member in server.members if is_example(member.peer.public_key)]:
        yield (
            f"member {', '.join(examples)}: public_key is the key of an example, whose private key does not exist:"
            " write what `uavlinkd keygen` or `uavlinkd pubkey` printed on the member"
        )
    if len(server.members) == 1:
        yield "there is only one [[member]]: a relay connects two"
