"""MAVLink from clients and peers: the splitters, then policy, router and switch behind them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Final, cast

from fastcrc.crc16 import mcrf4xx

from tests.daemon.inside import most_flows
from tests.daemon.lone_line import lone_line
from tests.daemon.test_switch import Client, policy
from tests.fuzz.engine import Run, Script
from tests.mavlink.inside import gate_tables, most_addresses, remembered_frames
from uavlinkd.daemon import switch as switching
from uavlinkd.daemon.journal import DaemonJournal
from uavlinkd.daemon.switch import Port, Switch
from uavlinkd.mavlink import headers, routing, sendings
from uavlinkd.mavlink.dialect import MESSAGES, SETUP_SIGNING
from uavlinkd.mavlink.frames import (
    MAVLINK1,
    MAX_FRAME_BYTES,
    Frame,
    SplitCounters,
    StreamSplitter,
    split_datagram,
    split_payload,
)
from uavlinkd.mavlink.headers import Header
from uavlinkd.mavlink.policy import gate as gates
from uavlinkd.mavlink.policy.compilation import Policy
from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.mavlink.routing import Router
from uavlinkd.system.clock import monotonic
from uavlinkd.system.stall import StallWatch

KNOWN: Final = (0, 4, 11, 20, 23, 30, 33, 39, 44, 73, 75, 76, 77, 110, 253, 256)
"""Messages of the frames: telemetry, parameters, missions, commands, files, SETUP_SIGNING."""
UNKNOWN: Final = (60_000, 250, 16_777_215)

LAST_STEPS: Final = {mcrf4xx(bytes((extra,)), 0) for extra in range(256)}
"""The effects of one more byte on the low byte of a checksum."""


def made(script: Script) -> bytes:
    """A frame, or bytes that are nearly one: its checksum is right unless the script changes it."""
    how = script.byte()
    msgid = KNOWN[how & 15] if how & 0xC0 else UNKNOWN[how % 3]
    system, component = script.byte(), script.byte()
    system = system if system & 0xC0 == 0xC0 else system & 7
    body = script.take(script.byte() & 63) or b"\0"
    definition = MESSAGES.get(msgid)
    if definition and how & 0x10:
        body = body[: definition[3]].ljust(definition[2], b"\1")
    if how & 0x20 and msgid < 256:
        covered = bytes((len(body), 1, system, component, msgid)) + body
        start, signature = b"\xfe", b""
    else:
        flags = int(how & 0xE0 == 0xE0)
        covered = bytes((len(body), flags, 0, 1, system, component)) + msgid.to_bytes(3, "little") + body
        start, signature = b"\xfd", bytes(13 * flags)
    checksum = mcrf4xx(covered + bytes((definition[1] if definition else 77,)))
    if how & 0xC8 == 0x88:
        checksum ^= 1 << (script.byte() & 15)
    return start + covered + checksum.to_bytes(2, "little") + signature


def check_frame(frame: Frame) -> None:
    """A frame's header matches its bytes, parsed here again; the checksum of a known message is right."""
    raw, header = frame
    if raw[0] == MAVLINK1:
        length, msgid, body_at = 8 + raw[1], raw[5], 6
        system, component = raw[3], raw[4]
    else:
        assert raw[0] == 0xFD, "a frame without a start"
        assert raw[2] <= 1, "a frame with unknown flags"
        length, msgid, body_at = 12 + raw[1] + 13 * raw[2], int.from_bytes(raw[7:10], "little"), 10
        system, component = raw[5], raw[6]
    assert len(raw) == length, "a frame of another length than its header's"
    assert (header.msgid, header.system, header.component) == (msgid, system, component), "another frame's header"
    checksum_at = body_at + raw[1]
    wanted = int.from_bytes(raw[checksum_at : checksum_at + 2], "little")
    if header.is_known:
        assert mcrf4xx(raw[1:checksum_at] + bytes((MESSAGES[msgid][1],))) == wanted, "a bad checksum"
    else:
        assert mcrf4xx(raw[1:checksum_at]) >> 8 ^ wanted in LAST_STEPS, "no checksum of any definition"


def facts_of(frame: Frame) -> tuple[object, ...]:
    """A frame's facts, for comparison: headers are compared by identity, and the cache forgets them now and then."""
    header = frame.header
    return frame.raw, header.is_known, header.target_system, header.target_component, header.command


