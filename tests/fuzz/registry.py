"""Every fuzz target by its name: the entry points for bytes or files of other senders."""

from __future__ import annotations

from typing import Final

from tests.fuzz import candidates, files, frames, handles, handshakes, insiders, lines, outsiders, relays, requests
from tests.fuzz.engine import Target

_CORE: Final = 4096

TARGETS: Final = {
    target.name: target
    for target in (
        Target("idle", "datagrams to a node before any handshake", outsiders.make_idle, outsiders.seeds, _CORE),
        Target(
            "initiator",
            "datagrams to a node that waits for the response to its initiation",
            outsiders.make_initiator,
            outsiders.seeds,
            _CORE,
        ),
        Target(
            "responder",
            "datagrams to a node that has answered and waits for the confirmation",
            outsiders.make_responder,
            outsiders.seeds,
            _CORE,
        ),
        Target("session", "datagrams to a node with a session", outsiders.make_session, outsiders.seeds, _CORE),
        Target(
            "sealed",
            "payloads, control records and handshakes of a configured peer that holds its keys",
            insiders.make_sealed,
            insiders.sealed_seeds,
        ),
        Target(
            "handshakes",
            "handshake messages sealed correctly around any content, to both roles",
            handshakes.make,
            handshakes.seeds,
            512,
        ),
        Target("relay", "a relay: strangers, and members that hold their keys", relays.make, relays.seeds, 512),
        Target("handles", "the handles that a hostile relay assigns", handles.make, handles.seeds, 1024),
        Target(
            "candidates",
            "the candidates of a peer that holds its keys",
            candidates.make,
            candidates.seeds,
            1024,
        ),
        Target(
            "stream", "a client's MAVLink on a serial port or TCP, cut anywhere", frames.make_stream, frames.seeds
        ),
        Target("line", "the line of a serial network, cut anywhere", lines.make, lines.seeds),
        Target("frames", "a client's datagrams, and a peer's payloads", frames.make_datagrams, frames.seeds),
        Target("gate", "frames at a policy", frames.make_gate, frames.seeds),
        Target(
            "switch", "frames from six ports through policies, router and switch", frames.make_switch, frames.seeds
        ),
        Target(
            "control",
            "the control socket's requests",
            requests.make_control,
            requests.control_seeds,
            512,
            (b"status", b"reload", b"\n", b"\r\n"),
        ),
        Target(
            "metrics",
            "HTTP at the metrics port",
            requests.make_metrics,
            requests.metrics_seeds,
            10_000,
            (b"GET ", b"HEAD ", b"/metrics", b" HTTP/1.1\r\n", b"Host: ", b"\r\n\r\n", b"[::1]"),
            is_text=True,
        ),
        Target(
            "config",
            "the daemon's configuration",
            files.make_config,
            files.config_seeds,
            4096,
            files.WORDS,
            is_text=True,
        ),
        Target(
            "mitm", "the man in the middle's settings", files.make_mitm, files.mitm_seeds, 4096, files.WORDS, True
        ),
        Target("manifest", "a fleet's manifest", files.make_manifest, files.manifest_seeds, 4096, files.WORDS, True),
        Target("key", "a key file", files.make_key, files.key_seeds, 300),
        Target("tlog", "a recorded flight", files.make_tlog, files.tlog_seeds),
        Target("anatomy", "a datagram as the man in the middle parses it", files.make_anatomy, files.anatomy_seeds),
    )
}
