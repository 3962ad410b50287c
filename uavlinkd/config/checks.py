"""What must hold between the values of a configuration. Each check looks at what is good and leaves out the rest."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from itertools import combinations
from typing import Any

from uavlinkd.system.addresses import Address, overlaps
from uavlinkd.config.problems import Problems, Values
from uavlinkd.config.schema import LinkSection, RecordingSection
from uavlinkd.endpoints.url import EndpointUrl, Kind, NetworkUrl, SerialUrl

LINK_KEYS = frozenset(LinkSection.model_fields)

# Smaller, larger, and why the order matters.
_ASCENDING = (
    ("echo_after_s", "handshake_after_s", "an echo is asked for before a handshake is tried"),
    ("coalesce_s", "max_age_s", "a frame that waits for others must not have grown too old"),
    ("handshake_after_s", "lost_after_s", "a handshake is tried before the peer is given up"),
)
_RETRIES_BEFORE_REJECT = 2


def names(problems: Problems, sections: Iterable[Values]) -> None:
    """No two of a kind have one name."""
    _unique(problems, sections, "name", lambda name: name, "the name of {other} too: write another")


def public_keys(problems: Problems, peers: Sequence[Values], own: bytes | None, private: bytes | None) -> None:
    """No two peers have one key, none has ours, and none has our private one in its place."""
    _unique(problems, peers, "public_key", bytes, "the key of {other} too: each peer has its own")
    for peer in peers:
        key = peer.good.get("public_key")
        if key is not None and key == own:
            problems.add(
                peer.place.key("public_key"),
                "is this daemon's own key: write what `uavlinkd pubkey` prints on the peer",
            )
        if key is not None and key == private:
            problems.add(
                peer.place.key("public_key"),
                "is this daemon's private key, which nobody else may see: make a new one with"
                " `uavlinkd keygen`, and write here what `uavlinkd pubkey` prints on the peer",
            )


def previous_keys(
    problems: Problems, top: Values, peers: Sequence[Values], own: bytes | None, previous: bytes | None
) -> None:
    """No key is two daemons' at a time, be it the one that they have or the one that they had."""
    if previous is not None and previous == own:
        problems.add("previous_private_key_file", "holds the key of private_key_file: leave it out")
    owners = {each.good.get("public_key"): each for each in peers}
    for peer in peers:
        key = peer.good.get("previous_public_key")
        if key is None:
            continue
        place = peer.place.key("previous_public_key")
        if key in (own, previous):
            problems.add(place, "is this daemon's own key: write what the peer's was, or leave it out")
        elif key == peer.good.get("public_key"):
            problems.add(place, "is the key that it has: leave it out")
        elif key in owners:
            problems.add(place, f"is the key of {owners[key].place.key('')}: each peer has its own")
    for peer in peers:
        if previous is not None and peer.good.get("public_key") == previous:
            problems.add(peer.place.key("public_key"), "is this daemon's own previous key: write the peer's")
    _unique(problems, peers, "previous_public_key", bytes, "the previous key of {other} too: each peer has its own")


def _unique(
    problems: Problems, sections: Iterable[Values], key: str, as_hashable: Callable[[Any], Hashable], message: str
) -> None:
    first: dict[Hashable, Values] = {}
    for section in sections:
        if (value := section.good.get(key)) is None:
            continue
        other = first.setdefault(as_hashable(value), section)
        if other is not section:
            problems.add(section.place.key(key), "is " + message.format(other=other.place.key("")))


def reachability(problems: Problems, top: Values, peers: Iterable[Values]) -> None:
    """Of two ends, one must be able to call the other; and nobody calls himself."""
    listen: list[Address] = top.good.get("listen", [])
    for a, b in combinations(listen, 2):
        if overlaps(a, b):
            problems.add("listen", f"names {a} and {b}, which one machine cannot listen on at once: write one")
    for peer in peers:
        addresses: list[Address] = peer.good.get("addresses", [])
        if not addresses and not listen and "listen" not in top.bad and "addresses" not in peer.bad:
            problems.add(
                peer.place.key("addresses"),
                "is empty, and so is listen: neither end could call the other; write the peer's address here,"
                ' or listen = ["0.0.0.0:5790"] at the top so that the peer can call',
            )
        for address in addresses:
            if any(_reaches(address, own) for own in listen):
                problems.add(
                    peer.place.key("addresses"), f"names {address}, where this daemon listens: write the peer's"
                )


def _reaches(target: Address, listening: Address) -> bool:
    """Whether a datagram to ``target`` comes back to this machine's ``listening``, as far as the text tells."""
    if target.port != listening.port or target.family != listening.family:
        return False
    return target.ip == listening.ip or (listening.is_wildcard and target.is_loopback)


