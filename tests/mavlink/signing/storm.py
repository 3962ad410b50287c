"""Millions of frames between a daemon's endpoint and an autopilot, with restarts, clocks that jump, and an attacker.

``python -m tests.mavlink.signing.storm --frames 10000000`` prints counts; exit status 1 if a rule was broken.

The judge is MAVLink's C library with ArduPilot's or PX4's list of unsigned messages. The wire loses and delays in
both directions, and reorders if it is a network. Stations' frames come in any order and more than once, as two paths
deliver them. The attacker reads the wire, repeats old frames to either end, sends frames back to their sender, alters
frames, makes frames with another key and without a signature, and withholds frames to deliver them later.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter, deque
from collections.abc import Sequence
from heapq import heappop, heappush
from random import Random
from typing import Final, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from tests.mavlink.signing.autopilot import ALWAYS_UNSIGNED
from tests.mavlink.signing.c_library import OK, OLD, SIGNATURES, VERIFIED, CAutopilot
from tests.mavlink.signing.wire import keyed
from tests.samples import ID, build, pack, read
from uavlinkd.config.model import LINK_ID
from uavlinkd.daemon.signing import RESERVE
from uavlinkd.mavlink.dialect import MESSAGES
from uavlinkd.mavlink.frames import Frame
from uavlinkd.mavlink.signing.endpoint_signing import EndpointSigning
from uavlinkd.mavlink.signing.signature import LAST_TIMESTAMP, Signer
from uavlinkd.protocol.crypto import Secret

KEY: Final = Secret(b"k" * 32)
STEP_S: Final = 0.001
"""Between two frames."""
LOSS: Final = 0.03
WITHHELD: Final = 0.003
OVERTAKEN: Final = 0.03
"""Frames that a network delays."""
DELAY_S: Final = (0.005, 0.2)
RECORDED: Final = 20_000
"""Frames that the attacker keeps of each direction, of any age."""
SETTLED_S: Final = 2.5
"""The longest time in which frames pass again: some of the wire's frames are lost."""
_UNKNOWN: Final = 12_345_678
_DAEMON, _AUTOPILOT, _ATTACKER = "daemon", "autopilot", "attacker"


class Sent(NamedTuple):
    """A frame on the wire."""

    raw: bytes
    sender: str
    number: int  # of a signed frame, in the order of signing at its end; -1: nobody signed it so
    event: int  # the last restart or jump of the autopilot that its sender could know


def stations_frames(random: Random) -> list[Frame]:
    """Frames of twelve senders: known and unknown messages, of each length, grown, signed, and of MAVLink 1."""
    frames: list[Frame] = []
    for sender in range(8):
        system = 250 - sender // 2
        for _ in range(30):
            kind = random.randrange(8)
            length = random.randint(1, 255)
            payload = random.randbytes(length - 1) + b"\1"
            if kind == 0:
                frames.append(read(build(_UNKNOWN, payload, system, crc_extra=random.randrange(256))))
            elif kind == 1:  # grown by extensions that this definition lacks
                longest = MESSAGES[ID["ATTITUDE"]][3]
                frames.append(read(build(ID["ATTITUDE"], random.randbytes(longest + 9) + b"\1", system)))
            elif kind == 2:
                frames.append(read(build(ID["ENCAPSULATED_DATA"], random.randbytes(254) + b"\1", system)))
            elif kind == 3:
                message = mavlink.MAVLink_attitude_message(1, 2, 3, 4, 5, 6, 7)
                frames.append(read(pack(message, system, 190 + sender % 2, signed=True)))
            elif kind == 4:
                message = mavlink.MAVLink_param_request_list_message(1, 1)
                frames.append(read(pack(message, system, version=1)))
            else:
                message = mavlink.MAVLink_command_long_message(1, 1, 400, 0, 1, 2, 3, 4, 5, 6, length)
                frames.append(read(pack(message, system, 190 + sender % 2, seq=length)))
    return frames


