"""Times handshakes and rekeys of real daemons, over UDP on loopback, through a counting relay.

First, the initiator has sent an initiation to the closed relay and waits for its retry; both processes are idle. Then
the relay opens. The time starts when the next initiation reaches the relay. It ends when the responder delivers the
first frame, which is sent when the initiator has confirmed. So the start of the processes (about 0.5 s) is not
included, and the computation before the initiation is only in the initiator's processor time. The relay delays each
of the four datagrams; the records of frames with and without it show by how much.
"""

from __future__ import annotations

import time

from uavlinkd.core import wire
from uavlinkd.lab.evaluation.loop import ENVELOPES, Relay
from uavlinkd.lab.evaluation.machine import CpuTimeError, EnergyMeter
from uavlinkd.lab.evaluation.pair import LinkChoice, Pair, PairError
from uavlinkd.lab.evaluation.records import Record, Status, Value

HANDSHAKE_LIMIT_S = 20.0
"""Enough for some retries: a handshake that takes longer has failed."""
REKEY_AFTER_S = 1.0
"""The shortest configurable interval."""
_SETTLE_S = 0.01
"""The delay after the frame until both processes are idle, so that their processor time is complete."""


def measure_handshake(choice: LinkChoice, meter: EnergyMeter) -> Record:
    """Measure one handshake between two new processes with new keys."""
    point = point_of(choice)
    try:
        with Pair(choice, with_relay=True) as pair:
            return Record("handshake", point, _time_handshake(pair, meter))
    except (PairError, CpuTimeError, OSError) as error:
        return Record("handshake", point, {}, Status.FAILED, str(error))


def point_of(choice: LinkChoice) -> dict[str, Value]:
    """The point of the grid."""
    return {"suite": choice.suite.name, "mac_key_bits": choice.mac_key_bits, "confidential": choice.confidential}


def _relay_of(pair: Pair) -> Relay:
    assert pair.relay is not None
    return pair.relay


def _time_handshake(pair: Pair, meter: EnergyMeter) -> dict[str, Value]:
    relay = _relay_of(pair)
    if not pair.loop.until(lambda: relay.turned_away > 0, HANDSHAKE_LIMIT_S):
        raise PairError("the initiator did not send an initiation")
    cpu_before = pair.cpu_s()
    meter.start()
    relay.open()
    _until_confirmed(pair, relay)
    sent = [pair.send_frame()]

    def is_delivered() -> bool:
        return any(frame in pair.sink.arrived for frame, _ in sent)

    # A frame that arrives before the initiator has a session is dropped: another follows.
    until = time.monotonic() + HANDSHAKE_LIMIT_S
    while not pair.loop.until(is_delivered, 0.25):
        if time.monotonic() >= until:
            raise PairError(f"no frame was delivered: {pair.responder.drops()}")
        sent.append(pair.send_frame())
    delivered_at = min(pair.sink.arrived[frame] for frame, _ in sent if frame in pair.sink.arrived)
    pair.loop.rest(_SETTLE_S)
    joules = meter.joules()
    cpu_after = pair.cpu_s()

    there, back = relay.there, relay.back
    started_at = there.first_at[wire.INITIATION]
    confirmed_at = min(there.first_at[kind] for kind in ENVELOPES if kind in there.first_at)
    return {
        "total_s": delivered_at - started_at,
        "response_s": back.first_at[wire.RESPONSE] - started_at,
        "confirmation_s": confirmed_at - back.first_at[wire.RESPONSE],
        "frame_s": delivered_at - sent[0][1],
        "cpu_initiator_s": cpu_after[0] - cpu_before[0],
        "cpu_responder_s": cpu_after[1] - cpu_before[1],
        "joules": joules,
        "initiations": there.kinds[wire.INITIATION],
        "frames_sent": len(sent),
        "datagrams_there": there.datagrams,
        "datagrams_back": back.datagrams,
        "bytes_there": there.bytes,
        "bytes_back": back.bytes,
    }


def _until_confirmed(pair: Pair, relay: Relay) -> None:
    """Wait for the initiator's first envelope: it confirms the session of both.

    Raises:
        PairError: there is no envelope in time.
    """
    if not pair.loop.until(lambda: any(kind in relay.there.kinds for kind in ENVELOPES), HANDSHAKE_LIMIT_S):
        raise PairError(
            f"no session within {HANDSHAKE_LIMIT_S:g} s, after {relay.there.kinds[wire.INITIATION]} initiations: "
            + pair.responder.drops()
        )


def measure_rekeys(choice: LinkChoice, count: int) -> list[Record]:
    """Measure ``count`` rekeys of one running pair, triggered by the age of the keys.

    The time is from the initiation to the first envelope under the new keys, both at the relay.
    """
    choice = LinkChoice(choice.suite, choice.mac_key_bits, choice.confidential, REKEY_AFTER_S)
    point = point_of(choice)
    records: list[Record] = []
    try:
        with Pair(choice, with_relay=True) as pair:
            relay = _relay_of(pair)
            relay.open()
            pair.wait_until_linked()
            while len(records) < count:
                records.append(Record("rekey", point, _time_rekey(pair, relay)))
    except (PairError, CpuTimeError, OSError) as error:
        records.append(Record("rekey", point, {}, Status.FAILED, str(error)))
    return records


def _time_rekey(pair: Pair, relay: Relay) -> dict[str, Value]:
    cpu_before = pair.cpu_s()
    relay.open()
    for kind, message, seen in (
        (wire.INITIATION, "initiation", relay.there),
        (wire.RESPONSE, "response", relay.back),
    ):
        if not pair.loop.until(lambda: kind in seen.kinds, HANDSHAKE_LIMIT_S):  # noqa: B023  called in this iteration only
            raise PairError(f"there was no {message} within {HANDSHAKE_LIMIT_S:g} s")
    started_at, answered_at = relay.there.first_at[wire.INITIATION], relay.back.first_at[wire.RESPONSE]
    # Envelopes under the old keys may have passed before: reset the counters at the response.
    initiations = relay.there.kinds[wire.INITIATION]
    relay.open()
    _until_confirmed(pair, relay)
    confirmed_at = min(relay.there.first_at[kind] for kind in ENVELOPES if kind in relay.there.first_at)
    pair.loop.rest(_SETTLE_S)
    cpu_after = pair.cpu_s()
    return {
        "total_s": confirmed_at - started_at,
        "response_s": answered_at - started_at,
        "cpu_initiator_s": cpu_after[0] - cpu_before[0],
        "cpu_responder_s": cpu_after[1] - cpu_before[1],
        "initiations": initiations,
    }
