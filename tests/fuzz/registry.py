"""Every fuzz target by its name: the entry points for bytes or files of other senders."""

from __future__ import annotations

from typing import Final

from tests.fuzz import (
    candidates,
    files,
    fleets,
    frames,
    handles,
    handshakes,
    insiders,
    lines,
    messages,
    outsiders,
    packets,
    relays,
    requests,
    signatures,
    stations,
)
from tests.fuzz.engine import Target

_CONTROL: Final = (b"status", b"reload", b"\n", b"\r\n")

_TARGETS: Final = (
    Target("idle", "datagrams before any handshake", outsiders.make_idle, 4096),
    Target("initiator", "datagrams beside an own initiation", outsiders.make_initiator, 4096),
    Target("responder", "datagrams beside an unconfirmed answer", outsiders.make_responder, 4096),
    Target("session", "datagrams to a node with a session", outsiders.make_session, 4096),
    Target("sealed", "all that a configured peer can seal", insiders.make_sealed),
    Target("handshakes", "handshakes sealed around any content", handshakes.make, 512),
    Target("relay", "a relay: strangers, and members that hold their keys", relays.make, 512),
    Target("handles", "the handles that a hostile relay assigns", handles.make, 1024),
    Target("candidates", "the candidates of a peer that holds its keys", candidates.make, 1024),
    Target("exchange", "bulletins from hostile members", fleets.make_exchange, 1024),
    Target(
        "signed", "what an authority signs, and its records", fleets.make_signed, 700, (), False, fleets.signed_seeds
    ),
    Target("stream", "a client's MAVLink on a serial port or TCP, cut anywhere", frames.make_stream),
    Target("line", "the line of a serial network, cut anywhere", lines.make),
    Target("messages", "HTTP and WebSocket inside TLS, cut anywhere", messages.make, 2048, messages.WORDS),
    Target("frames", "a client's datagrams, and a peer's payloads", frames.make_datagrams),
    Target("gate", "frames at a policy", frames.make_gate),
    Target("signing", "the wire to an autopilot that signs", signatures.make),
    Target("switch", "frames from six ports through policies and router", frames.make_switch),
    Target("control", "the control socket", requests.make_control, 512, _CONTROL),
    Target("config", "the configuration", files.make_config, 4096, files.WORDS, True, files.config_seeds),
    Target("mitm", "the man in the middle's settings", files.make_mitm, 4096, files.WORDS, True, files.mitm_seeds),
    Target("manifest", "a fleet's manifest", files.make_manifest, 4096, files.WORDS, True),
    Target("key", "a key file", files.make_key, 300),
    Target("enrolment", "the lines of an enrolment", files.make_enrolment),
    Target("stations", "datagrams to the port for stations", stations.make, 512),
    Target("packets", "packets inside a station's tunnel", packets.make, 256),
    Target("anatomy", "a datagram as the man in the middle parses it", files.make_anatomy),
)
TARGETS: Final = {target.name: target for target in _TARGETS}
