"""An attacker without keys recognises refusal reports in the clear, and attacks nothing else."""

from __future__ import annotations

import pytest

from tests.core.harness import Pair, datagrams, only, quiet
from tests.lab.mitm.samples import AB, Conversation, converse, sends
from uavlinkd.core import constants as c
from uavlinkd.core.refusals import Refused
from uavlinkd.core.wire import TAG_LENGTHS
from uavlinkd.lab.mitm.anatomy import is_refusal_report
from uavlinkd.lab.mitm.attacks import parse_attack


def report(tag_bytes: int = 16, entries: int = 3, *, confidential: bool = False) -> bytes:
    """A genuine report."""
    link = quiet(tag_bytes=tag_bytes, confidential=confidential)
    pair = Pair(link_a=link, link_b=link).establish()
    refused = [Refused(76, 400 + number, 4, 1) for number in range(entries)]
    return only(datagrams(pair.b.node.report_refusals(pair.b.peer, refused, 1.0)))


@pytest.mark.parametrize("tag_bytes", TAG_LENGTHS)
@pytest.mark.parametrize("entries", [1, c.REFUSALS_PER_REPORT])
def test_reports_are_recognised(tag_bytes: int, entries: int) -> None:
    """With every tag, from the smallest to the largest."""
    assert is_refusal_report(report(tag_bytes, entries))


@pytest.mark.parametrize("conversation", [converse(), converse(confidential=True)], ids=["clear", "confidential"])
def test_nothing_else_is_a_report(conversation: Conversation) -> None:
    """No other datagram of a conversation, and no truncated report."""
    assert not any(is_refusal_report(datagram) for datagram, _ in conversation.said)
    assert not is_refusal_report(b"")
    assert not is_refusal_report(report()[:-1])


def test_only_reports_are_altered() -> None:
    """``kinds=report`` passes all other datagrams as they are."""
    attack = parse_attack("bit-flip,kinds=report").make(converse().context, 1)
    genuine = report()
    for datagram in (converse().envelopes()[3], converse().initiation):
        assert [sent.datagram for sent in sends(attack.on_datagram(datagram, AB, 0.0))] == [datagram]
    (altered,) = sends(attack.on_datagram(genuine, AB, 0.0))
    assert altered.datagram != genuine
    assert len(altered.datagram) == len(genuine)
