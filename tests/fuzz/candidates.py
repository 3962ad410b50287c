"""The search for direct paths to a hostile peer behind a relay, which names any candidates.

It holds its keys, and does all that :mod:`tests.fuzz.insiders` does. Besides, the victim asks no more questions than
its bucket has, none at an address that may not be asked, and none that is longer than a short probe.
"""

from __future__ import annotations

from ipaddress import ip_address, ip_network
from typing import Final

from tests.fuzz.engine import Run, Script, play
from tests.fuzz.insiders import Insider
from tests.fuzz.stages import NOW, copier, pair_of
from tests.protocol import inside
from tests.protocol.harness import AT_A, ELSEWHERE, Pair, quiet
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.outputs import Event, Output, RecordReceived, Transmit
from uavlinkd.protocol.path import Path, relayed
from uavlinkd.protocol.relay_records import Bind, Bound, Candidates
from uavlinkd.protocol.settings import Link, Timers
from uavlinkd.relay.direct_search import DirectSearch, OwnSocket, Place

RELAYED: Final = relayed(0, "vps", 7)
RELAY: Final = ("192.0.2.77", 5790)
OWN: Final = ("10.13.0.5", 5790)
_SPECIAL: Final = """
    127.0.0.0/8 0.0.0.0/32 224.0.0.0/4 240.0.0.0/4 10.0.0.0/9 172.16.0.0/12 192.168.0.0/16 169.254.0.0/16
    100.64.0.0/10 ::1/128 ::/128 ff00::/8 fe80::/10 fc00::/7 ::ffff:0:0/96
"""
NEVER_ASKED: Final = tuple(map(ip_network, _SPECIAL.split()))
"""The victim has a route to one private network only: 10.200.0.0/16."""
HOSTS: Final = (
    *("203.0.113.9", "203.0.113.10", "198.51.100.9", "127.0.0.1", "127.9.9.9", "0.0.0.0", "224.0.0.5", "240.1.1.1"),
    *("255.255.255.255", "10.13.0.5", "10.200.0.1", "192.168.0.1", "172.31.255.255", "169.254.1.1", "100.127.0.1"),
    *("192.0.2.77", "::1", "::", "ff02::1", "fe80::1", "fd00::1", "2001:db8::9", "192.0.2.1"),
)
LONGEST_QUESTION: Final = 64


def leads_to(host: str) -> bool:
    """The only private network of the victim."""
    return host.startswith("10.200.")


SOCKETS: Final = (OwnSocket(0, False, (OWN,), leads_to), OwnSocket(1, True, (("2001:db8::5", 5790),), leads_to))


class Named(Insider):
    """The hostile peer, and a victim that searches for it."""

    def __init__(self, pair: Pair, link: Link) -> None:
        super().__init__(pair, link)
        self.places = (RELAYED, RELAYED, ELSEWHERE, AT_A)
        self.search = DirectSearch(self.node, self.peer, 0.0)
        self.asked = 0
        self.search.set_own((OWN,), SOCKETS, {RELAY}, self.now)

    def step(self, script: Script) -> None:
        """Name candidates, or do what any hostile peer does."""
        if script.byte() & 3 == 0:
            super().step(script)
        else:
            what = script.byte()
            datagram = self.sessions[-1].seal(self.sessions[-1].sealed_record(self._named(script)), self.now)
            self.recorded = [*self.recorded[-63:], datagram]
            self._offer(datagram, what)
            self._pass((what & 7) / 8)

    def _named(self, script: Script) -> bytes:
        how = script.byte()
        if how & 0xF0 == 0xF0:
            return script.take(how & 15)
        if how & 0xF0 == 0xE0:
            return Bind((script.take(c.KEY_BYTES).ljust(c.KEY_BYTES),)).encode()
        if how & 0xF0 == 0xD0:
            return Bound("203.0.113.1", 5, ((bytes(c.KEY_BYTES), script.word()),)).encode()
        places: list[Place] = []
        for _ in range(1 + (how & 7)):
            which, port = script.byte(), script.word()
            host = HOSTS[which] if which < len(HOSTS) else f"203.0.{which}.{script.byte()}"
            places.append((host, port))
        return Candidates(tuple(places)).encode()

    def _pass(self, seconds: float) -> None:
        until = self.now + seconds
        for _ in range(30):
            super()._pass(max(0.0, min(until, self.search.next_at) - self.now))
            if self.search.next_at <= self.now:
                self._take(self.search.do_due(self.now), None)
            if self.now >= until:
                return
        super()._pass(until - self.now)

    def _take(self, outputs: list[Output], path: Path | None) -> None:
        super()._take(outputs, path)
        for output in outputs:
            if isinstance(output, RecordReceived):
                assert output.peer is self.peer, "a record of another peer"
                self.search.on_record(output, self.now)
            elif isinstance(output, Event):
                self.search.on_event(output, self.now)

    def _charge(self, sent: Transmit) -> None:
        if self.peer.paths.find(sent.path) is not None or sent.path not in self.peer.paths.candidates:
            super()._charge(sent)
            return
        self.asked += 1
        assert self.asked <= c.CANDIDATE_QUESTIONS + c.CANDIDATE_QUESTIONS_PER_S * (self.now - NOW), (
            "too many questions"
        )
        assert len(sent.datagram) <= LONGEST_QUESTION, "a long question"
        host, port = sent.path.address[:2]
        address = ip_address(host)
        assert not any(address in network for network in NEVER_ASKED), f"a question to {host}"
        assert port >= 1024, f"a question to port {port}"
        assert (host, port) not in (RELAY, OWN), "a question to a relay, or to itself"

    def check_bounds(self) -> None:
        """Those of every peer, and of the candidates."""
        super().check_bounds()
        assert len(self.peer.paths.candidates) <= c.CANDIDATES, "too many candidates"
        assert inside.asked_candidates(self.peer.paths) <= c.CANDIDATES, "too many questions wait"
        assert len(self.search.theirs) <= c.CANDIDATES


def make() -> Run:
    """With and without the other timers of a link."""
    links = [quiet(features=c.FEATURE_RECORDS), Link(features=c.FEATURE_RECORDS, timers=Timers())]
    pairs = []
    for link in links:
        pair = pair_of(link)
        pair.a.peer_at = pair.b.peer_at = RELAYED
        for side in (pair.a, pair.b):
            side.configure_path(NOW)
        pairs.append(copier(pair.establish(NOW)))

    return play([lambda n=n: Named(pairs[n](), links[n]) for n in range(len(links))])  # type: ignore[misc]