class Storm:
    """One run. ``counts`` has what happened, ``faults`` the broken rules."""

    def __init__(self, kind: str, seed: int, *, is_ordered: bool) -> None:
        self.counts = Counter[str]()
        self.faults = Counter[str]()
        self.drops = Counter[str]()
        self.slowest_s = 0.0
        self._kind, self._is_ordered, self._random = kind, is_ordered, Random(seed)
        self._now = 0.0
        self._wire: list[tuple[float, int, bool, Sent]] = []
        self._steps = 0
        self._stations = stations_frames(self._random)
        self._other = Signer(Secret(b"x" * 32))
        self._event = 0  # counts the autopilot's restarts and jumps of its clock
        self._settled = 0  # the event after which the daemon has passed a frame
        self._since = 0.0  # when the last restart or jump was, of either end
        self._is_new_life = False  # the autopilot was restarted, and no question reached it since
        self._signed = self._made = self._first_of_life = 0
        self._caught: set[bytes] = set()  # senders of which it accepted, since its start, only frames from before
        self._records: dict[bool, list[Sent]] = {True: [], False: []}  # by: goes to the daemon
        self._recent: dict[bool, deque[Sent]] = {True: deque(maxlen=50), False: deque(maxlen=50)}
        self._withheld: list[tuple[bool, Sent]] = []
        self._taken: dict[bytes, int] = {}  # at the autopilot, by sender: the number of the last frame
        self._taken_ever = bytearray()
        self._passed = -1
        self.autopilot = keyed(CAutopilot(kind), KEY)
        self._start_daemon()

    # Ends.

    def _start_daemon(self) -> None:
        self._signing = EndpointSigning(KEY, LINK_ID, self._random.randbytes, self.drops)
        self._signing.send = lambda raw: self._sign(read(raw), "daemon")
        self._settled, self._since = -1, self._now

    def _sign(self, frame: Frame, source: str) -> None:
        for signed in self._signing.sign([frame], source):
            self._signed += 1
            self._taken_ever.append(0)
            self._put(Sent(signed.raw, _DAEMON, self._signed - 1, self._settled), to_daemon=False)

    def _make(self, message: int, payload: bytes) -> None:
        raw = self.autopilot.send_payload(message, payload, MESSAGES[message][1])
        self._made += 1
        self._put(Sent(raw, _AUTOPILOT, self._made - 1, self._event), to_daemon=True)

    def _put(self, sent: Sent, *, to_daemon: bool) -> None:
        random = self._random.random
        self._recent[to_daemon].append(sent)
        records = self._records[to_daemon]
        if len(records) < RECORDED:
            records.append(sent)
        elif random() < 0.05:
            records[int(random() * RECORDED)] = sent
        if (chosen := random()) < LOSS:
            self.counts["lost"] += 1
        elif chosen < LOSS + WITHHELD:
            self._withheld.append((to_daemon, sent))
        else:
            self._deliver(sent, to_daemon=to_daemon)

    def _deliver(self, sent: Sent, *, to_daemon: bool) -> None:
        least, most = DELAY_S
        is_late = not self._is_ordered and self._random.random() < OVERTAKEN
        delay = self._random.uniform(least, most) if is_late else least
        self._steps += 1
        heappush(self._wire, (self._now + delay, self._steps, to_daemon, sent))

    # What arrives.

    def _arrive(self, sent: Sent, *, at_daemon: bool) -> None:
        if at_daemon:
            self._at_daemon(sent)
        else:
            self._at_autopilot(sent)

    def _at_autopilot(self, sent: Sent) -> None:
        verdicts = self.autopilot.judge(sent.raw)
        if not verdicts or verdicts[-1].end < len(sent.raw):  # the attacker altered its length
            self.autopilot.judge(bytes(300))  # the rest of the frame that was begun
            return
        verdict = verdicts[-1]  # of an unknown message there is one behind its checksum, too
        is_taken = verdict.signature == VERIFIED
        sender = sent.raw[5:7]
        last = self._taken.get(sender, -1)
        if sent.sender == _ATTACKER and sent.number < 0:
            if verdict.framing == OK and (is_taken or verdict.message not in ALWAYS_UNSIGNED[self._kind]):
                self.faults["the autopilot accepts what the attacker made"] += 1
            return
        if sent.sender == _AUTOPILOT:
            self.counts["autopilot: own frames that the attacker sends back, accepted"] += is_taken
            return
        is_late = sent.number <= last or bool(self._taken_ever[sent.number])
        if is_taken and is_late:
            if self._is_new_life or sender in self._caught:
                self.counts["autopilot: replays accepted, begun between its start and the first question"] += 1
            else:
                self.faults["the autopilot accepts a replay"] += 1
        elif not is_taken and not is_late and sent.sender == _DAEMON:
            if last < 0 and not self._is_ordered and verdict.signature == OLD:
                self.counts["autopilot: rejected, a new sender's frame that a question has overtaken"] += 1
            elif sent.event == self._event:
                self.faults[f"the autopilot rejects a frame in order: {SIGNATURES[verdict.signature]}"] += 1
            self.counts["autopilot: rejected, under way at a restart or jump of a clock"] += 1
        if is_taken:
            self.counts["autopilot: accepted"] += 1
            self._taken[sender] = max(last, sent.number)
            change = self._caught.add if sent.number < self._first_of_life else self._caught.discard
            change(sender)
            self._taken_ever[sent.number] = 1
            if verdict.message == ID["TIMESYNC"]:
                self._is_new_life = self._is_new_life and sent.number < self._first_of_life
                (question,) = mavlink.MAVLink(None).parse_buffer(sent.raw)
                self._make(ID["TIMESYNC"], (7).to_bytes(8, "little") + question.ts1.to_bytes(8, "little"))
        elif is_late:
            self.counts["autopilot: late or repeated, rejected"] += 1

    def _at_daemon(self, sent: Sent) -> None:
        was_proven = self._signing.is_proven
        frame = read(sent.raw)
        drops = Counter(self.drops) if sent.sender == _AUTOPILOT else self.drops
        passed = self._signing.accept([frame], self._now)
        is_late = sent.number <= self._passed
        if passed and sent.sender != _AUTOPILOT:
            self.faults["the daemon passes what the attacker made or sent back"] += 1
        elif passed:
            if is_late:
                self.faults["the daemon passes a replay"] += 1
            elif not was_proven:
                self.faults["the daemon passes a frame before an answer"] += 1
            self.counts["daemon: passed"] += 1
            self._passed = max(self._passed, sent.number)
            if self._settled != sent.event == self._event:
                self._settled = sent.event
                self.slowest_s = max(self.slowest_s, self._now - self._since)
        elif sent.sender == _AUTOPILOT and not is_late:
            is_answer = frame.header.msgid == ID["TIMESYNC"]
            if self._settled == sent.event == self._event and not is_answer:
                reasons = ", ".join(self.drops - drops)
                self.faults[f"the daemon drops a frame in order: {reasons}"] += 1
            self._passed = sent.number if is_answer and self._signing.is_proven else self._passed

    # What happens.

    def step(self) -> None:
        """One frame, sent by somebody, and all that arrive until the next one."""
        self._now += STEP_S
        while self._wire and self._wire[0][0] <= self._now:
            _, _, at_daemon, sent = heappop(self._wire)
            self._arrive(sent, at_daemon=at_daemon)
        random = self._random.random
        chosen = random()
        if chosen < 0.5:
            frame = self._stations[int(random() * len(self._stations))]
            self._sign(frame, str(frame.header.system))
            if chosen < 0.02:
                self._sign(frame, "another path")
        elif chosen < 0.55:
            self._make(ID["HEARTBEAT"], bytes((1, 0, 0, 0, 2, 3, 0, 4, 3)))
        elif chosen < 0.9:
            self._make(ID["ATTITUDE"], b"1234" * 7)
        else:
            self._attack()

    def _attack(self) -> None:
        random = self._random
        self.counts["attacker: frames"] += 1
        to_daemon = random.random() < 0.5
        source = random.choice((self._records, self._recent))[not to_daemon if random.random() < 0.2 else to_daemon]
        if not source:
            return
        chosen = source[int(random.random() * len(source))]
        kind = random.randrange(6)
        if kind < 2:  # a replay, or sent back
            sent = chosen
            if sent.sender == _DAEMON and not to_daemon:
                sent = sent._replace(sender=_ATTACKER)
        elif kind == 2 and self._withheld:
            to_daemon, sent = self._withheld.pop(int(random.random() * len(self._withheld)))
            if sent.sender == _DAEMON:
                sent = sent._replace(sender=_ATTACKER)
        elif kind == 3:  # without a signature, or with one of another key
            message = random.choice(
                (mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3), mavlink.MAVLink_attitude_message(*range(7)))
            )
            raw = pack(message, random.choice((1, 250, 255)), 1)
            if random.random() < 0.5:
                raw = self._other.sign(
                    raw, random.choice((1, 3)), random.choice((5, LAST_TIMESTAMP, self._signing.timestamp + 9))
                )
            sent = Sent(raw, _ATTACKER, -1, 0)
        else:  # a new timestamp, link or payload under an old signature
            altered = bytearray(chosen.raw)
            at = random.choice((-13, -12, -9, -6, -1, 10))
            altered[at] ^= random.randint(1, 255)
            raw = bytes(altered)
            if at > 0:
                payload, message = raw[10 : 10 + raw[1]], int.from_bytes(raw[7:10], "little")
                raw = build(message, payload, raw[5], signature=raw[-13:])
            sent = Sent(raw, _ATTACKER, -1, 0)
        self._deliver(sent, to_daemon=to_daemon)

    def restart_daemon(self) -> None:
        self.counts["restarts of the daemon"] += 1
        stored = self._signing.timestamp + RESERVE
        self._start_daemon()
        self._signing.timestamp = stored

    def restart_autopilot(self) -> None:
        self.counts["restarts of the autopilot"] += 1
        self.autopilot.restart()
        self._taken, self._is_new_life, self._first_of_life, self._caught = {}, True, self._signed, set()
        self._event, self._since = self._event + 1, self._now

    def power_off(self) -> None:
        """Both ends restart, and nothing is under way."""
        self._wire.clear()
        self.restart_autopilot()
        self.restart_daemon()

    def save(self) -> None:
        self.autopilot.save()

    def jump(self, timestamp: int) -> None:
        """The autopilot's satellites tell another time."""
        self.counts["jumps of the autopilot's clock"] += 1
        self.autopilot.set_time(timestamp)
        self._event, self._since = self._event + 1, self._now


