"""The exchange of one daemon with its peers, record by record, at chosen times."""

from __future__ import annotations

import pytest

from tests.authority.signing import AUTHORITY, bulletin, published, signed, vehicle
from uavlinkd.authority import constants as c
from uavlinkd.authority.certificates import Bulletin, digest_of
from uavlinkd.authority.exchange import ROLLED_BACK, BulletinExchange, Reaction
from uavlinkd.authority.trust import Trust
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.relay_records import BulletinRecord, CertificateRecord, FleetRecord, Have, Who

OWN, PEER, OTHER = (bytes((number,)) * 32 for number in (1, 2, 3))
CERTIFICATES = {PEER: signed(vehicle(2, 20), PEER), OTHER: signed(vehicle(3), OTHER)}
OLD, NEW = bulletin(5), bulletin(6, 99)
WAIT_S = 0.5
NOW = 100.0


def have(data: bytes, serial: int = 20, known: int = 10) -> Have:
    """What a peer states that has this bulletin."""
    return Have(int.from_bytes(data[5:9], "big"), digest_of(data), serial, known)


class Daemon:
    """The exchange of vehicle 1, which has serial 10, and what it sent."""

    def __init__(self, data: bytes = OLD, certificate: bytes = signed(vehicle(1, 10), OWN)) -> None:
        self.trust = Trust(AUTHORITY, OWN, certificate, data)
        for key, held in CERTIFICATES.items():
            self.trust.hold(key, held)
        self.exchange = BulletinExchange(self.trust, lambda size: b"\xff" * size, lambda _: self.wait_s)
        self.order = 0
        self.wait_s = WAIT_S

    def up(self, *keys: bytes, now: float = NOW) -> list[tuple[bytes, FleetRecord]]:
        """Sessions are made; what is sent at once."""
        for key in keys or (PEER,):
            self.exchange.on_handshake(key, now)
        return self.due(now)

    def due(self, now: float) -> list[tuple[bytes, FleetRecord]]:
        """What is sent at a time."""
        assert self.exchange.next_at <= now
        return self.exchange.do_due(now)

    def receive(self, record: FleetRecord, now: float = NOW, key: bytes = PEER) -> Reaction:
        """A record arrives, in the order in which it was sealed."""
        self.order += 1
        return self.exchange.receive(key, record, self.order, now)

    def drop(self, record: FleetRecord, now: float = NOW, key: bytes = PEER) -> DropReason:
        """Why a record is dropped. The bulletin does not change."""
        before = self.trust.bulletin_bytes
        with pytest.raises(Drop) as drop:
            self.receive(record, now, key)
        assert self.trust.bulletin_bytes == before
        return drop.value.reason

    def hour(self, now: float = NOW) -> list[tuple[float, bytes, FleetRecord]]:
        """What is sent in the next hour without any answer."""
        sent: list[tuple[float, bytes, FleetRecord]] = []
        while self.exchange.next_at < now + 3600:
            at = max(now, self.exchange.next_at)
            sent += [(round(at - now, 6), *item) for item in self.exchange.do_due(at)]
        return sent


MINE = Have(5, digest_of(OLD), 10, 20)
"""What the daemon states to the peer in the beginning."""


def test_session_that_replaces_another_one() -> None:
    """Each end states what it has, once. A peer that was restarted with an older disk gets what it lacks."""
    daemon, stated = Daemon(NEW), Have(6, digest_of(NEW), 10, 20)
    daemon.up()
    daemon.receive(have(NEW))
    daemon.exchange.on_handshake(PEER, NOW + 120)
    daemon.receive(have(NEW), NOW + 120)
    assert daemon.hour(NOW + 120) == [(0, PEER, stated)]
    daemon.exchange.on_handshake(PEER, NOW + 130)
    assert daemon.receive(have(OLD), NOW + 130).event == ROLLED_BACK
    assert daemon.due(NOW + 130) == [(PEER, BulletinRecord(NEW)), (PEER, stated)]
    daemon.receive(have(NEW), NOW + 130.2)
    assert daemon.hour(NOW + 131) == []


