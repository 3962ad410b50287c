"""Why the daemon drops a datagram, or an outgoing frame. Every reason has a name, a meaning and a counter."""

from __future__ import annotations

from enum import Enum, StrEnum
from typing import Self


class Attention(Enum):
    """When the log has a line about a reason."""

    SECURITY = "at once, with limits of its own: what only an attacker, a captured member or a wrong key causes"
    PROBLEM = "at once"
    EVERYDAY = "if it persists: a lost datagram, a rekey or a restarted peer causes a few"
    DESIGN = "once per start: the policy works as configured"
    EXPLAINED = "never: another event explains it, or several paths cause it all the time"


class Reason(StrEnum):
    """A closed list of reasons. A member is its name in logs, status and metrics, and has what people read."""

    meaning: str
    """One sentence that an operator understands, without a full stop."""
    phrase: str
    """In the screen of ``status``, behind a count: "12 altered or forged"."""
    attention: Attention

    def __new__(cls, name: str, meaning: str, phrase: str = "", attention: Attention = Attention.PROBLEM) -> Self:
        """A member is written as these."""
        member = str.__new__(cls, name)
        member._value_ = name
        member.meaning, member.phrase, member.attention = meaning, phrase, attention
        return member


class DropReason(Reason):
    """Why a datagram or a frame is dropped. README.md, section 13, has the order of the checks."""

    # Not our protocol.
    MALFORMED = (
        "malformed",
        "the length or type fits no message, or an index or counter has an invalid value",
        "malformed datagrams",
    )
    RAW_MAVLINK = (
        "raw_mavlink",
        "a bare MAVLink frame arrived at the port for peers: any sender could have sent it",
        "bare MAVLink frames",
    )

    # Along relays: section 21. The shell counts these.
    RELAY_MALFORMED = (
        "relay_malformed",
        "data along a relay has no handle, or contains no datagram of a session",
        "malformed along a relay",
    )
    RELAY_UNKNOWN_HANDLE = (
        "relay_unknown_handle",
        "data along a relay has a handle that is not assigned to its sender: it is old or forged",
        "of an unknown handle of a relay",
        Attention.EVERYDAY,
    )

    RELAY_OVER_LIMIT = (
        "relay_over_limit",
        "a member sends more along this relay than its limit allows",
        "above a member's limit",
    )
    RECORD_OVER_LIMIT = (
        "record_over_limit",
        "a member asks this relay for more, or more often, than it may",
        "with wishes above a member's limit",
    )
    UNEXPECTED_RECORD = (
        "unexpected_record",
        "an authentic record of a relay or a member has no effect: this daemon asked for nothing that it names, or"
        " may not act on it along this path",
        "with records that are not for this daemon",
        Attention.EVERYDAY,
    )
    OLD_RECORD = (
        "old_record",
        "an authentic record of a relay or a member is older than one that came before it",
        "with records older than others",
        Attention.EVERYDAY,
    )

    # Handshake.
    UNEXPECTED_RESPONSE = (
        "unexpected_response",
        "the response belongs to no pending initiation of this daemon",
        "unexpected responses",
        Attention.EVERYDAY,
    )
    BAD_MAC1 = (
        "bad_mac1",
        "the sender does not know this daemon's public key, or the message was altered",
        "handshakes for another key than this daemon's",
        Attention.SECURITY,
    )
    OTHER_VERSION = (
        "other_version",
        "the sender knows this daemon's public key, but uses another protocol version: update the older side",
        "handshakes of another protocol version",
    )
    COOKIE_REQUIRED = (
        "cookie_required",
        "the daemon is under load, or a peer initiates too often: it sent a cookie, which the sender must return",
        "handshakes that have to return a cookie",
        Attention.EVERYDAY,
    )
    RATE_LIMITED = (
        "rate_limited",
        "handshake messages or cookie replies exceed the limit of one source, or of all sources together",
        "handshakes above the rate limit",
        Attention.EVERYDAY,
    )
    REPLAYED_INITIATION = (
        "replayed_initiation",
        "the daemon read this initiation before, too long ago or too often for a copy along a slow path: an attacker"
        " replays it",
        "replayed handshakes",
        Attention.SECURITY,
    )
    WRONG_NETWORK = (
        "wrong_network",
        "the datagram is of a peer that is not at the other end of this line or other point-to-point network",
        "of a peer not at the other end of the line",
    )
    INVALID_KEY_SHARE = (
        "invalid_key_share",
        "the public value is outside its group, or leads to a secret that anyone knows",
        "invalid key shares",
        Attention.SECURITY,
    )
    BAD_HANDSHAKE = (
        "bad_handshake",
        "the Noise message does not authenticate: it was altered, or the sender uses another key or PSK",
        "handshakes with another key or PSK",
        Attention.SECURITY,
    )
    UNKNOWN_PEER = (
        "unknown_peer",
        "the initiation is authentic, but its static key is not configured",
        "handshakes with an unknown key",
        Attention.SECURITY,
    )
    BAD_CERTIFICATE = (
        "bad_certificate",
        "the authority of this fleet did not sign this certificate for this key",
        "handshakes with an invalid certificate",
        Attention.SECURITY,
    )
    CERTIFICATE_REVOKED = (
        "certificate_revoked",
        "the bulletin revokes this certificate, or this daemon's file denies its member",
        "handshakes with a revoked certificate",
        Attention.SECURITY,
    )
    MEMBER_CONFLICT = (
        "member_conflict",
        "the certificate has the name or a system id of this daemon, of a pinned peer or of another member",
        "handshakes of a member with the name or id of another",
        Attention.SECURITY,
    )
    ROLE_NOT_ACCEPTED = (
        "role_not_accepted",
        "the certificate is valid, but this daemon has no policy for a member of its role",
        "handshakes of members whose role has no policy here",
    )
    BULLETIN_AWAITED = (
        "bulletin_awaited",
        "this daemon waits for the newest bulletin before it accepts members by certificate",
        "handshakes before the newest bulletin arrived",
        Attention.EVERYDAY,
    )
    TOO_MANY_MEMBERS = (
        "too_many_members",
        "this daemon has as many members by certificate as it may",
        "handshakes above the number of members",
    )
    SUITE_NOT_ACCEPTED = (
        "suite_not_accepted",
        "the peer offers a suite that is not in its list",
        "handshakes with another suite",
    )
    HEADER_MISMATCH = (
        "header_mismatch",
        "the header in clear differs from the one sealed inside: it was altered",
        "altered handshakes",
        Attention.SECURITY,
    )
    BAD_PARAMETERS = (
        "bad_parameters",
        "the peer's parameters are outside the protocol",
        "invalid parameters",
        Attention.SECURITY,
    )
    GROUP_BUDGET_SPENT = (
        "group_budget_spent",
        "the handshake is authentic, but its group needs more CPU time than the sender may cause now",
        "handshakes above the CPU budget",
    )
    NO_FREE_INDEX = (
        "no_free_index",
        "every session index is in use or in quarantine",
        "without a free session index",
    )
    UNEXPECTED_COOKIE = (
        "unexpected_cookie",
        "the cookie belongs to no pending message, or the message has a cookie already",
        "unexpected cookies",
        Attention.EVERYDAY,
    )
    BAD_COOKIE = ("bad_cookie", "the cookie does not decrypt", "invalid cookies", Attention.SECURITY)

    # Envelopes.
    UNKNOWN_INDEX = (
        "unknown_index",
        "the envelope names a session that does not exist here: one side restarted, or the envelope is forged",
        "of an unknown session",
        Attention.EVERYDAY,
    )
    LATE = (
        "late",
        "the envelope belongs to a session that ended recently",
        "of an ended session",
        Attention.EVERYDAY,
    )
    OVER_SHARE = (
        "over_share",
        "the daemon is busy, and more datagrams wait than the share of their sender or kind",
        "above the sender's share",
        Attention.EVERYDAY,
    )
    TOO_LONG = ("too_long", "the envelope is longer than both ends agreed", "longer than agreed", Attention.SECURITY)
    SESSION_EXPIRED = (
        "session_expired",
        "the keys of the envelope are too old",
        "with expired keys",
        Attention.EVERYDAY,
    )
    LONG_COUNTER = (
        "long_counter",
        "the envelope has a small counter in the long form",
        "with an invalid counter form",
        Attention.SECURITY,
    )
    DUPLICATE = (
        "duplicate",
        "a copy of an envelope or initiation that had just arrived: peers send copies along several paths",
        "copies of earlier ones",
        Attention.EXPLAINED,
    )
    LATE_COPY = (
        "late_copy",
        "a copy of an older envelope came along a path of the peer, which is slow or was blocked",
        "late copies along slow paths",
        Attention.EXPLAINED,
    )
    REPLAYED = (
        "replayed",
        "an older envelope came again, along no proven path of the peer: a network held it back, or an attacker"
        " replays it",
        "replayed",
        Attention.EVERYDAY,
    )
    DELAYED = (
        "delayed",
        "the peer sent the envelope too long ago: a network held it back, or an attacker",
        "delayed on the path",
        Attention.EVERYDAY,
    )
    BAD_TAG = (
        "bad_tag",
        "the tag does not verify: the envelope was altered or forged",
        "altered or forged",
        Attention.SECURITY,
    )
    BAD_CONTROL = (
        "bad_control",
        "the envelope is authentic, but its control record is invalid",
        "invalid control records",
        Attention.SECURITY,
    )
    FRAMES_NOT_ALLOWED = (
        "frames_not_allowed",
        "a relay, or a member that is not a peer, sent frames",
        "with frames of a relay or a member",
        Attention.SECURITY,
    )
    UNEXPECTED_ANSWER = (
        "unexpected_answer",
        "the answer belongs to no question that waits, or came along another path than the question",
        "unexpected answers to probes",
        Attention.EVERYDAY,
    )
    DOUBTFUL = (
        "doubtful",
        "the peer did not confirm in time that the frames are new, after a silence or while freshness is unverified",
        "not confirmed as new in time",
        Attention.EVERYDAY,
    )

    # Outgoing frames.
    NO_SESSION = (
        "no_session",
        "outgoing frames have no session with the peer: the daemon does not keep them for later",
        "while the link was down",
        Attention.EXPLAINED,
    )
    TOO_LARGE = (
        "too_large",
        "an outgoing frame is larger than an envelope to the peer may be",
        "too large for an envelope",
    )


class LinkProblem(Reason):
    """What the daemon counts for a peer although it drops no datagram."""

    ENVELOPES_MISSING = "envelopes_missing", "envelopes did not arrive: the radio is bad, or an attacker drops them"
    ENVELOPES_OUT_OF_ORDER = (
        "envelopes_out_of_order",
        "envelopes with frames arrived after later ones: the network has several paths, or an attacker reorders them",
    )
    PATHS_UNPROVEN = (
        "paths_unproven",
        "envelopes of the peer came from an address that did not answer: its network changes, an attacker forwards"
        " them, or a second machine has its key",
        "addresses without an answer",
    )
    ECHOES_UNANSWERED = (
        "echoes_unanswered",
        "the peer did not answer echo requests: it restarts, does not receive them, or an attacker drops replies",
        "unanswered echo requests",
    )
    HANDSHAKES_UNANSWERED = (
        "handshakes_unanswered",
        "the daemon repeated handshakes while the peer was up: it restarts, the radio is bad, or an attacker drops"
        " them",
        "unanswered handshakes",
    )
    COOKIES_TAKEN = (
        "cookies_taken",
        "the peer asked for proof of this daemon's address: it is under load, or an attacker forges its replies",
        "cookies requested by the peer",
    )


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
