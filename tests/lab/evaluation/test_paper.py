"""Tags of the paper's protocol; the quick runs of evaluations show its exchanges."""

from __future__ import annotations

from uavlinkd.lab.evaluation import paper_protocol
from uavlinkd.lab.evaluation.ledger import numbered_frame


def test_data_is_opened_under_its_key_alone() -> None:
    frame = numbered_frame(1, 7)
    for number in (0, 2**16 - 1, 2**16, 2**20):
        datagram = paper_protocol.seal(b"k" * 32, number, frame)
        assert paper_protocol.unseal(b"k" * 32, datagram) == frame
        assert paper_protocol.unseal(b"j" * 32, datagram) is None
        for at in range(len(datagram)):
            altered = datagram[:at] + bytes((datagram[at] ^ 1,)) + datagram[at + 1 :]
            assert paper_protocol.unseal(b"k" * 32, altered) is None
