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
        "30b",
        "one key on two machines at a relay",
        scenes.copied_card,
        signs=tuple(Sign(side, "key_on_two_machines", r"uavlinkd keygen. on one") for side in ("here", "there")),
    ),
    Mistake(
        "79",
        "member missing at the relay",
        scenes.member_missing,
        signs=(
            Sign("here", "not_a_member", r"`uavlinkd pubkey` there.*\[\[member\]\]"),
            Sign("there", "relay_not_answering", _NO_ANSWER),
        ),
    ),
    Mistake("80", "another key of the relay", scenes.relay_key, signs=_RELAY_KEY),
    Mistake("81", "keys of relay and peer exchanged", scenes.exchanged_keys, signs=_RELAY_KEY),
    Mistake(
        "82",
        "firewall in front of the relay",
        scenes.firewall,
        signs=(Sign("there", "relay_not_answering", r"open its firewall"),),
    ),
    Mistake(
        "83",
        "relay's name without address",
        scenes.unknown_name,
        check=r'relay "m83-there".*has no address here now.*getent hosts',
        signs=(Sign("here", "name_not_resolved", r"getent hosts"),),
    ),
    Mistake(
        "84",
        "`[[relay]]` at one end",
        scenes.one_end,
        signs=(
            Sign("here", "not_connecting", r"a \[\[relay\]\] into both"),
            Sign("there", "not_bound", r"write a \[\[relay\]\] .*into its file"),
        ),
    ),
    Mistake(
        "85",
        "another key of a peer behind a relay",
        scenes.peer_key,
        signs=tuple(Sign(side, "not_bound", r"compare both public_key") for side in ("here", "there")),
    ),
    Mistake(
        "86",
        "link through a relay not confidential",
        scenes.readable,
        check=r"its owner .*can read them; write confidential = true",
    ),
    Mistake(
        "87",
        "private key of the relay as its public key",
        scenes.private_key,
        check=r'relay "m87-there": .*form of a private key.*make a new one there with `uavlinkd keygen`',
    ),
    Mistake(
        "88",
        "example's key of the relay",
        scenes.example_key,
        check=r'relay "m88-there": .*key of an example.*`uavlinkd pubkey` printed',
    ),
    Mistake("89", "key file of the relay that others may read", scenes.key_file, check=r"chmod 600"),
    Mistake("90", "port of the relay in use", scenes.port_in_use, command=r"ss -lntup"),
    Mistake(
        "91",
        "`uavlinkd relay` with a vehicle's file",
        scenes.file_of_a_member,
        command=r"is not the file of a relay.*\[\[member\]\].*`uavlinkd run`",
    ),
    Mistake("92", "PSK for the relay at one end", scenes.psk, signs=(Sign("here", "wrong_psk", r"same psk_file"),)),
)
