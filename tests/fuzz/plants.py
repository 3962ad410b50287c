"""Planted faults of every class: a fuzz run proves something only if it finds them.

Each changes one thing of the package, in this process, and names the target that must find it. ``put`` plants it and
returns a function that removes it.
"""

from __future__ import annotations

import base64
import re
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from uavlinkd.config import checks as config_checks
from uavlinkd.config import keys
from uavlinkd.config import load as config_load
from uavlinkd.core import (
    cookie,
    handshake,
    initiator,
    path_state,
    probe,
    receive,
    refusals,
    replay,
    session,
    sessions,
    verification,
    wire,
)
from uavlinkd.core import node as core_node
from uavlinkd.core.drops import Drop, DropReason
from uavlinkd.core.limits import TokenBucket
from uavlinkd.core.outputs import Transmit
from uavlinkd.core.path import Path
from uavlinkd.endpoints import line_framing
from uavlinkd.lab.mitm import anatomy
from uavlinkd.lab.mitm import proxy_settings as mitm_settings
from uavlinkd.lab.sim import tlog
from uavlinkd.link import candidates, filter_tests, relay_link
from uavlinkd.mavlink import frames, routing, stream_splitter
from uavlinkd.mavlink.headers import Header
from uavlinkd.mavlink.policy import gate
from uavlinkd.ops import control, metrics_server
from uavlinkd.relay import bindings, forwarding, service

Undo = Callable[[], None]


@dataclass(frozen=True, slots=True)
class Plant:
    """One fault."""

    target: str
    about: str
    place: Any
    name: str
    wrong: Callable[[Any], Any]
    """Returns a faulty replacement for the original."""

    def put(self) -> Undo:
        """Plant it; call the result to remove it."""
        right = self.place.__dict__[self.name]
        setattr(self.place, self.name, self.wrong(right))
        return lambda: setattr(self.place, self.name, right)


def _answers_strangers(right: Any) -> Any:
    def receive(self: Any, datagram: bytes, path: Any, now: float) -> Any:
        out = right(self, datagram, path, now)
        return [*out, Transmit(b"?", path)] if datagram[:1] == b"\xfd" else out

    return receive


def _index_error_at(length: int) -> Callable[[Any], Any]:
    def wrong(right: Any) -> Any:
        def receive(self: Any, datagram: bytes, path: Any, now: float) -> Any:
            if len(datagram) == length:
                raise IndexError(length)
            return right(self, datagram, path, now)

        return receive

    return wrong


def _counts_twice(right: Any) -> Any:
    def receive(self: Any, datagram: bytes, path: Any, now: float) -> Any:
        out = right(self, datagram, path, now)
        if self.drops and datagram[:1] == b"\x03":
            self.drops[next(iter(self.drops))] += 1
        return out

    return receive


def _marks_first(right: Any) -> Any:
    def open_(self: Any, datagram: bytes, header_bytes: int, counter: int, now: float) -> Any:
        try:
            return right(self, datagram, header_bytes, counter, now)
        except Drop as drop:
            if drop.reason is DropReason.BAD_TAG:
                self.window.mark(counter)
            raise

    return open_


def _without_tag(right: Any) -> Any:
    return lambda computed, received: True


def _wedged_by_a_bad_response(right: Any) -> Any:
    def receive_response(self: Any, pending: Any, response: Any) -> Any:
        try:
            return right(self, pending, response)
        except Drop:
            self.pending.pop(response.receiver_index, None)
            raise

    return receive_response


def _remembers_strangers(right: Any) -> Any:
    def receive_stray(self: Any, datagram: bytes, index: int, path: Any, now: float) -> Any:
        self._by_address.setdefault(path.address, None)
        return right(self, datagram, index, path, now)

    return receive_stray


def _delivers_held_twice(right: Any) -> Any:
    def end(self: Any, fresh: int) -> Any:
        new, old = right(self, fresh)
        return new * 2, old

    return end


def _delivers_control(right: Any) -> Any:
    def receive_control(peer: Any, session_: Any, counter: int, payload: bytes, *rest: Any, **facts: bool) -> Any:
        out, frames_behind = right(peer, session_, counter, payload, *rest, **facts)
        return out, payload if payload[0] == probe.PROBE and not frames_behind else frames_behind

    return receive_control