def test_peer_that_states_nothing() -> None:
    """It is asked again, ten times after the wait, then at the long interval."""
    daemon = Daemon()
    daemon.up()
    times = [at for at, *_ in daemon.hour()]
    assert times[: c.PUSH_TRIES + 2] == [*(WAIT_S * n for n in range(1, 11)), 15.0, 25.0]


def test_peer_with_an_older_bulletin() -> None:
    """It gets the newer one at once, again until it states it, and less often after the tries."""
    daemon = Daemon(NEW)
    daemon.up()
    daemon.receive(have(OLD), NOW + 1)
    sent = daemon.hour(NOW + 1)
    assert {item[1:] for item in sent} == {(PEER, BulletinRecord(NEW))}
    assert [at for at, *_ in sent][: c.PUSH_TRIES + 1] == [*(WAIT_S * n for n in range(10)), 14.5]
    daemon.receive(have(NEW), NOW + 4000)
    stated = Have(6, digest_of(NEW), 10, 20)
    assert daemon.hour(NOW + 4000) == [(0, PEER, stated)], (
        "the peer states what it got, and learns that this end knows"
    )


def test_flood_of_have() -> None:
    """Different ones cause what the peer lacks for each wait, and *have* ten times a second at most."""
    daemon = Daemon(NEW)
    daemon.up()
    sent: list[FleetRecord] = []
    for step in range(10_000):
        now = NOW + step / 1000
        daemon.receive(have(OLD, serial=step % 20, known=step % 3 * 9), now)
        sent += [record for _, record in daemon.exchange.do_due(now)]
    assert 15 <= sum(isinstance(record, BulletinRecord) for record in sent) <= 21
    assert sum(isinstance(record, Have) for record in sent) <= 101


def test_peer_with_a_newer_bulletin() -> None:
    """It is asked if its bulletin does not come; *have* follows the write, and other peers get the bulletin."""
    daemon = Daemon()
    daemon.up(PEER, OTHER)
    daemon.receive(have(OLD, serial=3), key=OTHER)
    daemon.receive(have(NEW))
    assert daemon.due(NOW + WAIT_S) == [(PEER, MINE)]
    assert daemon.receive(BulletinRecord(NEW), NOW + 1) == Reaction(persists=True)
    assert daemon.due(NOW + 1 + c.PUSH_JITTER_S) == [(OTHER, BulletinRecord(NEW))]
    daemon.exchange.note_persisted(6, digest_of(NEW))
    daemon.receive(have(NEW, serial=3), NOW + 2, OTHER)
    stated = Have(6, digest_of(NEW), 10, 20)
    assert daemon.due(NOW + 2) == [(PEER, stated), (OTHER, stated._replace(known=3))]
    assert daemon.hour(NOW + 2) == []


def test_disk_that_cannot_be_written() -> None:
    """The bulletin counts and is passed on. No *have* states it, and a bulletin that is repeated causes none."""
    daemon = Daemon()
    daemon.up(PEER, OTHER)
    daemon.receive(have(OLD, serial=3), key=OTHER)
    daemon.receive(have(NEW))
    daemon.receive(BulletinRecord(NEW), NOW + 0.1)
    daemon.receive(BulletinRecord(NEW), NOW + 0.2)
    assert daemon.due(NOW + 1) == [(OTHER, BulletinRecord(NEW))]
    daemon.exchange.on_down(OTHER)
    assert daemon.hour(NOW + 2) == []
    daemon.exchange.on_down(PEER)
    assert daemon.up(now=NOW + 4000) == [(PEER, MINE)]
    assert daemon.trust.bulletin.number == 6
    daemon.exchange.note_persisted(6, digest_of(NEW))
    assert daemon.due(NOW + 4001) == [(PEER, Have(6, digest_of(NEW), 10, 20))]


