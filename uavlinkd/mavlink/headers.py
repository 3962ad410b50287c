"""The facts in a frame's header: sender, message, target and command. Frames with the same facts share one object.

Routing and policy decide once for each header object, not once for each frame. So the objects are kept: for each
sender and message, and for each target and command where a message carries them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple, final

from uavlinkd.mavlink.dialect import KINDS, MESSAGES, UNKNOWN, MessageKind

MAX_SENDER_MESSAGES: Final = 2048  # messages of one sender each whose headers are kept
MAX_TARGETED_HEADERS: Final = 8192
"""Headers with a target or command that are kept, of all senders: 2 MB. A ground station that sends thirty different
commands to each of 250 systems stays below."""


@final
@dataclass(slots=True, eq=False)
class Header:
    """What a frame's header, its target and its command say. Frames with the same facts share one object.

    A MAVLink 2 sender cuts zero bytes from the payload's end. A target or command that was cut is 0, as it is for
    every receiver.
    """

    msgid: int
    system: int
    component: int
    target_system: int = 0  # 0 in both targets: all, or the message has no target
    target_component: int = 0
    command: int | None = None
    """The MAV_CMD that the frame requests or that a mission item carries; None for a message without one."""
    is_known: bool = True
    """Whether the checksum fits the dialect's definition. Otherwise target and command could not be read."""
    is_mavlink1: bool = False
    kind: MessageKind = field(init=False)
    """All other facts about the message: looked up once for all frames with this header."""

    def __post_init__(self) -> None:
        self.kind = KINDS.get(self.msgid, UNKNOWN) if self.is_known else UNKNOWN


class SenderMessage(NamedTuple):
    """The facts that depend on sender and message id alone."""

    extra: bytes | None
    """The byte CRC_EXTRA of the definition; None if the dialect does not define the message."""
    known: Header | None
    """The header of a frame by this definition; None if its payload holds a target or a command."""
    other: Header
    """The header of a frame by another definition."""


OTHER_DEFINITION: Final = b"?"
"""Follows the key of a MAVLink 1 message whose payload lacks fields of the table's definition."""

sender_messages: Final[dict[bytes, SenderMessage]] = {}
"""By the header's bytes from system to message id, 5 in MAVLink 2 and 3 in MAVLink 1. The oldest first."""
targeted_headers: Final[dict[tuple[bytes, int, int, int | None], Header]] = {}
"""By the same bytes, target and command. The oldest first."""


def add_sender_message(key: bytes) -> SenderMessage:
    """Look up the facts that depend on sender and message id, and keep them in :data:`sender_messages`."""
    is_mavlink1 = len(key) < 5
    system, component = key[0], key[1]
    msgid = key[2] if is_mavlink1 else int.from_bytes(key[2:5], "little")
    definition = None if len(key) in (4, 6) else MESSAGES.get(msgid)
    extra = None if definition is None else bytes((definition[1],))
    other = Header(msgid, system, component, is_known=False, is_mavlink1=is_mavlink1)
    has_target = definition is None or definition[4] is not None or definition[6] is not None
    known = None if has_target else replace(other, is_known=True)
    if len(sender_messages) >= MAX_SENDER_MESSAGES:
        del sender_messages[next(iter(sender_messages))]
    message = sender_messages[key] = SenderMessage(extra, known, other)
    return message


def targeted_header(key: bytes, message: SenderMessage, payload: bytes) -> Header:
    """The header of a frame whose payload holds a target or a command."""
    like = message.other
    _, _, _, _, target_system_at, target_component_at, command_at = MESSAGES[like.msgid]
    length = len(payload)
    target_system = target_component = 0
    if target_system_at is not None and target_system_at < length:
        target_system = payload[target_system_at]
    if target_component_at is not None and target_component_at < length:
        target_component = payload[target_component_at]
    command: int | None = None
    if command_at is not None:
        # Little-endian: if the sender cut the payload within the command, the byte that is left is the low one.
        command = int.from_bytes(payload[command_at : command_at + 2], "little")
    facts = key, target_system, target_component, command
    header = targeted_headers.get(facts)
    if header is None:
        header = replace(
            like, target_system=target_system, target_component=target_component, command=command, is_known=True
        )
        if len(targeted_headers) >= MAX_TARGETED_HEADERS:
            del targeted_headers[next(iter(targeted_headers))]
        targeted_headers[facts] = header
    return header