def _bad_crc_passes(right: Any) -> Any:
    def parse_frames(data: bytes, position: int, result: Any, counters: Any, *, is_expected: bool) -> Any:
        at, fault = right(data, position, result, counters, is_expected=is_expected)
        if fault is not frames.FrameFault.BAD_CRC or not (is_expected or at > position):
            return at, fault
        raw = data[at : at + frames._length_of_frame(data, at)]
        is_mavlink1 = raw[0] == 0xFE
        msgid = raw[5] if is_mavlink1 else int.from_bytes(raw[7:10], "little")
        system, component = raw[3:5] if is_mavlink1 else raw[5:7]
        result.append(frames.Frame(raw, Header(msgid, system, component, is_mavlink1=is_mavlink1)))
        counters.frames += 1
        return parse_frames(data, at + len(raw), result, counters, is_expected=True)

    return parse_frames


def _holds_everything(right: Any) -> Any:
    def scan(self: Any, data: bytes, result: Any, *, is_final: bool) -> Any:
        if not is_final and len(data) > 600:
            self._rest = data
            return None
        return right(self, data, result, is_final=is_final)

    return scan


def _keeps_the_line(self: Any, rest: bytes) -> None:
    self._rest = rest


def _keeps_every_claim(_: Any) -> Any:
    def note(claims: refusals.RefusalClaims, report: refusals.RefusalReport, now: float) -> None:
        claims._claims.update({refused[:3]: refusals.Claim(refused, now) for refused in report.entries})

    return note


def _waits_beside_all(right: Any) -> Any:
    def wait(self: Any, unconfirmed: Any) -> None:
        index = unconfirmed.session.local_index
        self.unconfirmed[index] = unconfirmed

    return wait


def _learns_indefinitely(right: Any) -> Any:
    def learn(self: Any, port: Any, address: Any) -> None:
        self._received_at[port].setdefault(address, 0.0)
        self._ports_of.setdefault(address[0], {}).setdefault(address[1], set()).add(port)
        self._forget_decisions()

    return learn


def _remembers_indefinitely(right: Any) -> Any:
    def remember(self: Any, key: int, verdict: Any) -> Any:
        self._decisions[key] = verdict
        return verdict

    return remember


def _blind_look_up(right: Any) -> Any:
    def names(problems: Any, sections: Any) -> Any:
        assert (
            len({section.valid["name"] for section in sections}) >= 0
        )  # a KeyError where a name is missing or wrong
        return right(problems, sections)

    return names


def _back_to_sender(right: Any) -> Any:
    def decide(self: Any, source: Any, target_system: int, target_component: int) -> Any:
        ports = right(self, source, target_system, target_component)
        return (*ports, source) if target_system == 2 else ports

    return decide


def _forwards_by_handle(right: Any) -> Any:
    def take(self: Any, socket: int, data: bytes, source: Any) -> None:
        places = {handle: (number, address) for number, address, handle in self._routes}
        number, address = places.get(data[1:3], (socket, source))
        right(self, number, data, address)

    return take


def _longer_by_a_byte(right: Any) -> Any:
    def make(self: Any, send: Any, *rest: Any) -> None:
        right(self, lambda datagram, path: send(datagram + b"\0", path), *rest)

    return make


def _drops_in_silence(right: Any) -> Any:
    def take(self: Any, socket: int, data: bytes, source: Any) -> None:
        if len(data) > 3:
            right(self, socket, data, source)

    return take


def _remembers_every_wish(right: Any) -> Any:
    def _wish(self: Any, member: bytes, *rest: Any) -> Any:
        self._members[member].most_peers = 99
        return right(self, member, *rest)

    return _wish


def _matches_each_wish(right: Any) -> Any:
    def _end(self: Any, wishes: Any, now: float) -> Any:
        changes = bindings.Changes.none()
        for wish in list(wishes):
            opened, closed, concerned = right(self, [wish], now)
            changes.opened.extend(opened)
            changes.closed.extend(closed)
            changes.concerned.update(concerned)
        return changes

    return _end


def _reports_at_once(right: Any) -> Any:
    def on_record(self: Any, received: Any, now: float) -> None:
        right(self, received, now)
        self._perform([Transmit(bytes(600), received.path)])

    return on_record


