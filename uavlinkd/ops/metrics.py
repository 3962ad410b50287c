"""Metrics for Prometheus, made of what the daemon tells about itself, in the text format 0.0.4
(https://prometheus.io/docs/instrumenting/exposition_formats/).

Names follow https://prometheus.io/docs/practices/naming/: base units, ``_total`` for what only grows. Labels are
names from the configuration and reasons from closed lists: their number is bounded, whatever comes from the network.
What tells of an attack is there from the start, as zero: Prometheus sees no increase in what was not there before.

Ages, not points in time: a drone without a clock does not know when a handshake was, but how long ago.

Written here and not by a library: the loop that answers carries the link, and this takes a tenth of the time.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from uavlinkd import __version__
from uavlinkd.core.drops import DropReason
from uavlinkd.mavlink.policy.gate import Refusal

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"

Status = Mapping[str, Any]
Sample = tuple[str, float]
"""Labels as they are written, and the value."""

_STATM = Path("/proc/self/statm")

_PEER_AGES = {
    "handshake_s": ("peer_last_handshake_age_seconds", "Since the last handshake that made new keys."),
    "heard_s": ("peer_last_heard_age_seconds", "Since the last authentic datagram from the peer."),
    "round_trip_s": ("round_trip_seconds", "To the peer and back."),
}
_PEER_TOTALS = {
    "bytes_received": ("peer_receive_bytes_total", "Bytes of datagrams from the peer."),
    "bytes_sent": ("peer_transmit_bytes_total", "Bytes of datagrams to the peer."),
    "bytes_elsewhere": (
        "peer_elsewhere_bytes_total",
        "Bytes of answers to places where the peer is not known to be: somebody replays what it said.",
    ),
    "envelopes_received": ("peer_receive_envelopes_total", "Envelopes from the peer, authentic and new."),
    "envelopes_sent": ("peer_transmit_envelopes_total", "Envelopes to the peer."),
    "frames_received": ("peer_receive_frames_total", "MAVLink frames from the peer."),
    "handshakes": ("peer_handshakes_total", "Handshakes that made new keys."),
    "envelopes_missing": ("peer_missing_envelopes_total", "Envelopes that the peer sent and that never came."),
    "envelopes_out_of_order": ("peer_out_of_order_envelopes_total", "Envelopes that came after later ones."),
    "challenges_unanswered": ("peer_unanswered_challenges_total", "Places that spoke as the peer and are not it."),
    "handshakes_unanswered": (
        "peer_unanswered_handshakes_total",
        "Calls for new keys that had to be repeated while the peer was up.",
    ),
    "cookies_taken": ("peer_taken_cookies_total", "Cookies taken from the peer, which it sends under load."),
    "echoes_unanswered": ("peer_unanswered_echoes_total", "Echo requests that the peer did not answer."),
}
_ENDPOINT_TOTALS = {
    "bytes_received": ("endpoint_receive_bytes_total", "Bytes from the endpoint's programs."),
    "bytes_sent": ("endpoint_transmit_bytes_total", "Bytes to the endpoint's programs."),
    "frames_received": ("endpoint_receive_frames_total", "MAVLink frames from the endpoint's programs."),
    "frames_sent": ("endpoint_transmit_frames_total", "MAVLink frames to the endpoint's programs."),
    "garbage_bytes": ("endpoint_garbage_bytes_total", "Bytes from its programs that are in no MAVLink frame."),
}
_RECORDING_TOTALS = {
    "frames": ("recording_frames_total", "Frames written to recordings."),
    "bytes": ("recording_bytes_total", "Bytes written to recordings."),
    "frames_lost": ("recording_lost_frames_total", "Frames not recorded: the disk was full, broken or slow."),
}


def exposition(status: Status, uptime_s: float) -> bytes:
    """A status (:func:`uavlinkd.link.status.daemon_status`) as the text that Prometheus reads."""
    peers, endpoints = status["peers"], status["endpoints"]
    lines = [
        *_daemon(status, uptime_s),
        *_links(peers),
        *_drops(status),
        *_totals("peer", peers, _PEER_TOTALS),
        *_reasons("peer_malformed_total", "Faults in what the peer said.", "peer", peers, "malformed"),
        *_reasons("peer_unsent_frames_total", "Frames that its budget held back.", "peer", peers, "waiting_dropped"),
        *_refused("peer", peers),
        *_family(
            "endpoint_programs",
            "Programs at the endpoint.",
            [(_labels(endpoint=name), len(each["programs"])) for name, each in endpoints.items()],
        ),
        *_totals("endpoint", endpoints, _ENDPOINT_TOTALS),
        *_reasons("endpoint_malformed_total", "Faults in what programs said.", "endpoint", endpoints, "faults"),
        *_reasons("endpoint_failures_total", "What went wrong there.", "endpoint", endpoints, "failures"),
        *_refused("endpoint", endpoints),
        *_recording(status["recording"]),
        "",
    ]
    return "\n".join(lines).encode()


def _daemon(status: Status, uptime_s: float) -> Iterator[str]:
    labels = _labels(name=status["name"], version=__version__, python=platform.python_version())
    yield from _family("build_info", "Which daemon this is.", [(labels, 1)])
    yield from _family("uptime_seconds", "Since the daemon started.", [("", uptime_s)])
    yield from _family("cpu_seconds_total", "Processor time of the daemon.", [("", time.process_time())])
    with suppress(OSError, ValueError, IndexError):
        pages = int(_STATM.read_text().split()[1])
        resident = pages * os.sysconf("SC_PAGE_SIZE")
        yield from _family("resident_memory_bytes", "Memory of the daemon.", [("", resident)])


def _links(peers: Mapping[str, Status]) -> Iterator[str]:
    up = [(_labels(peer=name), peer["state"] == "up") for name, peer in peers.items()]
    yield from _family("peer_up", "Whether the peer is linked.", up)
    unverified = [(_labels(peer=name), peer["freshness_unverified_s"] is not None) for name, peer in peers.items()]
    text = "Whether frames arrive that the peer does not confirm to be new: commands are dropped."
    yield from _family("peer_freshness_unverified", text, unverified)
    linked = {name: peer for name, peer in peers.items() if peer["session"] is not None}
    yield from _family(
        "peer_info",
        "How the peer is spoken to, while it is.",
        [
            (_labels(peer=name, **{key: str(peer["session"][key]) for key in ("suite", "mode", "tag_bits")}), 1)
            for name, peer in linked.items()
        ],
    )
    yield from _family(
        "path_loss_ratio",
        "Envelopes that were lost lately, of those sent.",
        [
            (_labels(peer=name, direction=direction), peer[f"loss_{direction}"])
            for name, peer in linked.items()
            for direction in ("in", "out")
        ],
    )
    for key, (name, text) in _PEER_AGES.items():
        known = [(_labels(peer=peer), each[key]) for peer, each in peers.items() if each[key] is not None]
        yield from _family(name, text, known)


def _drops(status: Status) -> Iterator[str]:
    by_peer = {"": status["drops"], **{name: peer["drops"] for name, peer in status["peers"].items()}}
    yield from _family(
        "rx_dropped_total",
        "Datagrams discarded; the peer is empty where they are of nobody known.",
        [
            (_labels(peer=peer, reason=reason), drops.get(reason, 0))
            for peer, drops in by_peer.items()
            for reason in DropReason
        ],
    )
    yield from _counts("send_failures_total", "Datagrams that the kernel did not take.", status["send_failures"])
    yield from _counts("unrouted_frames_total", "Frames that belong nowhere.", status["unrouted"])
    stale = [(_labels(source=who), amount) for who, amount in status["stale"].items()]
    yield from _family("stale_frames_total", "Frames that had waited while the daemon stood still.", stale)


def _recording(recording: Status | None) -> Iterator[str]:
    if recording is None:
        return
    yield from _family("recording_up", "Whether recordings can be written.", [("", recording["is_recording"])])
    for key, (name, text) in _RECORDING_TOTALS.items():
        yield from _family(name, text, [("", recording[key])])
    yield from _counts("recording_failures_total", "What the disk said.", recording["failures"])


def _counts(name: str, text: str, counts: Mapping[str, int]) -> Iterator[str]:
    return _family(name, text, [(_labels(reason=reason), amount) for reason, amount in counts.items()])


def _totals(kind: str, parts: Mapping[str, Status], names: Mapping[str, tuple[str, str]]) -> Iterator[str]:
    for key, (name, text) in names.items():
        yield from _family(name, text, [(_labels(**{kind: part}), each[key]) for part, each in parts.items()])


def _reasons(name: str, text: str, kind: str, parts: Mapping[str, Status], key: str) -> Iterator[str]:
    samples = [
        (_labels(**{kind: part}, reason=reason), amount)
        for part, each in parts.items()
        for reason, amount in each[key].items()
    ]
    return _family(name, text, samples)


def _refused(kind: str, parts: Mapping[str, Status]) -> Iterator[str]:
    """Summed over the messages: which of them they were is in the status."""
    samples: list[Sample] = []
    for part, each in parts.items():
        for direction, messages in each["refused"].items():
            sums = _summed(messages.values())
            for reason in Refusal:
                samples.append((_labels(**{kind: part}, direction=direction, reason=reason), sums.get(reason, 0)))
    text = f"Frames from (in) and to (out) the {kind} that its policy refused."
    return _family(f"{kind}_refused_frames_total", text, samples)


def _summed(counts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    sums: dict[str, int] = {}
    for each in counts:
        for reason, amount in each.items():
            sums[reason] = sums.get(reason, 0) + amount
    return sums


def _family(name: str, text: str, samples: Iterable[Sample]) -> Iterator[str]:
    """A metric with its samples; ``text`` has no backslash and no line break in it."""
    full = f"uavlinkd_{name}"
    yield f"# HELP {full} {text}"
    yield f"# TYPE {full} {'counter' if name.endswith('_total') else 'gauge'}"
    for labels, value in samples:
        yield f"{full}{labels} {value:d}" if isinstance(value, int) else f"{full}{labels} {value!r}"


def _labels(**labels: str) -> str:
    return "{" + ",".join([f'{name}="{_escaped(value)}"' for name, value in labels.items()]) + "}"


def _escaped(value: str) -> str:
    return value.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")
