"""The numbers of the protocol: first those that both ends must share, then our own.

Durations are seconds on a monotonic clock. Timers that a configuration may change are in
:class:`uavlinkd.protocol.settings.Timers`; their defaults are here.
"""

from __future__ import annotations

import math
from typing import NamedTuple

NEVER = math.inf
"""A moment that does not come."""


class Rate(NamedTuple):
    """So many a second on average, and ``burst`` at once after a quiet while."""

    per_s: float
    burst: int


# Specification constants. Changing one makes another protocol.

PROTOCOL_VERSION = 2
"""A change of the wire or of a label makes another version. Versions do not interoperate."""
PROTOCOL_NAME = b"uavlink/%d" % PROTOCOL_VERSION
"""First part of the prologue and of every key label; the suite byte follows in the prologue."""
LAST_KNOWN_VERSION = 8
"""Every version up to this one has labels of this form, so that each version can name the others."""

KEY_BYTES = 32
"""An X25519 key, a PSK, a ChaCha20-Poly1305 key, a SHA-256 hash."""
AEAD_TAG_BYTES = 16
"""Poly1305 (RFC 8439, section 2.5)."""
MAC_BYTES = 16
"""mac1, mac2 and a cookie."""
COOKIE_NONCE_BYTES = 16
"""Random for each cookie reply: its key is derived from it, so it must not repeat."""
QUESTION_BYTES = 4
"""A question of a probe is unpredictable, and is answered inside an authentic envelope."""

SESSION_ENVELOPE_LIMIT = 2**32 - 1
"""Envelopes that a session may seal in each direction. The counter after the last one fits an echo's 32 bits."""
SHORT_COUNTER_LIMIT = 2**16
"""Counters below this travel in two bytes, others in four; the other form is refused."""
FEATURE_REFUSALS = 1
"""Both ends must set this bit of the parameters' features for refusal reports."""
FEATURE_RECORDS = 2
"""Both ends must set this bit for the records between a member and its relay."""
FEATURE_PROBLEMS = 4
"""Both ends must set this bit for problem reports."""
FEATURE_FLEET = 8
"""Both ends must set this bit for the records about the certificates of a fleet."""
KNOWN_FEATURES = FEATURE_REFUSALS | FEATURE_RECORDS | FEATURE_PROBLEMS | FEATURE_FLEET
REFUSALS_PER_REPORT = 16
"""Entries of a refusal report at most: with 161 bytes it fits the smallest envelope."""
PROBLEMS_PER_REPORT = 8
"""Codes of a problem report at most."""

LATE_AFTER_S = 2.0
"""A frame older than this is refused if the receiver can see it, else asked about: both ends must use one value."""

# Implementation constants. Ours; changing one does not change the wire.

REKEY_AFTER_ENVELOPES = 2**31
"""Half of what a session may carry: the other half is room for a handshake that has to be retried."""
REKEY_AFTER_S = 120.0
"""Age at which new keys are made (WireGuard's REKEY_AFTER_TIME)."""
REJECT_AFTER_S = 180.0
"""Age at which a session's keys are dropped (WireGuard's REJECT_AFTER_TIME): a minute of retries fits in between."""
RESPONDER_REKEY_SHARE = 0.25
"""The responder rekeys this share of (reject - rekey) after its initiator, so that one side rekeys, not both."""

RETRY_MIN_S = 0.25
"""The first wait for a response: several tries fit into the 5 s of ArduPilot's ground-station failsafe."""
RETRIES_PER_WAIT = 12
"""Tries before the wait doubles: at 30 % loss in each direction, two dozen in the first 10 s fail once in 10^7."""
RETRY_MAX_S = 1.5
"""The longest wait between tries, which never end: with the jitter a link is back within 2 s of any outage."""
TRY_AIRTIMES = 4
"""Tries along a network with a budget are so many airtimes of an initiation and its response apart."""
RETRY_JITTER = 0.25
"""Each wait is longer by up to this share, so that two ends do not stay in step."""
KEEPALIVE_S = 10.0
"""An idle end asks for an echo this often: it keeps a NAT's mapping alive and measures the round trip."""
ECHO_AFTER_S = 0.5
"""A peer that is silent for this long since something was sent is asked for an echo."""
HANDSHAKE_AFTER_S = 1.0
"""A peer that is silent for this long may have restarted: the node initiates too."""
LOST_AFTER_S = 3.0
"""A peer that is silent for this long is lost: inside every autopilot's failsafe."""
ECHO_ROUND_TRIPS = 2
"""The wait before an echo has at least so many round trips of the best path."""
HANDSHAKE_ROUND_TRIPS = 4
"""The wait before an initiation has at least so many round trips."""
LOST_ROUND_TRIPS = 8
"""The wait until a peer is lost has at least so many round trips."""
PROBE_INTERVAL_S = 5.0
"""How often a link in use measures its round trip and reports its losses."""
CLOSE_HOLDOFF_S = 1.0
"""After a peer's close no initiation is sent to it for this long: its daemon is stopping."""