def run(
    kind: str,
    frames: int,
    seed: int,
    *,
    is_ordered: bool,
    restarts: int = 100,
) -> Storm:
    """A run of so many frames, with so many restarts of each end, and jumps of the clock between them.

    Each third restart is one of both ends.
    """
    storm = Storm(kind, seed, is_ordered=is_ordered)
    every = max(frames // (restarts + 1), int(2 * SETTLED_S / STEP_S))
    for number in range(frames):
        storm.step()
        part = number % every
        if part == every // 2:
            storm.restart_daemon()
        elif part == every - 1:
            if number // every % 3 == 2:
                storm.power_off()
            else:
                storm.restart_autopilot()
        elif part == every // 4:
            storm.jump(Random(seed + number).choice((0, 2**40, storm.autopilot.timestamp + 2**36)))
        if number % min(30_000, every // 3) == 0:
            storm.save()
    return storm


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status 0: no rule was broken."""
    parser = argparse.ArgumentParser(prog="python -m tests.mavlink.signing.storm", description=__doc__)
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    faults = Counter[str]()
    for kind in ("ardupilot", "px4"):
        for is_ordered in (True, False):
            storm = run(kind, options.frames // 4, options.seed, is_ordered=is_ordered)
            print(
                f"\n{kind}, {'a cable' if is_ordered else 'a network'}; passes again within {storm.slowest_s:.2f} s"
            )
            print("\n".join(f"{count:12,} {name}" for name, count in sorted((storm.counts + storm.drops).items())))
            faults += storm.faults
    print("\n".join(f"{count:12,} FAULT {name}" for name, count in faults.items()) or "\nno fault")
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
