"""The parsers of pymavlink and MAVSDK accept of a filtered stream only what policy passed."""

from __future__ import annotations

import importlib
import queue
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tests.lab.sim import scenarios
from tests.mavlink.parsers.captured_member import CAST, MemberAttack, attacks_on, lacking, signed_unknown, within
from tests.mavlink.parsers.generate import Generator
from tests.mavlink.parsers.hidden_frames import Carrier, frame, msgid_of
from tests.mavlink.parsers.judge import Deliverer, Judge, Stream, unfiltered
from tests.mavlink.parsers.receivers import DIALECTS
from tests.mavlink.parsers.targets import concatenated, deliver
from tests.waiting import PATIENCE_S
from uavlinkd.mavlink.dialect import IDS, name_of

STREAMS = 400
MARKER_SYSTEM = 77
SPEAKERS = (1, 2, 3, 200, 255, MARKER_SYSTEM)
"""Systems that MAVSDK has to know before it reports their messages."""


def pymavlink_accepts(dialect: str, stream: bytes) -> list[bytes]:
    """The frames that pymavlink's parser accepts."""
    module = importlib.import_module(f"pymavlink.dialects.v20.{dialect}")
    parser = module.MAVLink(None)
    parser.robust_parsing = True
    accepted = parser.parse_buffer(stream) or []
    return [bytes(message.get_msgbuf()) for message in accepted if message.get_msgId() >= 0]


def breaches(dialect: str, stream: Stream, judge: Judge) -> list[bytes]:
    """Forbidden frames that pymavlink accepts from any offset on."""
    delivery = stream.delivery
    delivered = {delivery.stream[start:end] for start, end in delivery.frames}
    senders = tuple({author for _, author in stream.authors if author is not None})
    accepted = []
    offsets = {0, *(at for at, byte in enumerate(delivery.stream) if byte in (0xFD, 0xFE))}
    for offset in offsets:
        for raw in pymavlink_accepts(dialect, delivery.stream[offset:]):
            if raw not in delivered and judge.is_forbidden(raw, senders, stream.client):
                accepted.append(raw)
    return accepted


@pytest.mark.parametrize("dialect", DIALECTS)
def test_pymavlink_accepts_what_policy_passed(dialect: str) -> None:
    """From every start byte on. All senders count together, so that each of the frames has the same policy."""
    generator, deliverer, judge = Generator(21), Deliverer(), Judge()
    for _ in range(STREAMS):
        recipe = generator.recipe()
        if len({part.sender for part in recipe.parts} - {"private dialect"}) == 1:
            assert not breaches(dialect, deliverer.deliver(recipe), judge)


def test_pymavlink_accepts_forbidden_frames_without_the_filter() -> None:
    """The same streams with policy only."""
    generator, deliverer, judge = Generator(21), Deliverer(unfiltered), Judge()
    streams = [deliverer.deliver(generator.recipe()) for _ in range(STREAMS)]
    assert sum(bool(breaches("common", stream, judge)) for stream in streams) > 3


class MavsdkReceiver:
    """MAVSDK reads the given bytes, and reports each message that it accepts."""

    def __init__(self, sdk: Any, direct: Callable[[Any], Any]) -> None:
        self._sdk = sdk
        self._accepted: queue.Queue[tuple[str, int, str]] = queue.Queue()
        self._number = 0
        self._subscribed = []
        known = threading.Semaphore(0)
        sdk.subscribe_on_new_system(lambda *_: known.release())
        for number, system in enumerate(SPEAKERS):
            sdk.pass_received_raw_bytes(heartbeat(system, 0))
            while len(sdk.get_systems()) <= number:
                assert known.acquire(timeout=PATIENCE_S), f"MAVSDK does not know system {system}"
        for system in sdk.get_systems():
            self._subscribed.append(direct(system))
            self._subscribed[-1].subscribe_message("", self._on_message)

    def _on_message(self, message: Any, *_: object) -> None:
        self._accepted.put((message.message_name, message.system_id, message.fields_json))

    def accepts(self, stream: bytes) -> set[tuple[str, int]]:
        """The names and systems of the messages that it accepts. It keeps its state: filler bytes end open frames."""
        self._number += 1
        self._sdk.pass_received_raw_bytes(stream + b"U" * 300)
        self._sdk.pass_received_raw_bytes(heartbeat(MARKER_SYSTEM, self._number))
        accepted: set[tuple[str, int]] = set()
        while True:
            name, system, fields = self._accepted.get(timeout=PATIENCE_S)
            if system == MARKER_SYSTEM and f'"custom_mode":{self._number},' in fields:
                return accepted
            if system != MARKER_SYSTEM:
                accepted.add((name, system))


def heartbeat(system: int, number: int) -> bytes:
    """A numbered HEARTBEAT of a vehicle, by which MAVSDK knows the system."""
    return frame(0, number.to_bytes(4, "little") + bytes((2, 3, 0, 4, 3)), system)


@pytest.fixture
def mavsdk() -> Iterator[MavsdkReceiver]:
    """MAVSDK without a network."""
    scenarios.need("mavsdk.mavsdk")
    from mavsdk.component_type import ComponentType
    from mavsdk.mavsdk import Configuration, Mavsdk
    from mavsdk.plugins.mavlink_direct import MavlinkDirect

    sdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    try:
        sdk.add_any_connection("raw://")
        yield MavsdkReceiver(sdk, MavlinkDirect)
    finally:
        sdk.destroy()


def meaning(raw: bytes) -> tuple[str, int]:
    """A frame's message and system."""
    return name_of(msgid_of(raw)), raw[3] if raw[0] == 0xFE else raw[5]


TO_ALL = frame(76, bytes(28) + (400).to_bytes(2, "little") + bytes(3), 255)
"""COMMAND_LONG to every system: MAVSDK does not report messages to others."""


def smuggled() -> list[MemberAttack]:
    """The command in a payload, of a member; and where a signed message of an observer shifts a receiver to it."""
    member, observer = CAST["member"], CAST["observer"]
    home = Carrier(IDS["HOME_POSITION"], bytearray(60), 2)
    lacked, carrier = lacking("common", "observer"), IDS["PARAM_REQUEST_READ"]
    return [
        within("in a payload", member, home, TO_ALL),
        signed_unknown("behind a signature", observer, 200, lacked, carrier, TO_ALL),
    ]


def test_mavsdk_accepts_what_policy_passed(mavsdk: MavsdkReceiver) -> None:
    """From the start of a stream and from each start byte in it."""
    for attack in (*smuggled(), *attacks_on("common")):
        delivery = deliver(attack).delivery
        delivered = {meaning(delivery.stream[start:end]) for start, end in delivery.frames}
        for offset, byte in enumerate(delivery.stream):
            if byte in (0xFD, 0xFE) or offset == 0:
                assert mavsdk.accepts(delivery.stream[offset:]) <= delivered, attack.name


def test_mavsdk_accepts_forbidden_frames_without_the_filter(mavsdk: MavsdkReceiver) -> None:
    """If it starts to read at the hidden frame."""
    for attack in smuggled():
        stream = concatenated(attack).delivery.stream
        assert meaning(TO_ALL) in mavsdk.accepts(stream[stream.index(TO_ALL) :])
