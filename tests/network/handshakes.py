"""The time of a handshake over a link that loses datagrams at random in each direction."""

from __future__ import annotations

from functools import partial

from tests.network.network import Network, share_a_session
from uavlinkd.lab.mitm.radio import RadioSettings

MODES = ("both know", "one knows")
"""The ends with a configured address of the other, which initiate."""
SHARES = (0.5, 0.9, 0.99, 0.999, 1.0)


def handshake_time(mode: str, loss: float, seed: int) -> float:
    """Seconds from the start of both ends to a session that both send on. The same for the same arguments."""
    with Network(f"loss {mode} {loss} {seed}", RadioSettings(loss=loss, delay_s=0.05)) as network:
        a, b = network.add("a"), network.add("b")
        a.knows(b, b.addresses)
        b.knows(a, a.addresses if mode == "both know" else ())
        a.start()
        b.start()
        network.talk(a, b, interval_s=0.1)
        return network.run_until(partial(share_a_session, a, b), within_s=60)


def distribution(times: list[float]) -> dict[str, float]:
    """The time within which each share of the handshakes completed."""
    times = sorted(times)
    return {f"{share:.1%}": round(times[int(share * (len(times) - 1))], 2) for share in SHARES}


def broken(times: list[float]) -> str:
    """The violation of the bound, if any: 99 % within 3 s, all within 10 s."""
    in_time = sum(time_s <= 3 for time_s in times) / len(times)
    if in_time < 0.99:
        return f"only {in_time:.2%} within 3 s"
    return f"one took {max(times):.1f} s" if max(times) > 10 else ""
