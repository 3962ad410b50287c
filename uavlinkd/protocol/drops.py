"""Why the daemon drops a datagram, or an outgoing frame. Every reason has a name, a meaning and a counter."""

from __future__ import annotations

import re
from enum import StrEnum
from typing import Any, Final, NamedTuple, Self


class Attention(StrEnum):
    """When the log has a line about a reason."""

    SECURITY = "security"
    """At once, with limits of its own: what only an attacker, a captured member or a wrong key causes."""
    PROBLEM = "problem"
    """At once."""
    EVERYDAY = "everyday"
    """If it persists: a lost datagram, a rekey or a restarted peer causes a few."""
    DESIGN = "design"
    """Once per start: the policy works as configured."""
    EXPLAINED = "explained"
    """Never: another event explains it, or several paths cause it all the time."""


_TABLE: Final = """
malformed | problem | malformed datagrams |
    the length or type fits no message, or an index or counter has an invalid value
raw_mavlink | problem | bare MAVLink frames |
    a bare MAVLink frame arrived at the port for peers: any sender could have sent it
relay_malformed | problem | malformed along a relay |
    data along a relay has no handle, or contains no datagram of a session
relay_unknown_handle | everyday | of an unknown handle of a relay |
    data along a relay has a handle that is not assigned to its sender: it is old or forged
relay_over_limit | problem | above a member's limit |
    a member sends more along this relay than its limit allows
record_over_limit | problem | with wishes above a member's limit |
    a member asks this relay for more, or more often, than it may
unexpected_record | everyday | with records that are not for this daemon |
    an authentic record of a relay or a member has no effect: this daemon asked for nothing that it names, or
    may not act on it along this path
old_record | everyday | with records older than others |
    an authentic record of a relay or a member is older than one that came before it
unexpected_response | everyday | unexpected responses |
    the response belongs to no pending initiation of this daemon
bad_mac1 | security | handshakes for another key than this daemon's |
    the sender does not know this daemon's public key, or the message was altered
other_version | problem | handshakes of another protocol version |
    the sender knows this daemon's public key, but uses another protocol version: update the older side
cookie_required | everyday | handshakes that have to return a cookie |
    the daemon is under load, or a peer initiates too often: it sent a cookie, which the sender must return
rate_limited | everyday | handshakes above the rate limit |
    handshake messages or cookie replies exceed the limit of one source, or of all sources together
replayed_initiation | security | replayed handshakes |
    the daemon read this initiation before, too long ago or too often for a copy along a slow path: an attacker
    replays it
wrong_network | problem | of a peer not at the other end of the line |
    the datagram is of a peer that is not at the other end of this line or other point-to-point network
invalid_key_share | security | invalid key shares |
    the public value is outside its group, or leads to a secret that anyone knows
bad_handshake | security | handshakes with another key or PSK |
    the Noise message does not authenticate: it was altered, or the sender uses another key or PSK
unknown_peer | security | handshakes with an unknown key |
    the initiation is authentic, but its static key is not configured
bad_certificate | security | handshakes with an invalid certificate |
    the authority of this fleet did not sign this certificate for this key
certificate_revoked | security | handshakes with a revoked certificate |
    the bulletin revokes this certificate, or this daemon's file denies its member
member_conflict | security | handshakes of a member with the name or id of another |
    the certificate has the name or a system id of this daemon, of a pinned peer or of another member
role_not_accepted | problem | handshakes of members whose role has no policy here |
    the certificate is valid, but this daemon has no policy for a member of its role
bulletin_awaited | everyday | handshakes before the newest bulletin arrived |
    this daemon waits for the newest bulletin before it accepts members by certificate
too_many_members | problem | handshakes above the number of members |
    this daemon has as many members by certificate as it may
suite_not_accepted | problem | handshakes with another suite |
    the peer offers a suite that is not in its list
header_mismatch | security | altered handshakes |
    the header in clear differs from the one sealed inside: it was altered
bad_parameters | security | invalid parameters |
    the peer's parameters are outside the protocol
group_budget_spent | problem | handshakes above the CPU budget |
    the handshake is authentic, but its group needs more CPU time than the sender may cause now
no_free_index | problem | without a free session index |
    every session index is in use or in quarantine
unexpected_cookie | everyday | unexpected cookies |
    the cookie belongs to no pending message, or the message has a cookie already
bad_cookie | security | invalid cookies |
    the cookie does not decrypt
unknown_index | everyday | of an unknown session |
    the envelope names a session that does not exist here: one side restarted, or the envelope is forged
late | everyday | of an ended session |
    the envelope belongs to a session that ended recently
over_share | everyday | above the sender's share |
    the daemon is busy, and more datagrams wait than the share of their sender or kind
too_long | security | longer than agreed |
    the envelope is longer than both ends agreed
session_expired | everyday | with expired keys |
    the keys of the envelope are too old
long_counter | security | with an invalid counter form |
    the envelope has a small counter in the long form
duplicate | explained | copies of earlier ones |
    a copy of an envelope or initiation that had just arrived: peers send copies along several paths
late_copy | explained | late copies along slow paths |
    a copy of an older envelope came along a path of the peer, which is slow or was blocked
replayed | everyday | replayed |
    an older envelope came again, along no proven path of the peer: a network held it back, or an attacker
    replays it
delayed | everyday | delayed on the path |
    the peer sent the envelope too long ago: a network held it back, or an attacker
bad_tag | security | altered or forged |
    the tag does not verify: the envelope was altered or forged
bad_control | security | invalid control records |
    the envelope is authentic, but its control record is invalid
frames_not_allowed | security | with frames of a relay or a member |
    a relay, or a member that is not a peer, sent frames
unexpected_answer | everyday | unexpected answers to probes |
    the answer belongs to no question that waits, or came along another path than the question
doubtful | everyday | not confirmed as new in time |
    the peer did not confirm in time that the frames are new, after a silence or while freshness is unverified
no_session | explained | while the link was down |
    outgoing frames have no session with the peer: the daemon does not keep them for later
too_large | problem | too large for an envelope |
    an outgoing frame is larger than an envelope to the peer may be
envelopes_missing | problem | |
    envelopes did not arrive: the radio is bad, or an attacker drops them
envelopes_out_of_order | problem | |
    envelopes with frames arrived after later ones: the network has several paths, or an attacker reorders them
paths_unproven | problem | addresses without an answer |
    envelopes of the peer came from an address that did not answer: its network changes, an attacker forwards
    them, or a second machine has its key
echoes_unanswered | problem | unanswered echo requests |
    the peer did not answer echo requests: it restarts, does not receive them, or an attacker drops replies
handshakes_unanswered | problem | unanswered handshakes |
    the daemon repeated handshakes while the peer was up: it restarts, the radio is bad, or an attacker drops
    them
cookies_taken | problem | cookies requested by the peer |
    the peer asked for proof of this daemon's address: it is under load, or an attacker forges its replies
"""


