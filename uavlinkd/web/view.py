"""What a browser shows of a status: plain values and finished sentences, which the page sets as text."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from typing import Any, Final

from uavlinkd.mavlink.policy.gate import Refusal
from uavlinkd.ops import status_words as words
from uavlinkd.ops.log import titled
from uavlinkd.ops.netcheck import addresses
from uavlinkd.ops.status_words import Status

MOST_CARDS: Final = 4
"""With more peers, the first page has a table of them."""
PathKey = tuple[str, int]
"""Peer and number of a path."""
_WORDS: Final = {"security": "attack", "fault": "blocked", "warning": "warning"}
_ORDER: Final = ("attack", "lost", "blocked", "waiting", "warning", "up")
_SHOWN_REFUSALS: Final = 30
_ARDUPILOT: Final = 3  # MAV_AUTOPILOT
_PX4: Final = 12
_MODES: Final[Mapping[str, Any]] = tomllib.loads((files("uavlinkd.web") / "modes.toml").read_text())


def paths_of(status: Status) -> Iterator[tuple[PathKey, tuple[float | None, float | None, float]]]:
    """Round trip in seconds, worse of the two losses, and bytes a second in both directions, of each path.

    The daemon keeps the last figures of a path that is down, and of a link that is lost: these are left out.
    """
    for name, peer in status["peers"].items():
        for path in peer["paths"]:
            loss, rate = max(path["loss_in"], path["loss_out"]), path["bytes_in_s"] + path["bytes_out_s"]
            is_measured = peer["state"] == "up" and path["state"] != "down"
            measured = (path["round_trip_s"], round(loss, 4)) if is_measured else (None, None)
            yield (name, path["number"]), (*measured, round(rate))


def view(status: Status, past: Sequence[Mapping[str, Any]], peer: str) -> dict[str, Any]:
    """The whole page, or that of one peer. ``past``: the problems of the log."""
    lines, peers = words.problems(status["findings"]), words.peers_of(status)
    states = _states(peers, lines)
    names = [peer] if peer else list(states) if len(states) <= MOST_CARDS else []
    fleet = status["fleet"]
    facts: dict[str, Any] = {
        "daemon": status["name"],
        "fleet": "" if fleet is None else titled("fleet", fleet["fleet"]),
        "frames_pass": status["frames_pass"],
        "worst": next(iter(states.values()), "waiting"),
        "headline": [part._asdict() for part in words.headline(status)],
        "problems": [line._asdict() for line in lines if not peer or not line.peers or peer in line.peers],
        "past": [line for line in past if not peer or line["name"] == peer],
        "cards": [card(name, peers[name], states[name]) for name in names if name in states],
    }
    if peer:
        return facts
    relay = status["relay"]
    return facts | {
        "rows": [] if names else [top(name, peers[name], word) for name, word in states.items()],
        "members": {} if relay is None else relay["members"],
        "endpoints": [_endpoint(*item) for item in status["endpoints"].items()],
        "networks": [_network(*item) for item in status["networks"].items()],
        "lines": [
            *([] if fleet is None else [words.fleet_line(fleet)._asdict()]),
            *(words.used_relay(*item)._asdict() for item in status["relays"].items()),
            *({"text": text, "is_good": True} for text in words.other_losses(status)),
        ],
    }


def _states(peers: dict[str, Status], lines: Sequence[words.ProblemLine]) -> dict[str, str]:
    """The word for each peer, the broken ones first."""
    worst = {name: line.severity for line in reversed(lines) for name in line.peers}  # the most severe of several
    states = {
        name: _WORDS.get(worst.get(name, ""), "up")
        if peer["state"] == "up" or worst.get(name) == "security"
        else peer["state"]
        for name, peer in peers.items()
    }
    return dict(sorted(states.items(), key=lambda item: (_ORDER.index(item[1]), item[0])))


def top(name: str, peer: Status, word: str) -> dict[str, Any]:
    """What a row of the table shows, and the top of a card: also of a peer with few facts."""
    time_s, is_up, paths = peer["round_trip_s"], peer["state"] == "up", peer["paths"]
    return {
        "name": name,
        "word": word,
        **{key: peer[key] for key in ("role", "commands", "last_received_s", "freshness_unverified_s")},
        "is_up": is_up,
        "vehicles": [vehicle | {"mode": mode_name(vehicle)} for vehicle in peer["vehicles"]],
        "answered_s": min((path["answered_s"] for path in paths if path["answered_s"] is not None), default=None),
        "path": _kind(paths[0]) if paths else None,
        "round_trip_s": round(time_s, 4) if is_up and time_s is not None else None,
        "loss": round(max(peer["loss_in"], peer["loss_out"]), 3) if is_up else None,
        "rates": [round(peer["bytes_in_s"]), round(peer["bytes_out_s"])],
    }


def card(name: str, peer: Status, word: str) -> dict[str, Any]:
    """Everything about one peer. The daemon was perhaps asked for a few facts only."""
    facts = top(name, peer, word)
    if "session" not in peer:
        return facts | {"paths": [], "facts": [], "refused": [], "dropped": [], "reported": []}
    session = peer["session"] or {}
    return facts | {
        "paths": [
            _path(path, address, is_up=peer["state"] == "up")
            for path, address in zip(peer["paths"], addresses(peer["paths"]), strict=True)
        ],
        "facts": [
            ["role", peer["role"] or "none"],
            ["key exchange", session.get("suite", "no session")],
            ["mode", session.get("mode", "-")],
            ["public key", peer["public_key"]],
            *([["repair", words.repair_line(peer["repair"])]] if peer["repair"]["is_on"] else []),
            *([["withheld", text]] if (text := words.withheld(peer)) else []),
            *([["overtaken", text]] if (text := words.overtaken(peer)) else []),
        ],
        "refused": sorted(_refused(peer), key=lambda item: -item[3])[:_SHOWN_REFUSALS],
        "dropped": words.ranked(words.peer_drops(peer)),
        "reported": peer["refused_there"],
    }


def mode_name(vehicle: Mapping[str, int]) -> str:
    """The flight mode as ground stations name it; the number of one that the table does not have."""
    number, family = vehicle["custom_mode"], _MODES["types"]
    names: list[str] = []
    if vehicle["autopilot"] == _ARDUPILOT:
        kind = next((kind for kind, types in family.items() if vehicle["type"] in types), "")
        names, at = _MODES["ardupilot"].get(kind, []), number
    elif vehicle["autopilot"] == _PX4:
        names, at = _MODES["px4"]["main"], number >> 16 & 0xFF
        if names.index("AUTO") == at and 0 < number >> 24 < len(_MODES["px4"]["auto"]):
            names, at = _MODES["px4"]["auto"], number >> 24
    return (names[at] if names and at < len(names) else "") or f"mode {number}"


def _kind(path: Status) -> str:
    """What the path leads along: a network, a relay, or neither."""
    relay = "" if path["relay"] is None else titled("relay", path["relay"])
    return " by ".join(filter(None, (path["network"], relay))) or "direct"


def _path(path: Status, address: str, *, is_up: bool) -> dict[str, Any]:
    is_measured = is_up and path["state"] != "down"
    return {
        "number": path["number"],
        "kind": _kind(path),
        "address": address,
        "condition": words.condition(path) if is_up else "unknown",
        "state": words.path_state(path) if is_up else "no link",
        "carries": words.carried(path),
        "rtt": path["round_trip_s"] if is_measured else None,
        "jitter": path["jitter_s"] if is_measured else None,
        "loss": [path["loss_in"], path["loss_out"]] if is_measured else [None, None],
        "rate": [path["bytes_in_s"], path["bytes_out_s"]],
    }


def _refused(peer: Status) -> Iterator[tuple[str, str, str, int]]:
    """Direction, message or command, reason and count."""
    for kind in ("refused", "refused_commands"):
        for direction, messages in peer[kind].items():
            for message, reasons in messages.items():
                for reason, count in reasons.items():
                    yield direction, message, words.phrase(reason, Refusal), count


def _endpoint(name: str, endpoint: Status) -> dict[str, Any]:
    return {
        "name": name,
        "clients": [[address, client["last_received_s"]] for address, client in endpoint["clients"].items()],
        "frames": [endpoint["frames_received"], endpoint["frames_sent"]],
        "problems": words.listed(words.endpoint_drops(endpoint)),
    }


def _network(name: str, network: Status) -> dict[str, Any]:
    facts = {key: network[key] for key in ("is_metered", "is_present")}
    return {"name": name, "exit": words.network_exit(network), "text": words.network_text(network), **facts}
