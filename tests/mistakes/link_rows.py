"""Mistakes of two running daemons: the causes in `status` answer, and `check` where it can."""

from __future__ import annotations

from tests.mistakes import link_scenes as scenes
from tests.mistakes.row import Mistake, Sign

_KEY_HERE = Sign("here", "wrong_key_here", r"uavlinkd pubkey")
_KEY_THERE = Sign("there", "wrong_key_there", r"write public_key = ")


def _both(cause: str, remedy: str) -> tuple[Sign, Sign]:
    return Sign("here", cause, remedy), Sign("there", cause, remedy)


LINK_ROWS = (
    Mistake("1", "another public key", scenes.other_key, signs=(_KEY_HERE, _KEY_THERE)),
    Mistake(
        "3",
        "example's key",
        scenes.example_key,
        check=r"is the key of an example.*`uavlinkd pubkey` printed",
        signs=(_KEY_HERE,),
    ),
    Mistake(
        "4",
        "private key as the public key",
        scenes.private_key,
        check=r"form of a private key.*make a new one there with `uavlinkd keygen`",
        signs=(_KEY_HERE,),
    ),
    Mistake("6", "wrong port at one end", scenes.wrong_port_here),
    Mistake(
        "7",
        "wrong port at both ends",
        scenes.wrong_port_both,
        signs=_both("no_listener", r"compare its `listen` with `addresses`"),
    ),
    Mistake("17", "port in use", scenes.port_in_use, command=r"ss -lntup"),
    Mistake(
        "18",
        "host name without address",
        scenes.unknown_name,
        check=r"has no address here now.*getent hosts",
        signs=_both("name_not_resolved", r"getent hosts"),
    ),
    Mistake(
        "19",
        "serial device missing",
        scenes.serial_missing,
        check=r"is not there now: plug it in",
        signs=(Sign("here", "device_unavailable", r"device|plug"),),
    ),
    Mistake(
        "20",
        "serial device without permission",
        scenes.serial_forbidden,
        check=r"group, often dialout",
        signs=(Sign("here", "device_unavailable", r"dialout"),),
    ),
    Mistake(
        "23",
        "peer on IPv6, `listen` on IPv4",
        scenes.families,
        check=r'add "\[::\]:(?!5790)\d+" to listen',
        signs=_both("family_missing", r'add "\[::\]:(?!5790)\d+"'),
    ),
    Mistake("25", "PSK at one end", scenes.psk, signs=_both("wrong_psk", r"same psk_file")),
    Mistake("26", "no common suite", scenes.suites, signs=_both("no_common_suite", r"write this end's suites")),
    Mistake("27", "`confidential` at one end", scenes.confidential),
    Mistake("28", "tags of 64 and 128 bits", scenes.tags),
    Mistake(
        "30",
        "one key on two machines",
        scenes.copied_card,
        signs=_both("key_on_two_machines", r"uavlinkd pubkey.*only if a second machine"),
    ),
    Mistake("31", "clock of 1970", scenes.old_clock),
    Mistake(
        "32",
        "firewall drops what arrives there",
        scenes.input_dropped,
        signs=(Sign("here", "not_confirmed", r"firewall"), Sign("there", "no_answer", r"firewall")),
    ),
    Mistake(
        "33",
        "firewall drops what is sent here",
        scenes.output_dropped,
        signs=(Sign("here", "firewall_here", r"allow outgoing UDP.*nft list ruleset"),),
    ),
    Mistake(
        "35",
        "`listen` names another machine's address",
        scenes.listen_elsewhere,
        check=r"is not an address of this machine now.*0\.0\.0\.0",
        signs=(Sign("here", "listen_address_missing", r"ip -brief address"),),
    ),
    Mistake(
        "36",
        "addresses at neither end",
        scenes.no_addresses,
        check=r"the peer's file needs an address of this machine",
        signs=_both("not_connecting", r"address"),
    ),
    Mistake(
        "38",
        "autopilot has another system id",
        scenes.wrong_system,
        signs=(Sign("there", "foreign_system", r"SYSID_THISMAV.*MAV_SYS_ID"),),
    ),
    Mistake(
        "38b",
        "the same, in the file of a fleet's member",
        scenes.wrong_system_of_fleet,
        signs=(Sign("here", "foreign_system", r"MAV_SYSID .*MAV_SYS_ID .* of its autopilot to 2"),),
    ),
    Mistake(
        "39", "roles exchanged", scenes.roles, signs=(Sign("here", "roles_exchanged", r'write role = "operator"'),)
    ),
    Mistake(
        "46",
        "bare MAVLink to the peers' port",
        scenes.bare_mavlink,
        signs=(Sign("here", "raw_mavlink", r"port of an \[\[endpoint\]\]"),),
    ),
    Mistake(
        "47",
        "`udpout` to a closed port",
        scenes.closed_client,
        signs=(Sign("here", "client_unreachable", r"start the client there, or correct the port"),),
    ),
    Mistake(
        "48",
        "recording folder is a file",
        scenes.recording,
        signs=(Sign("here", "recording_stopped", r"daemon's user"),),
    ),
    Mistake(
        "50",
        "reload of a mistake",
        scenes.reload,
        command=r"tag_bits: must be 64, 96, 128 or 256",
        signs=(
            Sign("here", "configuration_refused", r"`uavlinkd check --config .*` prints, and run `uavlinkd reload`"),
        ),
    ),
    Mistake(
        "51",
        "reload of a fixed key",
        scenes.reload_listen,
        command=r"metrics: cannot change while the daemon runs: restart it",
    ),
    Mistake(
        "52",
        "rotation without the restart",
        scenes.without_restart,
        signs=(Sign("here", "wrong_key_here", r"After a change of keys, restart it with its new files"),),
    ),
    Mistake("53", "`status` as another user", scenes.other_user, command=r"use sudo"),
    Mistake("53b", "no daemon at the control socket", scenes.not_started, command=r"start it \(`uavlinkd run"),
    Mistake("54", "socket left by a killed daemon", scenes.killed, command=r"start it \(`uavlinkd run"),
    Mistake(
        "74",
        "command withheld by a role",
        scenes.withheld,
        signs=(Sign("here", "commands_withheld", r"write another role, or allow the command"),),
    ),
    Mistake("75", "endpoint gets no MAVLink", scenes.garbage, signs=(Sign("here", "garbage", r"baud rate"),)),
    Mistake(
        "77", "client only listens", scenes.listener, signs=(Sign("here", "client_silent", r"not only listens"),)
    ),
    Mistake("78", "no client at the endpoint", scenes.no_client, signs=(Sign("here", "no_client", r"send there"),)),
)
