"""Bytes on the line of a serial network: datagrams, reports of the modem, noise, cut anywhere."""

from __future__ import annotations

from typing import Final

from tests.fuzz.engine import Run, Script
from tests.serial.test_line_framing import counts, report
from uavlinkd.serial.line_framing import DELIMITER, MAX_ENCODED, LineDecoder, encode

LONGEST_REPORT: Final = 21


def _report(script: Script) -> bytes:
    """A modem's report with any figures, in MAVLink 1 or 2."""
    return report(1 + (script.byte() & 1), payload=script.take(9).ljust(9, b"\0"))


def _stream(script: Script) -> bytes:
    parts = []
    while script:
        how = script.byte()
        match how & 7:
            case 0:
                parts.append(script.take(1 + (script.byte() & 31)))
            case 1:
                parts.append(bytes((script.byte(),)) * (script.byte() * (1 + (how >> 4))))
            case 2:
                parts.append(_report(script))
            case 3:
                line, report = encode(script.take(script.byte())), _report(script)
                at = script.byte() % (len(line) + 1)
                parts.append(line[:at] + report + line[at:])
            case 4:
                damaged = bytearray(encode(script.take(script.byte())))
                damaged[script.byte() % len(damaged)] ^= 1 << (how >> 5)
                parts.append(bytes(damaged))
            case _:
                parts.append(encode(script.take(script.byte()) * (1 + (how >> 6))))
    return b"".join(parts)


def make() -> Run:
    """Any cuts give the same datagrams; memory is bounded; whole datagrams after the noise arrive."""

    def run(data: bytes) -> None:
        cuts, stream = data[:8], _stream(Script(data[8:]))
        decoder, datagrams = LineDecoder(), []
        at, number = 0, 0
        while at < len(stream):
            size = 1 + (cuts[number % len(cuts)] if cuts else 64)
            datagrams += decoder.feed(stream[at : at + size])
            assert decoder.pending_bytes <= MAX_ENCODED + LONGEST_REPORT + 1, "more is held than a datagram"
            at, number = at + size, number + 1
        whole = LineDecoder()
        assert whole.feed(stream) == datagrams, "the cuts change what is received"
        assert counts(whole) == counts(decoder), "the cuts change what is counted"
        for datagram in datagrams:
            again = LineDecoder()
            assert again.feed(encode(datagram)) == [datagram], "a datagram that is not encoded like this"
        later = [b"first", bytes(range(200))]
        tail = decoder.feed(DELIMITER * (LONGEST_REPORT + 1) + b"".join(map(encode, later)))
        assert tail[-2:] == later, "the stream is not in step again"

    return run
