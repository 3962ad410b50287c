"""Why a datagram, or a frame on its way out, was discarded. Every reason has a name and a counter."""

from __future__ import annotations

from enum import StrEnum


class DropReason(StrEnum):
    """The closed list of reasons. The value is the name in logs, status and metrics."""

    # Not our protocol.
    MALFORMED = "malformed"
    """Length or type fits no message."""
    RAW_MAVLINK = "raw_mavlink"
    """A bare MAVLink frame at the peers' port."""

    # Handshake. The order of the checks is in README.md, section 13.
    UNEXPECTED_RESPONSE = "unexpected_response"
    """A response to no initiation of ours that still waits."""
    BAD_MAC1 = "bad_mac1"
    """The sender does not know our public key, or the datagram was altered."""
    COOKIE_REQUIRED = "cookie_required"
    """Under load, or one peer's initiations come too fast; without a valid cookie: one was sent back."""
    RATE_LIMITED = "rate_limited"
    """Under load: this source, or all sources together, have had their share of work or of cookie replies."""
    REPLAYED_INITIATION = "replayed_initiation"
    """An initiation that was read before, whether it was answered or not."""
    INVALID_KEY_SHARE = "invalid_key_share"
    """A public value outside its group, or one that gives a secret anybody knows."""
    BAD_HANDSHAKE = "bad_handshake"
    """The Noise message does not authenticate: altered, or made with other keys or another PSK."""
    UNKNOWN_PEER = "unknown_peer"
    """A sound initiation under a static key that is not configured."""
    SUITE_NOT_ACCEPTED = "suite_not_accepted"
    """The peer offered a suite that this configuration does not list."""
    HEADER_MISMATCH = "header_mismatch"
    """The header in clear differs from the one that the peer sealed inside."""
    BAD_PARAMETERS = "bad_parameters"
    """The peer's parameters are outside the protocol."""
    GROUP_BUDGET_SPENT = "group_budget_spent"
    """An authentic handshake whose group arithmetic would take more CPU time than its sender may cause now."""
    NO_FREE_INDEX = "no_free_index"
    """Every session index is in use or in quarantine."""
    UNEXPECTED_COOKIE = "unexpected_cookie"
    """A cookie for no message of ours that still waits."""
    BAD_COOKIE = "bad_cookie"
    """A cookie that does not open."""

    # Envelopes.
    UNKNOWN_INDEX = "unknown_index"
    """An envelope for a session that is not here: this side restarted, or it was never ours."""
    LATE = "late"
    """An envelope for a session that ended here lately."""
    OVER_SHARE = "over_share"
    """This daemon is busy, and the sender has more waiting than its share: dropped unread."""
    TOO_LONG = "too_long"
    """The envelope is longer than the two ends agreed."""
    SESSION_EXPIRED = "session_expired"
    """An envelope under keys that are too old."""
    LONG_COUNTER = "long_counter"
    """A small counter written in the long form."""
    REPLAYED = "replayed"
    """The counter was accepted before."""
    TOO_OLD = "too_old"
    """The counter is behind the replay window."""
    DELAYED = "delayed"
    """Held back on the way: the peer sent it longer ago than anything may take to arrive."""
    BAD_TAG = "bad_tag"
    """The envelope was altered or forged."""
    BAD_CONTROL = "bad_control"
    """An authentic envelope with a control record that is not one."""
    BAD_PATH_RESPONSE = "bad_path_response"
    """An answer to no path challenge, or from another path than the challenged."""
    DOUBTFUL = "doubtful"
    """Frames after a silence, or such as must be new, and the peer did not say in time that they are."""

    # On the way out.
    NO_SESSION = "no_session"
    """Frames for a peer with which there are no keys now. Nothing is kept for later."""
    TOO_LARGE = "too_large"
    """A frame larger than an envelope to this peer may be."""


class Drop(Exception):  # noqa: N818  not an error of ours: the ordinary fate of a bad datagram
    """Raised inside the core where a datagram turns out to be bad. ``Node.receive`` counts it and raises nothing."""

    def __init__(self, reason: DropReason, detail: str = "") -> None:
        super().__init__(reason)
        self.reason = reason
        self.peer = ""
        """The name of the peer that authentically sent it, where one did."""
        self.detail = detail
        """For people: which key was unknown, which suite was offered."""
