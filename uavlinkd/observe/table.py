"""The table of findings: cause, severity, sign, sentence, remedy, exit status.

The log, ``status``, its exit status, the page, the metrics and the table in ops/README.md read these rows. To add a
finding, write its sign in :mod:`.signs` or :mod:`.traffic_signs` and a row here, where it belongs in the order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from enum import Enum
from functools import partial
from typing import Any, Final, NamedTuple

from uavlinkd.mavlink.dialect import SYSTEM_ID
from uavlinkd.observe import signs, traffic_signs
from uavlinkd.observe.facts import Fields
from uavlinkd.observe.finding import Severity
from uavlinkd.protocol.drops import DropReason

SECURITY, FAULT, WARNING = Severity


class Exit(Enum):
    """What a finding means for the exit status of ``status``."""

    OK = "0"
    FAILED = "1"
    EVERYWHERE = "1 if every endpoint has such a finding"
    RECENT = "1 for 30 s after the last evidence"


class Row(NamedTuple):
    """One finding. The sentences name fields of the sign, and ``here`` and ``who``: this daemon, and the part."""

    cause: str
    severity: Severity
    sign: Callable[[Any], Iterable[Fields]]
    text: str
    remedy: str
    exit: Exit = Exit.OK
    unless: frozenset[str] = frozenset()
    """Causes that explain it."""
    code: int = 0
    """In reports to peers, :data:`.traffic_signs.PROBLEMS`; 0 if it is no problem of theirs."""


_TWO_MACHINES: Final = (
    "two machines use {facts}; a card was copied, or the key is stolen",
    "run `uavlinkd pubkey` on both machines. If both print one key, {renew}; rotate the key only if a second machine"
    " has it: an attacker that holds handshakes back until a restart, or a captured peer, can also cause this",
)
OF_DAEMON: Final = (
    Row(
        *("own_key_elsewhere", SECURITY, signs.own_key_elsewhere),
        "a sender at {at} uses this daemon's private key, or an attacker replays an old recording",
        "if a card was copied, {renew}; else the key may be stolen: replace it",
        code=11,
    ),
    Row(
        *("key_on_two_machines", SECURITY, signs.own_key_twice, *_TWO_MACHINES),
        Exit.RECENT,
        code=11,
    ),
    Row(
        *("listen_address_missing", FAULT, signs.listen_address_missing),
        "no interface has {addresses}, which is in listen",
        "write an address of this machine (`ip -brief address` here) or {wildcard}; or wait for the network",
        code=7,
    ),
    Row(
        *("network_absent", FAULT, signs.network_absent),
        *("no peer is reached along {networks}", "{advice}"),
        code=7,
    ),
    Row(
        *("raw_mavlink", WARNING, signs.raw_mavlink),
        "bare MAVLink arrives from {at} at the port for peers, and is dropped",
        "let the autopilot or ground station send to the port of an [[endpoint]]",
    ),
    Row(
        *("fault_inside", WARNING, signs.fault_inside),
        "the daemon caught faults of its own: {places}",
        "send what `uavlinkd status --json` prints, and the log, to the developers; frames pass meanwhile",
    ),
    Row(
        *("configuration_refused", WARNING, signs.configuration_refused),
        "the last reload was refused, and the configuration before is in force: {problems}",
        "correct what `uavlinkd check --config {file}` here prints, and run `uavlinkd reload` here",
    ),
    Row(
        *("frames_in_circle", WARNING, signs.frames_in_circle),
        "frames that went to {ways} came back from {back}, and are dropped: a client, a bridge or a radio joins both,"
        " or a sender there repeats equal frames",
        "let what joins them no longer forward from one to the other; give each sender its own system id",
    ),
    Row(
        *("own_certificate_revoked", FAULT, signs.own_certificate_revoked),
        "the bulletin {number} revokes the certificate of this daemon (serial {serial}): members refuse it",
        "if this machine was not captured, on the laptop: uavlinkd fleet enroll {here} --replace --service",
    ),
    Row(
        *("bulletin_awaited", FAULT, signs.bulletin_awaited),
        "this daemon accepts no member by certificate: its bulletin is {number}, and require_bulletin is {required}",
        "run `uavlinkd fleet publish` where this daemon is reachable, or connect it to a pinned peer that has it",
    ),
    Row(
        *("fleet_state_degraded", WARNING, signs.fleet_state_degraded),
        "{problem}: since the last restart, or after the next one, this daemon may accept revoked members",
        "let the daemon's user write there, and make room on the disk; then restart the daemon",
    ),
    Row(
        *("bulletin_conflict", SECURITY, signs.bulletin_conflict),
        "{by} has another bulletin of the same number, or a newer one that accepts revoked members again: two copies"
        " of the authority's key are in use, or it is stolen. This daemon keeps its own one",
        "compare both folders of the authority; publish one with a higher number that revokes what both do",
    ),
    Row(
        *("bulletin_rolled_back", WARNING, signs.bulletin_rolled_back),
        "{by} has an older bulletin than it had: its disk was restored, or a second machine has its key",
        "it gets the newest one now: compare the machine, and replace its key if two have it",
    ),
    Row(
        *("bad_certificate", WARNING, signs.member_refused(DropReason.BAD_CERTIFICATE)),
        "the authority of this fleet did not sign the certificate of {senders}",
        "if the sender is yours, run `uavlinkd enroll` there again, for this fleet; else it is an attacker",
    ),
    Row(
        *("certificate_revoked", WARNING, signs.member_refused(DropReason.CERTIFICATE_REVOKED)),
        "refused, because the bulletin revokes it, or `deny` in this file names it: {senders}",
        "none if it was captured; else let the authority sign it again",
    ),
    Row(
        *("not_a_member", WARNING, signs.not_a_member),
        "a sender has a key of no member here: {senders}",
        "if it is yours, run `uavlinkd pubkey` there, write into its [[member]] what that prints, and run `uavlinkd"
        " reload` here: a key that arrives proves nothing. Of a fleet, `uavlinkd fleet list` shows whose key it is:"
        " let a member of yours run `uavlinkd enroll` again, and leave a revoked one out",
    ),
    Row(
        *("relay_not_answering", FAULT, signs.relay_silent),
        "the {relay} does not answer at {addresses}: {why}",
        "{advice}",
        Exit.FAILED,
        frozenset({"own_certificate_revoked"}),
    ),
    Row(
        *("no_datagram", FAULT, signs.no_datagram),
        "no datagram has reached UDP port {ports} since the start, {waited_s:.0f} s ago",
        "open it in the firewalls of this machine and of its provider, unless all members are off",
        Exit.FAILED,
    ),
    Row(
        *("line_noise", WARNING, signs.line_noise),
        "on the serial network {network}, {noise} of {pieces} pieces of the last 10 s are damaged",
        "compare the baud rate ({baud} here) with the modem's; set MAVLINK=0 on both SiK modems; let no other process"
        " and no autopilot use the line; else the radio is at its limit",
        code=8,
    ),
)

_PART: Final = (
    Row(
        *("hidden_frame", SECURITY, traffic_signs.hidden_frame),
        "{count:,} of its frames hid a forbidden frame, and were refused: more than by accident, outside of files",
        "treat {who} as captured",
    ),
)
"""A peer or an endpoint."""

OF_PEER: Final = (
    Row("key_on_two_machines", SECURITY, signs.peers_key_twice, *_TWO_MACHINES, Exit.RECENT),
    *_PART,
    Row(
        *("refused_there", WARNING, traffic_signs.refused_there),
        "it reports that it refuses {kinds}",
        "if these frames are needed, change the role, lists or system_ids for {here} in {who}'s file; a client here"
        f" with a foreign system id sets {SYSTEM_ID}",
    ),
    Row(
        *("problems_there", WARNING, traffic_signs.problems_there),
        *("it says about itself: {meanings}", "{advice}"),
    ),
    Row(
        *("revoked_but_pinned", WARNING, signs.revoked_but_pinned),
        "the bulletin revokes its certificate (serial {serial}), but its [[peer]] in this file lets it in",
        "if it was captured, delete that section and run `uavlinkd reload` here",
    ),
)
"""Any peer."""

_REFUSED: Final = (
    Row(
        *("foreign_system", FAULT, traffic_signs.foreign_system),
        "{which} of its frames are of system {systems}; its system_ids {where} are {ids}",
        f"set {SYSTEM_ID} of its autopilot, or the id of its ground station, to {{ids}}; or, only if you know that"
        " {who} has this id, and no other has it, {how}; else a client there forwards such frames, or treat {who} as"
        " captured",
        Exit.FAILED,
        code=1,
    ),
    Row(
        *("all_refused", FAULT, traffic_signs.all_refused),
        "{rule} refuses every frame {which}: {reasons}",
        "`uavlinkd check --verbose` here prints what passes: write the role of the other end, or allow what it needs",
        Exit.FAILED,
        frozenset({"roles_exchanged"}),
        code=1,
    ),
    Row(
        *("commands_withheld", WARNING, traffic_signs.commands_withheld),
        "{commands} withheld: {rule}",
        "intended, if {rule} is right; else write another role, or allow the command",
    ),
)
"""What the policy of a peer or an endpoint refuses."""

OF_PEER_UP: Final = (
    Row(
        *("freshness_unverified", FAULT, traffic_signs.freshness_unverified),
        "freshness unverified for {age_s:.0f} s: the peer's frames arrive, its echo replies do not: the direction"
        " from here to it is blocked, or an attacker delays frames. Commands, missions, parameters and manual control"
        " are held and dropped; reports pass and may be old",
        "fly by other means until answers return; look for a bad radio or a firewall in the direction to it",
    ),
    Row(
        *("high_loss", WARNING, traffic_signs.high_loss),
        "many datagrams are lost: {losses}",
        "look for a bad radio, a full network or a rate limit in this direction",
    ),
    Row(
        *("frames_unsent", WARNING, traffic_signs.frames_unsent),
        "{count:,} frames to it waited here for room on its network, and were dropped: clients here send more than"
        " the network, the connection by TLS or budget_bits_s carries",
        "lower the message rates of the clients here, end a log download, or raise a budget below what the network"
        " carries",
    ),
    Row(
        *("roles_exchanged", FAULT, traffic_signs.roles_exchanged),
        'role = "vehicle" says that it is a vehicle, but it sends a ground station\'s heartbeat: the roles may be'
        " exchanged",
        "{advice}",
        Exit.FAILED,
    ),
    *_REFUSED,
)

_down: Final = partial(Row, exit=Exit.FAILED)

OF_PEER_DOWN: Final = (
    _down(
        *("name_not_resolved", FAULT, signs.name_not_resolved),
        "{names} has no address now",
        "see `getent hosts {first}` here, or write an IP address; the daemon tries again each second",
    ),
    _down(
        *("firewall_here", FAULT, signs.firewall_here),
        "this machine refuses to send to {at} (EPERM)",
        "allow outgoing UDP from the daemon's port: see `sudo nft list ruleset` here",
    ),
    _down(
        *("no_route", FAULT, signs.no_route),
        *("this machine cannot send to {at} ({why})", "{advice}"),
    ),
    _down(
        *("not_bound", FAULT, signs.not_bound),
        "{who} is not bound at the {relay}: it is off, or cannot reach the relay (UDP blocked there)",
        "{advice}",
    ),
    _down(
        *("wrong_key_here", FAULT, signs.wrong_key_here),
        "a sender uses {keys}, which this file does not have",
        "run `uavlinkd pubkey` at {who}, and write into this file what that prints: a key that arrives proves"
        " nothing. After a change of keys, restart it with its new files; if the former key was stolen, this may be"
        " the thief",
    ),
    _down(
        *("other_version", FAULT, signs.other_version),
        "a sender at {at} speaks {versions}, this daemon uavlink/{ours}: the two cannot link",
        "update uavlinkd at {older}: it is older",
    ),
    _down(
        *("wrong_key_there", FAULT, signs.wrong_key_there),
        "a sender at {at} does not know this daemon's public key: that end may have another key for it",
        "{advice}",
        unless=frozenset({"other_version"}),
    ),
    _down(
        *("wrong_psk", FAULT, signs.wrong_psk),
        "the response from {sender} does not authenticate: the PSKs differ, or only one end has one",
        "give both ends the same psk_file; never remove a PSK: the message may be forged",
    ),
    _down(
        *("no_common_suite", FAULT, signs.no_common_suite),
        "it offers the suite {offered}; this end accepts {accepted}",
        "write this end's suites at {who}, or stronger ones at both ends; never weaker ones: an old recording can"
        " cause this",
    ),
    _down(
        *("no_listener", FAULT, signs.no_listener),
        "no process listens at {at}, or a firewall there rejects (ICMP)",
        "start uavlinkd at {who}, and compare its `listen` with `addresses` here",
    ),
    _down(
        *("not_confirmed", FAULT, signs.not_confirmed),
        "its initiations arrive, and it does not confirm this daemon's responses: these do not reach it, the PSKs"
        " differ, or an attacker replays old initiations",
        "let UDP from this daemon through the firewall at {who}; compare the PSKs",
        unless=frozenset({"firewall_here", "no_route", "wrong_psk", "no_common_suite"}),
    ),
)

OF_PEER_SILENT: Final = (
    _down(
        *("closed_by_peer", FAULT, signs.closed_by_peer),
        "closed by the peer, {age_s:.0f} s ago: its daemon was stopped, or its file no longer has this daemon",
        "none if that is meant; else start uavlinkd at {who}",
    ),
    _down(
        *("no_answer", FAULT, signs.no_answer),
        *("no answer from {places}: {causes}", "{advice}"),
        unless=frozenset({"closed_by_peer"}),
    ),
    _down(
        *("not_connecting", FAULT, signs.not_connecting),
        "{who} has not connected, and this file has no address of it",
        "start {who}, and write this daemon's address into its file, or its address into this one, or a [[relay]]"
        " into both",
    ),
)
"""A peer that is down, without any other finding."""

OF_ENDPOINT: Final = (
    *_PART,
    *_REFUSED,
    Row(
        *("garbage", WARNING, traffic_signs.is_silent_by("garbage")),
        "bytes arrive at {url}, and none of them is MAVLink",
        "correct the baud rate, set the port of the autopilot to MAVLink, and let only this daemon read it",
        Exit.EVERYWHERE,
        code=6,
    ),
    Row(
        *("client_silent", WARNING, traffic_signs.is_silent_by("client_silent")),
        *("{what}", "{advice}"),
        code=4,
    ),
    Row(
        *("device_unavailable", FAULT, traffic_signs.is_silent_by("device_unavailable")),
        *("the device of {url} cannot be opened{error}", "{meaning}"),
        Exit.EVERYWHERE,
        code=5,
    ),
    Row(
        *("no_client", WARNING, traffic_signs.is_silent_by("no_client")),
        "no client has sent MAVLink to {url} within {silent_s:.0f} s",
        "let the autopilot or ground station send there",
        Exit.EVERYWHERE,
        code=3,
    ),
    Row(
        *("autopilot_unverified", FAULT, traffic_signs.autopilot_unverified),
        "no frame passes to or from {url}, because none has a valid signature that is new: the autopilot {what}",
        "{advice}",
        Exit.FAILED,
    ),
    Row(
        *("too_many_senders", WARNING, traffic_signs.too_many_senders),
        "{count:,} frames to {who} got no signature: its autopilot remembers 16 senders, and more send to it",
        "let fewer systems and components send to it, by system_ids and roles; then restart this daemon and the"
        " autopilot, which forget all senders",
    ),
    Row(
        *("station_unverified", FAULT, traffic_signs.station_unverified),
        "commands of {who} are dropped, because nothing shows that they are new: its firewall drops pings from"
        " {address}, or an attacker delays its datagrams. Reports pass",
        "let it answer them; on Windows, as administrator: netsh advfirewall firewall add rule name=uavlinkd dir=in"
        " action=allow protocol=icmpv4:8,any remoteip={address}",
    ),
    Row(
        *("client_unreachable", WARNING, traffic_signs.is_silent_by("client_unreachable")),
        *("the client at {url} cannot be reached: {why}", "{meaning}"),
        Exit.EVERYWHERE,
        code=3,
    ),
    Row(
        *("send_fails", WARNING, traffic_signs.send_fails),
        *("datagrams to clients of {url} are lost ({error})", "{meaning}"),
    ),
    Row(
        *("other_port", WARNING, traffic_signs.other_port),
        "datagrams from {other} are dropped: the client is {url}, at another port",
        "let the client send from that port; or write udpin:HOST:PORT here, and let the client send there",
    ),
)

ROWS: Final = (*OF_DAEMON, *OF_PEER, *OF_PEER_UP, *OF_PEER_DOWN, *OF_PEER_SILENT, *OF_ENDPOINT)