def _accepts_any_key(right: Any) -> Any:
    def receive(self: Any, bound: Any, order: int, sender: Any, wanted: Any, now: float) -> Any:
        return right(self, bound, order, sender, [*wanted, *(key for key, _ in bound.handles)], now)

    return receive


def _takes_tokens_from_anywhere(right: Any) -> Any:
    def take_token(self: Any, data: bytes, path: Any) -> Any:
        test = self._tests.get(data[1:])
        return right(self, data, path if test is None else Path(test.path.socket, (test.path.host, 1)))

    return take_token


def _tests_without_a_limit(right: Any) -> Any:
    def on_record(self: Any, received: Any, now: float) -> None:
        for member in self.members.values():
            member.filter_tests = TokenBucket(1e6, 1e6, now)
        right(self, received, now)

    return on_record


def _fills_the_bucket(right: Any) -> Any:
    def ask_candidates(peer: Any, now: float) -> Any:
        peer.candidate_questions = TokenBucket(1e6, 1e6, now)
        return right(peer, now)

    return ask_candidates


def _raises(error: Exception, of: Callable[[Any], bool]) -> Callable[[Any], Any]:
    """Raises if the first argument that is bytes, text or a mapping meets a condition."""

    def wrong(right: Any) -> Any:
        def planted(*arguments: Any, **named: Any) -> Any:
            if any(of(argument) for argument in arguments if isinstance(argument, bytes | str | dict)):
                raise error
            return right(*arguments, **named)

        return planted

    return wrong


