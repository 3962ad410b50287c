"""Rules between the values of a configuration. Each yields the place of a key, what is wrong there and what to do.

A rule uses the valid values and ignores the others.
"""

from __future__ import annotations

from itertools import combinations

from uavlinkd.config import fleet_rules, key_rules, network_rules, relay_rules
from uavlinkd.config.build import inherited, policy_data, policy_problems
from uavlinkd.config.model import HttpsServer
from uavlinkd.config.problems import Found, Sections, Values, unique
from uavlinkd.config.schema import LinkSection
from uavlinkd.io.url import EndpointKind, NetworkUrl
from uavlinkd.system.addresses import Address, overlaps

_RETRIES_BEFORE_REJECT = 2


def check(file: Sections) -> Found:
    for sections in (file.endpoints, file.peers, file.members):
        yield from unique(sections, "name", "the name of {other} too: write another")
    yield from key_rules.check(file)
    yield from relay_rules.members(file)
    yield from _reachability(file)
    yield from relay_rules.relays(file)
    yield from fleet_rules.check(file)
    yield from network_rules.networks(file)
    yield from _endpoints(file)
    yield from _timers(file.link)
    for endpoint in file.endpoints:
        yield from policy_problems(endpoint, policy_data(endpoint), is_local=True)
    for peer in file.peers:
        yield from _timers(peer, file.link)
        yield from policy_problems(peer, policy_data(peer), is_local=False)


def _reachability(file: Sections) -> Found:
    """One of the two ends must be able to initiate, and a daemon does not initiate to itself."""
    listen: list[Address] = file.top.get("listen", [])
    for a, b in combinations(listen, 2):
        if overlaps(a, b):
            yield "listen", f"names {a} and {b}, which one machine cannot listen on at once: write one"
    for peer in file.peers:
        if (
            peer.lacks("addresses")
            and file.top.lacks("listen")
            and not relay_rules.needs_no_address(peer, file.used_relays)
        ):
            or_else = ", and remove relays = []" if peer.get("relays") == [] else ""
            yield (
                peer.at("addresses"),
                "is empty, and so is listen: neither end could initiate; write the peer's address here,"
                ' or listen = ["0.0.0.0:5790"] at the top so that the peer can initiate, or a [[relay]] that both'
                f" ends use{or_else}",
            )
    for section in (*file.peers, *file.relays, *file.contacts):
        for written in section.get("addresses", ()):
            if not written.address.resource and any(_reaches(written.address, own) for own in listen):
                yield section.at("addresses"), f"names {written.address}, where this daemon listens: write the peer's"


def _reaches(target: Address, listening: Address) -> bool:
    """Whether a datagram to ``target`` arrives at this machine's ``listening``, as far as the text shows."""
    if target.port != listening.port or target.family != listening.family:
        return False
    return target.ip == listening.ip or (listening.is_wildcard and target.is_loopback)


def _endpoints(file: Sections) -> Found:
    """Each endpoint has a port of its own, which is not a port for peers, and does not feed another endpoint."""
    listen: list[Address] = file.top.get("listen", [])
    https: HttpsServer | None = file.relay_server.get("https")
    urls = [(section, url) for section in file.endpoints if isinstance(url := section.get("url"), NetworkUrl)]
    for section, url in urls:
        key = section.at("url")
        if url.kind is EndpointKind.UDPIN and any(own.port == url.address.port for own in listen):
            yield key, f"has the port that `listen` has for peers, {url.address.port}: write another"
        if url.kind is EndpointKind.UDPOUT and any(_reaches(url.address, own) for own in listen):
            yield key, "sends to this daemon's own port for peers: write the address of the MAVLink client"
        if https and url.kind is EndpointKind.TCPIN and overlaps(https.listen, url.address):
            yield file.relay_server.at("https"), f"is where {section.at()} listens: write another port"
    for (other, other_url), (section, url) in combinations(urls, 2):
        if message := _clash(url, other_url):
            yield section.at("url"), message.format(other=other.at())


_FEEDS = {(EndpointKind.UDPOUT, EndpointKind.UDPIN), (EndpointKind.TCP, EndpointKind.TCPIN)}


def _clash(a: NetworkUrl, b: NetworkUrl) -> str | None:
    if a.listens and a.kind is b.kind and overlaps(a.address, b.address):
        return "listens where {other} does: write another port"
    if a == b:
        return "sends where {other} does, so every frame would arrive twice: write it once"
    for sender, listener in ((a, b), (b, a)):
        if (sender.kind, listener.kind) in _FEEDS and _reaches(sender.address, listener.address):
            return "and {other} are both ends of one connection, so frames would loop: write one of them"
    return None


def _timers(section: Values, link: Values | None = None) -> Found:
    """The timers of ``[link]``, or of a peer that inherits from it, are in order."""
    given = inherited(link, section) if link else section.valid
    values = {name: key.default for name, key in LinkSection.keys.items()} | given
    unknown = section.invalid | (link.invalid - set(section.valid) if link else frozenset())
    least = values["rekey_after_s"] + _RETRIES_BEFORE_REJECT * values["retry_max_s"]
    for key, others, is_wrong, message in (
        (
            "max_age_s",
            {"coalesce_s"},
            values["coalesce_s"] >= values["max_age_s"],
            f"must be more than coalesce_s ({values['coalesce_s']:g}): a frame that waits for others must not become"
            " too old",
        ),
        (
            "reject_after_s",
            {"rekey_after_s", "retry_max_s"},
            values["reject_after_s"] < least,
            f"must be {least:g} or more, rekey_after_s and {_RETRIES_BEFORE_REJECT} times retry_max_s: the ends need"
            " time to make new keys before they drop the old ones",
        ),
    ):
        involved = {key, *others}
        # A problem that a peer only inherits is reported once, for [link].
        if is_wrong and not involved & unknown and (link is None or involved & set(section.valid)):
            yield section.at(key), message
