"""Datagrams of a sender without keys of the two peers: to a node before a handshake, during one, and on a session.

The attacker has recorded the traffic. It sends altered copies, and any other bytes, from any address. If it knows
the victim's public key, it repairs ``mac1`` and proves its address with the cookies that it gets. For every
datagram the node counts exactly one drop, and sends only a cookie to a sender with a valid ``mac1``. Afterwards the
node is unchanged, and what it waited for still works.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Final

from tests.fuzz.engine import Run, Script
from tests.fuzz.stages import LINKS, PSK, Stage, copier, idle, initiator, responder, session, with_suite
from tests.protocol import inside
from tests.protocol.harness import ONLY_COUNTED, exchange, of, state_of
from uavlinkd.protocol import constants as c
from uavlinkd.protocol import wire
from uavlinkd.protocol.cookie import MacKeys, mac1_of
from uavlinkd.protocol.drops import DropReason
from uavlinkd.protocol.node import Node
from uavlinkd.protocol.outputs import Dropped, Output, SessionEstablished, Transmit
from uavlinkd.protocol.path import Path
from uavlinkd.protocol.suites import SUITES, SUITES_BY_NAME

CHECKS_THE_SEQUEL: Final = 0xF0
"""Set in a script's first byte. Then the genuine datagram follows at the end, and the link must work."""
BUDGET: Final = 8
"""Handshake messages of a script that reach a key exchange."""
_OF_COPIES = {"datagrams_received", "bytes_received", "duplicates", "received", "late_copies"}
_SPENT = ONLY_COUNTED | {"_cookied", "_sources"} | _OF_COPIES
_DEADLINES = {"deadlines", "next_at", "scheduled_at", "_heap", "_pushed"}
_SPENT_WITH_COOKIES = _SPENT | {"_received_cookies", "cookied", "retry_at", "cookies_taken", *_DEADLINES}
_KINDS = (*range(1, 4), 0x40, 0x41, 0xFD, 0xFE, 0)
_SUITE_NUMBERS = tuple(SUITES)
_REPAIRED = (wire.INITIATION, wire.RESPONSE)