def test_revoked_peer_ends() -> None:
    """Also the one that sent the bulletin. It gets nothing more, and what it sends is dropped."""
    daemon = Daemon()
    daemon.up(PEER, OTHER)
    reaction = daemon.receive(BulletinRecord(bulletin(6, 20)))
    assert reaction == Reaction((PEER,), persists=True)
    assert {key for _, key, _ in daemon.hour()} == {OTHER}
    assert daemon.exchange.shown(PEER) is None
    assert daemon.drop(have(NEW)) is DropReason.UNEXPECTED_RECORD


@pytest.mark.parametrize(
    ("data", "reason", "event"),
    [
        pytest.param(b"?", DropReason.BAD_CONTROL, "", id="not a bulletin"),
        pytest.param(NEW[:-1] + b"?", DropReason.BAD_CONTROL, "", id="not signed"),
        pytest.param(published(Bulletin(b"none", 9, 1, ())), DropReason.BAD_CONTROL, "", id="another fleet"),
        pytest.param(bulletin(6, least=0), None, "bulletin_shrinks", id="it shrinks"),
        pytest.param(bulletin(5, 3), None, "bulletin_conflict", id="the same number"),
    ],
)
def test_bulletin_that_is_refused(data: bytes, reason: DropReason | None, event: str) -> None:
    """The peer must wait a second before another one is verified. Older ones need no signature check."""
    daemon = Daemon()
    daemon.up()
    if reason is None:
        assert daemon.receive(BulletinRecord(data)) == Reaction(event=event)
    else:
        assert daemon.drop(BulletinRecord(data)) is reason
    assert daemon.drop(BulletinRecord(NEW), NOW + 0.99) is DropReason.RECORD_OVER_LIMIT
    daemon.receive(BulletinRecord(bulletin(4)), NOW + 0.99)
    daemon.up(now=NOW + 0.99)
    assert daemon.drop(BulletinRecord(NEW), NOW + 0.99) is DropReason.RECORD_OVER_LIMIT, "a handshake resets a limit"
    assert daemon.receive(BulletinRecord(NEW), NOW + c.BULLETIN_LEAST_S).persists


def test_other_digest_of_the_same_number() -> None:
    """It is reported once for each statement."""
    daemon = Daemon()
    daemon.up()
    other = have(bulletin(5, 3))
    assert daemon.receive(other).event == "bulletin_conflict"
    assert daemon.receive(other).event == ""
    assert daemon.hour() == []


def test_peer_whose_disk_was_restored() -> None:
    """What it had stated is remembered while it is down. A record that was overtaken does not count."""
    daemon = Daemon(NEW)
    daemon.up()
    daemon.receive(have(NEW))
    with pytest.raises(Drop) as drop:
        daemon.exchange.receive(PEER, have(OLD), 0, NOW)
    assert drop.value.reason is DropReason.OLD_RECORD
    daemon.exchange.on_down(PEER)
    assert daemon.drop(have(OLD)) is DropReason.UNEXPECTED_RECORD
    daemon.up(now=NOW + 60)
    assert daemon.receive(have(OLD), NOW + 60).event == ROLLED_BACK
    assert daemon.receive(have(OLD), NOW + 61).event == ""
    assert daemon.due(NOW + 61) == [(PEER, BulletinRecord(NEW))]
    daemon.exchange.forget(PEER)
    daemon.exchange.on_down(PEER)
    assert daemon.exchange.shown(PEER) is None


def test_records_of_other_parts() -> None:
    """Certificates are introductions, which relays send, and *who* is for relays."""
    daemon = Daemon()
    daemon.up()
    for record in (CertificateRecord(PEER, CERTIFICATES[PEER]), CertificateRecord(OWN, bytes(100)), Who(4)):
        assert daemon.drop(record) is DropReason.UNEXPECTED_RECORD


def test_ends_without_certificates() -> None:
    """A pinned pair, of which one end has no certificate, exchanges bulletins."""
    daemon = Daemon(certificate=b"")
    pinned = bytes(32)
    assert daemon.up(pinned) == [(pinned, Have(5, digest_of(OLD)))]
    daemon.receive(have(bulletin(4), serial=0, known=3), key=pinned)
    assert daemon.due(NOW) == [(pinned, BulletinRecord(OLD))]
