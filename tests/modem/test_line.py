"""Two daemons' links over emulated modems in virtual time: what arrives, and what attacks on the line achieve."""

from __future__ import annotations

from statistics import median

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.modem import command, line_network
from tests.modem.line_network import LineNetwork
from tests.modem.measure import on_bare_line, through_daemons
from tests.modem.offered import STATION, VEHICLE, Arrivals, Offered, offered
from uavlinkd.config.network_rules import SENDING_SHARE
from uavlinkd.core.settings import Link
from uavlinkd.lab.mitm.line_attacks import LINE_ATTACKS, parse_line_attack
from uavlinkd.lab.mitm.modem import ModemEnd, ModemSettings
from uavlinkd.mavlink.egress.budgeted import EgressSettings
from uavlinkd.mavlink.frames import SplitCounters, split_payload

OLDEST_S = 3.5
"""No frame is delivered later than this after it was sent: the limit after a silence (specification, section 11)."""


class Talk:
    """Numbered frames of both ends over a linked pair, checked against what was sent."""

    def __init__(self, modem: ModemSettings, seed: int = 1) -> None:
        self.network = LineNetwork(modem, Link(), EgressSettings(coalesce_s=0.1), seed)
        self.arrivals = Arrivals()
        self._codec = mavlink.MAVLink(None)
        self._messages = offered(300, 0.5)
        self._began = 0.0
        self._checked = {self.network.alpha: 0, self.network.bravo: 0}

    def link(self) -> None:
        while not self.network.is_linked():
            self.network.run(self.network.now + 0.05)
            assert self.network.now < 30
        self._began = self.network.now

    def send(self, what: Offered) -> bytes:
        self._codec.srcSystem, self._codec.srcComponent = what.system, 1
        raw = bytes(what.message.pack(self._codec))
        self.arrivals.send(raw, what, self.network.now)
        end = self.network.alpha if what.system == VEHICLE else self.network.bravo
        end.send(*split_payload(raw, SplitCounters()))
        return raw

    def run(self, seconds: float) -> None:
        """Both ends send for a time."""
        until = self.network.now + seconds
        while (at := self._began + self._messages[0].at) <= until:
            self.network.run(max(at, self.network.now))
            self.send(self._messages.pop(0))
        self.network.run(until)
        self.check()

    def check(self) -> None:
        """Every frame that was delivered was sent, and not delivered before."""
        for end, count in self._checked.items():
            for frame, at in zip(end.delivered[count:], end.delivered_at[count:], strict=True):
                self.arrivals.deliver(frame.raw, at)
            self._checked[end] = len(end.delivered)
        assert not self.arrivals.foreign

    def share(self, since: float = 0.0) -> float:
        """The smaller share of critical frames that arrived at an end. The newest may still be on air."""
        until = self.network.now - 1
        return min(self.arrivals.share(system, since, until, is_critical=True) for system in (VEHICLE, STATION))


def test_signing_alone_loses_heartbeats_under_load() -> None:
    """The modem drops what does not fit, whatever it is."""
    fits = on_bare_line(command.SIK, 30, command.factor_of(command.SIK, 0.5))
    assert (fits.critical_vehicle, fits.lost_in_queue) == (1.0, 0)
    overloaded = on_bare_line(command.SIK, 30, command.factor_of(command.SIK, 3))
    assert overloaded.critical_vehicle < 0.6
    assert overloaded.lost_in_queue > 10_000


def test_all_critical_frames_arrive_under_load() -> None:
    """States are thinned before the modem, which never loses a byte."""
    result = through_daemons(command.SIK, 30, command.factor_of(command.SIK, 3))
    assert (result.critical_vehicle, result.critical_station) == (1.0, 1.0)
    assert (result.lost_in_queue, result.foreign) == (0, 0)
    assert result.oldest_s < OLDEST_S
    assert result.delivered_s > 15


def test_radio_that_carries_half_of_what_the_file_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """Answers come too late to be accepted; the rate falls nevertheless. Otherwise 4 % arrive at this load."""
    monkeypatch.setattr(line_network, "SENDING_SHARE", 2 * SENDING_SHARE)
    result = through_daemons(command.SLOW, 120, command.factor_of(command.SLOW, 2))
    assert min(result.critical_vehicle, result.critical_station) > 0.4


def test_most_bytes_are_frames() -> None:
    """With coalescing: at least 80 % of what the vehicle writes, with handshake, probes and framing."""
    result = through_daemons(command.SIK, 60, command.factor_of(command.SIK, 1), *command.SAVING)
    assert result.frame_share >= 0.8
    assert result.critical_vehicle == 1.0


def test_noisy_radio_alters_no_delivered_frame() -> None:
    """Byte errors, lost bytes and lost packets cost frames, and nothing else."""
    talk = Talk(command.NOISY)
    talk.link()
    talk.run(120)
    assert talk.share() > 0.6
    assert sum(decoder.line_noise for decoder in talk.network.decoders.values()) > 10
    assert max(talk.arrivals.ages_s.values()) < OLDEST_S


@pytest.mark.parametrize("name", sorted(LINE_ATTACKS))
def test_attack_on_the_line_delivers_nothing(name: str) -> None:
    """No frame is forged, altered, repeated or late. When the attack ends, all frames arrive."""
    talk = Talk(command.SIK)
    talk.link()
    talk.run(5)
    interval_s = 15 if name == "line-hold" else 0.3
    attack = parse_line_attack(f"{name},interval_s={interval_s},limit=100")
    talk.network.attacker.change([attack], talk.network.now)
    talk.run(40)
    assert talk.network.interventions
    if name in ("line-forge", "line-replay"):  # these reach the core
        for end in (talk.network.alpha, talk.network.bravo):
            assert end.node.drops.total() + end.peer.traffic.drops.total() > 20
    assert max(talk.arrivals.ages_s.values()) < OLDEST_S
    talk.network.attacker.change([], talk.network.now)
    for place in ModemEnd:
        talk.network.modems.release(place, talk.network.now)
    talk.run(15)
    calm_since = talk.network.now
    talk.run(20)
    assert talk.share(calm_since) == 1.0


@pytest.mark.parametrize("end", list(ModemEnd))
@pytest.mark.parametrize("seconds", [2.0, 20.0])
def test_pulled_plug(end: ModemEnd, seconds: float) -> None:
    """A command and a heartbeat arrive in each direction about a second after the return, and nothing of before.

    If the noise destroys the first datagrams, within half a second more.
    """
    after_s = [_after_pull(seed, end, seconds) for seed in range(1, 8)]
    assert median(after_s) <= 1.1, after_s
    assert max(after_s) <= 1.5, after_s


def _after_pull(seed: int, end: ModemEnd, seconds: float) -> float:
    """How long after the return the first command of the later direction arrives."""
    talk = Talk(command.NOISY, seed)
    talk.link()
    talk.run(10)
    talk.network.pull(end)
    talk.run(seconds)
    back_at = talk.network.now
    talk.network.plug(end)
    sent: dict[int, list[bytes]] = {VEHICLE: [], STATION: []}
    for number in range(30):
        for system, frames in sent.items():
            message = mavlink.MAVLink_command_long_message(1, 1, 400, 0, number, 0, 0, 0, 0, 0, 1)
            frames.append(talk.send(Offered(back_at, system, message)))
        talk.network.run(talk.network.now + 0.1)
    talk.check()
    sent_at, ages_s = talk.arrivals.sent, talk.arrivals.ages_s
    first = [min(sent_at[raw][0] + ages_s[raw] for raw in frames if raw in ages_s) for frames in sent.values()]
    return max(first) - back_at
