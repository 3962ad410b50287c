"""The code behind the tag: a configured peer with its keys that sends anything.

The peer makes any handshake, seals any payload under any counter on any of its sessions, replays recorded envelopes
from several addresses, and lets time pass. After each datagram these properties hold. The peer sealed each delivered
frame, at least as often as it was delivered. An unproven address gets no more bytes than it sent. Tables stay within
their bounds. Afterwards an honest handshake makes a link that works.
"""

from __future__ import annotations

from collections import Counter
from typing import Final

from tests.fuzz.engine import Run, Script, play
from tests.fuzz.stages import LINKS, NOW, SeededEntropy, copier, pair_of
from tests.protocol import inside
from tests.protocol.harness import AT_A, ELSEWHERE, FRAME, KEY_A, KEY_B, Pair, of, unsealed
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import handshake, wire
from uavlinkd.protocol.cookie import MacKeys
from uavlinkd.protocol.outputs import Deliver, Dropped, Output, Transmit
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.session import Session
from uavlinkd.protocol.settings import Link, PeerSettings, Timers
from uavlinkd.protocol.wire import ANSWER_BYTES, PROBE, QUESTION_BYTES, Probe, ProblemReport, RefusalReport, Refused

PATHS: Final = (AT_A, AT_A, ELSEWHERE, Path(0, ("2001:db8::9", 5, 0, 0)))
_PROBE_AND_FRAMES: Final = bytes((PROBE, 1))


