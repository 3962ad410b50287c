"""Reasons in plain words, for a count in front: "12 altered or forged". The codes are in ``status --json``.

The tables are by the place of the count, because two places may use the same code.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping
from typing import Final

DATAGRAMS: Final[Mapping[str, str]] = {
    "malformed": "malformed datagrams",
    "raw_mavlink": "bare MAVLink frames",
    "unexpected_response": "unexpected responses",
    "bad_mac1": "handshakes for another key than this daemon's",
    "other_version": "handshakes of another protocol version",
    "cookie_required": "handshakes that have to return a cookie",
    "rate_limited": "handshakes above the rate limit",
    "replayed_initiation": "replayed handshakes",
    "wrong_network": "of a peer not at the other end of the line",
    "invalid_key_share": "invalid key shares",
    "bad_handshake": "handshakes with another key or PSK",
    "unknown_peer": "handshakes with an unknown key",
    "suite_not_accepted": "handshakes with another suite",
    "header_mismatch": "altered handshakes",
    "bad_parameters": "invalid parameters",
    "group_budget_spent": "handshakes above the CPU budget",
    "no_free_index": "without a free session index",
    "unexpected_cookie": "unexpected cookies",
    "bad_cookie": "invalid cookies",
    "unknown_index": "of an unknown session",
    "late": "of an ended session",
    "over_share": "above the sender's share",
    "too_long": "longer than agreed",
    "session_expired": "with expired keys",
    "long_counter": "with an invalid counter form",
    "duplicate": "copies along other paths",
    "late_copy": "late copies along slow paths",
    "replayed": "replayed",
    "delayed": "delayed on the path",
    "bad_tag": "altered or forged",
    "bad_control": "invalid control records",
    "unexpected_answer": "unexpected answers to probes",
    "doubtful": "not confirmed as new in time",
    "no_session": "while the link was down",
    "too_large": "too large for an envelope",
    "frames_not_allowed": "with frames of a relay or a member",
    "relay_malformed": "malformed along a relay",
    "relay_unknown_handle": "of an unknown handle of a relay",
    "relay_unexpected_token": "with tokens that no relay was asked for",
    "relay_over_limit": "above a member's limit",
    "record_over_limit": "with wishes above a member's limit",
    "unexpected_record": "with records that are not for this daemon",
    "old_record": "with records older than others",
    "relay_over_total": "above the limit of all members together",
}
"""Of dropped datagrams and outgoing frames (``DropReason``)."""

REFUSALS: Final[Mapping[str, str]] = {
    "foreign_system": "from a system not in system_ids",
    "message_not_allowed": "not allowed by role or lists",
    "unknown_message": "unknown to the dialect",
    "command_not_allowed": "commands not allowed by role or lists",
    "file_write_not_allowed": "file writes",
    "setup_signing": "with a signing key (SETUP_SIGNING)",
    "mavlink1_not_allowed": "MAVLink 1 frames",
    "ground_station_not_allowed": "heartbeats of a ground station",
    "rate_limited": "above the rate limit",
    "hidden_frame": "that hide a forbidden frame",
}
"""Of frames that a policy refused (``Refusal``)."""

LINK_PROBLEMS: Final[Mapping[str, str]] = {
    "envelopes_out_of_order": "out of order",
    "paths_unproven": "addresses without an answer",
    "echoes_unanswered": "unanswered echo requests",
    "handshakes_unanswered": "unanswered handshakes",
    "cookies_taken": "cookies requested by the peer",
}
"""Of problems of a link that no drop explains (``LinkProblem``); missing envelopes are in the column of losses."""

QUEUED: Final[Mapping[str, str]] = {
    "stale": "waited too long",
    "thinned": "replaced by newer ones",
    "overflow": "above the queue's limit",
    "closed": "waiting when the link ended",
}
"""Of frames that waited for the budget of a peer (``EgressDrop``)."""

FAULTS: Final[Mapping[str, str]] = {
    "not_mavlink": "not MAVLink",
    "bad_crc": "wrong checksums",
    "unknown_flags": "unknown flags",
    "truncated": "truncated frames",
}
"""Of bytes that are not a frame (``FrameFault``)."""

ENDPOINT_FAILURES: Final[Mapping[str, str]] = {
    "unsent": "unsent frames",
    "outgoing_full": "frames above the queue's limit",
    "stale": "frames that waited too long",
    "thinned": "frames replaced by newer ones",
    "disconnected": "disconnected",
    "stalled": "stalled connections",
    "too_many_clients": "clients above the limit",
    "displaced": "silent clients replaced",
    "http": "web browsers",
    "connect_timeout": "attempts without an answer",
    "not_resolved": "attempts without an address",
    "family_unavailable": "addresses of an unavailable family",
    "stranger": "datagrams of another address",
}
"""Of errors of an endpoint that the daemon names itself; the others are names of the kernel."""


def phrase(code: str, words: Mapping[str, str]) -> str:
    """A reason in plain words; an error of the kernel in the system's words."""
    if code in words:
        return words[code]
    number = {name: number for number, name in errno.errorcode.items()}.get(code)
    return code.replace("_", " ") if number is None else os.strerror(number).lower()
