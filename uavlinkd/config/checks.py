"""Rules between the values of a configuration. A check uses the valid values and ignores the others."""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from itertools import combinations
from typing import Any

from uavlinkd.config.model import PeerAddress
from uavlinkd.config.problems import Problems, Values
from uavlinkd.config.schema import LinkSection, RecordingSection
from uavlinkd.endpoints.url import EndpointKind, EndpointUrl, NetworkUrl, SerialUrl
from uavlinkd.system.addresses import Address, overlaps

LINK_KEYS = frozenset(LinkSection.model_fields)

# Smaller, larger, and why the order matters.
_ASCENDING = (
    ("echo_after_s", "handshake_after_s", "the daemon sends an echo request before it tries a handshake"),
    ("coalesce_s", "max_age_s", "a frame that waits for others must not become too old"),
    ("handshake_after_s", "lost_after_s", "the daemon tries a handshake before it reports the peer as lost"),
)
_RETRIES_BEFORE_REJECT = 2


def names(problems: Problems, sections: Iterable[Values]) -> None:
    """Two sections of a kind have different names."""
    unique(problems, sections, "name", lambda name: name, "the name of {other} too: write another")


def public_keys(
    problems: Problems, peers: Sequence[Values], own: bytes | None, private: bytes | None, what: str = "peer"
) -> None:
    """Each peer or member has a key of its own, which is not this daemon's public key."""
    unique(problems, peers, "public_key", bytes, f"the key of {{other}} too: each {what} has its own")
    for peer in peers:
        key = peer.valid.get("public_key")
        if key is not None and key == own and key != private:
            problems.add(
                peer.place.key("public_key"),
                f"is this daemon's own key: write what `uavlinkd pubkey` prints on the {what}",
            )


def previous_keys(
    problems: Problems, top: Values, sections: Sequence[Values], own: bytes | None, previous: bytes | None
) -> None:
    """Each previous key belongs to one daemon. ``sections``: the peers, members and relays."""
    if previous is not None and previous == own:
        problems.add("previous_private_key_file", "holds the key of private_key_file: leave it out")
    owners = {section.valid.get("public_key"): section for section in sections}
    for section in sections:
        if previous is not None and section.valid.get("public_key") == previous:
            problems.add(
                section.place.key("public_key"),
                "is this daemon's own previous key: write what `uavlinkd pubkey` prints on the other daemon",
            )
        key = section.valid.get("previous_public_key")
        if key is None:
            continue
        place = section.place.key("previous_public_key")
        if key in (own, previous):
            problems.add(place, "is this daemon's own key: write the other daemon's previous key, or leave it out")
        elif key == section.valid.get("public_key"):
            problems.add(place, "is its current key: leave it out")
        elif key in owners:
            problems.add(place, f"is the key of {owners[key].place.key('')}: write its own, or leave it out")
    unique(problems, sections, "previous_public_key", bytes, "the previous key of {other} too: write its own")


def of_peer(problems: Problems, section: Values, peer: Values) -> None:
    """A member or relay that is a peer too leaves to the peer what belongs to their one session."""
    for key in ("psk_file", "previous_public_key"):
        if key in section.valid:
            problems.add(
                section.place.key(key),
                f"has no effect, because {peer.place.key('')} has the same public_key: write it there only",
            )


def unique(
    problems: Problems, sections: Iterable[Values], key: str, as_hashable: Callable[[Any], Hashable], message: str
) -> None:
    """No two sections have the same value of a key. ``message`` says what to do, with the place of the ``other``."""
    first: dict[Hashable, Values] = {}
    for section in sections:
        if (value := section.valid.get(key)) is None:
            continue
        other = first.setdefault(as_hashable(value), section)
        if other is not section:
            problems.add(section.place.key(key), "is " + message.format(other=other.place.key("")))


def reachability(problems: Problems, top: Values, peers: Iterable[Values], relayed: Collection[Values] = ()) -> None:
    """One of the two ends must be able to initiate, and a daemon does not initiate to itself.

    ``relayed``: the peers that need no address, because they are reached along a relay.
    """
    listen: list[Address] = top.valid.get("listen", [])
    for a, b in combinations(listen, 2):
        if overlaps(a, b):
            problems.add("listen", f"names {a} and {b}, which one machine cannot listen on at once: write one")
    for peer in peers:
        addresses: list[PeerAddress] = peer.valid.get("addresses", [])
        if peer in relayed:
            pass
        elif not addresses and not listen and "listen" not in top.invalid and "addresses" not in peer.invalid:
            or_else = ", and remove relays = []" if peer.valid.get("relays") == [] else ""
            problems.add(
                peer.place.key("addresses"),
                "is empty, and so is listen: neither end could initiate; write the peer's address here,"
                ' or listen = ["0.0.0.0:5790"] at the top so that the peer can initiate, or a [[relay]] that both'
                f" ends use{or_else}",
            )
        for written in addresses:
            if any(_reaches(written.address, own) for own in listen):
                problems.add(
                    peer.place.key("addresses"),
                    f"names {written.address}, where this daemon listens: write the peer's",
                )


