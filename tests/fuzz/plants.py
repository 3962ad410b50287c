"""Bugs of every class, planted on purpose: a fuzz run that finds none of them proves nothing.

Each changes one thing of the product, in this process, and says which target must find it. ``put`` plants it and
returns what takes it out again.
"""

from __future__ import annotations

import base64
import re
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from uavlinkd.config import keys
from uavlinkd.ops import control, metrics_server
from uavlinkd.config import checks as config_checks
from uavlinkd.config import load as config_load
from uavlinkd.core import initiator as caller, cookie, freshness, handshake, peer, replay, session, sessions, wire
from uavlinkd.core import node as core_node
from uavlinkd.core.drops import Drop
from uavlinkd.core.outputs import Deliver, Transmit
from uavlinkd.mavlink import frames, routing
from uavlinkd.mavlink.policy import gate
from uavlinkd.lab.mitm import anatomy
from uavlinkd.lab.mitm import proxy_settings as mitm_settings
from uavlinkd.lab.sim import tlog

Undo = Callable[[], None]


@dataclass(frozen=True, slots=True)
class Plant:
    """One bug."""

    target: str
    about: str
    place: Any
    name: str
    wrong: Callable[[Any], Any]
    """Gives the wrong thing for the right one."""

    def put(self) -> Undo:
        """Plant it; call the result to take it out."""
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
        self.window.check(counter)
        payload = self._receive.open(datagram, header_bytes, counter)
        self.window.mark(counter)  # also where the tag was bad
        return right(self, datagram, header_bytes, counter, now) if payload is None else payload

    return open_


def _without_tag(right: Any) -> Any:
    return lambda self, datagram, header_bytes, counter: datagram[header_bytes : -self.tag_bytes]


def _wedged_by_a_bad_response(right: Any) -> Any:
    def receive_response(self: Any, pending: Any, response: Any) -> Any:
        try:
            return right(self, pending, response)
        except Drop:
            self.pending.pop(response.receiver_index, None)
            raise

    return receive_response


def _remembers_strangers(right: Any) -> Any:
    def _hint(self: Any, path: Any, now: float, out: Any) -> Any:
        self._by_address.setdefault((path[1], path[2]), None)
        return right(self, path, now, out)

    return _hint


def _delivers_held_twice(right: Any) -> Any:
    def end(self: Any, fresh: int) -> Any:
        new, old = right(self, fresh)
        return new * 2, old

    return end


def _delivers_control(right: Any) -> Any:
    def receive_control(self: Any, session_: Any, control_: Any, path: Any, now: float, out: Any) -> Any:
        if isinstance(control_, wire.PathResponse):
            out.append(Deliver(self.name, control_.encode()))
        return right(self, session_, control_, path, now, out)

    return receive_control


def _trusts_paths(right: Any) -> Any:
    def challenge_path(self: Any, session_: Any, path: Any, size: int, now: float, out: Any) -> Any:
        self._seal(session_, bytes((wire.ECHO_REQUEST,)) + bytes(60), path, now, out)

    return challenge_path


def _bad_crc_passes(right: Any) -> Any:
    def frame_at(data: bytes, position: int, size: int, *, is_expected: bool) -> Any:
        found = right(data, position, size, is_expected=is_expected)
        if found is frames.FrameFault.BAD_CRC and is_expected:
            end = position + frames._length_of_frame(data, position)
            msgid = (
                data[position + 5]
                if data[position] == 0xFE
                else int.from_bytes(data[position + 7 : position + 10], "little")
            )
            at = 3 if data[position] == 0xFE else 5
            return frames.Frame(
                data[position:end],
                frames.Header(
                    msgid, data[position + at], data[position + at + 1], is_mavlink1=data[position] == 0xFE
                ),
            )
        return found

    return frame_at


def _holds_everything(right: Any) -> Any:
    def scan(self: Any, data: bytes, found: Any, *, is_final: bool) -> Any:
        if not is_final and len(data) > 600:
            self._rest = data
            return None
        return right(self, data, found, is_final=is_final)

    return scan


def _waits_beside_all(right: Any) -> Any:
    def wait(self: Any, unconfirmed: Any) -> None:
        index = unconfirmed.session.local_index
        self.unconfirmed[index] = unconfirmed
        self._indices.owners[index] = unconfirmed.session

    return wait


def _learns_for_ever(right: Any) -> Any:
    def learn(self: Any, port: Any, address: Any) -> None:
        self._heard_at[port].setdefault(address, 0.0)
        self._ports_of.setdefault(address[0], {}).setdefault(address[1], set()).add(port)
        self._forget_decisions()

    return learn


def _remembers_for_ever(right: Any) -> Any:
    def remember(self: Any, key: int, verdict: Any) -> Any:
        self._decisions[key] = verdict
        return verdict

    return remember