class Outsider:
    """Runs scripts against one stage, which each script leaves unchanged."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._node = stage.victim.node
        self._receiver = MacKeys(self._node.public_key)
        self._cookies: dict[Path, bytes] = {}  # from the victim, by the path of the request
        self._copied_to: set[Path] = set()  # responses, in addition to the first one
        self._random_state = 0
        # Unaltered, these are genuine. mac2 has no effect until the node is under load.
        self._genuine = {*(stage.genuine, *stage.others)}
        self._genuine |= {datagram[: -c.MAC_BYTES] for datagram in self._genuine if datagram[0] in _REPAIRED}
        self._recorded = {datagram[: -c.MAC_BYTES] for datagram in stage.templates}
        self._copy = copier(stage.pair)
        self._take_pictures()

    def run(self, script: Script, *, checks_the_sequel: bool) -> None:
        """Send every datagram of a script, then check the node."""
        stage = self._stage
        receive, genuine, sources, cookies = self._node.receive, self._genuine, stage.sources, stage.cookies
        reasons: list[DropReason] = []
        cookies_taken = 0
        self._random_state = zlib.crc32(script.data)
        self._cookies.clear()
        self._copied_to.clear()
        now = stage.now
        self._reset()
        while script:
            how = script.byte()
            path = sources[how >> 4 & 3]
            datagram, is_repaired = self._datagram(script, how, self._cookies.get(path) if how & 8 else None)
            if datagram in genuine or datagram[: -c.MAC_BYTES] in genuine:
                continue
            now += (how >> 6) / 4096  # a script lasts up to half a second
            outputs = receive(datagram, path, now)
            if len(outputs) == 1 and type(outputs[0]) is Dropped:
                reasons.append(outputs[0].reason)
            elif not outputs and datagram in stage.templates and datagram not in cookies:
                reasons.append(DropReason.DUPLICATE)  # an authentic copy: it changes only counters
            elif not outputs and datagram in cookies:
                cookies_taken += 1
            else:
                is_copy = datagram[: -c.MAC_BYTES] in self._recorded
                assert is_repaired or is_copy, f"a stranger without a key got {outputs}"
                reasons.append(self._judge_answer(outputs, datagram, path))
        counted = Counter(self._node.drops)
        for peer in self._node.peers.values():
            counted += peer.traffic.drops
        assert counted == Counter(reasons), f"dropped {reasons}, counted {counted}"
        self._forget_copies()
        if cookies_taken:
            assert state_of(self._node, ignoring=_SPENT_WITH_COOKIES) == self._before_cookies, (
                "a forgery left a trace"
            )
        else:
            assert state_of(self._node, ignoring=_SPENT) == self._before, "a forgery left a trace"
        if checks_the_sequel:
            self._check_sequel(now)
        if checks_the_sequel or cookies_taken:
            self._restore()

    def _datagram(self, script: Script, how: int, cookie: bytes | None) -> tuple[bytes, bool]:
        """The next datagram, and whether its sender used the victim's public key."""
        match how & 7:
            case 0 | 1 | 2 | 3 as kind:
                return self._altered(script, cookie, is_varied=kind > 0)
            case 4:
                return self._of_right_length(script), False
            case 5:
                return self._receiver.add_macs(self._of_right_length(script)[: -wire.MACS_BYTES], cookie), True
            case 6:
                return bytes((_KINDS[script.byte() & 7],)) + script.take(script.byte() & 63), False
            case _:
                return script.take(script.byte() & 63), False

    def _altered(self, script: Script, cookie: bytes | None, *, is_varied: bool) -> tuple[bytes, bool]:
        """One of the recorded datagrams with a few bytes changed, truncated or longer, with valid macs or not.

        ``is_varied``: changes one more byte, chosen by the whole script, so that a script with one change changes all
        its other datagrams too.
        """
        templates = self._stage.templates
        what = script.byte()
        altered = bytearray(templates[(what >> 4) % len(templates)])
        if is_varied:
            self._random_state = (self._random_state * 1103515245 + 12345) & 0xFFFFFFFF
            altered[(self._random_state >> 8) % len(altered)] ^= 1 + (self._random_state >> 24) % 255
        for _ in range(1 + (what & 3)):
            if altered:
                altered[script.word() % len(altered)] ^= script.byte()
        if what & 4:
            if script.byte() & 1:
                altered += script.take(script.byte() & 31)
            else:
                del altered[script.word() % (len(altered) + 1) :]
        datagram = bytes(altered)
        if what & 8 and len(datagram) > wire.MACS_BYTES:
            return self._receiver.add_macs(datagram[: -wire.MACS_BYTES], cookie), True
        return datagram, False

    def _of_right_length(self, script: Script) -> bytes:
        """A handshake message or cookie of which only the length is right."""
        what = script.byte()
        kind = 1 + what % 3
        if kind == wire.COOKIE:
            return (bytes((kind, 0)) + script.take(what >> 2)).ljust(wire.COOKIE_BYTES, b"\7")
        suite = SUITES[_SUITE_NUMBERS[(what >> 2) % len(_SUITE_NUMBERS)]]
        size = (wire.initiation_bytes if kind == wire.INITIATION else wire.response_bytes)(suite)
        return (bytes((kind, suite.number)) + script.take(script.byte() & 31)).ljust(size, b"\7")[:size]

    def _judge_answer(self, outputs: Sequence[Output], datagram: bytes, path: Path) -> DropReason:
        """Answers to a sender that knows the public key go to itself, and are no longer than its message.

        They are a cookie; and the response, once for each path, to a copy of the initiation that it answered.
        """
        assert len(outputs) == 2, f"more than an answer: {outputs}"
        sent, dropped = outputs
        assert isinstance(sent, Transmit), f"more than an answer: {outputs}"
        assert isinstance(dropped, Dropped), f"more than an answer: {outputs}"
        assert sent.path == path, "an answer went elsewhere"
        assert len(sent.datagram) <= len(datagram), "an answer longer than its message"
        if dropped.reason is DropReason.DUPLICATE:
            assert {datagram[: -c.MAC_BYTES], sent.datagram[: -c.MAC_BYTES]} <= self._recorded, "not a copy"
            assert path not in self._copied_to, "a path got two copies of a response"
            self._copied_to.add(path)
            return dropped.reason
        assert dropped.reason is DropReason.COOKIE_REQUIRED
        assert sent.datagram[0] == wire.COOKIE
        reply, mac1 = wire.parse_cookie_reply(sent.datagram), mac1_of(datagram)
        self._cookies[path] = self._receiver.open_cookie(reply, mac1)
        return dropped.reason

    def _forget_copies(self) -> None:
        """A response remembers the paths that it was sent along; its copies leave no other trace."""
        peer = self._stage.victim.peer
        peer.traffic.bytes_elsewhere = self._bytes_elsewhere
        for waiting in peer.sessions.unconfirmed.values():
            assert set(waiting.paths[1:]) == self._copied_to
            assert len(waiting.paths) <= c.COPIES_OF_A_RESPONSE
            del waiting.paths[1:]

    def _check_sequel(self, now: float) -> None:
        """The expected datagram arrives at last: it completes, and frames cross in both directions."""
        stage = self._stage
        victim, other = stage.victim, stage.other
        _refill(victim.node, now)
        outputs = victim.receive(stage.genuine, now)
        assert not of(outputs, Dropped), f"the genuine datagram was dropped: {outputs}"
        seen = [*outputs, *exchange(other, victim, outputs, now)]
        assert victim.peer.sessions.current, "the genuine datagram made no session"
        assert victim.peer.is_up or of(seen, SessionEstablished)
        assert stage.pair.carries(now), "the link does not carry frames any more"

    def _reset(self) -> None:
        """Save what a run may spend and count."""
        _refill(self._node, self._stage.now)

    def _restore(self) -> None:
        """Restore the stage."""
        self._stage.pair = self._copy()
        self._node = self._stage.victim.node
        self._take_pictures()

    def _take_pictures(self) -> None:
        self._reset()
        self._bytes_elsewhere = self._stage.victim.peer.traffic.bytes_elsewhere
        self._before = state_of(self._node, ignoring=_SPENT)
        self._before_cookies = state_of(self._node, ignoring=_SPENT_WITH_COOKIES)