class ReasonText(NamedTuple):
    """What people read about a reason."""

    meaning: str
    """One sentence that an operator understands, without a full stop."""
    phrase: str = ""
    """In the screen of ``status``, behind a count: "12 altered or forged"."""
    attention: Attention = Attention.PROBLEM


def _parsed(row: str) -> tuple[str, ReasonText]:
    name, attention, phrase, meaning = (" ".join(cell.split()) for cell in row.split("|"))
    return name, ReasonText(meaning, phrase, Attention(attention))


_TEXTS: Final = dict(map(_parsed, re.split(r"\n(?=\S)", _TABLE.strip())))


class Reason(StrEnum):
    """A closed list of reasons. A member is its name in logs, status and metrics, and has what people read."""

    meaning: str
    phrase: str
    attention: Attention

    def __new__(cls, name: str, *texts: Any) -> Self:
        """A member is its name with the fields of :class:`ReasonText`, or its name alone if the table has them."""
        member = str.__new__(cls, name)
        member._value_ = name
        member.meaning, member.phrase, member.attention = ReasonText(*texts) if texts else _TEXTS[name]
        return member


class DropReason(Reason):
    """Why a datagram or a frame is dropped. README.md, section 13, has the order of the checks."""

    # Not our protocol.
    MALFORMED = "malformed"
    RAW_MAVLINK = "raw_mavlink"

    # Along relays: section 21. The shell counts these.
    RELAY_MALFORMED = "relay_malformed"
    RELAY_UNKNOWN_HANDLE = "relay_unknown_handle"
    RELAY_OVER_LIMIT = "relay_over_limit"
    RECORD_OVER_LIMIT = "record_over_limit"
    UNEXPECTED_RECORD = "unexpected_record"
    OLD_RECORD = "old_record"

    # Handshake.
    UNEXPECTED_RESPONSE = "unexpected_response"
    BAD_MAC1 = "bad_mac1"
    OTHER_VERSION = "other_version"
    COOKIE_REQUIRED = "cookie_required"
    RATE_LIMITED = "rate_limited"
    REPLAYED_INITIATION = "replayed_initiation"
    WRONG_NETWORK = "wrong_network"
    INVALID_KEY_SHARE = "invalid_key_share"
    BAD_HANDSHAKE = "bad_handshake"
    UNKNOWN_PEER = "unknown_peer"
    BAD_CERTIFICATE = "bad_certificate"
    CERTIFICATE_REVOKED = "certificate_revoked"
    MEMBER_CONFLICT = "member_conflict"
    ROLE_NOT_ACCEPTED = "role_not_accepted"
    BULLETIN_AWAITED = "bulletin_awaited"
    TOO_MANY_MEMBERS = "too_many_members"
    SUITE_NOT_ACCEPTED = "suite_not_accepted"
    HEADER_MISMATCH = "header_mismatch"
    BAD_PARAMETERS = "bad_parameters"
    GROUP_BUDGET_SPENT = "group_budget_spent"
    NO_FREE_INDEX = "no_free_index"
    UNEXPECTED_COOKIE = "unexpected_cookie"
    BAD_COOKIE = "bad_cookie"

    # Envelopes.
    UNKNOWN_INDEX = "unknown_index"
    LATE = "late"
    OVER_SHARE = "over_share"
    TOO_LONG = "too_long"
    SESSION_EXPIRED = "session_expired"
    LONG_COUNTER = "long_counter"
    DUPLICATE = "duplicate"
    LATE_COPY = "late_copy"
    REPLAYED = "replayed"
    DELAYED = "delayed"
    BAD_TAG = "bad_tag"
    BAD_CONTROL = "bad_control"
    FRAMES_NOT_ALLOWED = "frames_not_allowed"
    UNEXPECTED_ANSWER = "unexpected_answer"
    DOUBTFUL = "doubtful"

    # Outgoing frames.
    NO_SESSION = "no_session"
    TOO_LARGE = "too_large"


class LinkProblem(Reason):
    """What the daemon counts for a peer although it drops no datagram."""

    ENVELOPES_MISSING = "envelopes_missing"
    ENVELOPES_OUT_OF_ORDER = "envelopes_out_of_order"
    PATHS_UNPROVEN = "paths_unproven"
    ECHOES_UNANSWERED = "echoes_unanswered"
    HANDSHAKES_UNANSWERED = "handshakes_unanswered"
    COOKIES_TAKEN = "cookies_taken"


Detail = bytes | str | int
"""A fact about a dropped datagram; an empty string without one."""


class Drop(Exception):  # noqa: N818  not an error of ours: the ordinary fate of a bad datagram
    """Raised inside the core for a bad datagram. ``Node.receive`` catches it, counts it and raises nothing."""

    def __init__(self, reason: DropReason, detail: Detail = "") -> None:
        super().__init__(reason)
        self.reason = reason
        self.detail = detail
        """The public key of the sender (bytes), the name of the suite that the peer offered or of the member in its
        certificate (str), or the version of the protocol that the sender speaks (int).

        The log formats it when it writes a line, not for each drop.
        """
