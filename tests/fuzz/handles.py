"""A member of a hostile relay, which holds its keys and assigns any handles.

It does all that :mod:`tests.fuzz.insiders` does. Besides, the member accepts data only from an address of the relay,
with a handle that a record assigned there for a peer that the member asked for.
"""

from __future__ import annotations

from typing import Final

from tests.daemon.inside import handle_tables
from tests.fuzz.engine import Run, Script, play
from tests.fuzz.insiders import Insider
from tests.fuzz.stages import NOW, copier, pair_of
from tests.protocol.harness import AT_A, ELSEWHERE, KEY_A, KEY_C, quiet
from uavlinkd.config.model import PeerAddress, RelayConfig
from uavlinkd.protocol import constants as c
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.outputs import Event, Output, RecordReceived
from uavlinkd.protocol.path import Path, relayed
from uavlinkd.protocol.relay_records import Bound, wrap
from uavlinkd.protocol.settings import Link, PeerSettings, Timers
from uavlinkd.relay.client_link import RelayHandles, RelayLink
from uavlinkd.system.addresses import Address

WANTED: Final = (KEY_C.public, bytes([5]) * c.KEY_BYTES)
OTHERS: Final = (KEY_A.public, bytes(c.KEY_BYTES))
"""Keys that the member did not ask for: the relay's own among them."""
HANDLES: Final = 64
"""Those that a script assigns."""


def _ignore(*_: object) -> None:
    """What the rest of the daemon does."""


class Stage:
    """The relay's end, and the member."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self.pair = pair = pair_of(link)
        pair.b.node.remove_peer(pair.b.peer, NOW)
        pair.b.peer_name = "relay vps"
        settings = PeerSettings(pair.b.peer_name, KEY_A.public, None, link)
        config = RelayConfig(settings, (PeerAddress(Address("192.0.2.1", 14600)),))
        self.handles = RelayHandles()
        self.relay = RelayLink(config, pair.b.node, self.handles, _ignore, NOW)
        self.relay.set_paths([AT_A], NOW)
        self.relay.follow(WANTED)
        pair.establish(NOW)


class Assigned(Insider):
    """The hostile relay, and its member."""

    def __init__(self, stage: Stage) -> None:
        super().__init__(stage.pair, stage.link)
        self._relay, self._handles = stage.relay, stage.handles
        self._assigned: set[int] = set()

    def step(self, script: Script) -> None:
        """Assign handles, or do what any hostile peer does."""
        first = script.byte()
        if first & 3 == 0:
            super().step(script)
            return
        what = script.byte()
        entries = []
        for _ in range(1 + (what & 31)):
            which, handle = script.byte(), script.byte() % HANDLES
            key = (*WANTED, *OTHERS)[which & 3]
            entries.append((key, handle))
            if key in WANTED:
                self._assigned.add(handle)
        record = Bound("192.0.2.7", script.word(), tuple(entries))
        self._offer(self.sessions[-1].seal(self.sessions[-1].sealed_record(record.encode()), self.now), what)
        self._pass(0.01)

    def _pass(self, seconds: float) -> None:
        super()._pass(seconds)
        if self._relay.next_at <= self.now:
            self._take(self._relay.do_due(self.now), None)
        self._relay.do_housekeeping(self.now)

    def _take(self, outputs: list[Output], path: Path | None) -> None:
        super()._take(outputs, path)
        for output in outputs:
            if isinstance(output, RecordReceived):
                self._relay.on_record(output, self.now)
            elif isinstance(output, Event):
                self._relay.on_event(output, self.now)

    def check_bounds(self) -> None:
        """Those of every peer, and of the handles; and which data is accepted."""
        super().check_bounds()
        most = len(self.peer.paths.states) * len(WANTED) * c.HANDLES_PER_PAIR
        assert len(handle_tables(self._handles)[0]) <= most, "too many handles"
        assert len(handle_tables(self._handles)[1]) <= most, "handles in one direction only"
        for handle in range(HANDLES):
            for at in (AT_A, ELSEWHERE):
                taken = self._handles.unwrap(at.socket, wrap(handle, b"\x40"), at.address)
                if taken is DropReason.RELAY_UNKNOWN_HANDLE or taken is DropReason.RELAY_MALFORMED:
                    continue
                assert handle in self._assigned, "a handle that was not assigned"
                assert self.peer.paths.find(at) is not None, "data from another address than the relay's"
                assert taken == (b"\x40", relayed(at.socket, "vps", handle))


def make() -> Run:
    """With and without the other timers of a link."""
    links = [quiet(features=c.FEATURE_RECORDS), Link(features=c.FEATURE_RECORDS, timers=Timers())]
    stages = [copier(Stage(link)) for link in links]

    return play([lambda stage=stage: Assigned(stage()) for stage in stages])  # type: ignore[misc]
