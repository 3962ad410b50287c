"""How old frames come out at a receiver while an attacker stretches time. Run it to print the table of the figures.

::

    python -m tests.network.stretching
"""

from __future__ import annotations

from typing import NamedTuple

from tests.lab.mitm.middle import Middle
from tests.network.network import Drone, Flow, Network, every_second_may_be_old
from uavlinkd.lab.mitm.attacks import parse_attack
from uavlinkd.lab.mitm.radio import RadioSettings

ONE_EVERY_1_8_S = "direction=a>b,interval_s=1.8"
ATTACKS = {
    "handshakes blocked": f"stretch,{ONE_EVERY_1_8_S}",
    "answers dropped": f"stretch-one-way,{ONE_EVERY_1_8_S}",
    "other direction blocked": f"stretch-one-way,{ONE_EVERY_1_8_S},back=all",
    "handshakes pass": f"stretch,{ONE_EVERY_1_8_S},block_handshakes=false",
}
PACES_S = (0.07, 0.1, 0.2, 0.4, 0.8, 1.2, 1.8)
SESSION_S = 185.0
"""Longer than a session lives."""


class Oldest(NamedTuple):
    """The greatest age in seconds of a frame that came out."""

    must_be_new: float
    may_be_old: float


def oldest(flow: Flow) -> Oldest:
    """Of the frames of either kind."""
    ages: tuple[list[float], list[float]] = [0.0], [0.0]
    for number, at in flow.delivered.items():
        ages[number % 2].append(at - flow.sent_at[number])
    return Oldest(*map(max, ages))


def stretched(attack: str, seconds: float, *, answers: bool = True, interval_s: float = 0.05) -> tuple[Flow, Drone]:
    """What came out at b while an attacker delays what a sends; without ``answers`` b only listens."""
    with Network(f"stretched {attack} {answers}", RadioSettings(delay_s=0.02)) as network:
        network.screen = every_second_may_be_old
        middle, a, b = Middle.between(network)
        flow = network.traffic(a, b, interval_s)
        if answers:
            network.traffic(b, a, interval_s)
        network.run(3)
        middle.attack(parse_attack(attack).make(middle.context, 1, network.now))
        network.run(seconds)
        return flow, b


def main() -> None:
    """Print the oldest frames for each attack: of any pace, and of one envelope every 1.8 s."""
    for name, text in ATTACKS.items():
        for answers in (True, False):
            at_pace = {
                pace_s: oldest(stretched(text.replace("1.8", str(pace_s)), SESSION_S, answers=answers)[0])
                for pace_s in PACES_S
            }
            must_be_new = max(item.must_be_new for item in at_pace.values())
            may_be_old = max(item.may_be_old for item in at_pace.values())
            slowest = at_pace[PACES_S[-1]]
            print(
                f"{name}, receiver {'talks' if answers else 'listens'}:"
                f" every 1.8 s {slowest.must_be_new:.1f} / {slowest.may_be_old:.1f} s,"
                f" any pace {must_be_new:.1f} / {may_be_old:.1f} s (must be new / may be old)"
            )


if __name__ == "__main__":
    main()