def check_split(data: bytes, result: list[Frame], counters: SplitCounters, held: int = 0) -> None:
    """The frames are in the data, in order; every byte is in a frame, garbage, or held."""
    position = 0
    for frame in result:
        at = data.find(frame.raw, position)
        assert at >= 0, "a frame that was not sent"
        position = at + len(frame.raw)
        check_frame(frame)
    size = sum(len(frame.raw) for frame in result)
    assert size + counters.garbage_bytes + held == len(data), "bytes are unaccounted for"
    assert counters.frames == len(result), "frames are unaccounted for"
    assert len(headers.sender_messages) <= headers.MAX_SENDER_MESSAGES, "too many headers are remembered"
    assert len(headers.targeted_headers) <= headers.MAX_TARGETED_HEADERS, "too many headers are remembered"


def _stream(script: Script) -> bytes:
    """Frames, pieces of frames and noise, in a row."""
    parts = []
    while script:
        match script.byte() & 3:
            case 0:
                parts.append(script.take(1 + (script.byte() & 31)))
            case 1:
                frame = made(script)
                parts.append(frame[: script.byte() % len(frame)])
            case _:
                parts.append(made(script))
    return b"".join(parts)


def make_stream() -> Run:
    """A byte stream, cut into chunks anywhere: the same frames for any cuts."""

    def run(data: bytes) -> None:
        cuts, rest = data[:16], data[16:]
        stream = _stream(Script(rest[1:])) if rest[:1] < b"\xc0" else rest[1:]
        splitter = StreamSplitter()
        result: list[Frame] = []
        position, number = 0, 0
        while position < len(stream):
            size = 1 + (cuts[number % len(cuts)] if cuts else 64)
            chunk = stream[position : position + size]
            result += splitter.feed(chunk, 0.0)
            assert splitter.pending_bytes < MAX_FRAME_BYTES, "more is held than a frame"
            position += size
            number += 1
        check_split(stream, result, splitter.counters, splitter.pending_bytes)
        result += splitter.end()
        check_split(stream, result, splitter.counters)
        whole = StreamSplitter()
        uncut = [*whole.feed(stream, 0.0), *whole.end()]
        assert list(map(facts_of, result)) == list(map(facts_of, uncut)), "the cuts change what is found"
        assert splitter.counters == whole.counters

    return run


def make_datagrams() -> Run:
    """A local client's datagram, and the same bytes as the payload of an envelope."""

    def run(data: bytes) -> None:
        script = Script(data)
        while script:
            if script.byte() & 3:
                datagram = b"".join(made(script) for _ in range(1 + script.byte() % 4))
            else:
                datagram = script.take(script.byte())
            counters = SplitCounters()
            check_split(datagram, split_datagram(datagram, counters), counters)
            counters = SplitCounters()
            frames = split_payload(datagram, counters)
            check_split(datagram, frames, counters)
            again = SplitCounters()
            whole = b"".join(frame.raw for frame in frames)
            found_again = split_payload(whole, again)
            assert list(map(facts_of, found_again)) == list(map(facts_of, frames)), "frames are lost"
            assert again.garbage_bytes == 0

    return run


POLICIES: Final[tuple[dict[str, object], ...]] = (
    {},
    {"system_ids": [1, 2, "4-5"], "role": "vehicle"},
    {"system_ids": [1, 2, 3], "allow_in": ["telemetry", "HEARTBEAT", "30", "MAV_CMD_NAV_TAKEOFF"], "mavlink1": False},
    {
        "system_ids": "all",
        "allow_in": ["mission", "files-read"],
        "rate_out": {"files": 0},
        "rate_in": {"ATTITUDE": 2},
    },
    {"system_ids": [6], "role": "operator", "ground_station": False},
    {"system_ids": [7], "role": "observer"},
)
_CLAIMS: Final = (None, {1, 2, 4, 5}, {1, 2, 3}, None, {6}, {7})
"""The systems that each policy allows."""


_BOUNDS = (
    (routing, ("MAX_ADDRESSES_PER_PORT",)),
    (sendings, ("MAX_FRAMES_REMEMBERED",)),
    (gates, ("MAX_COUNTED", "MAX_BUCKETS", "MAX_DECISIONS")),
    (switching, ("MAX_FLOWS",)),
)


