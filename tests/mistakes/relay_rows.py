"""Mistakes with a relay: `status` there and at its members, and `check`."""

from __future__ import annotations

from tests.mistakes import relay_scenes as scenes
from tests.mistakes.row import Mistake, Sign

_NO_ANSWER = r"`uavlinkd pubkey` there must print .*\[\[member\]\] there"
_RELAY_KEY = (
    Sign("here", "relay_not_answering", _NO_ANSWER),
    Sign("there", "other_relay_key", r'compare the \[\[relay\]\] .*public_key = "'),
)

RELAY_ROWS = (
    Mistake(
        "79",
        "member missing at the relay",
        "new",
        signs=(
            Sign("here", "not_a_member", r"`uavlinkd pubkey` there.*\[\[member\]\]"),
            Sign("there", "relay_not_answering", _NO_ANSWER),
        ),
        make=scenes.member_missing,
    ),
    Mistake("80", "another key of the relay", "new", signs=_RELAY_KEY, make=scenes.relay_key),
    Mistake("81", "keys of relay and peer exchanged", "new", signs=_RELAY_KEY, make=scenes.exchanged_keys),
    Mistake(
        "82",
        "firewall in front of the relay",
        "new",
        signs=(Sign("there", "relay_not_answering", r"open its firewall"),),
        make=scenes.firewall,
    ),
    Mistake(
        "83",
        "relay's name without address",
        "new",
        check=r'relay "m83-there".*has no address here now.*getent hosts',
        signs=(Sign("here", "name_not_resolved", r"getent hosts"),),
        make=scenes.unknown_name,
    ),
    Mistake(
        "84",
        "`[[relay]]` at one end",
        "new",
        signs=(
            Sign("here", "not_connecting", r"a \[\[relay\]\] into both"),
            Sign("there", "not_bound", r"write a \[\[relay\]\] .*into its file"),
        ),
        make=scenes.one_end,
    ),
    Mistake(
        "85",
        "another key of a peer behind a relay",
        "new",
        signs=tuple(Sign(side, "not_bound", r"compare both public_key") for side in ("here", "there")),
        make=scenes.peer_key,
    ),
    Mistake(
        "86",
        "link through a relay not confidential",
        "new",
        check=r"owner of the relay .*can read them; write confidential = true",
        make=scenes.readable,
    ),
    Mistake(
        "87",
        "private key of the relay as its public key",
        "new",
        check=r'relay "m87-there": .*form of a private key.*make a new one there with `uavlinkd keygen`',
        make=scenes.private_key,
    ),
    Mistake(
        "88",
        "example's key of the relay",
        "new",
        check=r'relay "m88-there": .*key of an example.*`uavlinkd pubkey` printed',
        make=scenes.example_key,
    ),
    Mistake("89", "key file of the relay that others may read", "new", check=r"chmod 600", make=scenes.key_file),
    Mistake(
        "90",
        "port of the relay in use",
        "new",
        check=r"is in use by .*end that process",
        command=r"ss -lntup",
        make=scenes.port_in_use,
    ),
    Mistake(
        "91",
        "`uavlinkd relay` with a vehicle's file",
        "new",
        command=r"is not the file of a relay.*\[\[member\]\].*`uavlinkd run`",
        make=scenes.file_of_a_member,
    ),
    Mistake(
        "92",
        "PSK for the relay at one end",
        "new",
        signs=(Sign("here", "wrong_psk", r"same psk_file"),),
        make=scenes.psk,
    ),
)
