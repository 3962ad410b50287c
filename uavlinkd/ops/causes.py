"""The closed list of causes in ``status``: why frames do not pass, or what threatens a link."""

from __future__ import annotations

from uavlinkd.core.drops import Reason
from uavlinkd.ops.findings import Severity


class Cause(Reason):
    """What a finding is about. A member is its code for scripts; its meaning is in plain words, without facts."""

    # Attacks, or a key in two places. Without a key, an attacker on the path can cause KEY_ON_TWO_MACHINES, as it can
    # forward handshakes from its own address, and one with an old recording can cause OWN_KEY_ELSEWHERE.
    OWN_KEY_ELSEWHERE = "own_key_elsewhere", "another machine has this daemon's private key"
    KEY_ON_TWO_MACHINES = "key_on_two_machines", "two machines seem to have the peer's private key"
    HIDDEN_FRAME = "hidden_frame", "the sender hides forbidden frames in others"
    IMPERSONATION = "impersonation", "the peer sends as a system that belongs to another"

    # The link is down: this machine.
    LISTEN_ADDRESS_MISSING = "listen_address_missing", "an address in listen is not on this machine"
    NETWORK_ABSENT = "network_absent", "a network has no interface or address now"
    NAME_NOT_RESOLVED = "name_not_resolved", "the host name of the peer, or of its relay, has no address"
    OWN_ADDRESS = "own_address", "the peer's address leads to this daemon itself"
    ZONE_MISSING = "zone_missing", "a link-local IPv6 address lacks its network interface"
    FAMILY_MISSING = "family_missing", "no address in listen, or no network, is of the peer's address family"
    FIREWALL_HERE = "firewall_here", "this machine's firewall refuses datagrams to the peer"
    NO_ROUTE = "no_route", "this machine has no route to the peer"

    # The link is down: what arrives, or does not. Any sender can forge most of this evidence.
    NO_LISTENER = "no_listener", "no process listens at the peer's address"
    HOST_UNREACHABLE = "host_unreachable", "the network reports that the peer's host is not reachable"
    WRONG_KEY_HERE = "wrong_key_here", "a sender at the peer's address uses another public key than this file has"
    FORMER_KEY = "former_key", "a sender at the peer's address uses a key that was replaced here"
    WRONG_KEY_THERE = "wrong_key_there", "a sender at the peer's address has another public key for this daemon"
    OTHER_VERSION = "other_version", "a sender at the peer's address speaks another version of the protocol"
    WRONG_PSK = "wrong_psk", "the PSKs differ, or only one end has one"
    NO_COMMON_SUITE = "no_common_suite", "the peer offers a suite that is not in its list here"
    NOT_CONFIRMED = "not_confirmed", "the peer initiates, but does not confirm this daemon's responses"
    NO_ANSWER = "no_answer", "the peer does not answer"
    RELAY_NOT_ANSWERING = "relay_not_answering", "a relay that the peer needs does not answer"
    NOT_BOUND = "not_bound", "the peer does not ask the relay for this daemon"
    NOT_CONNECTING = "not_connecting", "only the peer can initiate, and it does not"

    # The link is up, but frames do not pass.
    FOREIGN_SYSTEM = "foreign_system", "every frame is of a system that is not in system_ids"
    ROLES_EXCHANGED = "roles_exchanged", "the peer's role seems to be exchanged with that of this end"
    ALL_REFUSED = "all_refused", "the policy refuses every frame"
    FRESHNESS_UNVERIFIED = "freshness_unverified", "frames arrive, answers do not: commands are held and dropped"
    DEVICE_UNAVAILABLE = "device_unavailable", "the endpoint's device or address cannot be opened"

    # Frames pass, or there is no frame to pass.
    OTHER_SYSTEM = "other_system", "some frames are of a system that is not in system_ids"
    COMMANDS_WITHHELD = "commands_withheld", "the policy withholds commands to the peer or endpoint"
    COMMANDS_REFUSED = "commands_refused", "the policy refuses commands from the peer or endpoint"
    REFUSED_THERE = "refused_there", "the peer reports that its policy refuses frames from here"
    NO_CLIENT = "no_client", "no client has connected to the endpoint"
    CLIENT_UNREACHABLE = "client_unreachable", "no process listens at the client's address"
    CLIENT_SILENT = "client_silent", "the endpoint's client sends no MAVLink"
    GARBAGE = "garbage", "the endpoint's client sends bytes that are not MAVLink"
    NOT_A_MEMBER = "not_a_member", "a sender that knows the relay here is not one of its members"
    OTHER_RELAY_KEY = "other_relay_key", "a sender has another public key for the relay here"
    RAW_MAVLINK = "raw_mavlink", "bare MAVLink arrives at the port for peers"
    MODEM_REPORTS = "modem_reports", "a radio modem puts RADIO_STATUS between datagrams: its MAVLINK is not 0"
    LINE_NOISE = "line_noise", "many pieces that arrive on a serial network are damaged"
    UNDER_LOAD = "under_load", "handshake messages arrive faster than the daemon accepts them"
    DAEMON_PAUSED = "daemon_paused", "the daemon was paused, and dropped frames from that time"
    RECORDING_STOPPED = "recording_stopped", "the recording folder cannot be used"

    @property
    def severity(self) -> Severity:
        """How much it matters: a cause has one severity."""
        if self in _SECURITY:
            return Severity.SECURITY
        return Severity.WARNING if self in _WARNINGS else Severity.FAULT


_SECURITY = frozenset(
    {Cause.OWN_KEY_ELSEWHERE, Cause.KEY_ON_TWO_MACHINES, Cause.HIDDEN_FRAME, Cause.IMPERSONATION},
)
_WARNINGS = frozenset(
    {
        *(Cause.OTHER_SYSTEM, Cause.COMMANDS_WITHHELD, Cause.COMMANDS_REFUSED, Cause.NO_CLIENT),
        *(Cause.CLIENT_UNREACHABLE, Cause.CLIENT_SILENT, Cause.GARBAGE, Cause.RAW_MAVLINK, Cause.UNDER_LOAD),
        *(Cause.NOT_A_MEMBER, Cause.OTHER_RELAY_KEY, Cause.MODEM_REPORTS, Cause.LINE_NOISE),
        *(Cause.REFUSED_THERE, Cause.DAEMON_PAUSED, Cause.RECORDING_STOPPED),
    }
)