TWIN_PROOFS_APART_S = 2.0
"""Two handshakes that are closer together do not show that a private key is in use twice."""
TWIN_PROOFS_WITHIN_S = 60.0
"""Two handshakes that are further apart do not show it either."""
UNCONFIRMED_PER_KIND = 16
"""Sessions that wait for their first envelope: so many to known addresses of the peer, so many to others."""
UNCONFIRMED_LIFETIME_S = 10.0
"""A session waits so long for its first envelope: several retries of the initiator on a slow path."""
PENDING_LIFETIME_S = 10.0
"""How long an own initiation may be answered."""
ANSWERS = Rate(2.0, 8)
"""Responses to one peer without a cookie: replays take little from a slow radio, and push no honest handshake out."""
PENDING_PER_PEER = 8
"""Own initiations that may still be answered, so a slow path's response finds its initiation."""
USABLE_PER_PEER = 3
"""Confirmed sessions of a peer: two that came up at once, and the one before them."""
COOKIED_ANSWERS_PER_S = 20
"""Responses a second to one peer with cookies, from all addresses: so it cannot use up the session indices."""
REMEMBERED_INITIATIONS = 65_536
"""Authentic initiations of all peers that are remembered, 300 bytes each: an exact replay costs no key exchange."""
REMEMBERED_LEAST = 16
"""The least share of a peer in them."""
REMEMBERED_MOST = 1024
"""The largest share of a peer in them."""
INITIATION_COPIES_S = 60.0
"""A copy may come so late, because mobile networks hold datagrams back; a later one is a recording."""
INITIATIONS = Rate(50.0, 50)
"""Messages that may reach a key exchange without a cookie; beyond that the node is under load."""
INITIATIONS_BURST_PER_PEER = 2
"""The burst has so many for each peer, if that is more: all of them initiate when this daemon starts again."""
INITIATIONS_BURST_MOST = 2000
"""The largest burst: an attacker can use it up, which takes half a second of a desktop's core."""
COOKIED_PER_SOURCE = Rate(10.0, 10)
"""Initiations under load from one source that holds a cookie."""
COOKIED_PER_S = 200
"""Initiations a second under load from all sources with cookies: a bounded share of a core."""
INITIATIONS_READ = Rate(2000, 1000)
"""Initiations that are read: what is beyond costs a quarter, so a flood leaves time for frames."""
INITIATIONS_READ_PER_KNOWN = Rate(50, 50)
"""Initiations that are read from each address where a peer is known to be: twelve times an honest peer's."""
VERSION_CHECKS = Rate(10, 20)
"""Initiations without a valid mac1 that are compared with other versions, each at most fourteen HMACs."""
VERSION_CHECKS_PER_KNOWN = Rate(5, 10)
"""Comparisons for each address where a peer is known to be: more than a peer of another version sends."""
VERSION_CHECK_BYTES = 4096
"""The longest message that is compared: twice the longest initiation of this version."""
COOKIE_REPLIES_PER_PREFIX = Rate(10, 10)
"""Cookie replies to one IPv4 /24 or IPv6 /64: a forger may choose any host there, and one radio leads to all."""
COOKIE_REPLIES_PER_S = 200
"""Cookie replies a second to all networks together: 0.4 % of a desktop's core."""
COOKIE_REPLIES_PER_KNOWN = Rate(20, 20)
"""Cookie replies to an address where a peer is known to be: others cannot use them up."""
GROUP_WORK = Rate(40, 2000)
"""Encapsulations for all peers, in hundredths of one of ``ffdhe8192``: one in 2.5 s delays 5 % of the frames."""
GROUP_WORK_PER_SOURCE = Rate(20, 1000)
"""Encapsulations for one source: half of all."""
GROUP_WORK_PER_PEER = Rate(20, 200)
"""Encapsulations for one peer, and once more for one that proves its known address by a cookie."""
SOURCES_TRACKED = 1024
"""Sources whose rate is remembered under load; the longest silent one is forgotten first."""
COOKIE_SECRET_LIFETIME_S = 120.0
"""The secret behind cookies changes this often; the one before it is honoured as long again."""
COOKIE_HELD_S = 120.0
"""How long a received cookie is used."""
COOKIES_PER_PEER = 8
"""Cookies of a peer that are held: one for each path."""
HINTS_INTERVAL_S = 1.0
"""An unknown index from a peer's address makes us initiate at most this often."""
RECOVER_S = 1.0
"""All timers of a peer expire within this time after a fault in the work for it."""
INDEX_QUARANTINE_S = 600.0
"""An index that carried a session is not used again for this long: a late envelope is late, not forged."""
QUARANTINED_PER_PEER = 1024
"""Quarantined indices of one peer, so that it cannot use up the indices of all others."""
CONFIGURED_PATHS = 8
"""Slots of a peer for configured paths."""
PATHS_PER_HOST = 2
"""Configured paths along one socket to one host of the peer."""
LEARNED_PATHS = 4
"""Slots of a peer for addresses from which its envelopes came."""
QUESTION_LIFETIME_S = 5.0
"""How long a question may be answered."""
FIRST_PATH_S = 10.0
"""How long the path of a session's first envelope carries traffic without an answer, if it is not configured."""
QUESTIONS_PER_PATH = 24
"""Questions that wait along one path: one each quarter of a second until the oldest expires, and some more."""
PROBE_FAST_S = 0.25
"""Between questions along the path of the stream, if another one is usable, and along one that is suspect."""
SETTLING_ANSWERS = 8
"""A new path is asked fast until so many answers: RTTVAR begins at half of SRTT (RFC 6298), which is too much."""
PROBE_BUDGET_SHARE = 0.05
"""Probes use at most this part of the budget of a network."""
PROBE_BYTES = 88
"""A question and an answer in their envelopes, with the long header and a 16-byte tag."""
ECHO_BYTES = 76
"""An echo request and its reply in their envelopes."""
IP_BYTES = 48
"""IPv6 and UDP: the most that an IP network adds to a datagram."""
QUESTION_EARLY_S = 0.05
"""A question joins an envelope of the stream if it is due within this time."""
PROBE_STANDBY_S = 2.0
"""Between questions along a path that stands by."""
PROBE_DOWN_S = 1.0
"""Between questions along a path that is down, or never answered."""
PROBE_LONG_DOWN_S = 5.0
"""Between questions along a path that is down for :data:`LONG_DOWN_S`."""
FORMER_PATH_S = 30.0
"""A learned path that is down keeps its slot for so long after its last answer."""
LONG_DOWN_S = 60.0
"""A path that did not work for so long is asked less often."""
PROBE_IDLE_S = 15.0
"""Between questions along a metered path that is not needed, and along all paths while no frames are sent."""
IDLE_AFTER_S = 10.0
"""A link is idle if no frames were sent for this long."""
STREAM_ENVELOPES = 4
"""More envelopes than this in :data:`STREAM_ENDS_AFTER_S` are a stream; a ground station's two a second are not."""
STREAM_ENDS_AFTER_S = 1.0
"""A path carries stream until it carried none for this long."""
FIRST_ANSWER_S = 1.0
"""How long the first answer may take before its path is suspect (RFC 6298, section 2.1)."""
LEAST_ANSWER_S = 0.1
"""How long a later answer may take, at least."""
DOWN_AFTER_S = 1.0
"""A path is down if two questions in a row were not answered, the first for this long."""
SUSPECT_ENVELOPES = 10
"""Loss makes a path suspect only if so many envelopes were sent along it."""
SUSPECT_LOSS = 0.2
"""More lost than this share makes a path suspect."""
SUSPECT_WINDOW_S = 1.0
"""The loss that makes a path suspect is that of this time."""
RECOVERED_ANSWERS = 3
"""A path that was down is usable again after so many answers."""
RECOVERED_AFTER_S = 2.0
"""A path that was down is usable again so long after the first answer, or later."""
BETTER_SHARE = 0.2
"""A path becomes the best if its cost is lower by this share."""
BETTER_BY_S = 0.01
"""A path becomes the best if its cost is lower by this."""
BETTER_FOR_S = 2.0
"""A path becomes the best if it was better for this long."""
HELD_BACK_MOST_S = 64.0
"""A path that lost frames soon after it became the best waits twice as long each time, at most this long."""
LOSS_PENALTY_S = 2.0
"""What all of a path's loss would add to its cost: 100 ms for each 5 %."""
LOSS_WINDOW_S = 4.0
"""The loss of a path is that of this time."""
LOSS_POINTS = 64
"""Reports about a path's loss that are kept."""
TRANSMISSIONS = 7
"""How often a critical envelope is sent along a path, repeats included, at most."""
REPAIR_WINDOW_S = 10.0
"""Whether to repeat depends on the loss of this time."""
CRITICAL_ENVELOPE_LIMIT = 320
"""The longest critical envelope along several paths, all of which carry it; a single frame may be longer."""
SMALLER_LIMITS = (1452, 1232, 1024, 768, 548)
"""Lengths that a path may carry if it does not carry longer ones; the last is 576 (RFC 791) less 28."""
ENVELOPE_AIR_S = 0.25
"""On a slow network, frames share an envelope up to the length that it carries in this time."""
SLOW_ENVELOPE_LEAST = 120
"""The shortest such length: below it, envelopes are mostly overhead."""
SLOW_ENVELOPE_MOST = 500
"""The greatest such length: framing on a line adds at most 6 bytes."""
LINE_BYTES = 5
"""Framing on a line adds one byte of COBS, two of the CRC and two delimiters to up to 252 bytes."""
LIMIT_TESTS = 8
"""Unanswered padded probes that show that a path does not carry them: at 20 % loss wrong in one of 3,500 cases."""
LIMIT_TEST_S = 0.25
"""Between two padded probes, at least."""
LIMIT_LOSSES = 3
"""Envelopes that were lost recently and make a path prove its limit again."""
LIMIT_DOUBT_S = 10.0
"""A path has to prove its limit again at most this often."""
LIMIT_RAISE_S = 60.0
"""How long after the tests one test shows whether the path carries more."""
REKEYS_ALONG_BEST = 2
"""Tries at new keys that go along the best path alone while it works."""
COPIES_OF_A_RESPONSE = 12
"""Paths along which one response is sent: as many as there are slots."""
METERED_RETRIES = ((60.0, 15.0), (600.0, 60.0))
"""After so many seconds of tries without an answer, the seconds between two along metered paths."""
LATE_STEP_S = 0.25
"""Counters of the past are remembered in such steps: what is late is so by up to one of them more."""
HOLD_S = 1.0
"""Frames that came after a silence wait so long for the peer's answer, and that answer may be so old."""
HOLD_ASK_S = 0.1
"""How often the peer is asked meanwhile, and after an interval without an answer."""
VERIFY_INTERVAL_S = 1.0
"""While frames arrive, the peer is asked for an echo this often; a network with a budget has a longer interval."""
VERIFY_REPEAT_SHARE = 0.25
"""After a longer interval without an answer the request is repeated each time this share of it has passed."""
VERIFIED_INTERVALS = 2
"""Freshness stays verified for so many intervals after an answer, at least for `LATE_AFTER_S`."""
REFUSALS_INTERVAL_S = 2.0
"""A peer gets a refusal report at most this often: with 16 entries and 12 bytes of tag under 1 kbit/s."""
REFUSALS_SENDS = 2
"""A changed count is in so many reports: at 30 % loss at least one of them arrives in 91 % of cases."""
REFUSALS_KEPT = 64
"""Kinds of refused frames that are counted for one peer, and claims of it that are kept."""
PROBLEMS_INTERVAL_S = 60.0
"""While a problem lasts, it is reported this often."""
PROBLEMS_LAST_S = 150.0
"""A problem report is shown for this long: one of two repetitions may be lost."""
ECHO_BUDGET_SHARE = 0.05
"""Periodic echo requests and their replies use at most this part of the budget of a network."""
HOLD_AIRTIMES = 8
"""Frames wait for so many airtimes of a request and its reply, from `HOLD_S` to `LATE_AFTER_S`."""
ASK_AIRTIMES = 2
"""The peer is asked again after so many airtimes, at least after `HOLD_ASK_S`."""
HELD_BYTES = 65536
"""Frames of one session that wait: the largest envelope fits, and a second of a fast link."""
HELD_OVERHEAD_BYTES = 64
"""Each frame that waits counts as so many bytes more, so that many small ones are bounded too."""

