"""An attack on datagrams tries every position."""

from __future__ import annotations

from tests.lab.mitm.samples import AB, converse, sends
from uavlinkd.lab.mitm.attacks import parse_attack

CONVERSATION = converse()
ENVELOPE = CONVERSATION.envelopes()[5]


def test_bit_flip_goes_through_every_bit() -> None:
    """As many datagrams as there are bits: each bit is flipped once, alone."""
    bits = 8 * len(ENVELOPE)
    attack = parse_attack("bit-flip").make(CONVERSATION.context, 1)
    flipped = [sent.datagram for _ in range(bits) for sent in sends(attack.on_datagram(ENVELOPE, AB, 0.0))]
    differences = [int.from_bytes(ENVELOPE, "big") ^ int.from_bytes(datagram, "big") for datagram in flipped]
    assert sorted(differences) == [1 << n for n in range(bits)]
