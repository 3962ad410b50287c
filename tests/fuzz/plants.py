"""Planted faults, one of each class and for each target: a hunt proves something only if it finds them."""

from __future__ import annotations

import base64
import tomllib
from collections.abc import Callable
from typing import Any, Final, NamedTuple

from tests.protocol import inside
from uavlinkd.authority import certificates, enrolment, trust
from uavlinkd.authority import constants as fleet_constants
from uavlinkd.config import checks as config_checks
from uavlinkd.config import keys
from uavlinkd.config import load as config_load
from uavlinkd.lab.mitm import anatomy
from uavlinkd.lab.mitm import proxy_settings as mitm_settings
from uavlinkd.mavlink import frames, routing
from uavlinkd.mavlink.policy import gate
from uavlinkd.mavlink.signing import endpoint_signing, signature
from uavlinkd.ops import control
from uavlinkd.protocol import counters, handshake, path_state, receive, reports, session, wire
from uavlinkd.protocol.drops import Drop, DropReason
from uavlinkd.protocol.outputs import Deliver, Transmit
from uavlinkd.relay import client_link as relay_link
from uavlinkd.relay import direct_search, forwarding, service
from uavlinkd.serial import line_framing
from uavlinkd.stations import inner
from uavlinkd.stations import session as station_session
from uavlinkd.tls import stream as web_stream


class Plant(NamedTuple):
    """One fault in the package."""

    target: str
    """The fuzz target that must find it."""
    place: Any
    name: str
    wrong: Callable[[Any], Any]
    """Returns a faulty replacement for the original."""


def put(about: str) -> Callable[[], None]:
    """Plant a fault in this process, or none without a name; call the result to remove it."""
    if not about:
        return lambda: None
    plant = PLANTS[about]
    right = plant.place.__dict__[plant.name]
    setattr(plant.place, plant.name, plant.wrong(right))
    return lambda: setattr(plant.place, plant.name, right)


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


def _marks_first_of_a_station(right: Any) -> Any:
    def open_(self: Any, datagram: bytes, now: float) -> Any:
        try:
            return right(self, datagram, now)
        except Drop as drop:
            if drop.reason is DropReason.BAD_TAG:
                self._window.mark(int.from_bytes(datagram[8:16], "little"))
            raise

    return open_


def _delivers_control(right: Any) -> Any:
    def receive_control(arrived: Any, payload: bytes, out: Any) -> None:
        right(arrived, payload, out)
        if isinstance(control := wire.parse_control(payload), wire.ProbeAndFrames) and not control.frames:
            out.append(Deliver(arrived.peer, payload))

    return receive_control


def _keeps_every_claim(_: Any) -> Any:
    def note(claims: reports.Claims, report: wire.RefusalReport, now: float) -> None:
        inside.believe(claims, report, now)

    return note


def _blind_look_up(right: Any) -> Any:
    def check(file: Any) -> Any:
        assert len({peer.valid["name"] for peer in file["peer"]}) >= 0  # a KeyError where a name is missing or wrong
        return right(file)

    return check


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


def _unwraps_by_handle(right: Any) -> Any:
    def unwrap(self: Any, socket: int, data: bytes, source: Any) -> Any:
        places = {handle: (number, address) for number, address, handle in self._inward}
        number, address = places.get(int.from_bytes(data[1:3], "big"), (socket, source))
        return right(self, number, data, address)

    return unwrap


def _reports_at_once(right: Any) -> Any:
    def on_record(self: Any, received: Any, now: float) -> None:
        right(self, received, now)
        self._perform([Transmit(bytes(600), received.path)])

    return on_record


def _keeps_the_line(_: Any) -> Any:
    def keep(self: Any, rest: bytes) -> None:
        self._rest = rest

    return keep


def _raises(error: Exception, of: Callable[[Any], bool]) -> Callable[[Any], Any]:
    """Raises if the first argument that is bytes, text or a mapping meets a condition."""

    def wrong(right: Any) -> Any:
        def planted(*arguments: Any, **named: Any) -> Any:
            if any(of(argument) for argument in arguments if isinstance(argument, bytes | str | dict)):
                raise error
            return right(*arguments, **named)

        return planted

    return wrong


def _reads_any(_: Any) -> Any:
    def read(_: Any, raw: bytes) -> tuple[bytes, int] | None:
        stream = raw[5:7] + raw[-13:-12]
        return (stream, int.from_bytes(raw[-12:-6], "little")) if signature.is_signed(raw) else None

    return read


def _always(result: object) -> Callable[[Any], Any]:
    return lambda _: lambda *arguments: result