PLANTS: Final = {
    "answers strangers": Plant(
        "idle", "a bare MAVLink frame is answered", core_node.Node, "receive", _answers_strangers
    ),
    "index error": Plant("session", "an unexpected length", core_node.Node, "receive", _index_error_at(43)),
    "two reasons": Plant("initiator", "a drop that is counted twice", core_node.Node, "receive", _counts_twice),
    "no mac1": Plant(
        "idle", "mac1 is not checked", cookie.MacKeys, "check_mac1", lambda _: lambda self, datagram: None
    ),
    "tag off": Plant("session", "any tag is accepted", session, "equal", _without_tag),
    "tag off, confirmation": Plant("responder", "any tag confirms", session, "equal", _without_tag),
    "marked before the tag": Plant("session", "forgeries use up counters", session.Session, "open", _marks_first),
    "replay window off": Plant(
        "sealed",
        "an envelope is accepted twice",
        replay.ReplayWindow,
        "is_used",
        lambda _: lambda self, counter: False,
    ),
    "wedged": Plant(
        "initiator",
        "a forged response ends the handshake",
        initiator.Initiator,
        "receive_response",
        _wedged_by_a_bad_response,
    ),
    "a table of strangers": Plant("idle", "unbounded memory", core_node.Node, "_receive_stray", _remembers_strangers),
    "unbounded sessions": Plant(
        "sealed", "unconfirmed sessions accumulate", sessions.Sessions, "wait", _waits_beside_all
    ),
    "unbounded claims": Plant(
        "sealed", "claims of refusals accumulate", refusals.RefusalClaims, "note", _keeps_every_claim
    ),
    "delivered twice": Plant(
        "sealed", "held frames are delivered twice", verification.HeldFrames, "release", _delivers_held_twice
    ),
    "control delivered": Plant(
        "sealed", "a record passes for a frame", receive, "_receive_control", _delivers_control
    ),
    "amplifies": Plant(
        "sealed",
        "more bytes to an unproven address than received",
        path_state.PathState,
        "allows",
        lambda _: lambda self, size: True,
    ),
    "relay, any address": Plant(
        "relay", "a handle is valid at any address", forwarding.Forwarding, "take", _forwards_by_handle
    ),
    "relay, longer": Plant("relay", "forwarded data grows", forwarding.Forwarding, "__init__", _longer_by_a_byte),
    "relay, not counted": Plant(
        "relay", "an empty datagram is not counted", forwarding.Forwarding, "take", _drops_in_silence
    ),
    "relay, unbounded wishes": Plant(
        "relay", "a member asks for any number of peers", bindings.Bindings, "_wish", _remembers_every_wish
    ),
    "relay, wishes one by one": Plant(
        "relay", "a connection is opened that ends in the same step", bindings.Bindings, "_end", _matches_each_wish
    ),
    "relay, unproven address": Plant(
        "relay",
        "an unproven path gets an answer",
        service.RelayService,
        "on_record",
        _reports_at_once,
    ),
    "handles of others": Plant(
        "handles", "a handle for a peer that was not asked for", relay_link._Binding, "receive", _accepts_any_key
    ),
    "token from anywhere": Plant(
        "handles",
        "a token counts from the relay's own port too",
        filter_tests.FilterTests,
        "take_token",
        _takes_tokens_from_anywhere,
    ),
    "filter tests without end": Plant(
        "relay", "a member's filter tests have no limit", service.RelayService, "on_record", _tests_without_a_limit
    ),
    "any candidate": Plant(
        "candidates", "special addresses are asked", candidates, "may_be_asked", lambda _: lambda place: True
    ),
    "questions without end": Plant(
        "candidates",
        "candidates are asked without a bucket",
        core_node,
        "ask_candidates",
        _fills_the_bucket,
    ),
    "header not compared": Plant(
        "handshakes",
        "the header in clear may lie",
        handshake,
        "_open_payload",
        lambda _: lambda payload, header: wire.parse_parameters(payload[len(header) - 1 :]),
    ),
    "any parameters": Plant("handshakes", "a tag of any length", wire, "TAG_LENGTHS", lambda _: range(256)),
    "bad checksum": Plant("stream", "a frame with a bad checksum passes", frames, "parse_frames", _bad_crc_passes),
    "unbounded buffer": Plant(
        "stream", "more is held than a frame", stream_splitter.StreamSplitter, "_find", _holds_everything
    ),
    "unbounded line": Plant(
        "line", "more is held than a datagram", line_framing.LineDecoder, "_keep", lambda _: _keeps_the_line
    ),
    "a byte lost": Plant(
        "frames",
        "a byte is skipped that belongs to the next frame",
        frames,
        "_length_of_frame",
        lambda right: lambda data, position: right(data, position) + 1,
    ),
    "foreign system": Plant(
        "gate",
        "every client may send as system 3",
        gate.Gate,
        "_verdict",
        lambda right: lambda self, header: None if header.system == 3 else right(self, header),
    ),
    "back to its sender": Plant("switch", "a frame comes back", routing.Router, "_decide", _back_to_sender),
    "unbounded routes": Plant("switch", "addresses accumulate", routing.Router, "_learn", _learns_indefinitely),
    "unbounded counts": Plant("gate", "message ids accumulate", gate.Gate, "_remember", _remembers_indefinitely),
    "control escapes": Plant(
        "control",
        "text that is not ASCII ends it",
        control.ControlServer,
        "_respond",
        _raises(KeyError(), lambda request: max(request, default=0) > 127),
    ),
    "metrics to anyone": Plant(
        "metrics",
        "a response to an invalid request",
        metrics_server,
        "_REQUEST_LINE",
        lambda _: re.compile(rb"(\S*) (/[!-~]*).*"),
    ),
    "loader lets a KeyError through": Plant(
        "config", "a name is looked up blindly", config_checks, "names", _blind_look_up
    ),
    "a key is repeated": Plant(
        "config",
        "a message that quotes the file",
        config_load,
        "syntax_problem",
        lambda right: lambda path, text, error: right(path, text, error)._replace(message=text),
    ),
    "mitm settings": Plant(
        "mitm",
        "an unusual limit",
        mitm_settings,
        "attack_from_table",
        _raises(TypeError(), lambda table: isinstance(table, dict) and table.get("limit", 5) != 5),
    ),
    "manifest": Plant(
        "manifest", "text that is not UTF-8", tomllib, "loads", _raises(AttributeError(), lambda text: "{" in text)
    ),
    "two spellings of a key": Plant(
        "key",
        "unused bits at the end",
        keys,
        "decode_key",
        lambda _: lambda text: base64.b64decode(text.strip().ljust(44, "="))[:32],
    ),
    "tlog": Plant(
        "tlog",
        "a record of the last three bytes",
        tlog,
        "_plausible_end",
        lambda right: lambda data, position: len(data) if len(data) - position == 3 else right(data, position),
    ),
    "anatomy": Plant(
        "anatomy",
        "an index beyond the end",
        anatomy,
        "_frame_at",
        lambda right: lambda data, at: (0, data[at + 40]) if data[at : at + 1] == b"\xfd" else right(data, at),
    ),
}
