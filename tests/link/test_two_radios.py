"""Frames by class between two daemons with two radios: what goes along which, and what is delivered."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest

from tests.link.two_radios import End, Network, Radio
from tests.mavlink.egress.samples import attitude, command, heartbeat
from tests.mavlink.egress.test_by_class import CLASS_OF, log_data
from tests.mavlink.test_answers import read_by_name, value
from tests.mavlink.test_newest import manual_control, number_of, steps_back
from uavlinkd.core.constants import CRITICAL_ENVELOPE_LIMIT
from uavlinkd.core.path_state import PathCondition
from uavlinkd.link.peer_output import PeerOutput
from uavlinkd.link.shell_reasons import ShellReason
from uavlinkd.mavlink.egress.budgeted import EgressSettings
from uavlinkd.mavlink.frames import Frame

FAST, SLOW = Radio(0.02), Radio(0.1)
GENTLE = {"alpha": EgressSettings(coalesce_s=0.05)}


def network(*radios: Radio, egress: dict[str, EgressSettings] | None = None) -> Network:
    """Both ends have all their paths."""
    made = Network(radios, egress=egress)
    made.establish()
    for end in (made.alpha, made.bravo):
        end.sent.clear()
    return made


def radios_of(end: End, *frames: Frame) -> dict[bytes, Counter[int]]:
    """How many datagrams with each of these frames an end sent on each radio. Frames are readable in an envelope."""
    return {frame.raw: Counter(sent.radio for sent in end.sent if frame.raw in sent.datagram) for frame in frames}


def test_joystick_over_a_lossy_fast_path_and_a_slow_one_never_goes_back() -> None:
    """40 s of MANUAL_CONTROL at 25 Hz: without the rule 29 % would be older than one delivered before."""
    pair = network(Radio(0.05, 0.3), Radio(0.4))
    for number in range(1000):
        pair.alpha.send(manual_control(number))
        pair.run(pair.now + 0.04)
    pair.run(pair.now + 1.0)
    delivered = [number_of(frame) for frame in pair.bravo.delivered]
    superseded = pair.bravo.link.frames_superseded
    assert steps_back(delivered) == 0
    assert len(delivered) + superseded == 1000, "one path loses nothing"
    assert 260 < superseded < 320


def test_critical_frames_go_along_every_path_and_others_along_the_best() -> None:
    """One batch, as a client sends it."""
    pair = network(FAST, SLOW)
    frames = [attitude(1), command(1), log_data(1), heartbeat(1)]
    pair.alpha.send(*frames)
    assert radios_of(pair.alpha, *frames) == {
        attitude(1).raw: {0: 1},
        command(1).raw: {0: 1, 1: 1},
        log_data(1).raw: {0: 1},
        heartbeat(1).raw: {0: 1, 1: 1},
    }
    pair.run(pair.now + 1.0)
    assert sorted(frame.raw for frame in pair.bravo.delivered) == sorted(frame.raw for frame in frames)


def test_critical_envelopes_are_short_and_bit_identical() -> None:
    """Forty commands together: each envelope fits every path, and its copy is the same datagram."""
    pair = network(FAST, SLOW)
    commands = [command(number) for number in range(40)]
    pair.alpha.send(*commands)
    pair.run(pair.now + 0.5)
    datagrams = [sent.datagram for sent in pair.alpha.sent if any(frame.raw in sent.datagram for frame in commands)]
    assert set(Counter(datagrams).values()) == {2}
    assert max(map(len, datagrams)) <= CRITICAL_ENVELOPE_LIMIT
    assert radios_of(pair.alpha, *commands) == {frame.raw: {0: 1, 1: 1} for frame in commands}


def test_waiting_frames_are_sent_by_class_too() -> None:
    """A coalescing delay: the command leaves at once along both paths, the attitudes later along the best one."""
    pair = network(FAST, SLOW, egress=GENTLE)
    began = pair.now
    pair.alpha.send(attitude(1), command(1))
    pair.run(began + 0.01)
    pair.alpha.send(attitude(2))
    assert radios_of(pair.alpha, attitude(1), command(1)) == {attitude(1).raw: {}, command(1).raw: {0: 1, 1: 1}}
    pair.run(began + 0.2)
    (envelope,) = [sent for sent in pair.alpha.sent if attitude(1).raw in sent.datagram]
    assert attitude(2).raw in envelope.datagram
    assert envelope.at == pytest.approx(began + 0.05)


def test_one_path_shares_envelopes_between_classes_as_ever() -> None:
    """The class has no effect: one envelope holds all frames of a batch."""
    pair = network(FAST)
    frames = [attitude(1), command(1), log_data(1)]
    pair.alpha.send(*frames)
    (envelope,) = pair.alpha.sent
    assert all(frame.raw in envelope.datagram for frame in frames)


def test_answer_to_a_parameter_request_is_critical_and_a_list_is_not() -> None:
    """The station asked for one parameter. The vehicle sends this one, and others of a list."""
    pair = network(FAST, SLOW)
    pair.alpha.send(read_by_name(b"RTL_ALT"))
    pair.run(pair.now + 0.5)
    pair.bravo.sent.clear()
    answer, other = value(b"RTL_ALT", 7), value(b"WP_RADIUS", 8)
    pair.bravo.send(answer, other)
    assert radios_of(pair.bravo, answer, other) == {answer.raw: {0: 1, 1: 1}, other.raw: {0: 1}}


def test_bulk_stays_off_a_metered_network() -> None:
    """The faster network is metered: only critical frames go there while the other one works."""
    pair = network(FAST, SLOW)
    pair.alpha.node.set_metered([0], pair.now)
    pair.run(pair.now + 0.1)
    pair.alpha.sent.clear()
    pair.alpha.send(log_data(1), attitude(1), command(1))
    assert radios_of(pair.alpha, log_data(1), attitude(1), command(1)) == {
        log_data(1).raw: {1: 1},
        attitude(1).raw: {1: 1},
        command(1).raw: {0: 1, 1: 1},
    }


def test_copies_of_events_are_delivered_once() -> None:
    """Each command once, whichever copy is first."""
    pair = network(Radio(0.02, 0.2), SLOW)
    commands = [command(number) for number in range(50)]
    for sent in commands:
        pair.alpha.send(sent)
        pair.run(pair.now + 0.02)
    pair.run(pair.now + 1.0)
    assert sorted(frame.raw for frame in pair.bravo.delivered) == sorted(frame.raw for frame in commands)


RADIO_BITS_S = 9600
TELEMETRY_MODEM = Radio(0.15, budget_bits_s=RADIO_BITS_S)


def wire_bits(end: End, radio: int, since: float) -> int:
    """What an end sent on a radio, with IPv4 and UDP headers."""
    return sum(8 * (len(sent.datagram) + 28) for sent in end.sent if sent.radio == radio and sent.at >= since)


def fly(pair: Network, seconds: int) -> tuple[list[Frame], list[Frame]]:
    """A vehicle's telemetry at 51 frames/s, and a command each second. Returns its heartbeats and the commands."""
    heartbeats, commands = [], []
    for tick in range(50 * seconds):
        pair.bravo.send(attitude(tick))
        if tick % 50 == 0:
            heartbeats.append(heartbeat(tick // 50))
            commands.append(command(tick))
            pair.bravo.send(heartbeats[-1])
            pair.alpha.send(commands[-1])
        pair.run(pair.now + 0.02)
    return heartbeats, commands


def test_standby_with_a_budget_carries_the_critical_frames_within_it() -> None:
    """LTE carries all. The telemetry modem carries every heartbeat and command too, within half of its budget."""
    pair = network(FAST, TELEMETRY_MODEM)
    pair.run(pair.now + 2.0)
    began, seconds = pair.now, 60
    heartbeats, commands = fly(pair, seconds)
    assert len(pair.alpha.delivered) == 51 * seconds
    assert len(pair.bravo.delivered) == seconds
    assert radios_of(pair.bravo, *heartbeats) == {frame.raw: {0: 1, 1: 1} for frame in heartbeats}
    assert radios_of(pair.alpha, *commands) == {frame.raw: {0: 1, 1: 1} for frame in commands}
    for end in (pair.alpha, pair.bravo):
        assert wire_bits(end, 1, began) < 0.5 * RADIO_BITS_S * seconds
        assert end.link.output.copies.dropped.total() == 0


def test_radio_that_is_alone_carries_what_its_budget_allows() -> None:
    """LTE dies. The stream waits for the modem's budget. No critical frame is lost, or waits for the stream."""
    pair = network(FAST, TELEMETRY_MODEM)
    fly(pair, 5)
    pair.radios[0] = Radio(0.02, loss=1.0)
    pair.run(pair.now + 3.0)
    for end in (pair.alpha, pair.bravo):
        end.sent.clear()
        end.delivered.clear()
        end.delivered_at.clear()
    began, seconds = pair.now, 30
    heartbeats, commands = fly(pair, seconds)
    pair.run(pair.now + 1.0)
    assert {frame.raw for frame in heartbeats} <= {frame.raw for frame in pair.alpha.delivered}
    assert {frame.raw for frame in commands} == {frame.raw for frame in pair.bravo.delivered}
    arrivals = dict(zip((frame.raw for frame in pair.alpha.delivered), pair.alpha.delivered_at, strict=True))
    late = [arrivals[frame.raw] - began - number for number, frame in enumerate(heartbeats)]
    assert max(late) < 1.0
    assert wire_bits(pair.bravo, 1, began) < RADIO_BITS_S * (seconds + 1.25)
    egress = pair.bravo.link.output.egress
    assert egress is not None
    assert egress.totals.total() > 0
    assert pair.bravo.link.measure(pair.now).demand > 1


def test_joystick_copies_on_a_slow_radio_are_the_newest_ones() -> None:
    """50 Hz of MANUAL_CONTROL: the modem carries a part of it, in half of its budget. Probes and echoes are extra."""
    pair = network(FAST, TELEMETRY_MODEM)
    began, seconds = pair.now, 20
    for number in range(50 * seconds):
        pair.alpha.send(manual_control(number))
        pair.run(pair.now + 0.02)
    copies = pair.alpha.link.output.copies
    assert wire_bits(pair.alpha, 1, began) < 0.7 * RADIO_BITS_S * seconds
    assert copies.dropped[ShellReason.COPY_REPLACED] > 10 * seconds
    ages = [
        sent.at - (began + number * 0.02)
        for number in range(50 * seconds)
        for sent in pair.alpha.sent
        if sent.radio == 1 and manual_control(number).raw in sent.datagram
    ]
    assert len(ages) > 3 * seconds
    assert max(ages) < 0.1
    delivered = [number_of(frame) for frame in pair.bravo.delivered]
    assert steps_back(delivered) == 0
    assert len(delivered) == 50 * seconds


def test_copies_that_wait_are_not_counted_as_lost_by_their_path() -> None:
    """The modem loses nothing: its probes show no loss, and the path is never suspect for it."""
    pair = network(FAST, TELEMETRY_MODEM)
    for number in range(1000):
        pair.alpha.send(manual_control(number), command(number))
        pair.run(pair.now + 0.02)
        modem = pair.alpha.peer.paths.states[1]
        assert modem.condition is PathCondition.USABLE
        assert modem.loss_out < 0.05
    assert pair.alpha.link.output.copies.dropped.total() > 100


@pytest.mark.parametrize("is_removed", [True, False], ids=["removed", "changed by a reload"])
def test_peer_that_stops_waiting_lets_others_use_the_network(is_removed: bool) -> None:
    """Its frames waited in line for the modem. The other peer's frames are next, not behind it indefinitely."""
    pair = network(TELEMETRY_MODEM)
    budget = pair.alpha.budgets[0]
    other = PeerOutput(EgressSettings(), pair.alpha.node, pair.alpha.budgets, CLASS_OF, lambda *_: None, pair.now)
    other.follow(pair.alpha.peer, pair.now)
    budget.all.spend(1.1 * RADIO_BITS_S / 8, pair.now)
    pair.alpha.send(attitude(1))
    other.send(pair.alpha.peer, [attitude(2)], pair.now, 0.0)
    other.send_waiting(pair.alpha.peer, [], pair.now)
    assert other.egress is not None
    assert other.egress.queued_frames == 1
    if is_removed:
        pair.alpha.link.leave(pair.now)
    else:
        config = replace(pair.alpha.link.config, egress=EgressSettings(budget_bits_s=RADIO_BITS_S))
        pair.alpha.link.change(config, pair.now)
    later = pair.now + 0.95
    assert budget.all.level(later) > 150
    assert other.egress.take(later)[1] == [attitude(2)]