PLANTS: Final = {
    "any signature is accepted": Plant("signing", signature.Signer, "read", _reads_any),
    "a signature stays": Plant("signing", endpoint_signing, "without_signature", lambda right: lambda raw: raw),
    "any answer proves": Plant("signing", endpoint_signing.EndpointSigning, "_is_answer", _always(True)),
    "a bare MAVLink frame is answered": Plant("idle", receive.DatagramReceiver, "receive", _answers_strangers),
    "an exception at one length": Plant("session", receive.DatagramReceiver, "receive", _index_error_at(43)),
    "a drop is counted twice": Plant("initiator", receive.DatagramReceiver, "receive", _counts_twice),
    "any tag is accepted": Plant("session", session, "equal", _always(True)),
    "any tag confirms": Plant("responder", session, "equal", _always(True)),
    "forgeries use up counters": Plant("session", session.Session, "open", _marks_first),
    "an envelope is accepted twice": Plant("sealed", counters.ReplayWindow, "is_used", _always(False)),
    "claims accumulate": Plant("sealed", reports.Claims, "note", _keeps_every_claim),
    "a record passes for a frame": Plant("sealed", receive, "_receive_control", _delivers_control),
    "more bytes to an unproven address than received": Plant("sealed", path_state.PathState, "allows", _always(True)),
    "a relay's handle is valid at any address": Plant("relay", forwarding.Forwarding, "take", _forwards_by_handle),
    "a relay answers an unproven path": Plant("relay", service.RelayService, "on_record", _reports_at_once),
    "a handle is valid from any address": Plant("handles", relay_link.RelayHandles, "unwrap", _unwraps_by_handle),
    "special addresses are asked": Plant("candidates", direct_search, "may_be_asked", _always(True)),
    "the header in clear may lie": Plant(
        "handshakes",
        handshake,
        "_open_payload",
        lambda _: lambda payload, header: (wire.parse_parameters(payload[len(header) - 1 :]), b""),
    ),
    "any bulletin is signed": Plant("exchange", trust, "is_published", _always(True)),
    "have is not limited": Plant("exchange", fleet_constants, "HAVE_LEAST_S", lambda _: 0.0),
    "signature checks are not limited": Plant("exchange", fleet_constants, "BULLETIN_LEAST_S", lambda _: 0.0),
    "serials in any order": Plant("signed", certificates, "pairwise", lambda _: lambda offsets: ()),
    "any checksum fits": Plant("stream", frames, "CHECKSUM_STEPS", lambda _: range(0x10000)),
    "a byte is skipped that belongs to the next frame": Plant(
        "frames", frames, "_length_of_frame", lambda right: lambda data, position: right(data, position) + 1
    ),
    "more is held than a datagram": Plant("line", line_framing.LineDecoder, "_keep", _keeps_the_line),
    "a fragment is a datagram": Plant("messages", web_stream, "_fault_of", lambda _: lambda frame: ""),
    "every client may send as system 3": Plant(
        "gate",
        gate.Gate,
        "_verdict",
        lambda right: lambda self, header: None if header.system == 3 else right(self, header),
    ),
    "a frame comes back": Plant("switch", routing.Router, "_ports_for", _back_to_sender),
    "text that is not ASCII ends the control socket": Plant(
        "control",
        control.ControlServer,
        "_respond",
        _raises(KeyError(), lambda request: max(request, default=0) > 127),
    ),
    "a name is looked up blindly": Plant("config", config_checks, "check", _blind_look_up),
    "a message quotes the file": Plant(
        "config",
        config_load,
        "syntax_problem",
        lambda right: lambda path, text, error: right(path, text, error)._replace(message=text),
    ),
    "an unusual limit": Plant(
        "mitm",
        mitm_settings,
        "attack_from_table",
        _raises(TypeError(), lambda table: isinstance(table, dict) and table.get("limit", 5) != 5),
    ),
    "text with a brace": Plant("manifest", tomllib, "loads", _raises(AttributeError(), lambda text: "{" in text)),
    "two spellings of a key": Plant(
        "key", keys, "decode_key", lambda _: lambda text: base64.b64decode(text.strip().ljust(44, "="))[:32]
    ),
    "two spellings of a line": Plant(
        "enrolment", enrolment, "_decoded", lambda _: lambda text, reason: base64.b64decode(text.encode())
    ),
    "a forgery takes a counter of a station": Plant(
        "stations", station_session.TunnelSession, "open", _marks_first_of_a_station
    ),
    "a checksum is not verified": Plant("packets", inner, "_sum", lambda _: lambda data: 0),
    "an index beyond the end": Plant(
        "anatomy",
        anatomy,
        "_frame_at",
        lambda right: lambda data, at: (0, data[at + 40]) if data[at : at + 1] == b"\xfd" else right(data, at),
    ),
}
