"""Times the core alone: two nodes in this process, without sockets and scheduler.

The result is the time of cryptography and protocol, for each step. The rest of a handshake's time is transport.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence

from uavlinkd.core.crypto import KeyPair, Secret
from uavlinkd.core.node import Node
from uavlinkd.core.outputs import Deliver, Output, Transmit
from uavlinkd.core.path import Path
from uavlinkd.core.settings import Link, PeerSettings
from uavlinkd.lab.evaluation.pair import LinkChoice, numbered_frame
from uavlinkd.lab.evaluation.records import Record, Status
from uavlinkd.lab.evaluation.timing_handshake import point_of

_HERE = Path(0, ("127.0.0.1", 1))
_THERE = Path(0, ("127.0.0.1", 2))


def measure_core(choice: LinkChoice) -> Record:
    """One handshake between two new nodes, and one frame."""
    point = point_of(choice)
    link = Link(suites=(choice.suite,), mac_key_bits=choice.mac_key_bits, confidential=choice.confidential)
    keys = [os.urandom(32), os.urandom(32)]
    psk = Secret(os.urandom(32))
    initiator, responder = (Node(Secret(key), os.urandom, 0.0) for key in keys)
    b = initiator.add_peer(PeerSettings("b", KeyPair(keys[1]).public, psk, link), 0.0)
    a = responder.add_peer(PeerSettings("a", KeyPair(keys[0]).public, psk, link), 0.0)
    initiator.set_paths(b, [_THERE], 0.0)

    frame = numbered_frame(1)
    moments = [time.perf_counter()]
    initiation = initiator.handle_timeout(0.0)
    moments.append(time.perf_counter())
    response = responder.receive(_only(initiation), _HERE, 0.001)
    moments.append(time.perf_counter())
    confirmation = initiator.receive(_only(response), _THERE, 0.002)
    moments.append(time.perf_counter())
    responder.receive(_only(confirmation), _HERE, 0.003)
    moments.append(time.perf_counter())
    envelope = initiator.send(b, [frame], 0.004)
    delivered = responder.receive(_only(envelope), _HERE, 0.005)
    moments.append(time.perf_counter())

    if Deliver(a, frame) not in delivered:
        return Record("core", point, {}, Status.FAILED, "the other node did not deliver the frame")
    names = ("initiate_s", "respond_s", "finish_s", "confirm_s", "frame_s")
    steps = {name: after - before for name, before, after in zip(names, moments, moments[1:], strict=False)}
    return Record("core", point, {"total_s": moments[-1] - moments[0], **steps})


def _only(outputs: Sequence[Output]) -> bytes:
    """The first datagram to send."""
    return next(output.datagram for output in outputs if isinstance(output, Transmit))
