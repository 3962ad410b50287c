"""Mistakes with a relay: `status` there and at its members, and `check`."""

from __future__ import annotations

from tests.mistakes import relay_scenes as scenes
from tests.mistakes.row import Mistake, Sign

_NO_ANSWER = r"`uavlinkd pubkey` there must print .* must be a member there"
_RELAY_KEY = (Sign("here", "relay_not_answering", _NO_ANSWER),)

RELAY_ROWS = (
    Mistake(
        "30b",
        scenes.copied_card,
        signs=tuple(Sign(side, "key_on_two_machines", r"uavlinkd keygen. on one") for side in ("here", "there")),
    ),
    Mistake(
        "79",
        scenes.member_missing,
        signs=(
            Sign("here", "not_a_member", r"`uavlinkd pubkey` there.*\[\[member\]\]"),
            Sign("there", "relay_not_answering", _NO_ANSWER),
        ),
    ),
    Mistake("80", scenes.relay_key, signs=_RELAY_KEY),
    Mistake("81", scenes.exchanged_keys, signs=_RELAY_KEY),
    Mistake(
        "82",
        scenes.firewall,
        signs=(
            Sign("here", "no_datagram", r"firewalls of this machine and of its provider"),
            Sign("there", "relay_not_answering", r"open its firewall"),
        ),
    ),
    Mistake(
        "83",
        scenes.unknown_name,
        signs=(Sign("here", "relay_not_answering", r"getent hosts"),),
    ),
    Mistake(
        "84",
        scenes.one_end,
        signs=(
            Sign("here", "not_connecting", r"a \[\[relay\]\] into both"),
            Sign("there", "not_bound", r"write a \[\[relay\]\] .*into its file"),
        ),
    ),
    Mistake(
        "85",
        scenes.peer_key,
        signs=tuple(Sign(side, "not_bound", r"compare both public_key") for side in ("here", "there")),
    ),
    Mistake("90", scenes.port_in_use, command=r"ss -lntup"),
    Mistake("91", scenes.file_of_a_member, command=r"is not the file of a relay.*\[\[member\]\].*`uavlinkd run`"),
)