@contextmanager
def small_tables() -> Iterator[None]:
    """Tables with eight entries: a script reaches the end of each, and shows whether it is bounded."""
    before = [(module, name, getattr(module, name)) for module, names in _BOUNDS for name in names]
    for module, name, _ in before:
        setattr(module, name, 8)
    try:
        yield
    finally:
        for module, name, limit in before:
            setattr(module, name, limit)


def make_switch() -> Run:
    """Six clients, each with a policy, at one switch: no frame passes that a policy refuses, and none comes back."""

    @small_tables()
    def run(data: bytes) -> None:
        script = Script(data)
        refused: Counter[Refusal] = Counter()
        router = Router[Port]()

        def count(name: str, header: Header, refusal: Refusal, now: float, *, to_them: bool) -> None:
            refused[refusal] += 1

        drops = cast("DaemonJournal", SimpleNamespace(add_refused=count))
        switch, stall = Switch(router, drops), StallWatch(monotonic(), lambda _: None)
        line = lone_line(switch, stall, drops)
        clients = [Client(str(number)) for number in range(len(POLICIES))]
        policies = [policy(**rules) for rules in POLICIES]
        for client, rules in zip(clients, policies, strict=True):
            switch.add(client.port, rules)
        now = 0.0
        while script:
            what = script.byte()
            if what & 0xF0 == 0xF0:
                now += (what & 15) ** 2
                switch.router.refresh(now)
                continue
            number = what % len(clients)
            raw = b"".join(made(script) for _ in range(1 + (what >> 6)))
            frames = split_datagram(raw, SplitCounters())
            line.forward(clients[number].port, frames, now, stall.turn(monotonic()))
            _check_received(clients, number, frames)
        _check_tables(router, switch, policies)

    return run


def _check_received(clients: list[Client], source: int, frames: list[Frame]) -> None:
    """No client received a frame more often than it was sent, nor a frame of a forbidden system, nor keys."""
    sent = Counter(frame.raw for frame in frames)
    by_raw = {frame.raw: frame.header for frame in frames}
    assert not clients[source].received, "a frame went back to where it came from"
    for client in clients:
        for raw, count in Counter(client.received).items():
            assert count <= sent[raw], "received more often than sent"
            header = by_raw[raw]
            claims = _CLAIMS[source]
            assert claims is None or header.system in claims, "a port sent as another system"
            assert header.msgid != SETUP_SIGNING, "a signing key was passed on"
        client.received.clear()


def _check_tables(router: Router[Port], switch: Switch, policies: list[Policy]) -> None:
    assert most_addresses(router) <= routing.MAX_ADDRESSES_PER_PORT, "too many addresses"
    assert remembered_frames(router) <= sendings.MAX_FRAMES_REMEMBERED
    assert most_flows(switch) <= switching.MAX_FLOWS
    for client_policy in policies:
        for gate in (client_policy.incoming, client_policy.outgoing):
            assert len(gate.refused) <= gates.MAX_COUNTED + len(Refusal), "too many separate counters"
            _check_memory(gate)


def _check_memory(gate: gates.Gate) -> None:
    decisions, buckets = gate_tables(gate)
    assert decisions <= gates.MAX_DECISIONS
    assert buckets <= gates.MAX_BUCKETS


def make_gate() -> Run:
    """One policy with any frames: a frame that passes at any rate always passes; its memory is bounded."""
    wanted = POLICIES

    @small_tables()
    def run(data: bytes) -> None:
        script = Script(data)
        number = script.byte() % len(wanted)
        gate = policy(**wanted[number]).incoming
        now = 0.0
        while script:
            now += script.byte() / 256
            raw = made(script)
            for frame in split_datagram(raw, SplitCounters()):
                always = gate.always_passes(frame.header)
                refusal = gate.check(frame, now)
                assert not (always and refusal), "a frame that always passes was refused"
                claims = _CLAIMS[number]
                assert refusal or claims is None or frame.header.system in claims, "spoke as another system"
                assert refusal or frame.header.msgid != SETUP_SIGNING, "a signing key may pass"
        assert len(gate.refused) <= gates.MAX_COUNTED + len(Refusal)
        _check_memory(gate)

    return run