def endpoints(problems: Problems, top: Values, sections: Iterable[Values]) -> None:
    """Each endpoint has a port of its own, is none of the link's, and does not feed another of them."""
    listen: list[Address] = top.good.get("listen", [])
    seen: list[tuple[Values, EndpointUrl]] = []
    for section in sections:
        url = section.good.get("url")
        key = section.place.key("url")
        if url is None:
            continue
        if url.kind is Kind.UDPIN and any(own.port == url.address.port for own in listen):
            problems.add(key, f"has the port on which peers are listened for, {url.address.port}: write another")
        if url.kind is Kind.UDPOUT and any(_reaches(url.address, own) for own in listen):
            problems.add(key, "sends to this daemon's own port for peers: write where the MAVLink program listens")
        for other, other_url in seen:
            if message := _clash(url, other_url):
                problems.add(key, message.format(other=other.place.key("")))
        seen.append((section, url))


def _clash(a: EndpointUrl, b: EndpointUrl) -> str | None:
    if not isinstance(a, NetworkUrl) or not isinstance(b, NetworkUrl):
        same = isinstance(a, SerialUrl) and isinstance(b, SerialUrl) and a.device == b.device
        return "is the device of {other} too, and only one can have it: write it once" if same else None
    if a.listens and a.kind is b.kind and overlaps(a.address, b.address):
        return "listens where {other} does: write another port"
    if a == b:
        return "sends where {other} does, so every frame would arrive twice: write it once"
    for sender, listener in ((a, b), (b, a)):
        if (sender.kind, listener.kind) in _FEEDS and _reaches(sender.address, listener.address):
            return "and {other} are both ends of one connection, so frames would go round: write one of them"
    return None


def metrics(problems: Problems, section: Values, endpoints: Iterable[Values]) -> None:
    """Prometheus is answered on a TCP port of its own."""
    address: Address | None = section.good.get("listen")
    for endpoint in endpoints:
        url = endpoint.good.get("url")
        if address and url and url.kind is Kind.TCPIN and overlaps(address, url.address):
            problems.add(
                section.place.key("listen"), f"is where {endpoint.place.key('')} listens: write another port"
            )


def recording(problems: Problems, section: Values, peers: Sequence[Values]) -> None:
    """Each peer has a file that is being written, and one more is kept at least."""
    if "folder" not in section.good or "max_files" in section.bad:
        return
    kept = section.good.get("max_files", RecordingSection.model_fields["max_files"].default)
    if kept <= len(peers):
        problems.add(
            section.place.key("max_files"),
            f"must be more than the number of peers, each of which has a file: write {len(peers) + 1} or more",
        )


_FEEDS = {(Kind.UDPOUT, Kind.UDPIN), (Kind.TCP, Kind.TCPIN)}


def inherited(link: Values, peer: Values) -> dict[str, Any]:
    """The link keys that a peer ends up with: its own, else those of ``[link]``. Defaults are left out."""
    return {key: value for key, value in {**link.good, **peer.good}.items() if key in LINK_KEYS}


def timers(problems: Problems, section: Values, link: Values | None = None) -> None:
    """The timers of ``[link]``, or of a peer that inherits from it, are in order."""
    given = inherited(link, section) if link else section.good
    values = {name: field.default for name, field in LinkSection.model_fields.items()} | given
    unknown = section.bad | (link.bad - set(section.good) if link else frozenset())
    for key, others, message in _disorder(values):
        involved = {key, *others}
        # What a peer only inherits is told once, where it stands.
        if not involved & unknown and (link is None or involved & set(section.good)):
            problems.add(section.place.key(key), message)


def _disorder(values: Mapping[str, Any]) -> Iterator[tuple[str, tuple[str, ...], str]]:
    for smaller, larger, reason in _ASCENDING:
        if values[smaller] >= values[larger]:
            yield larger, (smaller,), f"must be more than {smaller} ({values[smaller]:g}): {reason}"
    if values["retry_min_s"] > values["retry_max_s"]:
        yield (
            "retry_max_s",
            ("retry_min_s",),
            f"must be no less than retry_min_s ({values['retry_min_s']:g}): the wait grows from one to the other",
        )
    least = values["rekey_after_s"] + _RETRIES_BEFORE_REJECT * values["retry_max_s"]
    if values["reject_after_s"] < least:
        yield (
            "reject_after_s",
            ("rekey_after_s", "retry_max_s"),
            f"must be {least:g} or more, rekey_after_s and {_RETRIES_BEFORE_REJECT} times retry_max_s: new keys"
            " must have time to come before the old ones are dropped",
        )