def _reaches(target: Address, listening: Address) -> bool:
    """Whether a datagram to ``target`` arrives at this machine's ``listening``, as far as the text shows."""
    if target.port != listening.port or target.family != listening.family:
        return False
    return target.ip == listening.ip or (listening.is_wildcard and target.is_loopback)


def endpoints(problems: Problems, top: Values, sections: Iterable[Values]) -> None:
    """Each endpoint has a port of its own, which is not a port for peers, and does not feed another endpoint."""
    listen: list[Address] = top.valid.get("listen", [])
    seen: list[tuple[Values, EndpointUrl]] = []
    for section in sections:
        url = section.valid.get("url")
        key = section.place.key("url")
        if url is None:
            continue
        if url.kind is EndpointKind.UDPIN and any(own.port == url.address.port for own in listen):
            problems.add(key, f"has the port that `listen` has for peers, {url.address.port}: write another")
        if url.kind is EndpointKind.UDPOUT and any(_reaches(url.address, own) for own in listen):
            problems.add(key, "sends to this daemon's own port for peers: write the address of the MAVLink client")
        for other, other_url in seen:
            if message := _clash(url, other_url):
                problems.add(key, message.format(other=other.place.key("")))
        seen.append((section, url))


def _clash(a: EndpointUrl, b: EndpointUrl) -> str | None:
    if not isinstance(a, NetworkUrl) or not isinstance(b, NetworkUrl):
        same = isinstance(a, SerialUrl) and isinstance(b, SerialUrl) and a.device == b.device
        return "is the device of {other} too, and only one endpoint can open it: write it once" if same else None
    if a.listens and a.kind is b.kind and overlaps(a.address, b.address):
        return "listens where {other} does: write another port"
    if a == b:
        return "sends where {other} does, so every frame would arrive twice: write it once"
    for sender, listener in ((a, b), (b, a)):
        if (sender.kind, listener.kind) in _FEEDS and _reaches(sender.address, listener.address):
            return "and {other} are both ends of one connection, so frames would loop: write one of them"
    return None


def metrics(problems: Problems, section: Values, endpoints: Iterable[Values]) -> None:
    """The server for Prometheus has a TCP port of its own."""
    address: Address | None = section.valid.get("listen")
    for endpoint in endpoints:
        url = endpoint.valid.get("url")
        if address and url and url.kind is EndpointKind.TCPIN and overlaps(address, url.address):
            problems.add(
                section.place.key("listen"), f"is where {endpoint.place.key('')} listens: write another port"
            )


def recording(problems: Problems, section: Values, peers: Sequence[Values]) -> None:
    """Each peer has a file that the daemon writes, and at least one more file is kept."""
    if "folder" not in section.valid or "max_files" in section.invalid:
        return
    kept = section.valid.get("max_files", RecordingSection.model_fields["max_files"].default)
    if kept <= len(peers):
        problems.add(
            section.place.key("max_files"),
            f"must be more than the number of peers, each of which has a file: write {len(peers) + 1} or more",
        )


_FEEDS = {(EndpointKind.UDPOUT, EndpointKind.UDPIN), (EndpointKind.TCP, EndpointKind.TCPIN)}


def inherited(link: Values, peer: Values) -> dict[str, Any]:
    """The link keys that apply to a peer: its own, else those of ``[link]``, without defaults."""
    return {key: value for key, value in {**link.valid, **peer.valid}.items() if key in LINK_KEYS}


def timers(problems: Problems, section: Values, link: Values | None = None) -> None:
    """The timers of ``[link]``, or of a peer that inherits from it, are in order."""
    given = inherited(link, section) if link else section.valid
    values = {name: field.default for name, field in LinkSection.model_fields.items()} | given
    unknown = section.invalid | (link.invalid - set(section.valid) if link else frozenset())
    for key, others, message in _disorder(values):
        involved = {key, *others}
        # A problem that a peer only inherits is reported once, for [link].
        if not involved & unknown and (link is None or involved & set(section.valid)):
            problems.add(section.place.key(key), message)


def _disorder(values: Mapping[str, Any]) -> Iterator[tuple[str, tuple[str, ...], str]]:
    for smaller, larger, reason in _ASCENDING:
        if values[smaller] >= values[larger]:
            yield larger, (smaller,), f"must be more than {smaller} ({values[smaller]:g}): {reason}"
    if values["retry_min_s"] > values["retry_max_s"]:
        yield (
            "retry_max_s",
            ("retry_min_s",),
            f"must be at least retry_min_s ({values['retry_min_s']:g}): the wait grows from one to the other",
        )
    least = values["rekey_after_s"] + _RETRIES_BEFORE_REJECT * values["retry_max_s"]
    if values["reject_after_s"] < least:
        yield (
            "reject_after_s",
            ("rekey_after_s", "retry_max_s"),
            f"must be {least:g} or more, rekey_after_s and {_RETRIES_BEFORE_REJECT} times retry_max_s: the ends"
            " need time to make new keys before they drop the old ones",
        )
