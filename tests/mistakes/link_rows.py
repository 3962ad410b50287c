"""Mistakes of two running daemons: the causes in `status` answer, and `check` where it can."""

from __future__ import annotations

from tests.mistakes import link_scenes as scenes
from tests.mistakes.row import Mistake, Sign

_KEY_HERE = Sign("here", "wrong_key_here", r"uavlinkd pubkey")
_KEY_THERE = Sign("there", "wrong_key_there", r"write public_key = ")


def _both(cause: str, remedy: str) -> tuple[Sign, Sign]:
    return Sign("here", cause, remedy), Sign("there", cause, remedy)


LINK_ROWS = (
    Mistake("1", "another public key", "half", signs=(_KEY_HERE, _KEY_THERE), make=scenes.other_key),
    Mistake(
        "3",
        "example's key",
        "no",
        check=r"is the key of an example.*`uavlinkd pubkey` printed",
        signs=(_KEY_HERE,),
        make=scenes.example_key,
    ),
    Mistake(
        "4",
        "private key as the public key",
        "no",
        check=r"form of a private key.*make a new one there with `uavlinkd keygen`",
        signs=(_KEY_HERE,),
        make=scenes.private_key,
    ),
    Mistake("6", "wrong port at one end", "-", "not needed", make=scenes.wrong_port_here, is_up=True),
    Mistake(
        "7",
        "wrong port at both ends",
        "half",
        signs=_both("no_listener", r"compare its `listen` with `addresses`"),
        make=scenes.wrong_port_both,
    ),
    Mistake(
        "17",
        "port in use",
        "yes",
        check=r"is in use by .*end that process",
        command=r"ss -lntup",
        make=scenes.port_in_use,
    ),
    Mistake(
        "18",
        "host name without address",
        "half",
        check=r"has no address here now.*getent hosts",
        signs=_both("name_not_resolved", r"getent hosts"),
        make=scenes.unknown_name,
    ),
    Mistake(
        "19",
        "serial device missing",
        "yes",
        check=r"is not there now: plug it in",
        signs=(Sign("here", "device_unavailable", r"device|plug"),),
        make=scenes.serial_missing,
    ),
    Mistake(
        "20",
        "serial device without permission",
        "yes",
        check=r"group, often dialout",
        signs=(Sign("here", "device_unavailable", r"dialout"),),
        make=scenes.serial_forbidden,
    ),
    Mistake(
        "23",
        "peer on IPv6, `listen` on IPv4",
        "yes",
        check=r'add "\[::\]:\d+" to listen',
        signs=_both("family_missing", r'add "\[::\]:5790"'),
        make=scenes.families,
    ),
    Mistake("25", "PSK at one end", "yes", signs=_both("wrong_psk", r"same psk_file"), make=scenes.psk),
    Mistake(
        "26",
        "no common suite",
        "yes",
        signs=_both("no_common_suite", r"write this end's suites"),
        make=scenes.suites,
    ),
    Mistake("27", "`confidential` at one end", "-", "not needed", make=scenes.confidential, is_up=True),
    Mistake("28", "tags of 64 and 128 bits", "-", "not needed", make=scenes.tags, is_up=True),
    Mistake(
        "30",
        "one key on two machines",
        "no",
        signs=(Sign("here", "key_on_two_machines", r"uavlinkd pubkey.*only if a second machine"),),
        make=scenes.copied_card,
    ),
    Mistake("31", "clock of 1970", "-", "not needed", make=scenes.old_clock, is_up=True),
    Mistake(
        "32",
        "firewall drops what arrives there",
        "half",
        signs=(Sign("here", "not_confirmed", r"firewall"), Sign("there", "no_answer", r"firewall")),
        make=scenes.input_dropped,
    ),
    Mistake(
        "33",
        "firewall drops what is sent here",
        "half",
        signs=(Sign("here", "firewall_here", r"allow outgoing UDP.*nft list ruleset"),),
        make=scenes.output_dropped,
    ),
    Mistake(
        "35",
        "`listen` names another machine's address",
        "half",
        check=r"is not an address of this machine now.*0\.0\.0\.0",
        signs=(Sign("here", "listen_address_missing", r"ip -brief address"),),
        make=scenes.listen_elsewhere,
    ),
    Mistake(
        "36", "addresses at neither end", "yes", signs=_both("not_connecting", r"address"), make=scenes.no_addresses
    ),
    Mistake(
        "38",
        "autopilot has another system id",
        "half",
        signs=(Sign("there", "foreign_system", r"SYSID_THISMAV.*MAV_SYS_ID"),),
        make=scenes.wrong_system,
    ),
    Mistake(
        "39",
        "roles exchanged",
        "no",
        signs=(Sign("here", "roles_exchanged", r'write role = "operator"'),),
        make=scenes.roles,
    ),
    Mistake(
        "46",
        "bare MAVLink to the peers' port",
        "yes",
        signs=(Sign("here", "raw_mavlink", r"port of an \[\[endpoint\]\]"),),
        make=scenes.bare_mavlink,
    ),
    Mistake(
        "47",
        "`udpout` to a closed port",
        "half",
        signs=(Sign("here", "client_unreachable", r"start the client there, or correct the port"),),
        make=scenes.closed_client,
    ),
    Mistake(
        "48",
        "recording folder is a file",
        "yes",
        check=r"is not a folder: nothing would be recorded",
        signs=(Sign("here", "recording_stopped", r"daemon's user"),),
        make=scenes.recording,
    ),
    Mistake("50", "reload of a mistake", "yes", command=r"tag_bits: must be 64, 96, 128 or 256", make=scenes.reload),
    Mistake(
        "51",
        "reload of a fixed key",
        "yes",
        command=r"metrics: cannot change while the daemon runs: restart it",
        make=scenes.reload_listen,
    ),
    Mistake(
        "52",
        "rotation finished before the restart",
        "no",
        signs=(Sign("here", "wrong_key_here", r"After a change of keys, restart it with its new files"),),
        make=scenes.finished_too_early,
    ),
    Mistake("53", "`status` as another user", "yes", command=r"use sudo", make=scenes.other_user),
    Mistake("54", "socket left by a killed daemon", "-", "not needed", make=scenes.killed, is_up=True),
    Mistake(
        "74",
        "command withheld by a role",
        "new",
        signs=(Sign("here", "commands_withheld", r"write another role, or allow the command"),),
        make=scenes.withheld,
    ),
    Mistake(
        "75", "endpoint gets no MAVLink", "new", signs=(Sign("here", "garbage", r"baud rate"),), make=scenes.garbage
    ),
    Mistake(
        "77",
        "client only listens",
        "new",
        signs=(Sign("here", "client_silent", r"not only listens"),),
        make=scenes.listener,
    ),
    Mistake(
        "78",
        "no client at the endpoint",
        "new",
        signs=(Sign("here", "no_client", r"send there"),),
        make=scenes.no_client,
    ),
)
