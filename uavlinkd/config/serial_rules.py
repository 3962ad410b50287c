"""Rules about serial networks: ``[[network]]`` with ``serial``, and the peer at the other end."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from uavlinkd.config.model import PeerAddress
from uavlinkd.config.problems import Problems, Values
from uavlinkd.endpoints.url import SerialUrl

USUAL_BAUD: Final = 57600
"""The baud rate of SiK modems as they are sold."""
USUAL_AIR_BITS_S: Final = 24_000
"""What such a modem carries by radio, in both directions together, beside its own overhead and turn-around times."""
SLOW_LINE_SHARE: Final = 0.4
"""Of the baud rate of a slower line: what is assumed that its radio carries."""
SENDING_SHARE: Final = 0.4
"""The part of the radio's rate that each end uses. The rest is for collisions, turn-around times and noise."""
_OTHER_EXITS: Final = ("interface", "address")
_BITS_PER_BYTE: Final = 10
"""On a wire, with start and stop bit."""


def default_air_bits_s(line: SerialUrl) -> int | None:
    """What a radio behind a line is assumed to carry; None if the file must say."""
    if line.baud == USUAL_BAUD:
        return USUAL_AIR_BITS_S
    return int(SLOW_LINE_SHARE * line.baud) if line.baud < USUAL_BAUD else None


def air_bits_s(section: Values) -> int:
    """What the radio of a valid section carries; 0 of a section without one."""
    line: SerialUrl | None = section.valid.get("serial")
    written: int | None = section.valid.get("air_bits_s")
    return 0 if line is None else written or default_air_bits_s(line) or 0


def serial_network(problems: Problems, section: Values) -> None:
    """The keys of one ``[[network]]`` that concern a serial device."""
    line: SerialUrl | None = section.valid.get("serial")
    key = section.place.key
    if line is None:
        if "air_bits_s" in section.valid and "serial" not in section.invalid:
            problems.add(
                key("air_bits_s"),
                'is for a radio behind a serial device: write serial = "/dev/ttyUSB0:57600" too, or budget_bits_s'
                " instead",
            )
        return
    for other in _OTHER_EXITS:
        if other in section.valid:
            problems.add(
                key("serial"), f"and {other} are both written, but a network has one exit: write two networks"
            )
    if section.valid.get("metered"):
        problems.add(key("metered"), "is for networks that cost money, and this is a serial line: leave it out")
    if section.valid.get("budget_bits_s"):
        problems.add(
            key("budget_bits_s"),
            f"does not go with serial: write air_bits_s, of which this end sends {SENDING_SHARE:.0%}",
        )
    if "air_bits_s" in section.invalid:
        return
    if not (air := air_bits_s(section)):
        problems.add(
            key("air_bits_s"),
            f"is missing: at {line.baud} baud the line does not show what the radio carries. Write the bits per"
            f" second of both directions together, about half of the modem's air rate, such as {USUAL_AIR_BITS_S}",
        )
    elif SENDING_SHARE * air / 8 > line.baud / _BITS_PER_BYTE:
        problems.add(
            key("air_bits_s"), f"is more than a line of {line.baud} baud carries: write less, or raise the baud rate"
        )


def devices(problems: Problems, sections: Iterable[Values], endpoints: Iterable[Values]) -> None:
    """A device has one user: a network or an endpoint."""
    users: dict[str, str] = {}
    for endpoint in endpoints:
        if isinstance(url := endpoint.valid.get("url"), SerialUrl):
            users.setdefault(url.device, endpoint.place.key(""))
    for section in sections:
        line: SerialUrl | None = section.valid.get("serial")
        if line is None:
            continue
        if line.device in users:
            problems.add(
                section.place.key("serial"),
                f"names {line.device}, the device of {users[line.device]} too, and only one can open it: write"
                " another",
            )
        users.setdefault(line.device, section.place.key(""))


def other_ends(problems: Problems, sections: Sequence[Values], peers: Iterable[Values]) -> None:
    """Each serial network has one peer, which names it without an address."""
    serial = {section.valid["name"] for section in sections if "serial" in section.valid}
    users: dict[str, Values] = {}
    complete = True
    for peer in peers:
        complete &= "addresses" not in peer.invalid
        for written in peer.valid.get("addresses", ()):
            key = peer.place.key("addresses")
            for message in _wrong(written, serial):
                problems.add(key, message)
            if not written.is_serial or written.network not in serial:
                continue
            other = users.setdefault(written.network, peer)
            if other is not peer:
                problems.add(
                    key,
                    f'names the serial network "{written.network}", whose other end is {other.place.key("")}: a line'
                    " has one peer; write it for one of them",
                )
    for section in sections:
        name = section.valid["name"]
        if complete and name in serial - set(users):
            problems.add(
                section.place.key("serial"),
                f'has no peer at its other end: write addresses = [{{ network = "{name}" }}] in its [[peer]]',
            )


def _wrong(written: PeerAddress, serial: set[str]) -> Iterator[str]:
    if written.is_serial and written.network not in serial:
        names = " or ".join(f'"{name}"' for name in sorted(serial))
        yield (
            f'names "{written.network}" without an address, which only a serial network may have: write'
            f' {{ address = "10.13.0.2:5790", network = "{written.network}" }}'
            + (f", or the serial network {names}" if names else "")
        )
    elif written.network in serial and not written.is_serial:
        yield (
            f'names {written.address} on "{written.network}", a serial network, which has no addresses: write'
            f' {{ network = "{written.network}" }}'
        )
