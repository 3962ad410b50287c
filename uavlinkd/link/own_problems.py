"""What this daemon tells its peers about itself, and what they say about themselves: codes of problem reports."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, NamedTuple

from uavlinkd.core import constants as c
from uavlinkd.core.peer import Peer
from uavlinkd.link.facts import Found, fault, warning
from uavlinkd.ops.findings import Finding, Subject


class ReportedProblem(NamedTuple):
    """A problem of a daemon that matters to its peers."""

    name: str
    """In ``status --json`` and in the metric."""
    meaning: str
    causes: frozenset[str] = frozenset()
    """The findings about an endpoint or the daemon that mean it."""


CUT_OFF: Final = 2
NO_CLIENT: Final = 3
PROBLEMS: Final = {
    1: ReportedProblem(
        "all_refused", "its policy refuses all frames of a client", frozenset({"all_refused", "foreign_system"})
    ),
    CUT_OFF: ReportedProblem("cut_off", "no endpoint has a client"),
    NO_CLIENT: ReportedProblem(
        "no_client", "an endpoint has no client", frozenset({"no_client", "client_unreachable"})
    ),
    4: ReportedProblem("client_silent", "a client sends no MAVLink", frozenset({"client_silent"})),
    5: ReportedProblem("device_unavailable", "a serial device cannot be opened", frozenset({"device_unavailable"})),
    6: ReportedProblem("garbage", "bytes that are not MAVLink arrive at an endpoint", frozenset({"garbage"})),
    7: ReportedProblem(
        "network_absent", "a network is absent", frozenset({"network_absent", "listen_address_missing"})
    ),
    8: ReportedProblem(
        "radio_disturbed", "a radio's line is disturbed", frozenset({"line_noise", "modem_reports", "radio_slow"})
    ),
    9: ReportedProblem("daemon_paused", "its process was paused", frozenset({"daemon_paused"})),
    11: ReportedProblem(
        "key_twice", "two machines use one private key", frozenset({"key_on_two_machines", "own_key_elsewhere"})
    ),
}
"""By code, the most important first. README.md of the core has the same table."""
_STOPS_FRAMES: Final = frozenset({1, CUT_OFF})


def own_codes(findings: Iterable[Finding], *, is_cut_off: bool) -> list[int]:
    """The codes for this daemon's own findings: not those about peers. ``is_cut_off``: no endpoint has a client."""
    causes = {finding.cause for finding in findings if finding.subject is not Subject.PEER}
    if is_cut_off:  # it says the same of every endpoint
        causes -= PROBLEMS[NO_CLIENT].causes
    return [code for code, problem in PROBLEMS.items() if problem.causes & causes or (is_cut_off and code == CUT_OFF)]


def codes_there(peer: Peer, now: float) -> tuple[int, ...]:
    """What a peer says about itself now: nothing if it is not up, or did not repeat it."""
    claim = peer.problem_claim
    return claim.codes if peer.is_up and now - claim.received_at <= c.PROBLEMS_LAST_S else ()


def stops_frames(peer: Peer, now: float) -> bool:
    """Whether a peer says that frames stop there."""
    return not _STOPS_FRAMES.isdisjoint(codes_there(peer, now))


def name_of_problem(code: int) -> str:
    """Its name; a number for one that only a newer version knows."""
    return PROBLEMS[code].name if code in PROBLEMS else f"problem_{code}"


def problems_there(codes: Iterable[int]) -> Found:
    """The finding for the codes of a peer."""
    meanings = [PROBLEMS[code].meaning if code in PROBLEMS else f"problem {code}" for code in codes]
    fault_if_stopped = fault if _STOPS_FRAMES.intersection(codes) else warning
    return fault_if_stopped(
        "problems_there", f"it says about itself: {'; '.join(meanings)}", "run `uavlinkd status` there"
    )