def _refill(node: Node, now: float) -> None:
    """Full budgets, and no drops. The budgets are small, so that scripts reach requests for cookies."""
    # All scripts without a sequel share the budgets: the clock stands still, and a fast machine runs many.
    inside.give_small_budgets(node, BUDGET, now)
    node.drops.clear()
    for peer in node.peers.values():
        peer.traffic.drops.clear()


def _make(stages: Callable[[], Sequence[Stage]]) -> Run:
    outsiders = [Outsider(stage) for stage in stages()]

    def run(data: bytes) -> None:
        script = Script(data)
        first = script.byte()
        outsider = outsiders[(first & ~CHECKS_THE_SEQUEL) % len(outsiders)]
        outsider.run(script, checks_the_sequel=first & CHECKS_THE_SEQUEL == CHECKS_THE_SEQUEL)

    return run


_MLKEM: Final = with_suite(LINKS[0], SUITES_BY_NAME["mlkem768"])


def make_idle() -> Run:
    """Before any handshake."""
    link = LINKS[0]
    return _make(lambda: [idle(link), idle(_MLKEM), idle(link, PSK)])


def make_initiator() -> Run:
    """While its initiation waits for the response."""
    return _make(lambda: [initiator(LINKS[0]), initiator(_MLKEM), initiator(LINKS[0], PSK)])


def make_responder() -> Run:
    """While its response waits for confirmation."""
    return _make(lambda: [responder(LINKS[0]), responder(LINKS[3]), responder(LINKS[0], PSK)])


def make_session() -> Run:
    """On an established session, of each kind of envelope."""
    return _make(lambda: [*(session(link) for link in LINKS), session(LINKS[0], counter=2**16 + 5)])