class Insider:
    """The hostile peer's end, and the victim's: alpha's keys against bravo."""

    def __init__(self, pair: Pair, link: Link) -> None:
        self.pair = pair
        self.node = pair.b.node
        self.peer = pair.b.peer
        self.now = NOW
        self.link = link
        self.places = PATHS
        """Where its datagrams come from; the first one is its own."""
        self.sessions: list[Session] = [pair.a.session]
        self.sealed: Counter[bytes] = Counter()
        self.delivered: Counter[bytes] = Counter()
        self.credit: Counter[Path] = Counter()
        """Bytes that came from an address and were not answered with as many."""
        self.recorded: list[bytes] = []
        self.questions: list[int] = [1]
        """Of the victim's probes: the last four."""
        self.echoes: list[int] = [0]
        self._random_state = SeededEntropy(77)
        self._to_bravo = MacKeys(KEY_B.public)

    # The peer's actions.

    def step(self, script: Script) -> None:
        """One action of a script."""
        what = script.byte()
        match what & 15:
            case 0 | 1 | 2:
                self._offer(self._seal(script.take(script.byte() & 63), script, what), what)
            case 3:
                self._offer(self._seal(b"\xfd" + script.take(script.byte()), script, what), what)
            case 4 | 5:
                self._offer(self._seal(self._record(script), script, what), what)
            case 6:
                self._pass(script.byte() / 64)
            case 7:
                self._pass((script.byte() / 16) ** 2)  # to beyond a session's life
            case 8:
                if self.recorded:
                    self._offer(self.recorded[script.word() % len(self.recorded)], what)
            case 9:
                self._take(self.node.send(self.peer, [FRAME] * (script.byte() & 7), self.now), None)
                refused = Refused(script.byte(), 0, 2, script.long())
                self._take(self.node.report_refusals(self.peer, [refused], self.now), None)
            case 10:
                self.call(script.byte(), what, self.link)
            case 11:
                for _ in range(script.byte() & 63):  # many frames at once, of any size
                    self._offer(self._seal(b"\xfe" + bytes(script.byte() << 4), script, what), what)
            case 12:
                self._offer(self._seal(b"", script, what), what)
            case _:
                self._offer(self._seal(self._record(script), script, what | 0x80), what)

    def call(self, generation: int, what: int, link: Link) -> Session | None:
        """An honest handshake; the session if there was an answer."""
        bravo = PeerSettings("bravo", KEY_B.public, None, link)
        index = 1 + int.from_bytes(self._random_state(2), "big") % 65535
        initiated = handshake.initiate(KEY_A, bravo, index, generation, self._random_state)
        outputs = self._offer(self._to_bravo.add_macs(initiated.message, None), what)
        for sent in of(outputs, Transmit):
            if sent.datagram[0] != wire.RESPONSE:
                continue
            response = wire.parse_response(sent.datagram)
            keys = handshake.receive_response(initiated, response)
            session = Session(keys, index, self.now, c.REJECT_AFTER_S, is_initiator=True)
            self.sessions.append(session)
            del self.sessions[:-8]
            return session
        return None

    def _record(self, script: Script) -> bytes:
        """A valid or nearly valid control record."""
        which = script.byte()
        token = self.echoes[which >> 4 & 3 & (len(self.echoes) - 1)]
        match which & 7:
            case 0:
                return wire.Echo(False, script.word(), script.long(), script.long()).encode()
            case 1:
                return wire.Echo(True, token, script.byte(), script.byte(), script.byte()).encode()
            case 2:
                return wire.Echo(True, script.long(), script.long(), script.long(), script.long()).encode()
            case 3:
                return self.probe(script, 0)
            case 4:
                return self.probe(script, self.questions[-1 - (which >> 4) % len(self.questions)])
            case 5:
                return self.probe(script, script.long())
            case 6:
                return wire.Close().encode()
            case 7 if which & 24 == 24:
                codes = sorted({script.byte() for _ in range(script.byte() & 7)})
                return ProblemReport(tuple(codes)).encode()
            case 7 if which & 8:
                entries = tuple(
                    Refused(script.word() << 8 | script.byte(), script.word(), script.byte(), script.long())
                    for _ in range(1 + (script.byte() & 15))
                )
                return RefusalReport(entries).encode()
            case _:
                return bytes((script.byte() % wire.FRAMES_FROM,)) + script.take(script.byte() & 31)

    def probe(self, script: Script, answer: int) -> bytes:
        """A probe with any report; alone, or before frames or padding."""
        how = script.byte()
        question = script.long() if how & 1 else 0
        record = Probe(question, answer, script.word(), script.word())
        behind = script.byte() >> 2
        return record.encode(bytes((0xFD,)) * behind if how & 2 else b"", behind if how & 4 else 0)

    def _seal(self, payload: bytes, script: Script, what: int) -> bytes:
        """An envelope around any bytes; sometimes on an older session, or with a counter of its choice."""
        session = self.sessions[-1]
        if what & 0x80:
            how = script.byte()
            session = self.sessions[-1 - (how & 7) % len(self.sessions)]
            if how & 8:
                session.send_counter = script.long()
            elif how & 16:
                session.send_counter = max(0, session.send_counter - script.word())
            elif how & 32:
                session.send_counter += script.word()
        session.send_counter %= c.SESSION_ENVELOPE_LIMIT
        datagram = session.seal(payload, self.now)
        self.sealed[payload] += 1
        if payload[:2] == _PROBE_AND_FRAMES:
            self.sealed[payload[QUESTION_BYTES if any(payload[2:6]) else ANSWER_BYTES :]] += 1
        self.recorded.append(datagram)
        del self.recorded[:-64]
        return datagram

    def _pass(self, seconds: float) -> None:
        """Time passes, and the victim's timers run."""
        until = self.now + seconds
        for _ in range(12):
            due = self.node.next_deadline()
            if due > until:
                break
            self.now = max(self.now, due)
            self._take(self.node.handle_timeout(self.now), None)
        self.now = until
        self._take(self.node.handle_timeout(self.now), None)

    # Properties.

    def _offer(self, datagram: bytes, what: int) -> list[Output]:
        path = self.places[what >> 5 & 3]
        self.credit[path] += len(datagram)
        before = set(self.peer.paths.by_path)
        outputs = self.node.receive(datagram, path, self.now)
        places = {path, *before, *self.peer.paths.by_path}
        assert all(output.path in places for output in of(outputs, Transmit)), "sent elsewhere"
        self._take(outputs, path)
        return outputs

    def _take(self, outputs: list[Output], path: Path | None) -> None:
        refused = 0
        copies = Counter(out.datagram for out in of(outputs, Transmit))
        for out in outputs:
            if type(out) is Transmit:
                self._charge(out)
                self._see(out.datagram, copies[out.datagram])
            elif type(out) is Deliver:
                assert out.peer is self.peer, "delivered for another peer"
                assert out.payload[0] >= wire.FRAMES_FROM, "a control record was delivered"
                self.delivered[out.payload] += 1
                assert self.delivered[out.payload] <= self.sealed[out.payload], "delivered more often than sent"
            elif type(out) is Dropped and out.path is not None:
                refused += 1
        assert refused <= (path is not None), f"one datagram, {refused} drops"

    def _charge(self, sent: Transmit) -> None:
        """An address that is neither configured nor proven gets no more bytes than came from there."""
        if self.is_proven(sent.path):
            return
        self.credit[sent.path] -= len(sent.datagram)
        assert self.credit[sent.path] >= 0, "more bytes to an unproven address than came from there"

    def is_proven(self, path: Path) -> bool:
        """Whether the victim may send there first."""
        state = self.peer.paths.find(path)
        return state is not None and state.is_proven

    def _see(self, datagram: bytes, copies: int) -> None:
        """Read from the victim's outputs what an honest peer would read. ``copies``: how often they have it."""
        if datagram[0] not in (wire.SHORT_ENVELOPE, wire.LONG_ENVELOPE):
            return
        index, _, _ = wire.parse_envelope_header(datagram)
        for session in self.sessions:
            if session.local_index == index:
                payload = unsealed(session, datagram)
                if payload and payload[0] < wire.FRAMES_FROM:
                    self.learn(wire.parse_control(payload), copies)

    def learn(self, control: wire.Control, copies: int) -> None:
        """A record that an honest peer would read."""
        if isinstance(control, wire.ProbeAndFrames):
            assert copies == 1, "a probe was copied"
            if control.probe.question:
                self.questions = [*self.questions[-3:], control.probe.question]
        elif isinstance(control, wire.Echo) and not control.is_reply:
            self.echoes = [*self.echoes[-3:], control.token]

    def check_bounds(self) -> None:
        peer, sessions = self.peer, self.peer.sessions
        assert len(sessions.confirmed) <= c.USABLE_PER_PEER, "too many sessions"
        assert len(sessions.unconfirmed) <= 2 * c.UNCONFIRMED_PER_KIND, "too many unconfirmed sessions"
        assert len(peer.initiator.pending) <= c.PENDING_PER_PEER, "too many initiations"
        owned = len(sessions.confirmed) + len(sessions.unconfirmed) + len(peer.initiator.pending)
        assert inside.owned_indices(self.node) == owned, "an index without an owner"
        assert len(peer.remembered) == inside.remembered_initiations(self.node) <= c.REMEMBERED_MOST
        assert len(peer.echo_requests) <= 64, "too many echo requests"
        assert len(peer.claims.refusals()) <= c.REFUSALS_KEPT, "too many claims"
        assert len(peer.claims.problems.codes) <= c.PROBLEMS_PER_REPORT, "too many problems"
        assert inside.counted_refusals(peer) <= c.REFUSALS_KEPT, "too many refusals"
        for session in sessions.confirmed:
            is_one = inside.held_frames(session) == 1
            assert session.held.size <= c.HELD_BYTES or is_one, "too much is held"
            assert inside.history_steps(session) <= 16, "too many steps"

    def check_sequel(self) -> None:
        """After any script, an honest handshake later makes a link that carries frames in both directions."""
        self._pass(c.REJECT_AFTER_S)
        session = self.call(0, 0, self.link)
        assert session is not None, "no answer to an honest handshake"
        confirmation = wire.Echo(False, 1, 0, 0).encode()
        self.sessions.append(session)
        for payload in (confirmation, FRAME):
            self.sealed[payload] += 1
            before = self.delivered[FRAME]
            self._offer(session.seal(payload, self.now), 0)
        assert self.delivered[FRAME] == before + 1, "a frame on a new session was not delivered"
        outputs = self.node.send(self.peer, [FRAME], self.now)
        (envelope,) = (output.datagram for output in of(outputs, Transmit))
        index, _, _ = wire.parse_envelope_header(envelope)
        assert index == session.local_index
        opened = unsealed(session, envelope)
        assert opened is not None, "a frame that cannot be opened"
        if opened[0] < wire.FRAMES_FROM:
            control = wire.parse_control(opened)
            assert isinstance(control, wire.ProbeAndFrames), "a frame in another record"
            opened = control.frames
        assert opened == FRAME, "another frame"


def make_sealed() -> Run:
    """Payloads and control records under genuine keys."""
    links = [Link(timers=Timers(), features=c.FEATURE_REFUSALS | c.FEATURE_PROBLEMS), *LINKS[1:]]
    pairs = [copier(pair_of(link).establish(NOW)) for link in links]
    return play([lambda n=n: Insider(pairs[n](), links[n]) for n in range(len(links))])  # type: ignore[misc]
