"""Mistakes of two running daemons: the causes in `status` answer, and `check` where it can."""

from __future__ import annotations

from tests.mistakes import link_scenes as scenes
from tests.mistakes.row import Mistake, Sign

_KEY_HERE = Sign("here", "wrong_key_here", r"uavlinkd pubkey")
_KEY_THERE = Sign("there", "wrong_key_there", r"write public_key = ")


def _both(cause: str, remedy: str) -> tuple[Sign, Sign]:
    return Sign("here", cause, remedy), Sign("there", cause, remedy)


def _here(cause: str, remedy: str) -> tuple[Sign]:
    return (Sign("here", cause, remedy),)


LINK_ROWS = (
    Mistake("1", scenes.other_key, signs=(_KEY_HERE, _KEY_THERE)),
    Mistake(
        "4",
        scenes.private_key,
        check=r"form of a private key.*make a new one there with `uavlinkd keygen`",
        signs=(_KEY_HERE,),
    ),
    Mistake("6", scenes.wrong_port_here),
    Mistake("7", scenes.wrong_port_both, signs=_both("no_listener", r"compare its `listen` with `addresses`")),
    Mistake("17", scenes.port_in_use, command=r"ss -lntup"),
    Mistake(
        "18",
        scenes.unknown_name,
        signs=_both("name_not_resolved", r"getent hosts"),
    ),
    Mistake(
        "19",
        scenes.serial_missing,
        check=r"is not there now: plug it in",
        signs=_here("device_unavailable", r"device|plug"),
    ),
    Mistake(
        "20", scenes.serial_forbidden, check=r"group, often dialout", signs=_here("device_unavailable", r"dialout")
    ),
    Mistake(
        "23",
        scenes.families,
        signs=_both("no_route", r'add "\[::\]:(?!5790)\d+"'),
    ),
    Mistake("25", scenes.psk, signs=_both("wrong_psk", r"same psk_file")),
    Mistake("26", scenes.suites, signs=_both("no_common_suite", r"write this end's suites")),
    Mistake(
        "30", scenes.copied_card, signs=_both("key_on_two_machines", r"uavlinkd pubkey.*only if a second machine")
    ),
    Mistake(
        "32",
        scenes.input_dropped,
        signs=(Sign("here", "not_confirmed", r"firewall"), Sign("there", "no_answer", r"firewall")),
    ),
    Mistake("33", scenes.output_dropped, signs=_here("firewall_here", r"allow outgoing UDP.*nft list ruleset")),
    Mistake(
        "35",
        scenes.listen_elsewhere,
        check=r"is not an address of this machine now.*0\.0\.0\.0",
        signs=_here("listen_address_missing", r"ip -brief address"),
    ),
    Mistake(
        "36",
        scenes.no_addresses,
        check=r"it connects, to an address of this machine",
        signs=_both("not_connecting", r"address"),
    ),
    Mistake("38", scenes.wrong_system, signs=(Sign("there", "foreign_system", r"SYSID_THISMAV.*MAV_SYS_ID"),)),
    Mistake(
        "38b",
        scenes.wrong_system_of_fleet,
        signs=_here("foreign_system", r"MAV_SYSID .*MAV_SYS_ID .* of its autopilot, or .* to 2"),
    ),
    Mistake("39", scenes.roles, signs=_here("roles_exchanged", r'write role = "operator"')),
    Mistake("40", scenes.no_control_socket, command=r'add control_socket = "NAME\.sock"'),
    Mistake("46", scenes.bare_mavlink, signs=_here("raw_mavlink", r"port of an \[\[endpoint\]\]")),
    Mistake(
        "47", scenes.closed_client, signs=_here("client_unreachable", r"start the client there, or correct the port")
    ),
    Mistake(
        "50",
        scenes.reload,
        command=r"tag_bits: must be 64, 96 or 128",
        signs=_here("configuration_refused", r"`uavlinkd check --config .*` here prints, and run `uavlinkd reload`"),
    ),
    Mistake(
        "52",
        scenes.without_restart,
        signs=_here("wrong_key_here", r"After a change of keys, restart it with its new files"),
    ),
    Mistake("53", scenes.other_user, command=r"use sudo"),
    Mistake("54", scenes.killed, command=r"start it \(`uavlinkd run"),
    Mistake("74", scenes.withheld, signs=_here("commands_withheld", r"write another role, or allow the command")),
    Mistake("75", scenes.garbage, signs=_here("garbage", r"baud rate")),
    Mistake("77", scenes.listener, signs=_here("client_silent", r"must not only listen")),
    Mistake("78", scenes.no_client, signs=_here("no_client", r"send there")),
    Mistake("93", scenes.revoked_card, signs=_here("certificate_revoked", r"sign it again")),
)