ARRIVALS = 2048
"""Envelopes of which a session with several paths remembers when and along which path each arrived: a second."""
REPLAY_WINDOW = 8192
"""Envelopes that may overtake one another: 0.8 s at 10,000 a second."""
MIN_ENVELOPE_LIMIT = 320
"""The smallest limit on an envelope: a MAVLink frame has up to 280 bytes, header and tag up to 23."""
MAX_ENVELOPE_LIMIT = 65000
"""Largest limit on an envelope: under what a UDP datagram over IPv4 holds (65,507)."""
DEFAULT_ENVELOPE_LIMIT = 1232
"""1,280 (least MTU of IPv6, RFC 8200 section 5) less 40 and 8 bytes of IPv6 and UDP header."""

# Relays. README.md, section 21.
RELAY_BYTES = 3
"""What a relay adds to a datagram: type and handle."""
RELAYED_ENVELOPE_LIMIT = 1229
"""The longest envelope along a relay, so that its datagram is not longer than a direct one."""
RELAYED_COPIES = 2
"""Copies from one socket go through so many relays, and with so many handles of one relay."""
COPIES_PER_SOCKET = 3
"""Paths from one socket along which copies go, if one of them leads through a relay."""
EARLY_MOST_S = 0.1
"""Frames do not wait for a path that is slower by more than this."""
EARLY_MARGIN_S = 0.01
"""Frames wait longer than a path is slower, by this: delays vary."""
EARLY_ENVELOPES = 64
"""Envelopes whose frames wait for those before them."""
RESENT_S = LATE_AFTER_S
"""A new relayed path carries the critical envelopes of this time again; a peer drops older ones as late."""
RESENT_ENVELOPES = 64
"""Critical envelopes that are kept for a new relayed path."""
KEYS_PER_BIND = 16
"""Keys of a bind at most."""
ENTRIES_PER_BOUND = 32
"""Entries of a record with handles: it fits an MTU of 1,280 bytes."""
HANDLES_PER_PAIR = 4
"""Handles of a pair: two networks at each end, so that copies along both are possible."""
HANDLE_QUARANTINE_S = 600.0
"""A handle is not given to the same member again for so long: longer than any session lasts."""
BIND_LIFETIME_S = 60.0
"""A wish ends after this: two repeated binds may be lost."""
BIND_INTERVAL_S = 20.0
"""Between repeated binds."""
BIND_WAITING_S = 5.0
"""Between binds while a peer has no handle: a relay's report of a change may be lost."""
BIND_RETRY_S = 1.0
"""Between binds without an answer."""

# Direct connections through NAT. README.md, section 22.
CANDIDATES = 8
"""Addresses in a record, and paths to candidates that are asked."""
CANDIDATES_PER_HOST = 2
"""Candidates of one host."""
CANDIDATE_QUESTIONS = 80
"""Questions to candidates at first: ten to each."""
CANDIDATE_QUESTIONS_PER_S = 1.0
"""Later questions to all candidates together, whatever a captured peer names (RFC 8445, section 19.5.1)."""
CANDIDATE_TRIES = 10
"""Questions of the first round."""
CANDIDATE_TRY_S = 0.1
"""Between the first two questions; it doubles."""
CANDIDATE_TRY_MOST_S = 1.0
"""Between questions of the first round at most: each may open the sender's own NAT."""
CANDIDATE_ROUND_S = 10.0
"""Until the second round, of one question; it doubles."""
CANDIDATE_ROUND_MOST_S = 60.0
"""Between later rounds at most."""
