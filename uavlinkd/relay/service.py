"""The relay of a daemon: its members as peers of the core, their bindings, and the forwarding between them.

A member is found by its public key. Its peer in the core may be one that carries frames too: one session serves both.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from uavlinkd.authority.trust import HeldCertificate
from uavlinkd.daemon.features import Feature
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import outputs as o
from uavlinkd.protocol.crypto import Entropy
from uavlinkd.protocol.drops import DropReason, Reason
from uavlinkd.protocol.limits import TokenBucket
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import LinkedPeer, Output
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.peer import Peer
from uavlinkd.protocol.relay_records import Bind, Who, bounds_of
from uavlinkd.relay.bindings import Bindings, Changes
from uavlinkd.relay.forwarding import Forwarding, MemberSettings, Meter
from uavlinkd.relay.introductions import Introductions
from uavlinkd.system.guard import run

BINDS_PER_S = 32  # Binds of one member a second, each of up to 16 keys. Each may cause reports to other members.
BINDS_BURST = 256  # So many at once, after a quiet while: a ground station with 1,000 vehicles, along four paths.
CHECKED_PER_S = 50
"""Members whose wishes are compared with the paths that the core knows: data waits while that is done."""
LOOK_S = 0.1  # paths of binds that came before their validation are looked at so often, and after an event


class RelayMember:
    """A member, and what it does."""

    def __init__(self, settings: MemberSettings, peer: Peer, now: float, *, is_own: bool) -> None:
        self.settings = settings
        self.peer = peer
        """Its object in the core."""
        self.is_own = is_own  # whether the relay added its peer to the core: it does not carry frames
        self.meter = Meter(settings.bits_s, settings.name)
        self.binds = TokenBucket(BINDS_PER_S, BINDS_BURST, now)
        self.binds_ignored = 0  # binds above `BINDS_PER_S`
        self.since = now  # when it was up or not for the first time, as it is now

    @property
    def key(self) -> bytes:
        """Its static public key."""
        return self.settings.peer.public_key


@dataclass(slots=True)
class _Asked:
    """Keys that a member asked for along a path that may yet be validated, and its last question there."""

    until: float = 0.0
    keys: dict[bytes, None] = field(default_factory=dict)
    who: Who | None = None


@dataclass(frozen=True, slots=True)
class RelayShell:
    """What a relay uses of its daemon."""

    entropy: Entropy
    clock: Callable[[], float]  # monotonic
    perform: Callable[[list[Output]], None]  # executes outputs of the core
    send: Callable[[bytes, Path], None]  # passes a datagram to the kernel
    on_event: Callable[[o.Event, float], None]  # receives the events of the members that are not peers


class RelayService(Feature):
    """The members of a relay."""

    records = (Bind,)

    def __init__(self, node: Node, bits_s: int, shell: RelayShell) -> None:
        self._node = node
        self._shell = shell
        self.members: dict[bytes, RelayMember] = {}  # by public key
        self._member_of: dict[LinkedPeer, RelayMember] = {}
        self.bindings = Bindings(shell.entropy)
        self.forwarding = Forwarding(shell.send, shell.clock, bits_s)
        self.introductions = Introductions(self.bindings.wished_at)
        self._due: dict[tuple[bytes, Path], dict[bytes, None]] = {}  # reports to members
        self._asked: dict[bytes, dict[Path, _Asked]] = {}
        self._look_at = 0.0
        self._unchecked: list[bytes] = []  # keys of members whose paths are to be looked at
        self._questions: list[tuple[RelayMember, Path, Who]] = []

    # Members.

    def set_members(self, members: Mapping[bytes, MemberSettings], peers: Mapping[bytes, Peer], now: float) -> None:
        """These are all members from now on, by public key. ``peers``: the daemon's peers, which carry frames, by
        their public key.

        A member that changes from one to the other, or that has another name or PSK, has to make a new session.
        """
        for member in self._configured_before(members):
            peer = None if member.is_own else member.peer
            if not _is_same(member, members) or peers.get(member.key) is not peer:
                self._remove(member, now)
        for key, settings in members.items():
            if key not in self.members:
                peer = peers.get(key) or self._node.add_peer(settings.peer, now)
                self._add(RelayMember(settings, peer, now, is_own=key not in peers))
            self._set(self.members[key], settings)

    def admit(self, peer: Peer, settings: MemberSettings, held: HeldCertificate, now: float, *, is_own: bool) -> None:
        """A peer of the core with this certificate is a member from now on, perhaps with a newer one or other limits.

        ``is_own``: it carries no frames, and the relay removes it from the core. A member of the configuration with
        the same key stays as it is.
        """
        key = settings.peer.public_key
        if key in self.members and self.members[key].peer is not peer:
            self.end(key, now)
        if key not in self.members:
            self._add(RelayMember(settings, peer, now, is_own=is_own))
        elif key not in self.introductions:
            return
        self._set(self.members[key], settings)
        self.introductions.set(key, held, now, is_up=peer.is_up)

    def end(self, key: bytes, now: float) -> None:
        """A member by certificate is one no more: its wishes and handles end, and it gets no close."""
        if key in self.introductions:
            self._remove(self.members[key], now)

    def release(self, members: Mapping[bytes, MemberSettings], others: Collection[bytes], now: float) -> None:
        """Give up the peers in the core whose name or key another one may have now. ``others``: keys of the daemon's
        peers and relays.
        """
        for member in self._configured_before({*members, *others}):
            if member.is_own and (member.key in others or not _is_same(member, members)):
                self._remove(member, now)

    def _configured_before(self, keys: Collection[bytes]) -> list[RelayMember]:
        """The members of the configuration, and those by certificate whose key it has now."""
        return [member for key, member in self.members.items() if key not in self.introductions or key in keys]

    def _add(self, member: RelayMember) -> None:
        self.members[member.key] = self._member_of[member.peer] = member

    def _set(self, member: RelayMember, settings: MemberSettings) -> None:
        member.settings = settings
        member.meter.set_limit(settings.bits_s)
        self.bindings.set_member(member.key, settings.most_peers)

    def _remove(self, member: RelayMember, now: float) -> None:
        self._apply(self.bindings.remove_member(member.key, now))
        del self.members[member.key]
        self._asked.pop(member.key, None)
        self._member_of.pop(member.peer, None)
        is_certified = member.key in self.introductions
        if is_certified:
            self.introductions.remove(member.key)
        if member.is_own:
            self._shell.perform(self._node.remove_peer(member.peer, now, closes=not is_certified))

    # From the core. Neither method sends.

    def on_event(self, event: o.Event, now: float) -> None:
        member = self._member_of.get(event.peer)
        if member is None:
            return
        self._look_at = now  # a path may be validated
        if isinstance(event, o.PeerUp | o.PeerLost | o.PeerClosed):
            member.since = now
            self.introductions.set_up(member.key, is_up=member.peer.is_up)
        if isinstance(event, o.SessionEstablished):
            self.introductions.on_session(member.key, now)
        if isinstance(event, o.PathStateChanged) and not event.is_usable:  # a NAT may have given the address up
            self._apply(self.bindings.end_path(member.key, event.path, now))
        if isinstance(event, o.PeerClosed):
            for path in self.bindings.paths_of(member.key):
                self._apply(self.bindings.end_path(member.key, path, now))
        if member.is_own:
            self._shell.on_event(event, now)

    def on_record(self, received: o.RecordReceived, now: float) -> DropReason | None:
        """A record came from a member. Returns why it has no effect; None if it has one."""
        member, path, record = self._member_of.get(received.peer), received.path, received.record
        if member is None or path.is_serial or path.is_relayed:
            return DropReason.UNEXPECTED_RECORD
        state = member.peer.paths.find(path)
        if state is None:
            return DropReason.UNEXPECTED_RECORD
        is_proven = state.is_validated and state.works
        if isinstance(record, Bind):
            return self._receive_bind(member, path, record, now, is_proven=is_proven)
        if isinstance(record, Who):
            return self._receive_question(member, path, record, now, is_proven=is_proven)
        return DropReason.UNEXPECTED_RECORD

    def _receive_bind(
        self, member: RelayMember, path: Path, bind: Bind, now: float, *, is_proven: bool
    ) -> DropReason | None:
        if not member.binds.take(now):
            member.binds_ignored += 1
            return DropReason.RECORD_OVER_LIMIT
        if is_proven:
            return self._bind(member, path, bind.keys, now)
        asked = self._asked_along(member, path, now)
        keys = asked.keys
        keys |= dict.fromkeys(bind.keys)
        left_out = list(keys)[member.settings.most_peers :]
        for key in left_out:
            del keys[key]
        member.binds_ignored += len(left_out)
        return DropReason.RECORD_OVER_LIMIT if left_out else None

    def _asked_along(self, member: RelayMember, path: Path, now: float) -> _Asked:
        """What waits for a path. The first bind comes with the first envelope of a session; its path is validated one
        round trip later.
        """
        asked = self._asked.setdefault(member.key, {})
        for gone in [path for path in asked if member.peer.paths.find(path) is None]:
            del asked[gone]
            self._count_late(DropReason.UNEXPECTED_RECORD, member)
        asked.setdefault(path, _Asked()).until = now + c.QUESTION_LIFETIME_S
        return asked[path]

    def _receive_question(
        self, member: RelayMember, path: Path, who: Who, now: float, *, is_proven: bool
    ) -> DropReason | None:
        if (reason := self.introductions.may_ask(member.key, now)) is None:
            if is_proven:
                self._questions.append((member, path, who))
            else:
                self._asked_along(member, path, now).who = who
        return reason

    def _bind(self, member: RelayMember, path: Path, keys: Sequence[bytes], now: float) -> DropReason | None:
        before = self.bindings.refused(member.key)
        self._apply(self.bindings.bind(member.key, path, keys, now))
        self.introductions.on_bind(member.key, keys, now)
        return DropReason.RECORD_OVER_LIMIT if self.bindings.refused(member.key) > before else None

    # From the shell.

    @property
    def is_due(self) -> bool:
        """Whether :meth:`settle` may have something to do."""
        return bool(self._due or self._asked or self._questions or self.introductions.is_due)

    def on_read(self) -> None:
        """Datagrams were read: settle what they caused."""
        if self.is_due:
            run(self.settle, self._shell.clock())

    def settle(self, now: float) -> None:
        """Bind along paths that are validated now, and send the members changes and certificates."""
        if self._asked and now >= self._look_at:
            self._look_at = now + LOOK_S
            self._bind_validated(now)
        due, self._due = self._due, {}
        for (key, path), keys in due.items():
            if (member := self.members.get(key)) is None:
                continue
            handles = {other: self.bindings.handles(key, path, other) for other in keys}
            host, port = path.address[:2]
            for bound in bounds_of(host.partition("%")[0], port, handles):
                self._shell.perform(self._node.send_record(member.peer, path, bound, now))
        questions, self._questions = self._questions, []
        for member, path, who in questions:
            if self.members.get(member.key) is not member:
                continue
            if (answer := self.introductions.answer(member.key, who, now)) is None:
                self._count_late(DropReason.RECORD_OVER_LIMIT, member)
            for record in answer or ():
                self._shell.perform(self._node.send_record(member.peer, path, record, now))
        for key, record in self.introductions.pop_due(now):
            self._shell.perform(self._node.send_record(self.members[key].peer, None, record, now))

    def _bind_validated(self, now: float) -> None:
        before, self._asked = self._asked, {}
        for key, asked_along in before.items():
            member = self.members[key]
            for path, asked in asked_along.items():
                state = member.peer.paths.find(path)
                if state is None or now >= asked.until:
                    self._count_late(DropReason.UNEXPECTED_RECORD, member)
                elif state.is_validated and state.works:
                    if (reason := self._bind(member, path, list(asked.keys), now)) is not None:
                        self._count_late(reason, member)
                    if asked.who is not None:
                        self._questions.append((member, path, asked.who))
                else:
                    self._asked.setdefault(key, {})[path] = asked

    def _count_late(self, reason: DropReason, member: RelayMember) -> None:
        """A bind that waited for its path has no effect."""
        self._node.drops[reason] += 1
        self.forwarding.unreported[reason, member.settings.name] += 1

    def do_housekeeping(self, now: float) -> None:
        """End the wishes that were not renewed, and those along paths that the core has given up."""
        self._apply(self.bindings.expire(now))
        if not self._unchecked:
            self._unchecked = list(self.members)
        checked, self._unchecked = self._unchecked[:CHECKED_PER_S], self._unchecked[CHECKED_PER_S:]
        for member in filter(None, map(self.members.get, checked)):
            self.introductions.prune(member.key)
            for path in self.bindings.paths_of(member.key):
                if member.peer.paths.find(path) is None:
                    self._apply(self.bindings.end_path(member.key, path, now))
        self.settle(now)

    def count_drops(self) -> Iterator[tuple[Reason, str, int]]:
        """The datagrams that were dropped since the last call: reason, name of the member or nothing, count."""
        unreported, self.forwarding.unreported = self.forwarding.unreported, Counter()
        return ((reason, name, count) for (reason, name), count in unreported.items())

    def _apply(self, changes: Changes) -> None:
        for connection in changes.closed:
            self.forwarding.close(connection)
        for connection in changes.opened:
            one, other = (self.members[end.member].meter for end in connection)
            self.forwarding.open(connection, (one, other))
        for place, keys in changes.concerned.items():
            self._due.setdefault(place, {}).update(keys)


def _is_same(member: RelayMember, members: Mapping[bytes, MemberSettings]) -> bool:
    """Whether it is one of these members, with the same name and PSK."""
    settings = members.get(member.key)
    return settings is not None and settings.peer == member.settings.peer