def _blind_look_up(right: Any) -> Any:
    def names(problems: Any, sections: Any) -> Any:
        assert len({each.good["name"] for each in sections}) >= 0  # a KeyError where a name is missing or wrong
        return right(problems, sections)

    return names


def _back_to_sender(right: Any) -> Any:
    def decide(self: Any, source: Any, target_system: int, target_component: int) -> Any:
        ports = right(self, source, target_system, target_component)
        return (*ports, source) if target_system == 2 else ports

    return decide


def _raises(error: Exception, of: Callable[[Any], bool]) -> Callable[[Any], Any]:
    """Raises where the first argument that is bytes, text or a mapping has something about it."""

    def wrong(right: Any) -> Any:
        def planted(*arguments: Any, **named: Any) -> Any:
            if any(of(each) for each in arguments if isinstance(each, bytes | str | dict)):
                raise error
            return right(*arguments, **named)

        return planted

    return wrong


PLANTS: Final = {
    "answers strangers": Plant(
        "idle", "a bare MAVLink frame is answered", core_node.Node, "receive", _answers_strangers
    ),
    "index error": Plant(
        "session", "a length that nobody thought of", core_node.Node, "receive", _index_error_at(43)
    ),
    "two reasons": Plant("initiator", "a drop that is counted twice", core_node.Node, "receive", _counts_twice),
    "no mac1": Plant(
        "idle", "mac1 is not looked at", cookie.MacKeys, "check_mac1", lambda _: lambda self, datagram: None
    ),
    "tag off": Plant("session", "any tag will do", session.Authenticated, "open", _without_tag),
    "tag off, confirmation": Plant("responder", "any tag confirms", session.Authenticated, "open", _without_tag),
    "marked before the tag": Plant("session", "forgeries use up counters", session.Session, "open", _marks_first),
    "replay window off": Plant(
        "sealed", "an envelope is accepted twice", replay.ReplayWindow, "check", lambda _: lambda self, counter: None
    ),
    "wedged": Plant(
        "initiator",
        "a forged response ends the handshake",
        caller.Caller,
        "receive_response",
        _wedged_by_a_bad_response,
    ),
    "a table of strangers": Plant("idle", "unbounded memory", core_node.Node, "_hint", _remembers_strangers),
    "unbounded sessions": Plant(
        "sealed", "unconfirmed sessions pile up", sessions.Sessions, "wait", _waits_beside_all
    ),
    "delivered twice": Plant("sealed", "what waited comes twice", freshness.Doubt, "end", _delivers_held_twice),
    "control delivered": Plant(
        "sealed", "a record passes for a frame", peer.Peer, "_receive_control", _delivers_control
    ),
    "amplifies": Plant("sealed", "more to an unproven place than came", peer.Peer, "_challenge_path", _trusts_paths),
    "header not compared": Plant(
        "handshakes",
        "the header in clear may lie",
        handshake,
        "_open_payload",
        lambda _: lambda payload, header: wire.parse_parameters(payload[len(header) - 1 :]),
    ),
    "any parameters": Plant("handshakes", "a tag of any length", wire, "TAG_LENGTHS", lambda _: range(256)),
    "bad checksum": Plant("stream", "a frame with a bad checksum passes", frames, "_frame_at", _bad_crc_passes),
    "unbounded buffer": Plant(
        "stream", "more is held than a frame", frames.StreamSplitter, "_scan", _holds_everything
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
        "system 3 may be spoken as by all",
        gate.Gate,
        "_verdict",
        lambda right: lambda self, header: None if header.system == 3 else right(self, header),
    ),
    "back to its sender": Plant("switch", "a frame comes back", routing.Router, "_decide", _back_to_sender),
    "unbounded routes": Plant("switch", "addresses pile up", routing.Router, "_learn", _learns_for_ever),
    "unbounded counts": Plant("gate", "message ids pile up", gate.Gate, "_remember", _remembers_for_ever),
    "control escapes": Plant(
        "control",
        "text that is not ASCII ends it",
        control.ControlServer,
        "_respond",
        _raises(KeyError(), lambda each: max(each, default=0) > 127),
    ),
    "metrics to anyone": Plant(
        "metrics",
        "a response to what is no request",
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
        "_toml_problem",
        lambda right: lambda path, text, error: right(path, text, error)._replace(message=text),
    ),
    "mitm settings": Plant(
        "mitm",
        "a limit that nobody tried",
        mitm_settings,
        "attack_from_table",
        _raises(TypeError(), lambda each: isinstance(each, dict) and each.get("limit", 5) != 5),
    ),
    "manifest": Plant(
        "manifest",
        "text that is not UTF-8",
        tomllib,
        "loads",
        _raises(AttributeError(), lambda each: "{" in each),
    ),
    "two spellings of a key": Plant(
        "key",
        "loose bits at the end",
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
