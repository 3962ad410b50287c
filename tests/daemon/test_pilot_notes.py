"""What the pilot is shown, and when: severe texts first, one a second, nothing that is not true any more."""

from __future__ import annotations

import pytest

from tests.processes.frames import command_long
from tests.protocol.harness import KEY_B, Pair, quiet
from uavlinkd.config.model import PeerConfig
from uavlinkd.daemon.local_endpoints import PilotNotes
from uavlinkd.daemon.peer_link import Carriage, PeerLink
from uavlinkd.mavlink.frames import SplitCounters, split_payload
from uavlinkd.mavlink.own_frames import TEXT_BYTES, Note, TextSeverity
from uavlinkd.mavlink.routing import SystemComponent
from uavlinkd.protocol.settings import PeerSettings
from uavlinkd.protocol.wire import RefusalReport, Refused

ARM = Refused(76, 400, 2, 1)


class Cockpit:
    """One link, whose state a test sets, and the notes about it."""

    def __init__(self, name: str = "drone1", **policy: object) -> None:
        policy = {"role": "swarm-member", "system_ids": "all"} | policy
        self.pair = Pair().establish()
        config = PeerConfig(PeerSettings(name, KEY_B.public, None, quiet()), (), policy)
        self.link = PeerLink(config, self.pair.a.peer, Carriage(self.pair.a.node, lambda _: None), 0.0)
        self.addresses: list[SystemComponent] = [(1, 1)]
        self.notes = PilotNotes(lambda _: self.addresses)
        self.next(0.0)

    def next(self, now: float) -> Note | None:
        """The next text."""
        return self.notes.next([self.link], now)

    def set_up(self, is_up: bool) -> None:
        """The link comes or goes."""
        self.link.peer.is_up = is_up

    def claim(self, now: float, *refused: Refused) -> None:
        """The peer reports."""
        self.link.peer.claims.note(RefusalReport(refused), now)

    def withhold(self, *raws: bytes) -> None:
        """Frames to the peer meet its policy."""
        for frame in split_payload(b"".join(raws), SplitCounters()):
            self.link.policy.outgoing.check(frame, 0.0)


def test_a_healthy_link_is_silent() -> None:
    """Also one that comes up for the first time."""
    cockpit = Cockpit()
    cockpit.set_up(False)
    fresh = PilotNotes(lambda _: [(1, 1)])
    assert fresh.next([cockpit.link], 0.0) is None
    cockpit.set_up(True)
    assert [fresh.next([cockpit.link], float(second)) for second in range(1, 20)] == [None] * 19


def test_lost_and_restored() -> None:
    """Each once."""
    cockpit = Cockpit()
    cockpit.set_up(False)
    assert cockpit.next(1.0) == Note(TextSeverity.CRITICAL, "link to drone1 lost", 1)
    assert cockpit.next(2.0) is None
    cockpit.set_up(True)
    assert cockpit.next(3.0) == Note(TextSeverity.NOTICE, "link to drone1 restored", 1)
    assert cockpit.next(4.0) is None


def test_texts_that_are_not_true_any_more_are_dropped() -> None:
    """Freshness is verified again before its text had its turn."""
    cockpit = Cockpit()
    cockpit.set_up(False)
    cockpit.link.peer.unverified_since = 1.0
    assert cockpit.next(1.0) == Note(TextSeverity.CRITICAL, "link to drone1 lost", 1)
    cockpit.link.peer.unverified_since = None
    assert cockpit.next(2.0) is None


def test_one_a_second_and_severe_ones_first() -> None:
    """A lost link comes before unverified frames, and these before a withheld command."""
    cockpit = Cockpit()
    cockpit.claim(0.5, ARM)
    cockpit.link.peer.unverified_since = 0.5
    cockpit.set_up(False)
    texts = [note.text if (note := cockpit.next(1.0 + 0.5 * half)) else "" for half in range(8)]
    assert texts == [
        "link to drone1 lost",
        "",
        "link to drone1: age of commands unverified",
        "",
        "drone1: (DIS)ARM withheld there, role or list",
        *[""] * 3,
    ]


@pytest.mark.parametrize("name", ["d", "n" * 14, "n" * 64])
def test_texts_fit(name: str) -> None:
    """A long name is cut, not the reason."""
    cockpit = Cockpit(name)
    cockpit.claim(0.5, Refused(76, 31014, 4, 1))  # a command with a long name
    note = cockpit.next(1.0)
    assert note is not None
    assert len(note.text) <= TEXT_BYTES
    assert note.text.endswith(" withheld there, role or list")


def test_a_hostile_peer_cannot_fill_the_screen() -> None:
    """It claims new refusals each second: one text in ten seconds, and a lost link comes at once."""
    cockpit, shown = Cockpit(), []
    for second in range(1, 100):
        cockpit.claim(float(second), *(Refused(76, 400 + second * 16 + place, 2, 1) for place in range(16)))
        if note := cockpit.next(second + 0.5):
            shown.append(second)
    assert shown == list(range(1, 100, 10))
    cockpit.set_up(False)
    note = cockpit.next(101.0)
    assert note is not None
    assert note.severity is TextSeverity.CRITICAL


def test_the_vehicle_behind_the_link() -> None:
    """Its autopilot's system, as received last; until one is known, the text waits."""
    cockpit = Cockpit()
    for now, addresses in (1.0, [(9, 191), (7, 1)]), (2.0, list[SystemComponent]()):
        cockpit.addresses = addresses
        cockpit.set_up(not cockpit.link.peer.is_up)
        note = cockpit.next(now)
        assert note is not None
        assert note.system == 7
    cockpit = Cockpit()
    cockpit.notes = PilotNotes(lambda _: cockpit.addresses)
    cockpit.addresses = []
    cockpit.next(0.0)
    cockpit.set_up(False)
    assert cockpit.next(1.0) is None
    cockpit.addresses = [(4, 154)]
    note = cockpit.next(2.0)
    assert note is not None
    assert note.system == 4


def test_a_text_does_not_wait_for_long() -> None:
    """After ten seconds it is dropped."""
    cockpit = Cockpit()
    cockpit.notes = PilotNotes(lambda _: cockpit.addresses)
    cockpit.addresses = []
    cockpit.next(0.0)
    cockpit.set_up(False)
    assert cockpit.next(1.0) is None
    cockpit.addresses = [(1, 1)]
    assert cockpit.next(11.5) is None


def test_claims_do_not_hide_what_is_withheld_here() -> None:
    """A peer that claims something new each second: each own text is shown all the same, and at once."""
    cockpit, shown = Cockpit(), []
    for second in range(1, 61):
        cockpit.claim(float(second), Refused(76, 22, 4, second))
        if second % 20 == 7:
            cockpit.withhold(command_long(400, 255))
        if (note := cockpit.next(float(second))) and "withheld here" in note.text:
            shown.append(second)
    assert shown == [7, 27, 47]
